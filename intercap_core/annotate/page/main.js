/* The page: the shown frame, layers, modes and panels.
 *
 * - A frame is a moment of the sequence, a set the images that the cameras recorded together. A delayed
 *   camera shows a frame in a later set; annotations that name an image use the number of its set.
 * - A view is the canvas of one camera (views.js); `brush` is its 2D context.
 * - A place is a run of frames with a flag or doubt: { first, last, frame to show, kind, message, weight }.
 * - A mode (subject, floor, pose, paint) gets the pointer's events: hint is its text, press(view, event)
 *   returns { move, end } for a drag, {} for a click, or null to pan the view instead; wheel is optional.
 * - Everything that is drawn over the images has mark(view, brush). */
import { fetchArrays, get, readToken } from "./api.js";
import { banner, button, find, make, refill } from "./dom.js";
import { Contact } from "./contact.js";
import { Copies } from "./copies.js";
import { Draft } from "./draft.js";
import { apply, invert } from "./geometry.js";
import { handleKey, help } from "./keys.js";
import { showList } from "./list.js";
import { DroppedFrames, FloorMarks, SubjectMarks } from "./marks.js";
import { Paint, SymmetryEditor } from "./object_settings.js";
import { Overlay } from "./overlay.js";
import { Pictures } from "./pictures.js";
import { PoseEditor, objectPose, poseAt } from "./pose.js";
import { Questions } from "./questions.js";
import { Saving } from "./saving.js";
import { Sides, legend, sidesPanel } from "./sides.js";
import { BEFORE, GREY, Space } from "./space.js";
import { Timeline } from "./timeline.js";
import { Views } from "./views.js";

const OBJECT = [1.0, 0.62, 0.18], EDITED = [0.2, 0.85, 0.45];

class App {
  constructor(info, copies) {
    this.info = info; // description of the sequence by the server
    this.path = `sequences/${info.sequence}`; // of requests
    this.frame = 0;
    this.direction = 1;
    this.opacity = 0.62;
    this.layers = { body: true, object: true, contact: true, marks: true, sides: false, before: false };
    this.mode = null;
    this.steps = []; // milliseconds from a request for a frame until all views are drawn
    this.draft = new Draft(info.annotation, copies);
    this.pictures = new Pictures(info.sequence, info.stamp);
    this.contact = new Contact(this);
    try { this.overlay = new Overlay(); } catch (error) { banner("overlay", error.message); }
    this.subject = new SubjectMarks(this);
    this.floor = new FloorMarks(this);
    this.dropped = new DroppedFrames(this);
    this.sides = new Sides(this);
    this.space = new Space(this);
    this.symmetry = new SymmetryEditor(this);
    this.views = new Views(this);
    this.timeline = new Timeline(this);
    this.questions = new Questions(this);
    this.saving = new Saving(this);
    this.draft.addEventListener("change", () => this.refresh());
    this.#layerBar();
    this.#tabs();
    document.addEventListener("keydown", (event) => handleKey(this, event));
    find("help").onclick = help;
  }

  // ---------------------------------------------------------------- loading
  async load() {
    this.show(0);
    if (this.info.object) {
      try {
        const object = await fetchArrays(`${this.path}/object?v=${this.info.result}`);
        this.pose = new PoseEditor(this, object);
        this.paint = new Paint(this, object, this.paint);
        this.overlay?.mesh("object", object.arrays.faces, OBJECT);
        this.overlay?.move("object", object.arrays.vertices);
      } catch (error) { banner("object", error.message); }
    }
    this.panels();
    this.redraw();
    this.questions.load();
    if (this.info.viewer) await this.space.load();
    else this.space.showReason("There is no body yet: the 4D viewer needs stage body_fit.");
    document.body.dataset.ready = "yes";
  }

  /* Load the result before the last run, and show its layer. */
  async loadBefore() {
    await this.space.loadBefore();
    this.layers.before = true;
    this.#layerBar();
    this.redraw();
  }

