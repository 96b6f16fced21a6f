/* Keys, and their list. */
import { ask, find, make } from "./dom.js";

const KEYS = [
  ["← →", "a frame back or on; with Shift ten"], ["Home End", "first and last frame"], ["Space", "play"],
  ["N P", "next and previous flag or doubt"], ["F", "near the object, and all again"], ["1 2 3 4 5", "layers: body, object, contact, marks, left and right (also L)"],
  ["B", "the result before the last run"], ["O", "place the object"], ["S", "fit it to the images"],
  ["C", "confirm contact"], ["[ ]", "contact starts or ends at this frame"], ["K", "split contact"], ["Delete", "delete contact"],
  ["E", "left and right are exchanged in the view under the pointer, from this frame; again: to this frame; with Shift in all views"],
  ["U", "click the subject"], ["G", "click floor points"], ["X", "drop the frame, or keep it"],
  ["Q", "next question; then 1, 2, 3 answer it"], ["Ctrl+Z", "undo; with Shift redo"], ["Ctrl+S", "save"], ["Esc", "end what is going on"],
];

const VIEWERS = /^( |f|Arrow(Left|Right)|Home|End|[1-9])$/; // keys that the 3D viewer has itself
const AGAIN = /^(Arrow(Left|Right)|[npNP])$/; // that go on as long as they are held
const PRESSED = ["BUTTON", "INPUT", "SUMMARY"]; // by the space bar

export function help() {
  ask("Keys", make("table", { class: "keys" }, KEYS.map(([key, says]) => make("tr", {}, make("td", {}, make("kbd", {}, key)), make("td", {}, says)))), [["", "Close", true]]);
}

export function pressed(app, event) {
  if (find("dialog").open) return;
  const control = event.ctrlKey || event.metaKey, typed = event.target.tagName, letter = event.key.toLowerCase();
  if (control && /^[szy]$/.test(letter)) {
    event.preventDefault();
    typedFirst(event.target, () => {
      if (letter === "s") app.keep.save();
      else if (letter === "y" || event.shiftKey) app.redo();
      else app.undo();
    });
    return;
  }
  if (["INPUT", "SELECT", "TEXTAREA"].includes(typed) && event.target.type !== "checkbox" && event.target.type !== "range") return;
  if (control || event.altKey || (VIEWERS.test(event.key) && event.target.closest?.(".viewer"))) return;
  if (event.repeat && !AGAIN.test(event.key)) { event.preventDefault(); return; }
  const one = app.contact.chosen(app.frame);
  const contact = (act) => (one ? act() : app.say("choose a bar of the timeline first: click it"));
  const far = event.shiftKey ? 10 : 1;
  const names = Object.keys(app.layers);
  const act = {
    arrowleft: () => app.show(app.frame - far), arrowright: () => app.show(app.frame + far),
    home: () => app.show(0), end: () => app.show(app.told.frames - 1),
    n: () => app.jump(1), p: () => app.jump(-1),
    f: () => (app.near ? app.whole() : app.nearby()),
    o: () => { if (app.pose) { app.tab("object"); app.pose.start(); } },
    s: () => { if (app.pose) { app.tab("object"); app.pose.snap(); } },
    u: () => { app.tab("marks"); app.setMode(app.subject); },
    g: () => { app.tab("marks"); app.setMode(app.floor); },
    l: () => app.layer("sides", !app.layers.sides),
    e: () => app.sides.press(event.shiftKey ? null : app.views.chosen?.camera.name),
    x: () => app.dropped.toggle(app.frame),
    q: () => app.questions.next(),
    b: () => (app.space.before ? app.layer("before", !app.layers.before) : app.keep.compare()),
    c: () => contact(() => app.contact.confirm(one)), k: () => contact(() => app.contact.split(one, app.frame)),
    "[": () => contact(() => app.contact.change(one, app.frame, one.end)), "]": () => contact(() => app.contact.change(one, one.start, app.frame + 1)),
    delete: () => remove(app, contact, one), backspace: () => remove(app, contact, one),
    escape: () => { app.setMode(null); app.questions.current = null; app.sides.cancel(); app.contact.selected = null; app.timeline.draw(); app.panels(); },
    "?": () => help(),
    " ": () => app.play(),
  }[letter];
  if (/^[1-9]$/.test(event.key)) {
    const number = Number(event.key);
    if (app.open !== "questions" || !app.questions.key(number)) {
      const name = names[number - 1];
      if (name) app.layer(name, !app.layers[name]);
    }
  } else if (act && !(event.key === " " && PRESSED.includes(typed) && event.target.type !== "range")) act();
  else return;
  event.preventDefault();
}

function remove(app, contact, one) {
  if (app.sides.selected) app.sides.remove(app.sides.selected);
  else contact(() => app.contact.remove(one));
}

/* What is being typed into a field counts before a key of the whole page does. */
function typedFirst(field, act) {
  const fields = () => [...find("panels").querySelectorAll("input")], at = fields().indexOf(field);
  if (at >= 0) field.blur();
  act();
  if (at >= 0 && !find("dialog").open) fields()[at]?.focus();
}
