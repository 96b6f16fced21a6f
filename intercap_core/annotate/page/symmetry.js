/* How the object can be turned and look the same. A slider turns the drawn object, so that one sees
 * whether it does; the choice is of the object, for all its sequences, and saved by its own button. */
import { get, post } from "./api.js";
import { ask, button, make } from "./dom.js";
import { rigid, compose } from "./geometry.js";

const AXES = { x: [1, 0, 0], y: [0, 1, 0], z: [0, 0, 1] };
const half = ([x, y, z]) => [[2 * x - 1, 0, 0, 0], [0, 2 * y - 1, 0, 0], [0, 0, 2 * z - 1, 0], [0, 0, 0, 1]].flat();
const CHOICES = {
  none: ["looks the same in no other turn", {}, null],
  ...Object.fromEntries(Object.entries(AXES).map(([name, axis]) => [`any_${name}`, [`any turn about its ${name}`, { continuous: [{ axis }] }, axis]])),
  ...Object.fromEntries(Object.entries(AXES).map(([name, axis]) => [`half_${name}`, [`half a turn about its ${name}`, { discrete: [half(axis)] }, axis]])),
  sphere: ["any turn at all: a ball", { sphere: true }, AXES.x],
};

export class SymmetryEditor {
  constructor(app) {
    this.app = app;
    this.told = null;
    this.choice = "";
    this.angle = 0;
  }

  get path() { return `sequences/${this.app.told.sequence}/symmetry`; }

  /* The object's pose with the turn that is tried. */
  turned(pose) {
    const axis = CHOICES[this.choice]?.[2];
    if (!pose || !axis || !this.angle || this.app.open !== "object" || this.app.mode) return pose;
    return compose(pose, rigid(axis.map((v) => v * this.angle), [0, 0, 0]));
  }

  async load() {
    try { this.#take(await get(this.path)); } catch (error) { this.app.say(error.message); }
    this.app.panels();
  }

  #take(told) {
    this.told = told;
    const own = JSON.stringify(plain(told.symmetry));
    this.own = Object.keys(CHOICES).find((name) => JSON.stringify(plain(CHOICES[name][1])) === own) ?? "as written";
    this.choice = this.own;
  }

  async save() {
    const [text, symmetry] = CHOICES[this.choice];
    const answer = await ask(`Save ${this.told.path}`, make("p", {}, `The object: ${text}. ${this.told.sequences} sequences have it: a run makes them anew from object_track on.`), [["save", "Save", true], ["", "Cancel"]]);
    if (!answer) return;
    try {
      this.#take(await post(this.path, { symmetry, digest: this.told.digest }));
      this.app.say("saved");
    } catch (error) { this.app.say(error.message); }
    this.app.panels();
  }

  panel() {
    const head = make("h2", {}, "What looks the same");
    if (!this.told) return make("div", {}, head, button("Show its symmetry", () => this.load()));
    const names = [...Object.keys(CHOICES), ...(this.own === "as written" ? ["as written"] : [])];
    const choose = make("select", { onchange: () => { this.choice = choose.value; this.angle = 0; this.app.panels(); this.app.redraw(); } },
      names.map((name) => new Option(CHOICES[name]?.[0] ?? "as objects.yaml has it", name, false, name === this.choice)));
    choose.setAttribute("aria-label", "Symmetry of the object");
    const slider = make("input", { type: "range", min: "0", max: "360", step: "1", value: String((this.angle * 180) / Math.PI), oninput: () => { this.angle = (slider.valueAsNumber * Math.PI) / 180; this.app.redraw(); } });
    slider.setAttribute("aria-label", "Turn the drawn object by, degrees");
    return make("div", {}, head, choose, CHOICES[this.choice]?.[2] ? make("label", {}, " turn it to see ", slider) : null,
      this.choice !== this.own && CHOICES[this.choice] ? button("Save the symmetry…", () => this.save(), { class: "main" }) : null);
  }
}

/* Without what is so by default, and numbers as numbers. */
const plain = ({ discrete = [], continuous = [], sphere = false }) => ({
  discrete: discrete.map((one) => one.map(Number)), sphere,
  continuous: continuous.map(({ axis, offset = [0, 0, 0] }) => ({ axis: axis.map(Number), offset: offset.map(Number) })),
});
