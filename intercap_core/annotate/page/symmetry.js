/* Symmetry of the object: rotations that leave its appearance unchanged. A slider rotates the drawn
 * object as a check. The symmetry belongs to the object and all its sequences, and has its own save
 * button. */
import { get, post } from "./api.js";
import { ask, button, make } from "./dom.js";
import { rigid, compose } from "./geometry.js";

// Choices of the page: text, entry `symmetry` of objects.yaml, and axis of the slider
const AXES = { x: [1, 0, 0], y: [0, 1, 0], z: [0, 0, 1] };
const half = ([x, y, z]) => [[2 * x - 1, 0, 0, 0], [0, 2 * y - 1, 0, 0], [0, 0, 2 * z - 1, 0], [0, 0, 0, 1]].flat();
const CHOICES = {
  none: ["none", {}, null],
  ...Object.fromEntries(Object.entries(AXES).map(([name, axis]) => [`any_${name}`, [`any rotation about its ${name} axis`, { continuous: [{ axis }] }, axis]])),
  ...Object.fromEntries(Object.entries(AXES).map(([name, axis]) => [`half_${name}`, [`half a turn about its ${name} axis`, { discrete: [half(axis)] }, axis]])),
  sphere: ["any rotation: a ball", { sphere: true }, AXES.x],
};

const CUSTOM = "custom"; // a symmetry in objects.yaml that the page does not offer

export class SymmetryEditor {
  constructor(app) {
    this.app = app;
    this.stored = null;
    this.choice = "";
    this.angle = 0;
  }

  get path() { return `sequences/${this.app.info.sequence}/symmetry`; }

  /* The object's pose, rotated by the slider. */
  rotated(pose) {
    const axis = CHOICES[this.choice]?.[2];
    if (!pose || !axis || !this.angle || this.app.open !== "object" || this.app.mode) return pose;
    return compose(pose, rigid(axis.map((v) => v * this.angle), [0, 0, 0]));
  }

  async load() {
    try { this.#load(await get(this.path)); } catch (error) { this.app.say(error.message); }
    this.app.panels();
  }

  #load(stored) {
    this.stored = stored;
    const settings = JSON.stringify(canonical(stored.symmetry));
    this.saved = Object.keys(CHOICES).find((name) => JSON.stringify(canonical(CHOICES[name][1])) === settings) ?? CUSTOM;
    this.choice = this.saved;
  }

  async save() {
    const [text, symmetry] = CHOICES[this.choice];
    const answer = await ask(`Save ${this.stored.path}`, make("p", {}, `Symmetry of the object: ${text}. In all ${this.stored.sequences} sequences of this object, the stages from object_track on become stale.`), [["save", "Save", true], ["", "Cancel"]]);
    if (!answer) return;
    try {
      this.#load(await post(this.path, { symmetry, digest: this.stored.digest }));
      this.app.say("saved");
    } catch (error) { this.app.say(error.message); }
    this.app.panels();
  }

  panel() {
    const head = make("h2", {}, "Symmetry");
    if (!this.stored) return make("div", {}, head, button("Show the symmetry", () => this.load()));
    const names = [...Object.keys(CHOICES), ...(this.saved === CUSTOM ? [CUSTOM] : [])];
    const choose = make("select", { "aria-label": "Symmetry of the object", onchange: () => { this.choice = choose.value; this.angle = 0; this.app.panels(); this.app.redraw(); } },
      names.map((name) => new Option(CHOICES[name]?.[0] ?? "as in objects.yaml", name, false, name === this.choice)));
    const slider = make("input", { type: "range", "aria-label": "Rotation of the drawn object, degrees", min: "0", max: "360", step: "1", value: String((this.angle * 180) / Math.PI), oninput: () => { this.angle = (slider.valueAsNumber * Math.PI) / 180; this.app.redraw(); } });
    return make("div", {}, head, choose, CHOICES[this.choice]?.[2] ? make("label", {}, " rotate the drawn object ", slider) : null,
      this.choice !== this.saved && CHOICES[this.choice] ? button("Save the symmetry…", () => this.save(), { class: "main" }) : null);
  }
}

/* A symmetry with all defaults filled in and all elements as numbers. */
const canonical = ({ discrete = [], continuous = [], sphere = false }) => ({
  discrete: discrete.map((matrix) => matrix.map(Number)), sphere,
  continuous: continuous.map(({ axis, offset = [0, 0, 0] }) => ({ axis: axis.map(Number), offset: offset.map(Number) })),
});
