/* Painting of the surface that people are likely to touch, in any view. The list belongs to the object
 * and all its sequences, and therefore has its own save button. */
import { get, post } from "./api.js";
import { ask, button, make } from "./dom.js";
import { apply, rotate } from "./geometry.js";

const BRUSH_PX = 14; // radius on the screen
// Share of the object's diameter: vertices that are farther behind the nearest one are not painted.
const DEPTH_RANGE = 0.04;

export class Paint {
  /* `before`: the earlier instance, whose unsaved strokes are kept if the mesh is the same. */
  constructor(app, object, before = null) {
    this.app = app;
    const { vertices, faces } = object.arrays;
    this.vertices = vertices;
    this.normals = normalsOf(vertices, faces);
    this.size = object.header.diameter;
    this.surface = null;
    this.painted = new Set();
    this.strokes = [];
    this.redoStrokes = [];
    if (before?.changed) {
      const { vertices: old } = before;
      if (old.length === vertices.length && old.every((v, k) => v === vertices[k])) {
        const { surface, saved, painted, strokes, redoStrokes } = before;
        Object.assign(this, { surface, saved, painted, strokes, redoStrokes });
      } else app.say("the object's mesh has changed: unsaved paint on the old mesh was discarded");
    }
  }

  get hint() { return "Paint where people touch the object; Shift erases, the wheel zooms, Ctrl+Z undoes a stroke. Esc ends."; }

  get path() { return `sequences/${this.app.info.sequence}/surface`; }

  async start() {
    const { app } = this;
    if (!app.pose.at(app.frame)) { app.say("the object has no pose in this frame; place it first"); return; }
    try {
      if (!this.surface) this.#load(await get(this.path));
    } catch (error) { app.say(error.message); return; }
    app.setMode(this);
    app.following = false;
    app.views.zoomTo(app.middle(), 0.9 * this.size);
  }

  #load(surface) {
    this.surface = surface;
    this.saved = new Set(surface.vertices);
    this.painted = new Set(surface.vertices);
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

  get changed() { return this.surface && (this.painted.size !== this.saved.size || [...this.painted].some((id) => !this.saved.has(id))); }

  async save() {
    const added = [...this.painted].filter((id) => !this.saved.has(id)).length;
    const removed = [...this.saved].filter((id) => !this.painted.has(id)).length;
    const answer = await ask(`Save ${this.surface.path}`, make("p", {}, `${added} vertices are added and ${removed} removed; ${this.painted.size} are painted. The stages that use this list become stale in all ${this.surface.sequences} sequences of this object.`),
      [["save", "Save", true], ["", "Cancel"]]);
    if (!answer) return;
    try {
      this.#load(await post(this.path, { vertices: [...this.painted], digest: this.surface.digest }));
      this.app.say("saved");
    } catch (error) { this.app.say(error.message); }
    this.app.panels();
  }

  panel() {
    const { app } = this, on = app.mode === this;
    return make("div", {}, make("h2", {}, "Contact surface"),
      this.surface ? make("p", {}, `${this.painted.size} of ${this.vertices.length / 3} vertices are painted. The list belongs to the object and all its sequences.`) : null,
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
