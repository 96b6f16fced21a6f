/* Keyboard shortcuts, and their list. */
import { ask, find, make } from "./dom.js";

const KEYS = [
  ["← →", "previous and next frame; with Shift ten frames"], ["Home End", "first and last frame"], ["Space", "play"],
  ["N P", "next and previous issue"], ["F", "zoom to the object and follow it; again: show whole images"], ["1 2 3 4 5", "layers: body, object, contact, marks, left and right (also L)"],
  ["B", "the result before the last run"], ["O", "place the object"], ["S", "fit the object to the images"],
  ["C", "confirm contact"], ["[ ]", "contact starts or ends at this frame"], ["K", "split contact"], ["Delete", "delete contact"],
  ["E", "exchange left and right in the view under the pointer, from this frame; again: up to this frame; with Shift in all views"],
  ["U", "click the subject"], ["G", "click floor points"], ["X", "drop the frame, or keep it"],
  ["Q", "next question; then 1, 2, 3 answer it"], ["Ctrl+Z", "undo; with Shift redo"], ["Ctrl+S", "save"], ["Esc", "leave the current mode"],
];

const VIEWER_KEYS = /^( |f|Arrow(Left|Right)|Home|End|[1-9])$/; // handled by the 3D viewer if it has the focus
const REPEATED = /^(Arrow(Left|Right)|[npNP])$/; // keys that repeat while they are held down
const PRESSED_BY_SPACE = ["BUTTON", "INPUT", "SUMMARY"];

export function help() {
  ask("Keys", make("table", { class: "keys" }, KEYS.map(([key, effect]) => make("tr", {}, make("td", {}, make("kbd", {}, key)), make("td", {}, effect)))), [["", "Close", true]]);
}

export function handleKey(app, event) {
  if (find("dialog").open) return;
  const control = event.ctrlKey || event.metaKey, tag = event.target.tagName, letter = event.key.toLowerCase();
  if (control && /^[szy]$/.test(letter)) {
    event.preventDefault();
    commitField(event.target, () => {
      if (letter === "s") app.saving.save();
      else if (letter === "y" || event.shiftKey) app.redo();
      else app.undo();
    });
    return;
  }
  if (["INPUT", "SELECT", "TEXTAREA"].includes(tag) && event.target.type !== "checkbox" && event.target.type !== "range") return;
  if (control || event.altKey || (VIEWER_KEYS.test(event.key) && event.target.closest?.(".viewer"))) return;
  if (event.repeat && !REPEATED.test(event.key)) { event.preventDefault(); return; }
  const interval = app.contact.selectedAt(app.frame);
  const withContact = (act) => (interval ? act() : app.say("select a bar of the timeline first: click it"));
  const remove = () => (app.sides.selected ? app.sides.remove(app.sides.selected) : withContact(() => app.contact.remove(interval)));
  const frames = event.shiftKey ? 10 : 1;
  const act = {
    arrowleft: () => app.show(app.frame - frames), arrowright: () => app.show(app.frame + frames),
    home: () => app.show(0), end: () => app.show(app.info.frames - 1),
    n: () => app.jump(1), p: () => app.jump(-1),
    f: () => (app.following ? app.showWhole() : app.showNear()),
    o: () => { if (app.pose) { app.tab("object"); app.pose.start(); } },
    s: () => { if (app.pose) { app.tab("object"); app.pose.snap(); } },
    u: () => { app.tab("marks"); app.setMode(app.subject); },
    g: () => { app.tab("marks"); app.setMode(app.floor); },
    l: () => app.setLayer("sides", !app.layers.sides),
    e: () => app.sides.press(event.shiftKey ? null : app.views.selected?.camera.name),
    x: () => app.dropped.toggle(app.frame),
    q: () => app.questions.next(),
    b: () => (app.space.before ? app.setLayer("before", !app.layers.before) : app.saving.compare()),
    c: () => withContact(() => app.contact.confirm(interval)), k: () => withContact(() => app.contact.split(interval, app.frame)),
    "[": () => withContact(() => app.contact.change(interval, app.frame, interval.end)), "]": () => withContact(() => app.contact.change(interval, interval.start, app.frame + 1)),
    delete: remove, backspace: remove,
    escape: () => { app.setMode(null); app.questions.current = null; app.contact.selected = null; app.sides.cancel(); },
    "?": () => help(),
    " ": () => app.play(),
  }[letter];
  if (/^[1-9]$/.test(event.key)) {
    const number = Number(event.key);
    if (app.open !== "questions" || !app.questions.key(number)) {
      const name = Object.keys(app.layers)[number - 1];
      if (name) app.setLayer(name, !app.layers[name]);
    }
  } else if (act && !(event.key === " " && PRESSED_BY_SPACE.includes(tag) && event.target.type !== "range")) act();
  else return;
  event.preventDefault();
}

/* Commit the text that is being typed into a field before a shortcut acts. */
function commitField(field, act) {
  const fields = () => [...find("panels").querySelectorAll("input")], at = fields().indexOf(field);
  if (at >= 0) field.blur();
  act();
  if (at >= 0 && !find("dialog").open) fields()[at]?.focus();
}