  /* Read the changed results; edits are kept. */
  async reload() {
    const again = [["Try again", () => this.reload()]];
    let info;
    try {
      info = await get(this.path);
      if (!info.frames && this.info.frames) throw new Error(info.notes.join("; "));
    } catch (error) {
      banner("result", `${error.message} The page continues with the loaded data; your edits are kept.`, again);
      return;
    }
    banner("result", "");
    const frame = this.frame;
    if (!this.info.frames) { // the page was built without frames
      this.info.result = info.result;
      if (info.frames) location.reload(); else showInfo(info);
      return;
    }
    for (const key of Object.keys(this.info)) delete this.info[key]; // entries of removed results
    Object.assign(this.info, info);
    this.pictures = new Pictures(info.sequence, info.stamp);
    this.contact = new Contact(this);
    this.views.views.forEach((view, k) => (view.camera = info.cameras[k] ?? view.camera));
    this.setMode(null);
    if (info.annotation.digest !== this.draft.file.digest && !this.draft.dirty && !info.annotation.problem) this.saved(info.annotation, true);
    showInfo(info);
    await this.load();
    await this.sides.reload();
    this.timeline.draw();
    this.show(Math.min(frame, info.frames - 1));
  }

  // ---------------------------------------------------------------- time
  has(camera, frame) { return this.info.images[camera]?.[frame] === "1"; }

  /* The frame set whose image of a camera shows a frame, -1 if there is none. */
  setOf(camera, frame) {
    if (!this.has(camera, frame)) return -1;
    return this.info.image_of ? this.info.image_of[camera][frame] : frame;
  }

  /* Show a frame in all views. */
  show(number) {
    const frame = Math.max(0, Math.min(this.info.frames - 1, Math.round(number)));
    this.requestedAt ??= performance.now();
    if (frame !== this.frame) {
      this.direction = frame < this.frame ? -1 : 1;
      this.pictures.cancel();
      if (this.pose?.editing) this.setMode(null);
    }
    this.frame = frame;
    if (this.following) this.showNear();
    this.redraw();
  }

  /* Draw in the next animation frame. */
  redraw() {
    if (this.waits) return;
    this.waits = true;
    requestAnimationFrame(() => {
      this.waits = false;
      this.draw();
    });
  }

  /* Draw timeline, panels and views again. */
  refresh() {
    this.timeline.draw();
    this.panels();
    this.redraw();
  }

  draw() {
    if (!this.info.frames) return;
    this.views.draw();
    this.space.follow();
    this.timeline.cursor();
    const place = this.info.places.find(({ first, last }) => first <= this.frame && this.frame <= last);
    find("moment").textContent = `${this.info.times[this.frame].toFixed(2)} s, frame ${this.frame} of ${this.info.frames}${place ? `: ${place.message}` : ""}`;
    document.body.dataset.frame = this.frame;
    if (this.panelFrame !== this.frame) { this.panelFrame = this.frame; this.panels(); }
  }

  /* Called when all views show the requested frame. */
  drawn() {
    if (this.requestedAt === null || this.requestedAt === undefined) return;
    this.steps.push(performance.now() - this.requestedAt);
    this.requestedAt = null;
    document.body.dataset.drawn = this.frame;
    if (this.playing) this.#tick();
  }

  play() {
    this.playing = !this.playing;
    find("play").textContent = this.playing ? "Pause" : "Play";
    if (this.playing) this.show(this.frame >= this.info.frames - 1 ? 0 : this.frame + 1);
  }

