/* Left and right of the subject: as detected in each view, as in the result, and the frames in which
 * the annotation states that the detector exchanged them. The limbs have 14 points: shoulder, elbow,
 * wrist, hip, knee, ankle and big toe of the left side (0 to 6), then of the right side (7 to 13). */
import { fetchArrays } from "./api.js";
import { apply, project } from "./geometry.js";
import { button, make } from "./dom.js";
import { same } from "./draft.js";
import { intervals } from "./runs.js";

export const LEFT = "#56b4ff", RIGHT = "#ff8c1a"; // distinguishable with all common kinds of colour blindness
const LETTERED = [2, 5]; // points with a letter: wrist and ankle
const ARM = [0, 1, 2], LEG = [3, 4, 5, 6];
// A limb agrees with a side if its distance from that side is below this share of the distance from the
// other side; otherwise the comparison is undecided.
const MAX_RATIO = 0.6;
// Smallest mean distance from the farther side, share of the image's height: sides that nearly coincide in
// the image are undecided.
const MIN_DISTANCE = 0.012;
const AGREES = 1, DIFFERS = 2;
const MAX_ROWS = 12; // of a list

export class Sides {
  constructor(app) {
    this.app = app;
    this.open = new Map(); // ranges without a last frame: { from, on } by camera, "" = all cameras
    this.selected = null;
    this.data = null;
    this.fault = "";
  }

  /* Fetch the data when the layer is first shown. */
  async load() {
    const { info } = this.app;
    if (!info.frames || this.loading === info.result) return;
    this.loading = info.result;
    try {
      this.data = await fetchArrays(`${this.app.path}/sides?v=${info.result}`);
      this.fault = "";
      this.cells = info.cameras.map((camera) => this.data.header.cameras.indexOf(camera.name));
      this.compared = info.cameras.map((_, c) => Array.from({ length: info.frames }, (__, t) => this.#compare(c, t)));
    } catch (error) { this.data = null; this.loading = null; this.fault = error.message; }
    this.app.refresh();
  }

  /* Fetch the data of changed results. */
  async reload() { if (this.loading || this.app.layers.sides) { this.data = null; this.loading = null; await this.load(); } }

  // ---------------------------------------------------------------- stated exchanges, by image set
  /* Mask of images with stated exchanges, by camera and set. */
  #matrix() {
    const { info, draft } = this.app;
    const rows = info.cameras.map(() => new Uint8Array(info.frames));
    for (const { start, end, camera } of draft.get("left_right") ?? []) {
      info.cameras.forEach(({ name }, c) => { if (!camera || name === camera) rows[c].fill(1, start, end); });
    }
    return rows;
  }

  /* Entries of the annotation from such a mask: sets of all cameras give an entry without a camera. */
  #entries(rows) {
    const { info } = this.app, all = rows[0].map((_, s) => (rows.every((row) => row[s]) ? 1 : 0));
    const toEntries = (row, more) => intervals(row).map(([start, end]) => ({ start, end, ...more }));
    const single = rows.flatMap((row, c) => toEntries(row.map((v, s) => (v && !all[s] ? 1 : 0)), { camera: info.cameras[c].name }));
    return [...toEntries(all, {}), ...single].sort((a, b) => a.start - b.start);
  }

