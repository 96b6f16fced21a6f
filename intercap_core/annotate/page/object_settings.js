/* Settings of the object in objects.yaml: the surface that people are likely to touch, painted in any view, and
 * the symmetry, the rotations that leave its appearance unchanged. They belong to the object and all its
 * sequences, and therefore have their own save buttons. */
import { get, post } from "./api.js";
import { ask, button, make } from "./dom.js";
import { apply, compose, rigid, rotate } from "./geometry.js";

class ObjectSetting {
  constructor(app, name) {
    this.app = app;
    this.path = `${app.path}/${name}`;
    this.stored = null; // as the server has sent it
  }

  /* Fetch the setting once; returns whether it is known. */
  async load() {
    try { if (!this.stored) this.take(await get(this.path)); } catch (error) { this.app.say(error.message); }
    this.app.panels();
    return this.stored !== null;
  }

  /* Save `values` after the user has seen their `effect`. */
  async store(effect, values) {
    const answer = await ask(`Save ${this.stored.path}`, make("p", {}, effect), [["save", "Save", true], ["", "Cancel"]]);
    if (!answer) return;
    try {
      this.take(await post(this.path, { ...values, digest: this.stored.digest }));
      this.app.say("saved");
    } catch (error) { this.app.say(error.message); }
    this.app.panels();
  }
}

/* --- contact surface ---------------------------------------------------------------------------- */
const BRUSH_PX = 14; // radius on the screen
// Share of the object's diameter: vertices that are farther behind the nearest one are not painted.
const DEPTH_RANGE = 0.04;

export class Paint extends ObjectSetting {
  /* `before`: the earlier instance, whose unsaved strokes are kept if the mesh is the same. */
  constructor(app, object, before = null) {
    super(app, "surface");
    const { vertices, faces } = object.arrays;
    this.vertices = vertices;
    this.normals = normalsOf(vertices, faces);
    this.size = object.header.diameter;
    this.painted = new Set();
    this.strokes = [];
    this.redoStrokes = [];
    if (before?.changed) {
      const { vertices: old } = before;
      if (old.length === vertices.length && old.every((v, k) => v === vertices[k])) {
        const { stored, saved, painted, strokes, redoStrokes } = before;
        Object.assign(this, { stored, saved, painted, strokes, redoStrokes });
      } else app.say("the object's mesh has changed: unsaved paint on the old mesh was discarded");
    }
  }

  get hint() { return "Paint where people touch the object; Shift erases, the wheel zooms, Ctrl+Z undoes a stroke. Esc ends."; }

  async start() {
    const { app } = this;
    if (!app.pose.at(app.frame)) { app.say("the object has no pose in this frame; place it first"); return; }
    if (!await this.load()) return;
    app.setMode(this);
    app.following = false;
    app.views.zoomTo(app.middle(), 0.9 * this.size);
  }

  take(stored) {
    this.stored = stored;
    this.saved = new Set(stored.vertices);
    this.painted = new Set(stored.vertices);
    this.strokes = [];
    this.redoStrokes = [];
  }

