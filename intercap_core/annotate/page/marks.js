/* Marks in the images: the subject, points of the floor, and frames to drop. */
import { post } from "./api.js";
import { button, make } from "./dom.js";
import { runs } from "./runs.js";

/* Clicks on the subject among several people. */
export class SubjectMarks {
  constructor(app) { this.app = app; }

  get hint() { return "Click the subject once, in any view; click again in a frame after the person was out of view. Esc ends."; }

  press(view, event) {
    if (event.button !== 0) return null;
    const { app } = this, [x, y] = view.pixel(event), [w, h] = view.camera.size;
    const set = app.setOf(view.index, app.frame);
    if (set < 0 || x < 0 || y < 0 || x >= w || y >= h) { app.say("there is no image at this position"); return {}; }
    const point = { camera: view.camera.name, frame: set, x: Number(x.toFixed(1)), y: Number(y.toFixed(1)) };
    const others = (app.draft.get("subject") ?? []).filter((mark) => mark.camera !== point.camera || mark.frame !== set);
    app.draft.set("subject", [...others, point], "subject marked");
    return {};
  }

  mark(view, brush) {
    const { app } = this;
    for (const mark of app.draft.get("subject") ?? []) {
      if (mark.camera !== view.camera.name || (mark.frame ?? 0) !== app.setOf(view.index, app.frame)) continue;
      const [x, y] = app.views.spot(view, mark.x, mark.y);
      ring(brush, x, y, "#ffd60a", 9);
      brush.font = "bold 13px system-ui";
      brush.fillStyle = "#ffd60a";
      brush.fillText("subject", x + 12, y + 4);
    }
  }

  panel() {
    const { app } = this, points = app.draft.get("subject") ?? [], { subject } = app.info;
    const reasons = { alone: "the only person", named: "marked in the annotation", handling: "the person who handles the object", middle: "the person who is visible most" };
    return make("div", {},
      make("p", {}, subject ? `The subject is ${reasons[subject.chosen_by] ?? subject.chosen_by}.${subject.doubts ? ` Doubt: ${subject.doubts}.` : ""}` : "The subject has not been determined yet."),
      make("ul", {}, points.map((point, k) => make("li", {}, `${point.camera}, frame ${point.frame ?? 0} `,
        button("Go", () => app.show(point.frame ?? 0)),
        button("Remove", () => app.draft.set("subject", points.filter((_, i) => i !== k), "subject point removed"))))),
      app.mode === this ? button("Done", () => app.setMode(null), { title: "Esc" })
        : button("Click the subject", () => app.setMode(this), { class: "main", title: "U" }));
  }
}

/* Three or more points of the floor; the server measures their position by depth. */
export class FloorMarks {
  constructor(app) { this.app = app; }

  get hint() { return "Click three or more points of the bare floor, far apart, in any views. Esc ends."; }

  press(view, event) {
    if (event.button !== 0) return null;
    this.#add(view, event);
    return {};
  }

  async #add(view, event) {
    const { app } = this, [x, y] = view.pixel(event);
    try {
      const { point } = await post(`${app.path}/point`, { camera: view.camera.name, frame: app.frame, x, y });
      app.draft.set("floor", [...(app.draft.get("floor") ?? []), point], "floor point");
    } catch (error) { app.say(error.message); }
  }

  mark(view, brush) {
    const { app } = this;
    (app.draft.get("floor") ?? []).forEach((point, k) => {
      const at = app.views.place(view, point);
      if (!at) return;
      ring(brush, ...at, "#12b886", 7);
      brush.fillStyle = "#12b886";
      brush.font = "bold 12px system-ui";
      brush.fillText(String(k + 1), at[0] + 10, at[1] + 4);
    });
    for (const line of this.grid()) {
      const ends = line.map((point) => app.views.place(view, point));
      if (ends.some((end) => !end)) continue;
      brush.strokeStyle = "rgba(18, 184, 134, 0.8)";
      brush.lineWidth = 1;
      brush.beginPath();
      brush.moveTo(...ends[0]);
      brush.lineTo(...ends[1]);
      brush.stroke();
    }
  }

  /* Grid lines, 0.5 m apart, of the plane through the points, or of the known floor. */
  grid() {
    const points = this.app.draft.get("floor") ?? [];
    const known = this.app.info.ground;
    const normal = points.length >= 3 ? planeNormal(points) : known?.normal;
    if (!normal) return [];
    const middle = points.length >= 3 ? [0, 1, 2].map((i) => points.reduce((s, p) => s + p[i], 0) / points.length) : this.#below(known);
    const along = unit(cross(normal, Math.abs(normal[0]) < 0.9 ? [1, 0, 0] : [0, 0, 1]));
    const across = cross(normal, along), lines = [];
    const at = (a, b) => middle.map((v, i) => v + a * along[i] + b * across[i]);
    for (let k = -3; k <= 3; k += 1) {
      for (let j = -3; j < 3; j += 1) {
        lines.push([at(k / 2, j / 2), at(k / 2, (j + 1) / 2)], [at(j / 2, k / 2), at((j + 1) / 2, k / 2)]);
      }
    }
    return lines;
  }

  #below(ground) { // point of the floor below the middle of the room
    const middle = this.app.middle(), { point, normal } = ground;
    const above = normal.reduce((s, n, i) => s + n * (middle[i] - point[i]), 0);
    return middle.map((v, i) => v - above * normal[i]);
  }

  panel() {
    const { app } = this, points = app.draft.get("floor") ?? [];
    const status = points.length ? `${points.length} points${points.length < 3 ? ": a plane needs 3 or more" : ""}.`
      : app.info.ground ? "The grid shows the known floor. Points replace it." : "No floor is known.";
    return make("div", {}, make("p", {}, status),
      make("ol", {}, points.map((point, k) => make("li", {}, `${point.map((v) => v.toFixed(3)).join(", ")} m `,
        button("Remove", () => app.draft.set("floor", points.filter((_, i) => i !== k), "floor point removed"))))),
      app.mode === this ? button("Done", () => app.setMode(null), { title: "Esc" })
        : button("Click floor points", () => app.setMode(this), { class: "main", title: "G" }));
  }
}

