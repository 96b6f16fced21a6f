/* The panel of left and right, and its rows on the timeline. */
import { button, make } from "./dom.js";
import { intervals, legend } from "./sides.js";

const SHOWN = 12; // of a list

export function sidesPanel(app) {
  const { sides, told, frame } = app;
  const says = (one) => { const [a, b] = sides.moments(one); return `${one.camera ?? "All views"}, frames ${a}${b - a > 1 ? `–${b - 1}` : ""}`; };
  const entries = sides.entries(), doubts = told.places.filter((one) => one.kind === "sides");
  const open = (camera) => {
    const begun = sides.open.get(camera ?? "");
    const cameras = told.cameras.map((_, c) => c).filter((c) => !camera || told.cameras[c].name === camera);
    const on = begun ? begun.on : !cameras.every((c) => sides.stated(c, frame));
    const text = begun ? `${on ? "Exchanged" : "As detected"} ${Math.min(begun.from, frame)} to ${Math.max(begun.from, frame)}` : `${on ? "Exchanged" : "As detected"} from ${frame}…`;
    return button(text, () => sides.press(camera), { class: begun ? "main" : "", data: { sides: camera ?? "all" }, title: camera ? "E, with the pointer in this view" : "Shift+E" });
  };
  const state = (c) => (sides.against(c, frame) ? make("span", { class: "fault" }, "not as the body") : make("span", { class: "dim" }, sides.stated(c, frame) ? "exchanged, as you state" : sides.data ? "as the body" : ""));
  const other = sides.data ? told.cameras.flatMap((camera, c) => intervals(Array.from({ length: told.frames }, (_, t) => sides.against(c, t))).map(([a, b]) => ({ camera: camera.name, a, b }))).sort((p, q) => q.b - q.a - (p.b - p.a)) : [];
  return make("div", { class: "sides" },
    make("p", {}, legend(), " Thick: the result's body. Thin, with letters: what a detector named left and right, exchanged where you state it. On the wrong side of the person? State from which frame to which."),
    sides.fault ? make("p", { class: "fault" }, sides.fault) : sides.data ? null : make("p", { class: "dim" }, app.layers.sides ? "Loading…" : "Press L to see them."),
    make("table", {}, told.cameras.map((camera, c) => make("tr", {}, make("td", {}, camera.name), make("td", {}, state(c)), make("td", {}, open(camera.name)))),
      make("tr", {}, make("td", {}, "All"), make("td", {}), make("td", {}, open(null)))),
    sides.open.size ? button("Cancel what is begun", () => { sides.cancel(); app.timeline.draw(); app.panels(); }, { title: "Esc" }) : null,
    make("h2", {}, entries.length ? "Stated to be exchanged" : "Nothing is stated to be exchanged"),
    make("ul", {}, entries.map((one) => make("li", {}, `${says(one)} `,
      button("Go", () => app.show(sides.moments(one)[0])),
      button("Starts here", () => sides.move(one, frame, sides.moments(one)[1])),
      button("Ends here", () => sides.move(one, sides.moments(one)[0], frame + 1)),
      button("Remove", () => sides.remove(one))))),
    doubts.length ? make("h2", {}, "Doubted") : null,
    make("ol", {}, doubts.slice(0, SHOWN).map((place) => make("li", {}, button(`${place.first}–${place.last}: ${place.words}`, () => app.go(place), { class: "plain" })))),
    other.length ? make("h2", {}, "Views that name the sides other than the body") : null,
    make("ul", {}, other.slice(0, SHOWN).map(({ camera, a, b }) => make("li", {}, button(`${camera}, ${b - a > 1 ? `frames ${a}–${b - 1}` : `frame ${a}`}`, () => { app.views.prefer([camera]); app.show(a); }, { class: "plain" })))),
    other.length > SHOWN ? make("p", { class: "dim" }, `and ${other.length - SHOWN} shorter ones`) : null);
}

/* Rows on the timeline: [{ label, camera, entries, open, shade }]. */
export function sidesRows(app) {
  const { sides, told } = app, entries = sides.entries();
  const rows = [null, ...told.cameras.map((one) => one.name)].map((camera, k) => ({
    camera, label: `L/R ${camera ?? "all views"}`, entries: entries.filter((one) => (one.camera ?? null) === camera), open: sides.open.get(camera ?? ""),
    shade: camera && app.layers.sides && sides.data ? Array.from({ length: told.frames }, (_, t) => sides.against(k - 1, t)) : null,
  }));
  return rows.filter((row) => row.entries.length || row.open || row.shade?.some(Boolean));
}