  /* While playing, show the next frame when its time has come. */
  #tick() {
    if (this.frame >= this.info.frames - 1) { this.play(); return; }
    const wait = Math.max(0, 1000 / this.info.fps - (this.steps.at(-1) ?? 0));
    setTimeout(() => { if (this.playing) this.show(this.frame + 1); }, wait);
  }

  /* Show the next (1) or previous (-1) flag or doubt. */
  jump(by) {
    const frames = [...new Set(this.info.places.map(({ frame }) => frame))].sort((a, b) => a - b);
    const next = by > 0 ? frames.find((t) => t > this.frame) : frames.findLast((t) => t < this.frame);
    if (next === undefined) this.say(`no issue ${by > 0 ? "after" : "before"} this frame`);
    else this.show(next);
  }

  // ---------------------------------------------------------------- drawing
  /* Meshes to draw over the images: { name, pose, colour }. */
  drawables() {
    const { overlay, layers, frame, space } = this;
    if (!overlay) return [];
    const meshes = this.paint && this.mode === this.paint ? [] : space.bodies(frame, layers);
    if (!layers.object || !this.pose) return meshes;
    const old = layers.before && space.before?.object ? objectPose(space.before.object.arrays, frame) : null;
    if (old) meshes.push({ name: "object", pose: old, colour: BEFORE });
    const pose = this.symmetry.rotated(this.pose.at(frame));
    if (pose) {
      const annotated = this.pose.editing || poseAt(this.draft, frame);
      meshes.push({ name: "object", pose, colour: annotated ? EDITED : layers.sides ? GREY : OBJECT });
    }
    return meshes;
  }

  /* Draw all marks over the image of a view. */
  mark(view, brush) {
    if (this.layers.contact && !this.layers.sides && !(this.paint && this.mode === this.paint)) this.space.markContact(view, brush);
    if (this.layers.marks) {
      this.subject.mark(view, brush);
      if (this.mode === this.floor || this.draft.get("floor")) this.floor.mark(view, brush);
    }
    if (this.pose?.editing) this.pose.mark(view, brush);
    if (this.paint && this.mode === this.paint) this.paint.mark(view, brush);
    if (this.layers.sides) this.sides.mark(view, brush);
    this.questions?.mark(view, brush);
  }

  /* Centre of the object in the shown frame, or of the room. */
  middle() {
    const pose = this.pose?.at(this.frame);
    return pose ? apply(pose, this.pose.centre) : this.roomCentre();
  }

  /* Mean of the points 2 m in front of the cameras. */
  roomCentre() {
    const ahead = this.info.cameras.filter((camera) => camera.pose).map((camera) => apply(invert(camera.pose), [0, 0, 2]));
    return [0, 1, 2].map((i) => ahead.reduce((s, v) => s + v[i], 0) / Math.max(1, ahead.length));
  }

  /* Zoom to the object and follow it. */
  showNear() { this.following = true; this.views.zoomTo(this.middle(), Math.max(0.45, this.pose?.object.header.diameter ?? 0)); }

  showWhole() { this.following = false; this.views.zoomTo(null); }

  // ---------------------------------------------------------------- modes, panels, messages
  setMode(mode) {
    if (this.mode === this.pose && this.pose && mode !== this.pose) this.pose.leave();
    this.mode = mode;
    find("hint").hidden = !mode;
    find("hint").textContent = mode?.hint ?? "";
    document.body.dataset.mode = mode ? mode.constructor.name : "";
    this.panels();
    this.redraw();
  }

  /* Show a message for five seconds. */
  say(text) {
    const box = find("hint");
    box.hidden = false;
    box.textContent = text;
    clearTimeout(this.hintTimer);
    this.hintTimer = setTimeout(() => { box.textContent = this.mode?.hint ?? ""; box.hidden = !this.mode; }, 5000);
  }

  undo() { this.#step("undo"); }

  redo() { this.#step("redo"); }

  #step(by) {
    if (this.paint && this.mode === this.paint) { this.paint[by](); return; }
    this.pose?.finishWheel();
    this.draft[by]();
    if (this.pose?.editing) this.pose.followDraft();
    this.panels();
  }

  /* Take over the file's new content after a save, by this page or by another annotator (`theirs`). */
  saved(annotation, theirs = false) {
    const unedited = !this.draft.dirty;
    this.draft.rebase(annotation, theirs);
    if (unedited) this.draft.sections = structuredClone(this.draft.saved);
    this.draft.notify();
  }

  #layerBar() {
    const names = { body: "body", object: this.info.object ? this.info.object.replaceAll("_", " ") : null, contact: "contact", marks: "marks", sides: "left/right", before: this.space.before ? "before" : null };
    const numbers = Object.keys(this.layers);
    refill(find("layers"), ...Object.entries(names).filter(([, text]) => text).map(([name, text]) => make("label", { title: name === "before" ? "B" : String(numbers.indexOf(name) + 1) },
      make("input", { type: "checkbox", checked: this.layers[name], data: { layer: name }, onchange: (event) => this.setLayer(name, event.target.checked) }), ` ${text} `, name === "sides" ? legend() : null)));
  }

  setLayer(name, on) {
    this.layers[name] = on;
    this.space.setLayers(this.layers);
    this.#layerBar();
    this.redraw();
    if (name !== "sides") return;
    if (on) this.sides.load();
    this.timeline.draw();
  }

  #tabs() {
    const panels = { doubts: "Issues", questions: "Questions", object: "Object", marks: "Subject, floor, frames", sides: "Left/right", run: "Run" };
    if (!this.info.object) delete panels.object;
    find("tabs").replaceChildren(...Object.entries(panels).map(([name, text]) =>
      button(text, () => this.tab(name), { id: `tab-${name}`, role: "tab", "aria-controls": "panels", data: { tab: name } })));
    find("panels").setAttribute("role", "tabpanel");
    this.tab("doubts");
  }

  tab(name) {
    this.open = name;
    if (name === "sides" && !this.layers.sides) this.setLayer("sides", true);
    for (const tab of find("tabs").children) tab.setAttribute("aria-selected", String(tab.dataset.tab === name));
    find("panels").setAttribute("aria-labelledby", `tab-${name}`);
    this.panels();
  }

  panels() {
    const box = find("panels");
    const typing = box.contains(document.activeElement) && document.activeElement.tagName === "INPUT";
    if (typing && this.open === "object") { this.pose?.panel(); return; }
    const parts = {
      doubts: () => [doubts(this)],
      questions: () => [this.questions?.panel()],
      object: () => (this.pose ? [this.pose.panel(), ...(this.pose.editing ? [] : [this.paint.panel(), this.symmetry.panel()])] : [make("p", {}, "The object's mesh is missing.")]),
      marks: () => [make("h2", {}, "Subject"), this.subject.panel(), make("h2", {}, "Floor"), this.floor.panel(), make("h2", {}, "Frames to drop"), this.dropped.panel()],
      sides: () => [sidesPanel(this)],
      run: () => [this.saving?.panel()],
    };
    refill(box, ...(parts[this.open]?.() ?? []).filter(Boolean));
  }
}