  entries() { return this.app.info.cameras.length ? [...this.#entries(this.#matrix()), ...this.#others()] : []; }

  /* Entries of cameras that the recording does not have; they are kept until the user removes them. */
  #others() { return (this.app.draft.get("left_right") ?? []).filter((entry) => entry.camera && this.#index(entry.camera) < 0); }

  #store(rows, label, others = this.#others()) { this.app.draft.set("left_right", [...this.#entries(rows), ...others], label); }

  #index(camera) { return this.app.info.cameras.findIndex(({ name }) => name === camera); }

  /* The set whose image of a camera shows a frame; the frame's own number if there is no image. */
  #set(c, frame) {
    const set = this.app.setOf(c, frame);
    return set >= 0 ? set : frame;
  }

  /* Whether the annotation states an exchange in camera c and a frame. */
  stated(c, frame) {
    const set = this.#set(c, frame), { name } = this.app.info.cameras[c];
    return (this.app.draft.get("left_right") ?? []).some((entry) => (!entry.camera || entry.camera === name) && entry.start <= set && set < entry.end);
  }

  /* Set or clear frames `first` to `last` in a camera, null for all. */
  change(camera, first, last, on) {
    const rows = this.#matrix(), [a, b] = [Math.min(first, last), Math.max(first, last)];
    rows.forEach((row, c) => {
      if (camera && c !== this.#index(camera)) return;
      row.fill(on ? 1 : 0, this.#set(c, a), this.#set(c, b) + 1);
    });
    this.#store(rows, on ? "left and right swapped" : "left and right not swapped");
  }

  /* Move an entry to other frames; remove it if `end` <= `start`. */
  move(entry, start, end) {
    const rows = this.#matrix(), chosen = rows.filter((_, c) => !entry.camera || c === this.#index(entry.camera));
    if (!chosen.length) { this.#store(rows, "left and right: frames removed", this.#others().filter((other) => !same(other, entry))); return; }
    for (const row of chosen) row.fill(0, entry.start, entry.end);
    const c = Math.max(0, this.#index(entry.camera));
    const next = { ...entry, start: this.#set(c, start), end: this.#set(c, end - 1) + 1 };
    if (next.end > next.start) for (const row of chosen) row.fill(1, next.start, next.end);
    this.selected = null; // until its bar has the focus again
    this.#store(rows, next.end > next.start ? "left and right: frames moved" : "left and right: frames removed");
  }

  remove(entry) { this.move(entry, 0, 0); }

  /* First frame of an entry, and first frame after it. */
  framesOf(entry) {
    const { info } = this.app, setOfFrame = info.image_of?.[Math.max(0, this.#index(entry.camera))];
    const frameOf = (set) => { const t = setOfFrame ? setOfFrame.indexOf(set) : set; return t < 0 ? set : t; };
    return [frameOf(entry.start), frameOf(entry.end - 1) + 1];
  }

  // ---------------------------------------------------------------- marking of ranges by two presses
  /* The first press sets the first frame of a range to the shown frame, the second press the last. */
  press(camera) {
    const { app } = this, key = camera ?? "", range = this.open.get(key);
    if (!app.info.frames) { app.say("there are no images yet"); return; }
    this.show();
    if (range) {
      this.open.delete(key);
      this.change(camera, range.from, app.frame, range.on);
      app.say(`${camera ?? "all views"}: left and right ${range.on ? "swapped" : "not swapped"} in frames ${Math.min(range.from, app.frame)} to ${Math.max(range.from, app.frame)}`);
    } else {
      const cameras = camera ? [this.#index(camera)] : app.info.cameras.map((_, c) => c);
      const on = !cameras.every((c) => this.stated(c, app.frame));
      this.open.set(key, { from: app.frame, on });
      app.say(`${camera ?? "all views"}: ${on ? "swapped" : "not swapped"} from frame ${app.frame}; go to the last frame and press again`);
    }
    app.refresh();
  }

  cancel() { this.open.clear(); this.selected = null; this.app.refresh(); }

  show() {
    const { app } = this;
    if (app.open !== "questions") app.tab("sides");
    if (!app.layers.sides) app.setLayer("sides", true);
  }

  // ---------------------------------------------------------------- comparison and drawing
  /* Detected point i in camera c and frame t, pixels; null if it is not visible. */
  #detected(c, t, i) {
    const n = this.data.header.cameras.length, k = 2 * ((t * n + this.cells[c]) * 14 + i);
    const { detected } = this.data.arrays;
    return detected[k] < 0 ? null : [detected[k], detected[k + 1]];
  }

  /* Point i of the result in frame t, master frame, metres; null if unknown. */
  #result(t, i) {
    const p = this.data.arrays.result.subarray(3 * (t * 14 + i), 3 * (t * 14 + i) + 3);
    return Number.isFinite(p[0]) ? [...p] : null;
  }

  /* Compare the detected sides of a view with the result's, for arms and legs: AGREES, DIFFERS, or 0 if
   * undecided. */
  #compare(c, t) {
    const camera = this.app.info.cameras[c];
    if (!camera.pose || this.cells[c] < 0) return [0, 0];
    const spots = Array.from({ length: 14 }, (_, i) => {
      const point = this.#result(t, i), local = point && apply(camera.pose, point);
      return local && local[2] > 0.05 ? project(camera.lens, local) : null;
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
      const least = count * MIN_DISTANCE * camera.size[1];
      if (count < 3 || Math.max(own, other) < least) return 0;
      if (other < MAX_RATIO * own) return DIFFERS;
      return own < MAX_RATIO * other ? AGREES : 0;
    });
  }

  /* Return whether the sides of a view, with stated exchanges, differ from the result's. */
  differs(c, t) {
    if (!this.data) return false;
    return this.compared[c][t].includes(this.stated(c, t) ? AGREES : DIFFERS);
  }

  mark(view, brush) {
    const { app } = this, { frame } = app;
    if (!this.data) return;
    const large = view.width > 400, exchanged = this.stated(view.index, frame);
    const fitted = Array.from({ length: 14 }, (_, i) => { const p = this.#result(frame, i); return p && app.views.place(view, p); });
    this.#limbs(brush, fitted, large ? 7 : 4, 0.8);
    if (this.cells[view.index] >= 0) {
      const detected = Array.from({ length: 14 }, (_, i) => { const at = this.#detected(view.index, frame, exchanged ? (i + 7) % 14 : i); return at && app.views.spot(view, ...at); });
      this.#limbs(brush, detected, large ? 2 : 1.5, 1, true);
      for (const k of LETTERED) for (const side of [0, 7]) if (detected[k + side]) letter(brush, detected[k + side], side, large ? 9 : 6);
    }
    if (this.differs(view.index, frame)) tag(brush, view, large ? "L and R differ from the body" : "L, R differ", "#b3261e");
    else if (exchanged) tag(brush, view, large ? "exchanged by annotation" : "exchanged", "#1f5fc9");
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

export function legend() {
  const side = (text, colour) => make("span", { class: "side", style: `background: ${colour}` }, text);
  return make("span", { class: "legend" }, side("L", LEFT), side("R", RIGHT));
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
  const width = brush.measureText(text).width + 10;
  brush.fillStyle = colour;
  brush.fillRect(view.width - width, 0, width, 20);
  brush.fillStyle = "#ffffff";
  brush.fillText(text, view.width - width + 5, 14);
}

/* The panel of left and right. */
export function sidesPanel(app) {
  const { sides, info, frame } = app;
  const framesText = ([a, b]) => (b - a > 1 ? `frames ${a}–${b - 1}` : `frame ${a}`);
  const entries = sides.entries(), doubts = info.places.filter(({ kind }) => kind === "sides");
  const rangeButton = (camera) => {
    const range = sides.open.get(camera ?? "");
    const cameras = info.cameras.map((_, c) => c).filter((c) => !camera || info.cameras[c].name === camera);
    const on = range ? range.on : !cameras.every((c) => sides.stated(c, frame));
    const text = `${on ? "Swapped" : "Not swapped"} ${range ? `${Math.min(range.from, frame)} to ${Math.max(range.from, frame)}` : `from ${frame}…`}`;
    return button(text, () => sides.press(camera), { class: range ? "main" : "", data: { sides: camera ?? "all" }, title: camera ? "E, with the pointer in this view" : "Shift+E" });
  };
  const state = (c) => (sides.differs(c, frame) ? make("span", { class: "fault" }, "differs from the body")
    : make("span", { class: "dim" }, sides.stated(c, frame) ? "swapped by annotation" : sides.data ? "agrees with the body" : ""));
  const differing = sides.data ? info.cameras.flatMap(({ name }, c) =>
    intervals(Array.from({ length: info.frames }, (_, t) => sides.differs(c, t))).map(([a, b]) => ({ camera: name, a, b })))
    .sort((p, q) => q.b - q.a - (p.b - p.a)) : [];
  return make("div", { class: "sides" },
    make("p", {}, legend(), " Thick lines: body of the result. Thin lines with letters: detected limbs, swapped as annotated. If letters are on the wrong side of the person, annotate the first and last frame."),
    sides.fault ? make("p", { class: "fault" }, sides.fault) : sides.data ? null : make("p", { class: "dim" }, app.layers.sides ? "Loading…" : "Press L to show left and right."),
    make("table", {}, info.cameras.map((camera, c) => make("tr", {}, make("td", {}, camera.name), make("td", {}, state(c)), make("td", {}, rangeButton(camera.name)))),
      make("tr", {}, make("td", {}, "All"), make("td", {}), make("td", {}, rangeButton(null)))),
    sides.open.size ? button("Cancel unfinished ranges", () => sides.cancel(), { title: "Esc" }) : null,
    make("h2", {}, entries.length ? "Annotated left/right swaps" : "No left/right swaps annotated"),
    make("ul", {}, entries.map((entry) => {
      const [start, end] = sides.framesOf(entry);
      return make("li", {}, `${entry.camera ?? "All views"}, ${framesText([start, end])} `,
        button("Go", () => app.show(start)),
        button("Starts here", () => sides.move(entry, frame, end)),
        button("Ends here", () => sides.move(entry, start, frame + 1)),
        button("Remove", () => sides.remove(entry)));
    })),
    doubts.length ? make("h2", {}, "Doubtful") : null,
    make("ol", {}, doubts.slice(0, MAX_ROWS).map((place) => make("li", {}, button(`${place.first}–${place.last}: ${place.message}`, () => app.show(place.frame), { class: "plain" })))),
    differing.length ? make("h2", {}, "Views that differ from the body") : null,
    make("ul", {}, differing.slice(0, MAX_ROWS).map(({ camera, a, b }) => make("li", {},
      button(`${camera}, ${framesText([a, b])}`, () => { app.views.prefer([camera]); app.show(a); }, { class: "plain" })))),
    differing.length > MAX_ROWS ? make("p", { class: "dim" }, `and ${differing.length - MAX_ROWS} shorter ranges`) : null);
}

/* Rows on the timeline: [{ label, camera, entries, open, differs: by frame }]. */
export function sidesRows(app) {
  const { sides, info } = app, entries = sides.entries();
  const rows = [null, ...info.cameras.map(({ name }) => name)].map((camera, k) => ({
    camera, label: `L/R ${camera ?? "all views"}`, entries: entries.filter((entry) => (entry.camera ?? null) === camera), open: sides.open.get(camera ?? ""),
    differs: camera && app.layers.sides && sides.data ? Array.from({ length: info.frames }, (_, t) => sides.differs(k - 1, t)) : null,
  }));
  return rows.filter((row) => row.entries.length || row.open || row.differs?.some(Boolean));
}
