/* Left and right of the subject: what a detector named so in each view, what the result has, and the
 * frames in which a person states that the detector exchanged them. */
import { packed } from "./api.js";
import { apply, project } from "./geometry.js";
import { make } from "./dom.js";
import { same } from "./draft.js";

export const LEFT = "#56b4ff", RIGHT = "#ff8c1a"; // told apart in all common kinds of colour blindness
const LETTERED = [2, 5]; // of a side's points: wrist and ankle
const ARM = [0, 1, 2], LEG = [3, 4, 5, 6];
const CLEARLY = 0.6; // of the distance as named: how much nearer the other side has to be
const LEAST_SHARE = 0.012; // of the image's height: nearer, sides cannot be told apart
const AGREES = 1, AGAINST = 2;

export class Sides {
  constructor(app) {
    this.app = app;
    this.open = new Map(); // by camera, "" = all: { from, on }, ranges that are not ended
    this.selected = null;
    this.data = null;
    this.fault = "";
  }

  /* Fetched when it is first to be seen. */
  async load() {
    const { told } = this.app;
    if (!told.frames || this.loading === told.result) return;
    this.loading = told.result;
    try {
      this.data = await packed(`sequences/${told.sequence}/sides?v=${told.result}`);
      this.fault = "";
      this.cells = told.cameras.map((camera) => this.data.header.cameras.indexOf(camera.name));
      this.compared = told.cameras.map((_, c) => Array.from({ length: told.frames }, (__, t) => this.#compare(c, t)));
    } catch (error) { this.data = null; this.loading = null; this.fault = error.message; }
    this.app.timeline.draw();
    this.app.panels();
    this.app.redraw();
  }

  /* Results are others by now. */
  async again() { if (this.loading || this.app.layers.sides) { this.data = null; this.loading = null; await this.load(); } }

  // ---------------------------------------------------------------- what is stated, by image
  /* Images (C, sets) in which left and right are stated to be exchanged. */
  #matrix() {
    const { told, draft } = this.app;
    const rows = told.cameras.map(() => new Uint8Array(told.frames));
    for (const { start, end, camera } of draft.get("left_right") ?? []) {
      told.cameras.forEach((one, c) => { if (!camera || one.name === camera) rows[c].fill(1, start, end); });
    }
    return rows;
  }

  /* Entries of the annotation: where all cameras are stated, one of all; the others by camera. */
  #entries(rows) {
    const { told } = this.app, all = rows[0].map((_, s) => (rows.every((row) => row[s]) ? 1 : 0));
    const of = (row, more) => intervals(row).map(([start, end]) => ({ start, end, ...more }));
    const own = rows.flatMap((row, c) => of(row.map((v, s) => (v && !all[s] ? 1 : 0)), { camera: told.cameras[c].name }));
    return [...of(all, {}), ...own].sort((a, b) => a.start - b.start);
  }

