/* Where people are likely to touch the object, painted on its mesh in any view. The list is of the
 * object: all sequences that have it share it, so it is saved by a button of its own. */
import { get, post } from "./api.js";
import { ask, button, make } from "./dom.js";
import { apply, turnOnly } from "./geometry.js";

const BRUSH_PX = 14; // of the screen
const BEHIND = 0.04; // of the object's size: what lies this much behind the nearest is not painted

export class Paint {
  /* `before`: the one until now, whose strokes go on where the mesh is the same. */
  constructor(app, object, before = null) {
    this.app = app;
    const { vertices, faces } = object.arrays;
    this.vertices = vertices;
    this.normals = normalsOf(vertices, faces);
    this.size = object.header.diameter;
    this.told = null;
    this.painted = new Set();
    this.strokes = [];
    this.undone = [];
    if (before?.changed) {
      const { vertices: own } = before;
      if (own.length === vertices.length && own.every((v, k) => v === vertices[k])) {
        const { told, saved, painted, strokes, undone } = before;
        Object.assign(this, { told, saved, painted, strokes, undone });
      } else app.say("the object has another mesh by now: what was painted and not saved was of the old one, and is gone");
    }
  }

  get hint() { return "Paint where people touch the object; Shift erases, the wheel zooms, Ctrl+Z undoes a stroke. Esc ends."; }

  get path() { return `sequences/${this.app.told.sequence}/surface`; }

  async start() {
    const { app } = this;
    if (!app.pose.at(app.frame)) { app.say("the object is not in this frame; place it first"); return; }
    try {
      if (!this.told) this.#take(await get(this.path));
    } catch (error) { app.say(error.message); return; }
    app.setMode(this);
    app.near = false;
    app.views.near(app.middle(), 0.9 * this.size);
  }

  #take(told) {
    this.told = told;
    this.saved = new Set(told.vertices);
    this.painted = new Set(told.vertices);
    this.strokes = [];
    this.undone = [];
  }

  /* Vertices that a view sees from ahead: { id, at: on its canvas, depth }. */
  #seen(view) {
    const { app } = this, pose = app.pose.at(app.frame), found = [];
    if (!pose || !view.camera.pose) return found;
    for (let v = 0; v < this.vertices.length / 3; v += 1) {
      const own = [this.vertices[3 * v], this.vertices[3 * v + 1], this.vertices[3 * v + 2]];
      const point = apply(pose, own), ahead = apply(view.camera.pose, point);
      const normal = turnOnly(view.camera.pose, turnOnly(pose, [this.normals[3 * v], this.normals[3 * v + 1], this.normals[3 * v + 2]]));
      if (normal[0] * ahead[0] + normal[1] * ahead[1] + normal[2] * ahead[2] >= 0) continue;
      const at = app.views.place(view, point);
      if (at) found.push({ id: v, at, depth: ahead[2] });
    }
    return found;
  }

  press(view, event) {
    if (event.button !== 0) return null;
    const seen = this.#seen(view), before = new Set(this.painted), scale = view.width / view.canvas.clientWidth;
    const dab = (next) => {
      const box = view.canvas.getBoundingClientRect();
      const [x, y] = [(next.clientX - box.left) * scale, (next.clientY - box.top) * scale];
      const under = seen.filter(({ at }) => Math.hypot(at[0] - x, at[1] - y) < BRUSH_PX * scale);
      const nearest = Math.min(...under.map((one) => one.depth));
      for (const { id, depth } of under) {
        if (depth > nearest + BEHIND * this.size) continue;
        if (next.shiftKey) this.painted.delete(id); else this.painted.add(id);
      }
      this.app.redraw();
    };
    dab(event);
    return { move: dab, end: () => { this.strokes.push(before); this.undone = []; this.app.panels(); } };
  }

  undo() { this.#swap(this.strokes, this.undone); }

  redo() { this.#swap(this.undone, this.strokes); }

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
    for (const { id, at } of this.#seen(view)) {
      if (this.painted.has(id)) brush.fillRect(at[0] - 1.5, at[1] - 1.5, 3, 3);
    }
  }

  get changed() { return this.told && (this.painted.size !== this.saved.size || [...this.painted].some((id) => !this.saved.has(id))); }

  async save() {
    const added = [...this.painted].filter((id) => !this.saved.has(id)).length;
    const gone = [...this.saved].filter((id) => !this.painted.has(id)).length;
    const answer = await ask(`Save ${this.told.path}`, make("p", {}, `${added} vertices come, ${gone} go, ${this.painted.size} are painted. ${this.told.sequences} sequences have this object: a run makes what uses the list anew in all of them.`),
      [["save", "Save", true], ["", "Cancel"]]);
    if (!answer) return;
    try {
      this.#take(await post(this.path, { vertices: [...this.painted], digest: this.told.digest }));
      this.app.say("saved");
    } catch (error) { this.app.say(error.message); }
    this.app.panels();
  }

  panel() {
    const { app } = this, on = app.mode === this;
    return make("div", {}, make("h2", {}, "Where people touch it"),
      this.told ? make("p", {}, `${this.painted.size} of ${this.vertices.length / 3} vertices are painted; the list is of the object, for all its sequences.`) : null,
      on ? button("Done", () => app.setMode(null), { title: "Esc" }) : button("Paint its contact surface", () => this.start()),
      this.changed ? button("Save the surface…", () => this.save(), { class: "main" }) : null);
  }
}

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
