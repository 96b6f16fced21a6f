/* The page: one frame for all views, the viewer and the timeline; layers, modes, keys. */
import { get, packed, takeToken } from "./api.js";
import { banner, button, find, make, refill } from "./dom.js";
import { Contact } from "./contact.js";
import { Copies } from "./copies.js";
import { Draft } from "./draft.js";
import { apply, invert } from "./geometry.js";
import { Keep } from "./keep.js";
import { help, pressed } from "./keys.js";
import { showList } from "./list.js";
import { DroppedFrames, FloorMarks, SubjectMarks } from "./marks.js";
import { Overlay } from "./overlay.js";
import { Paint } from "./paint.js";
import { Pictures } from "./pictures.js";
import { PoseEditor, objectPose, poseAt } from "./pose.js";
import { Questions } from "./questions.js";
import { Sides, legend } from "./sides.js";
import { sidesPanel } from "./sides_panel.js";
import { BEFORE, GREY, Space } from "./space.js";
import { SymmetryEditor } from "./symmetry.js";
import { Timeline } from "./timeline.js";
import { Views } from "./views.js";

const OBJECT = [1.0, 0.62, 0.18], EDITED = [0.2, 0.85, 0.45];
class App {
  constructor(told, copies) {
    this.told = told;
    this.frame = 0;
    this.direction = 1;
    this.opacity = 0.62;
    this.layers = { body: true, object: true, contact: true, marks: true, sides: false, before: false };
    this.mode = null;
    this.steps = []; // milliseconds from a wish for a frame to all views drawn
    this.draft = new Draft(told.annotation, copies);
    this.pictures = new Pictures(told.sequence, told.stamp);
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
    this.keep = new Keep(this);
    this.draft.addEventListener("change", () => {
      this.timeline.draw();
      this.panels();
      this.redraw();
    });
    this.#bar();
    this.#tabs();
    document.addEventListener("keydown", (event) => pressed(this, event));
    find("help").onclick = help;
  }

  // ---------------------------------------------------------------- what is loaded
  async load() {
    const of = `sequences/${this.told.sequence}`;
    this.show(0);
    if (this.told.object) {
      try {
        const object = await packed(`${of}/object?v=${this.told.result}`);
        this.pose = new PoseEditor(this, object);
        this.paint = new Paint(this, object, this.paint);
        this.overlay?.mesh("object", object.arrays.faces, OBJECT);
        this.overlay?.move("object", object.arrays.vertices);
      } catch (error) { banner("object", error.message); }
    }
    this.panels();
    this.redraw();
    this.questions.load();
    if (this.told.viewer) await this.space.load();
    else this.space.none("No body to show: the 4D viewer comes with stage body_fit.");
    document.body.dataset.ready = "yes";
  }

  async loadBefore() {
    await this.space.loadBefore();
    this.layers.before = true;
    this.#bar();
    this.redraw();
  }

  async reload() {
    const again = [["Try again", () => this.reload()]];
    let told;
    try {
      told = await get(`sequences/${this.told.sequence}`);
      if (!told.frames && this.told.frames) throw new Error(told.notes.join("; "));
    } catch (error) {
      banner("result", `${error.message} The page goes on with what it has; your edits are kept.`, again);
      return;
    }
    banner("result", "");
    const frame = this.frame;
    if (!this.told.frames) { // views, time and all else come with the first frames
      this.told.result = told.result;
      if (told.frames) location.reload(); else facts(told);
      return;
    }
    for (const key of Object.keys(this.told)) delete this.told[key]; // of what is not there any more
    Object.assign(this.told, told);
    this.pictures = new Pictures(told.sequence, told.stamp);
    this.contact = new Contact(this);
    this.timeline.contact = this.contact;
    this.views.views.forEach((view, k) => (view.camera = told.cameras[k] ?? view.camera));
    this.setMode(null);
    if (told.annotation.digest !== this.draft.file.digest && !this.draft.dirty && !told.annotation.problem) this.saved(told.annotation, true);
    facts(told);
    await this.load();
    await this.sides.again();
    this.timeline.draw();
    this.show(Math.min(frame, told.frames - 1));
  }

  // ---------------------------------------------------------------- time
  has(camera, frame) { return this.told.images[camera]?.[frame] === "1"; }

  /* The frame set whose image of a camera shows a moment, -1 = none. */
  setOf(camera, frame) {
    if (!this.has(camera, frame)) return -1;
    return this.told.image_of ? this.told.image_of[camera][frame] : frame;
  }

