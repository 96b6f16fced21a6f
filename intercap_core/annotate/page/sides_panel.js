/* The panel of left and right, and its rows on the timeline. */
import { button, make } from "./dom.js";
import { intervals, legend } from "./sides.js";

const MAX_ROWS = 12; // of a list

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
    sides.open.size ? button("Cancel unfinished ranges", () => { sides.cancel(); app.timeline.draw(); app.panels(); }, { title: "Esc" }) : null,
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