/* Frame sets that count as not recorded. Other frames keep their numbers. */
export class DroppedFrames {
  constructor(app) { this.app = app; this.from = null; this.on = true; }

  has(frame) { return (this.app.draft.get("drop_frames") ?? []).includes(frame); }

  toggle(frame) { this.put(frame, frame, !this.has(frame)); }

  put(first, last, on) {
    const { app } = this, frames = new Set(app.draft.get("drop_frames") ?? []);
    for (let t = first; t <= last; t += 1) { if (on) frames.add(t); else frames.delete(t); }
    app.draft.set("drop_frames", [...frames].sort((a, b) => a - b), on ? "frames dropped" : "frames kept");
  }

  panel() {
    const { app } = this, dropped = app.draft.get("drop_frames") ?? [];
    return make("div", {},
      make("p", {}, dropped.length ? `Dropped: ${runs(dropped).map(([a, b]) => (a === b ? a : `${a}–${b}`)).join(", ")}.` : "No frames are dropped."),
      make("p", { class: "dim" }, "A dropped frame counts as not recorded. All frames keep their numbers, so contact and poses do not move in time."),
      button(this.has(app.frame) ? `Keep frame ${app.frame}` : `Drop frame ${app.frame}`, () => this.toggle(app.frame), { class: "main", title: "X" }),
      this.from === null
        ? button(`${this.has(app.frame) ? "Keep" : "Drop"} from this frame…`, () => { this.from = app.frame; this.on = !this.has(app.frame); app.panels(); })
        : button(`${this.on ? "Drop" : "Keep"} ${this.from} to ${app.frame}`, () => {
          const [a, b] = [Math.min(this.from, app.frame), Math.max(this.from, app.frame)];
          this.from = null;
          this.put(a, b, this.on);
        }));
  }
}

function ring(brush, x, y, colour, radius) {
  for (const [style, width] of [["rgba(0,0,0,0.65)", 5], [colour, 2.5]]) {
    brush.strokeStyle = style;
    brush.lineWidth = width;
    brush.beginPath();
    brush.arc(x, y, radius, 0, 7);
    brush.stroke();
  }
}

const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (v) => { const n = Math.hypot(...v) || 1; return v.map((x) => x / n); };

/* Normal of a plane: the mean normal of the triangles that pairs of points form with their centroid. */
function planeNormal(points) {
  const middle = [0, 1, 2].map((i) => points.reduce((s, p) => s + p[i], 0) / points.length);
  let sum = [0, 0, 0];
  for (let a = 0; a < points.length; a += 1) {
    for (let b = a + 1; b < points.length; b += 1) {
      let n = cross(points[a].map((v, i) => v - middle[i]), points[b].map((v, i) => v - middle[i]));
      if (n.reduce((s, v, i) => s + v * sum[i], 0) < 0) n = n.map((v) => -v);
      sum = sum.map((v, i) => v + n[i]);
    }
  }
  return Math.hypot(...sum) > 1e-9 ? unit(sum) : null;
}