  /* Vertices that face a view: { id, at: position on its canvas, depth }. */
  #visible(view) {
    const { app } = this, pose = app.pose.at(app.frame), visible = [];
    if (!pose || !view.camera.pose) return visible;
    for (let v = 0; v < this.vertices.length / 3; v += 1) {
      const vertex = [this.vertices[3 * v], this.vertices[3 * v + 1], this.vertices[3 * v + 2]];
      const point = apply(pose, vertex), inCamera = apply(view.camera.pose, point);
      const normal = rotate(view.camera.pose, rotate(pose, [this.normals[3 * v], this.normals[3 * v + 1], this.normals[3 * v + 2]]));
      if (normal[0] * inCamera[0] + normal[1] * inCamera[1] + normal[2] * inCamera[2] >= 0) continue;
      const at = app.views.place(view, point);
      if (at) visible.push({ id: v, at, depth: inCamera[2] });
    }
    return visible;
  }

  press(view, event) {
    if (event.button !== 0) return null;
    const visible = this.#visible(view), before = new Set(this.painted), scale = view.width / view.canvas.clientWidth;
    const dab = (next) => {
      const box = view.canvas.getBoundingClientRect();
      const [x, y] = [(next.clientX - box.left) * scale, (next.clientY - box.top) * scale];
      const under = visible.filter(({ at }) => Math.hypot(at[0] - x, at[1] - y) < BRUSH_PX * scale);
      const nearest = Math.min(...under.map(({ depth }) => depth));
      for (const { id, depth } of under) {
        if (depth > nearest + DEPTH_RANGE * this.size) continue;
        if (next.shiftKey) this.painted.delete(id); else this.painted.add(id);
      }
      this.app.redraw();
    };
    dab(event);
    return { move: dab, end: () => { this.strokes.push(before); this.redoStrokes = []; this.app.panels(); } };
  }

  undo() { this.#swap(this.strokes, this.redoStrokes); }

  redo() { this.#swap(this.redoStrokes, this.strokes); }

  #swap(from, to) {
    const next = from.pop();
    if (next) {
      to.push(this.painted);
      this.painted = next;
    }
    this.app.redraw();
    this.app.panels();
  }

  mark(view, brush) {
    brush.fillStyle = "#ff3df2";
    for (const { id, at } of this.#visible(view)) {
      if (this.painted.has(id)) brush.fillRect(at[0] - 1.5, at[1] - 1.5, 3, 3);
    }
  }

  get changed() { return this.stored && (this.painted.size !== this.saved.size || [...this.painted].some((id) => !this.saved.has(id))); }

  save() {
    const added = [...this.painted].filter((id) => !this.saved.has(id)).length;
    const removed = [...this.saved].filter((id) => !this.painted.has(id)).length;
    return this.store(`${added} vertices are added and ${removed} removed; ${this.painted.size} are painted. The stages that use this list become stale in all ${this.stored.sequences} sequences of this object.`,
      { vertices: [...this.painted] });
  }

  panel() {
    const { app } = this, on = app.mode === this;
    return make("div", {}, make("h2", {}, "Contact surface"),
      this.stored ? make("p", {}, `${this.painted.size} of ${this.vertices.length / 3} vertices are painted. The list belongs to the object and all its sequences.`) : null,
      on ? button("Done", () => app.setMode(null), { title: "Esc" }) : button("Paint the contact surface", () => this.start()),
      this.changed ? button("Save the surface…", () => this.save(), { class: "main" }) : null);
  }
}

/* Normals of the vertices, not of unit length: sums of the faces' normals, weighted by area. */
function normalsOf(vertices, faces) {
  const normals = new Float32Array(vertices.length);
  const at = (v) => [vertices[3 * v], vertices[3 * v + 1], vertices[3 * v + 2]];
  for (let f = 0; f < faces.length; f += 3) {
    const [a, b, c] = [at(faces[f]), at(faces[f + 1]), at(faces[f + 2])];
    const u = b.map((x, i) => x - a[i]), w = c.map((x, i) => x - a[i]);
    const n = [u[1] * w[2] - u[2] * w[1], u[2] * w[0] - u[0] * w[2], u[0] * w[1] - u[1] * w[0]];
    for (let k = 0; k < 3; k += 1) for (let i = 0; i < 3; i += 1) normals[3 * faces[f + k] + i] += n[i];
  }
  return normals;
}

/* --- symmetry ----------------------------------------------------------------------------------- */
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

export class SymmetryEditor extends ObjectSetting {
  constructor(app) {
    super(app, "symmetry");
    this.choice = "";
    this.angle = 0;
  }

  /* The object's pose, rotated by the slider. */
  rotated(pose) {
    const axis = CHOICES[this.choice]?.[2];
    if (!pose || !axis || !this.angle || this.app.open !== "object" || this.app.mode) return pose;
    return compose(pose, rigid(axis.map((v) => v * this.angle), [0, 0, 0]));
  }

  take(stored) {
    this.stored = stored;
    const settings = JSON.stringify(canonical(stored.symmetry));
    this.saved = Object.keys(CHOICES).find((name) => JSON.stringify(canonical(CHOICES[name][1])) === settings) ?? CUSTOM;
    this.choice = this.saved;
  }

  save() {
    const [text, symmetry] = CHOICES[this.choice];
    return this.store(`Symmetry of the object: ${text}. In all ${this.stored.sequences} sequences of this object, the stages from object_track on become stale.`, { symmetry });
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