  show(wanted) {
    const frame = Math.max(0, Math.min(this.told.frames - 1, Math.round(wanted)));
    this.asked ??= performance.now();
    if (frame !== this.frame) {
      this.direction = frame < this.frame ? -1 : 1;
      this.pictures.calm();
      if (this.pose?.editing) this.setMode(null);
    }
    this.frame = frame;
    if (this.near) this.nearby(); // goes along with the object
    this.redraw();
  }

  redraw() {
    if (this.waits) return;
    this.waits = true;
    requestAnimationFrame(() => {
      this.waits = false;
      this.draw();
    });
  }

  draw() {
    if (!this.told.frames) return;
    this.views.draw();
    this.space.follow();
    this.timeline.cursor();
    const place = this.told.places.find((one) => one.first <= this.frame && this.frame <= one.last);
    find("moment").textContent = `${this.told.times[this.frame].toFixed(2)} s, frame ${this.frame} of ${this.told.frames}${place ? `: ${place.words}` : ""}`;
    document.body.dataset.frame = this.frame;
    if (this.panelFrame !== this.frame) { this.panelFrame = this.frame; this.panels(); }
  }

  /* All views show the frame that was asked for. */
  drawn() {
    if (this.asked === null || this.asked === undefined) return;
    this.steps.push(performance.now() - this.asked);
    this.asked = null;
    document.body.dataset.drawn = this.frame;
    if (this.playing) this.#tick();
  }

  play() {
    this.playing = !this.playing;
    find("play").textContent = this.playing ? "Pause" : "Play";
    if (this.playing) this.show(this.frame >= this.told.frames - 1 ? 0 : this.frame + 1);
  }

  #tick() {
    if (this.frame >= this.told.frames - 1) { this.play(); return; }
    const wait = Math.max(0, 1000 / this.told.fps - (this.steps.at(-1) ?? 0));
    setTimeout(() => { if (this.playing) this.show(this.frame + 1); }, wait);
  }

  go(place) { this.show(place.frame); }

  jump(by) {
    const frames = [...new Set(this.told.places.map((one) => one.frame))].sort((a, b) => a - b);
    const next = by > 0 ? frames.find((t) => t > this.frame) : frames.findLast((t) => t < this.frame);
    if (next === undefined) this.say(`no flag or doubt ${by > 0 ? "after" : "before"} this frame`);
    else this.show(next);
  }

  // ---------------------------------------------------------------- what is drawn
  things() {
    const { overlay, layers, frame, space } = this;
    if (!overlay) return [];
    const found = this.paint && this.mode === this.paint ? [] : space.bodies(frame, layers);
    if (!layers.object || !this.pose) return found;
    const old = layers.before && space.before?.object ? objectPose(space.before.object.arrays, frame) : null;
    if (old) found.push({ name: "object", pose: old, colour: BEFORE });
    const pose = this.symmetry.turned(this.pose.at(frame));
    if (pose) {
      const own = this.pose.editing || poseAt(this.draft, frame);
      found.push({ name: "object", pose, colour: own ? EDITED : layers.sides ? GREY : OBJECT });
    }
    return found;
  }

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

  middle() {
    const seen = this.pose?.at(this.frame);
    if (seen) return apply(seen, this.pose.centre);
    const ahead = this.told.cameras.filter((one) => one.pose).map((one) => apply(invert(one.pose), [0, 0, 2]));
    return [0, 1, 2].map((i) => ahead.reduce((s, v) => s + v[i], 0) / Math.max(1, ahead.length));
  }

  nearby() { this.near = true; this.views.near(this.middle(), Math.max(0.45, this.pose?.object.header.diameter ?? 0)); }

  whole() { this.near = false; this.views.near(null); }

  // ---------------------------------------------------------------- modes, panels, words
  setMode(mode) {
    if (this.mode === this.pose && this.pose && mode !== this.pose) this.pose.leave();
    this.mode = mode;
    find("hint").hidden = !mode;
    find("hint").textContent = mode?.hint ?? "";
    document.body.dataset.mode = mode ? mode.constructor.name : "";
    this.panels();
    this.redraw();
  }

  say(text) {
    const box = find("hint");
    box.hidden = false;
    box.textContent = text;
    clearTimeout(this.saying);
    this.saying = setTimeout(() => { box.textContent = this.mode?.hint ?? ""; box.hidden = !this.mode; }, 5000);
  }

  undo() {
    if (this.paint && this.mode === this.paint) { this.paint.undo(); return; }
    this.pose?.settle();
    this.draft.undo();
    if (this.pose?.editing) this.pose.undone();
    this.panels();
  }

  redo() {
    if (this.paint && this.mode === this.paint) { this.paint.redo(); return; }
    this.pose?.settle();
    this.draft.redo();
    if (this.pose?.editing) this.pose.undone();
    this.panels();
  }

  saved(annotation, theirs = false) {
    this.told.annotation = annotation;
    const untouched = !this.draft.dirty;
    this.draft.base(annotation, theirs);
    if (untouched) this.draft.sections = structuredClone(this.draft.saved);
    this.draft.told();
  }

  #bar() {
    const names = { body: "body", object: this.told.object ? this.told.object.replaceAll("_", " ") : null, contact: "contact", marks: "marks", sides: "left/right", before: this.space.before ? "before" : null };
    const numbers = Object.keys(this.layers);
    refill(find("layers"), ...Object.entries(names).filter(([, text]) => text).map(([name, text]) => make("label", { title: name === "before" ? "B" : String(numbers.indexOf(name) + 1) },
      make("input", { type: "checkbox", checked: this.layers[name], data: { layer: name }, onchange: (event) => this.layer(name, event.target.checked) }), ` ${text} `, name === "sides" ? legend() : null)));
  }

  layer(name, on) {
    this.layers[name] = on;
    this.space.layers(this.layers);
    this.#bar();
    this.redraw();
    if (name !== "sides") return;
    if (on) this.sides.load();
    this.timeline.draw();
  }

  #tabs() {
    const panels = { doubts: "Doubts", questions: "Questions", object: "Object", marks: "Marks", sides: "Sides", run: "Run" };
    if (!this.told.object) delete panels.object;
    find("tabs").replaceChildren(...Object.entries(panels).map(([name, text]) => {
      const tab = button(text, () => this.tab(name), { id: `tab-${name}`, role: "tab", data: { tab: name } });
      tab.setAttribute("aria-controls", "panels");
      return tab;
    }));
    find("panels").setAttribute("role", "tabpanel");
    this.tab("doubts");
  }

  tab(name) {
    this.open = name;
    if (name === "sides" && !this.layers.sides) this.layer("sides", true);
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
      object: () => (this.pose ? [this.pose.panel(), ...(this.pose.editing ? [] : [this.paint.panel(), this.symmetry.panel()])] : [make("p", {}, "The object's mesh is not there.")]),
      marks: () => [make("h2", {}, "Subject"), this.subject.panel(), make("h2", {}, "Floor"), this.floor.panel(), make("h2", {}, "Frames to drop"), this.dropped.panel()],
      sides: () => [sidesPanel(this)],
      run: () => [this.keep?.panel()],
    };
    refill(box, ...(parts[this.open]?.() ?? []).filter(Boolean));
  }
}