  entries() { return this.app.told.cameras.length ? [...this.#entries(this.#matrix()), ...this.#others()] : []; }

  /* Of a camera that the recording has not, entries stay as they are until they are removed. */
  #others() { return (this.app.draft.get("left_right") ?? []).filter((one) => one.camera && this.#index(one.camera) < 0); }

  #put(rows, says, others = this.#others()) { this.app.draft.set("left_right", [...this.#entries(rows), ...others], says); }

  #index(camera) { return this.app.told.cameras.findIndex((one) => one.name === camera); }

  /* The set whose image of a camera shows a moment, or would. */
  #set(c, frame) {
    const found = this.app.setOf(c, frame);
    return found >= 0 ? found : frame;
  }

  stated(c, frame) {
    const set = this.#set(c, frame), { name } = this.app.told.cameras[c];
    return (this.app.draft.get("left_right") ?? []).some((one) => (!one.camera || one.camera === name) && one.start <= set && set < one.end);
  }

  /* Moments `first` to `last`, in one camera or in all (camera null). */
  change(camera, first, last, on) {
    const rows = this.#matrix(), [a, b] = [Math.min(first, last), Math.max(first, last)];
    rows.forEach((row, c) => {
      if (camera && c !== this.#index(camera)) return;
      row.fill(on ? 1 : 0, this.#set(c, a), this.#set(c, b) + 1);
    });
    this.#put(rows, on ? "left and right exchanged" : "left and right as detected");
  }

  /* An entry moved to other moments, or taken away. */
  move(one, start, end) {
    const rows = this.#matrix(), chosen = rows.filter((_, c) => !one.camera || c === this.#index(one.camera));
    if (!chosen.length) { this.#put(rows, "left and right: frames removed", this.#others().filter((other) => !same(other, one))); return; }
    for (const row of chosen) row.fill(0, one.start, one.end);
    const c = Math.max(0, this.#index(one.camera));
    const next = { ...one, start: this.#set(c, start), end: this.#set(c, end - 1) + 1 };
    if (next.end > next.start) for (const row of chosen) row.fill(1, next.start, next.end);
    this.selected = null; // until its bar is in focus again
    this.#put(rows, next.end > next.start ? "left and right: frames moved" : "left and right: frames removed");
  }

  remove(one) { this.move(one, 0, 0); }

  /* First moment of an entry and the one after its last. */
  moments(one) {
    const { told } = this.app, shows = told.image_of?.[Math.max(0, this.#index(one.camera))];
    const at = (set) => { const t = shows ? shows.indexOf(set) : set; return t < 0 ? set : t; };
    return [at(one.start), at(one.end - 1) + 1];
  }

  // ---------------------------------------------------------------- from this frame to another
  /* The first press begins at the frame that is shown, the second one ends with it. */
  press(camera) {
    const { app } = this, key = camera ?? "", begun = this.open.get(key);
    if (!app.told.frames) { app.say("no images are there yet"); return; }
    this.show();
    if (begun) {
      this.open.delete(key);
      this.change(camera, begun.from, app.frame, begun.on);
      app.say(`${camera ?? "all views"}: left and right ${begun.on ? "exchanged" : "as detected"} in frames ${Math.min(begun.from, app.frame)} to ${Math.max(begun.from, app.frame)}`);
    } else {
      const cameras = camera ? [this.#index(camera)] : app.told.cameras.map((_, c) => c);
      const on = !cameras.every((c) => this.stated(c, app.frame));
      this.open.set(key, { from: app.frame, on });
      app.say(`${camera ?? "all views"}: ${on ? "exchanged" : "not exchanged"} from frame ${app.frame}; go to the last one and press again`);
    }
    app.timeline.draw();
    app.panels();
  }

  cancel() { this.open.clear(); this.selected = null; }

  show() {
    const { app } = this;
    if (app.open !== "questions") app.tab("sides");
    if (!app.layers.sides) app.layer("sides", true);
  }

  // ---------------------------------------------------------------- what is seen
  #detected(c, t, i) {
    const n = this.data.header.cameras.length, k = 2 * ((t * n + this.cells[c]) * 14 + i);
    const { detected } = this.data.arrays;
    return detected[k] < 0 ? null : [detected[k], detected[k + 1]];
  }

  #result(t, i) {
    const p = this.data.arrays.result.subarray(3 * (t * 14 + i), 3 * (t * 14 + i) + 3);
    return Number.isFinite(p[0]) ? [...p] : null;
  }

  /* Whether a view's points, as they were detected, lie on the result's own side: of arms and of legs
   * AGREES, AGAINST or 0 = it cannot be told. */
  #compare(c, t) {
    const camera = this.app.told.cameras[c];
    if (!camera.pose || this.cells[c] < 0) return [0, 0];
    const spots = Array.from({ length: 14 }, (_, i) => {
      const point = this.#result(t, i), seen = point && apply(camera.pose, point);
      return seen && seen[2] > 0.05 ? project(camera.lens, seen) : null;
    });
    return [ARM, LEG].map((limb) => {
      let own = 0, other = 0, count = 0;
      for (const k of limb) {
        for (const [i, j] of [[k, k + 7], [k + 7, k]]) {
          const at = this.#detected(c, t, i);
          if (!at || !spots[i] || !spots[j]) continue;
          own += Math.hypot(at[0] - spots[i][0], at[1] - spots[i][1]);
          other += Math.hypot(at[0] - spots[j][0], at[1] - spots[j][1]);
          count += 1;
        }
      }
      const least = count * LEAST_SHARE * camera.size[1];
      if (count < 3 || Math.max(own, other) < least) return 0;
      if (other < CLEARLY * own) return AGAINST;
      return own < CLEARLY * other ? AGREES : 0;
    });
  }

  /* Whether a view, with what is stated, names the sides other than the result does. */
  against(c, t) {
    if (!this.data) return false;
    return this.compared[c][t].includes(this.stated(c, t) ? AGREES : AGAINST);
  }

  mark(view, brush) {
    const { app } = this, { frame } = app;
    if (!this.data) return;
    const large = view.width > 400, swap = this.stated(view.index, frame);
    const fitted = Array.from({ length: 14 }, (_, i) => { const p = this.#result(frame, i); return p && app.views.place(view, p); });
    this.#limbs(brush, fitted, large ? 7 : 4, 0.8);
    if (this.cells[view.index] >= 0) {
      const seen = Array.from({ length: 14 }, (_, i) => { const at = this.#detected(view.index, frame, swap ? (i + 7) % 14 : i); return at && app.views.spot(view, ...at); });
      this.#limbs(brush, seen, large ? 2 : 1.5, 1, true);
      for (const k of LETTERED) for (const side of [0, 7]) if (seen[k + side]) letter(brush, seen[k + side], side, large ? 9 : 6);
    }
    if (this.against(view.index, frame)) tag(brush, view, large ? "L and R other than the body's" : "L, R other", "#b3261e");
    else if (swap) tag(brush, view, large ? "exchanged, as you state" : "exchanged", "#1f5fc9");
  }

  #limbs(brush, points, width, alpha, dots = false) {
    brush.lineCap = "round";
    brush.globalAlpha = alpha;
    for (const [colour, more] of [["rgba(0, 0, 0, 0.75)", 2.5], [null, 0]]) {
      for (const side of [0, 7]) {
        brush.strokeStyle = brush.fillStyle = colour ?? (side ? RIGHT : LEFT);
        brush.lineWidth = width + more;
        brush.beginPath();
        for (const [a, b] of this.data.header.bones) {
          if (!points[a + side] || !points[b + side]) continue;
          brush.moveTo(...points[a + side]);
          brush.lineTo(...points[b + side]);
        }
        brush.stroke();
        if (!dots) continue;
        for (const at of points.slice(side, side + 7)) if (at) { brush.beginPath(); brush.arc(...at, width + 1 + more / 2, 0, 7); brush.fill(); }
      }
    }
    brush.globalAlpha = 1;
  }
}

/* Runs of a row that are set: [first, after the last]. */
export function intervals(row) {
  const found = [];
  let start = -1;
  for (let s = 0; s <= row.length; s += 1) {
    if (row[s] && start < 0) start = s;
    if (!row[s] && start >= 0) { found.push([start, s]); start = -1; }
  }
  return found;
}

export function legend() {
  const one = (text, colour) => make("span", { class: "side", style: `background: ${colour}` }, text);
  return make("span", { class: "legend" }, one("L", LEFT), one("R", RIGHT));
}

function letter(brush, [x, y], side, radius) {
  brush.fillStyle = side ? RIGHT : LEFT;
  brush.strokeStyle = "#000000";
  brush.lineWidth = 1.5;
  brush.beginPath();
  brush.arc(x, y, radius, 0, 7);
  brush.fill();
  brush.stroke();
  brush.fillStyle = "#000000";
  brush.font = `bold ${Math.round(1.4 * radius)}px system-ui`;
  brush.textAlign = "center";
  brush.textBaseline = "middle";
  brush.fillText(side ? "R" : "L", x, y + 0.5);
  brush.textAlign = "start";
  brush.textBaseline = "alphabetic";
}

function tag(brush, view, text, colour) {
  brush.font = `600 ${view.width > 400 ? 13 : 11}px system-ui`;
  const wide = brush.measureText(text).width + 10;
  brush.fillStyle = colour;
  brush.fillRect(view.width - wide, 0, wide, 20);
  brush.fillStyle = "#ffffff";
  brush.fillText(text, view.width - wide + 5, 14);
}