/* The panel of estimated errors, doubts and places to check. */
function doubts(app) {
  const { info } = app, verdict = info.verdict ?? [];
  const warnings = [info.track?.doubts, info.subject?.doubts].filter(Boolean);
  const none = info.verdict ? "There are no issues." : "Flags and errors are not computed yet: run the stages.";
  return make("div", {},
    verdict.length ? make("p", {}, "Estimated errors (no ground truth): ", verdict.map(({ part, mm, silent }) => `${part} ${mm === null ? `– (${silent})` : `${mm} mm`}`).join(", "), ".") : null,
    warnings.map((text) => make("p", { class: "fault" }, text)),
    info.places.length ? make("ol", { class: "places" }, info.places.slice(0, 60).map((place) => make("li", {},
      button(`${place.first === place.last ? place.first : `${place.first}–${place.last}`}: ${place.message}`, () => app.show(place.frame), { class: "plain" }))))
      : warnings.length ? null : make("p", {}, none));
}

function showInfo(info) {
  find("name").textContent = info.sequence;
  find("facts").textContent = [info.person, info.object.replaceAll("_", " "), info.frames ? `${info.frames} frames` : ""].filter(Boolean).join(" · ");
  document.title = `${info.sequence}: annotate`;
  for (const old of find("banners").querySelectorAll("[data-banner^=note]")) old.remove();
  [info.read_only, info.annotation.problem, info.annotation.note, ...info.notes].filter(Boolean).forEach((note, k) => banner(`note${k}`, note));
}

async function start() {
  const stop = (text) => { find("stopped").hidden = false; find("stopped").textContent = text; };
  if (!readToken()) { stop("Open the full address that `intercap annotate` printed."); return; }
  const name = /^\/sequence\/([^/]+)$/.exec(location.pathname)?.[1];
  try {
    if (!name) { await showList(); return; }
    const info = await get(`sequences/${name}`);
    find("editor").hidden = false;
    showInfo(info);
    if (!info.frames) {
      Object.assign(info, { cameras: [], places: [], images: [], times: [], fps: 1, stamp: "" });
    }
    window.annotate = new App(info, await Copies.open(info.project, info.sequence));
    await window.annotate.load();
  } catch (error) { stop(error.message); }
}

/* The user pasted the address of a new server, with another token, into this tab. */
addEventListener("hashchange", () => { if (/[#&]token=/.test(location.hash) && readToken()) location.reload(); });
start();