function doubts(app) {
  const { told } = app, verdict = told.verdict ?? [];
  const doubt = [told.track?.doubts, told.subject?.doubts].filter(Boolean);
  return make("div", {},
    verdict.length ? make("p", {}, "Stated errors: ", verdict.map((one) => `${one.part} ${one.mm === null ? `– (${one.silent})` : `${one.mm} mm`}`).join(", "), ".") : null,
    doubt.map((text) => make("p", { class: "fault" }, text)),
    told.places.length ? make("ol", { class: "places" }, told.places.slice(0, 60).map((place) => make("li", {},
      button(`${place.first === place.last ? place.first : `${place.first}–${place.last}`}: ${place.words}`, () => app.go(place), { class: "plain" }))))
      : make("p", {}, told.frames && told.verdict ? "Nothing is flagged or doubted." : "No verdict yet."));
}

function facts(told) {
  find("name").textContent = told.sequence;
  find("facts").textContent = [told.person, told.object.replaceAll("_", " "), told.frames ? `${told.frames} frames` : ""].filter(Boolean).join(" · ");
  document.title = `${told.sequence}: annotate`;
  for (const old of find("banners").querySelectorAll("[data-banner^=note]")) old.remove();
  [told.read_only, told.annotation.problem, told.annotation.note, ...told.notes].filter(Boolean).forEach((note, k) => banner(`note${k}`, note));
}

async function begin() {
  const stop = (text) => { find("stopped").hidden = false; find("stopped").textContent = text; };
  if (!takeToken()) { stop("Open this page by the address that `intercap annotate` printed, with its token."); return; }
  const name = /^\/sequence\/([^/]+)$/.exec(location.pathname)?.[1];
  try {
    if (!name) { await showList(); return; }
    const told = await get(`sequences/${name}`);
    find("editor").hidden = false;
    facts(told);
    if (!told.frames) {
      Object.assign(told, { cameras: [], places: [], images: [], times: [], fps: 1, stamp: "" });
    }
    window.annotate = new App(told, await Copies.open(told.project, told.sequence));
    await window.annotate.load();
  } catch (error) { stop(error.message); }
}

/* The address that a new server has printed, put into this tab: its token is taken. */
addEventListener("hashchange", () => { if (/[#&]token=/.test(location.hash) && takeToken()) location.reload(); });
begin();
