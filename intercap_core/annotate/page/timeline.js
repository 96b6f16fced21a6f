/* The timeline: flags, doubts, dropped frames, object poses, left and right, and contact by body part. */
import { button, find, followPointer, make, refill, readable } from "./dom.js";
import { OTHER, id, isUncertain } from "./contact.js";
import { posedFrames } from "./pose.js";
import { runs } from "./runs.js";
import { sidesRows } from "./sides.js";

const SHOWN = 0.25; // a part has a row if its probability of contact reaches this value

export class Timeline {
  constructor(app) {
    this.app = app;
    this.extra = new Set();
    const slider = find("frame");
    slider.oninput = () => app.show(Number(slider.value));
    find("play").onclick = () => app.play();
    find("previous").onclick = () => app.jump(-1);
    find("next").onclick = () => app.jump(1);
    this.rows = find("rows");
    this.rows.onpointerdown = (event) => this.#seek(event);
    this.draw();
  }

  get contact() { return this.app.contact; }

  /* CSS position of a frame on a lane. */
  at(t) { return `${(100 * t) / this.app.info.frames}%`; }

  #frameAt(event) {
    const lane = this.rows.querySelector(".lane").getBoundingClientRect();
    return ((event.clientX - lane.left) / lane.width) * this.app.info.frames;
  }

  #seek(event) {
    if (event.target.closest("button, .bar") || !event.target.closest(".lane")) return;
    const go = (e) => this.app.show(Math.floor(this.#frameAt(e)));
    go(event);
    followPointer(go);
  }

  /* Body parts that have a row. */
  parts() {
    const { regions } = this.contact, intervals = this.contact.intervals();
    const shown = regions.filter((part) => {
      if (this.extra.has(part) || intervals.some((interval) => interval.part === part)) return true;
      for (let t = 0; t < this.app.info.frames; t += 1) if ((this.contact.probabilityAt(part, t) ?? 0) >= SHOWN) return true;
      return false;
    });
    if (intervals.some(({ part }) => part === "any") || this.extra.has("any")) shown.unshift("any");
    return shown;
  }

  draw() {
    const { app } = this, { info } = app;
    find("frame").max = Math.max(0, info.frames - 1);
    const focused = document.activeElement?.dataset?.interval;
    const marks = this.#lane("doubts", "Issues");
    for (const place of info.places) {
      marks.lane.append(this.#mark(place.first, place.last + 1, `mark ${place.kind}`, place.message,
        () => app.show(place.frame)));
    }
    const list = [marks.row];
    const dropped = app.draft.get("drop_frames") ?? [];
    if (dropped.length) {
      const { row, lane } = this.#lane("dropped", "Frames to drop");
      for (const [first, last] of runs(dropped)) {
        lane.append(this.#mark(first, last + 1, "mark dropped", `frames ${first} to ${last} are dropped`, () => app.show(first)));
      }
      list.push(row);
    }
    const posed = posedFrames(app.draft);
    if (posed.length) {
      const { row, lane } = this.#lane("posed", "Object poses");
      for (const t of posed) lane.append(this.#mark(t, t + 1, "mark posed", `the object is placed in frame ${t}`, () => app.show(t)));
      list.push(row);
    }
    for (const row of sidesRows(app)) list.push(this.#sides(row));
    if (info.object) for (const part of this.parts()) list.push(this.#part(part));
    this.rows.replaceChildren(...list, make("div", { class: "cursor-lane" }, make("div", { class: "cursor" })));
    if (info.object) this.#contactBar();
    this.cursor();
    if (focused) this.rows.querySelector(`[data-interval="${focused}"]`)?.focus({ preventScroll: true });
  }

  #lane(kind, label) {
    const lane = make("div", { class: `lane ${kind}` });
    return { lane, row: make("div", { class: "row" }, make("span", { class: "label", title: label }, label), lane) };
  }

  #mark(start, end, kind, label, act) {
    const mark = button("", act, { class: kind, title: label, "aria-label": label });
    mark.style.left = this.at(start);
    mark.style.width = this.at(Math.max(end - start, 0.5));
    return mark;
  }

  /* Shade frames by a value from 0 to 1. */
  #heat(share) {
    const { frames } = this.app.info;
    const heat = make("canvas", { width: frames, height: 1, "aria-hidden": "true" });
    const brush = heat.getContext("2d");
    for (let t = 0; t < frames; t += 1) {
      brush.fillStyle = `rgba(237, 128, 16, ${(0.75 * share(t)).toFixed(3)})`;
      brush.fillRect(t, 0, 1, 1);
    }
    return heat;
  }

  /* Stated exchanges of left and right in a camera or all; frames that differ from the body are shaded. */
  #sides({ label, camera, entries, open, differs }) {
    const { app } = this, { sides } = app;
    const { row, lane } = this.#lane("sides", label);
    row.dataset.sides = camera ?? "all";
    if (differs) lane.append(this.#heat((t) => (differs[t] ? 1 : 0)));
    for (const entry of entries) {
      const [start, end] = sides.framesOf(entry);
      const title = `left and right swapped in ${camera ?? "all views"}, frames ${start} to ${end - 1}`;
      const bar = this.#bar(title, `sides:${camera ?? ""}:${start}:${end}`, "stated", "swapped");
      this.#place(bar, start, end);
      bar.onfocus = () => { app.contact.selected = null; sides.selected = entry; };
      bar.onblur = () => { if (sides.selected === entry) sides.selected = null; };
      bar.onpointerdown = (event) => this.#drag(event, bar, { start, end }, (from, to) => {
        sides.move(entry, from, to);
        return `sides:${camera ?? ""}:${from}:${to}`;
      });
      lane.append(bar);
    }
    if (open) {
      const range = make("div", { class: "bar estimated unfinished" });
      this.#place(range, Math.min(open.from, app.frame), Math.max(open.from, app.frame) + 1);
      range.dataset.from = open.from;
      lane.append(range);
    }
    return row;
  }

  #place(bar, start, end) {
    bar.style.left = this.at(start);
    bar.style.width = this.at(end - start);
  }

  /* A bar with ends that can be dragged. */
  #bar(title, interval, kind, text) {
    return make("button", { type: "button", class: `bar ${kind}`, title, "aria-label": title, data: { interval } },
      make("i", { class: "end left", data: { end: "start" } }), make("span", {}, text), make("i", { class: "end right", data: { end: "end" } }));
  }

  #part(part) {
    const { app, contact } = this;
    const { row, lane } = this.#lane("contact", readable(part));
    row.dataset.part = part;
    if (part !== "any" && contact.probability) {
      lane.append(this.#heat((t) => contact.probabilityAt(part, t)));
    }
    for (const interval of contact.intervals()) if (interval.part === part) lane.append(this.#interval(interval), ...this.#uncertainEnds(interval));
    return row;
  }

  #interval(interval) {
    const { app, contact } = this;
    const confirmed = contact.isConfirmed(interval), percent = Math.round(100 * contact.mean(interval));
    const title = `${readable(interval.part)}, frames ${interval.start} to ${interval.end - 1}, ${confirmed ? (interval.uncertain ? "annotated, ends uncertain" : "annotated") : `estimated, probability ${percent} %`}`;
    const bar = this.#bar(title, id(interval), confirmed ? "stated" : "estimated", confirmed ? "" : `${percent} %`);
    bar.setAttribute("aria-pressed", String(contact.selected !== null && id(contact.selected) === id(interval)));
    this.#place(bar, interval.start, interval.end);
    bar.onfocus = () => { app.sides.selected = null; contact.selected = interval; this.#contactBar(); };
    bar.onpointerdown = (event) => {
      contact.selected = interval;
      this.#drag(event, bar, interval, (start, end) => {
        contact.change(interval, start, end);
        return id(contact.selected ?? interval);
      });
    };
    return bar;
  }

  /* Hatched frames around the uncertain ends of an interval, within which a run may move them. */
  #uncertainEnds(interval) {
    const { uncertainty_frames: by, frames } = this.app.info;
    return Object.keys(OTHER).filter((end) => this.contact.stated && isUncertain(interval, end) && interval[end] > 0 && interval[end] < frames).map((end) => {
      const zone = make("div", { class: "uncertain" });
      this.#place(zone, Math.max(0, interval[end] - by), Math.min(frames, interval[end] + by));
      return zone;
    });
  }

  /* Drag a bar or one of its ends. `store` saves the new ends and returns the data-interval of the bar. */
  #drag(event, bar, interval, store) {
    const { app } = this;
    const end = event.target.dataset.end, from = this.#frameAt(event);
    let [start, stop] = [interval.start, interval.end];
    const move = (next) => {
      const lowest = end === "end" ? interval.start + 1 - interval.end : -interval.start; // a whole bar keeps its length
      const highest = end === "start" ? interval.end - 1 - interval.start : app.info.frames - interval.end;
      const by = Math.min(Math.max(Math.round(this.#frameAt(next) - from), lowest), highest);
      start = interval.start + (end === "end" ? 0 : by);
      stop = interval.end + (end === "start" ? 0 : by);
      this.#place(bar, start, stop);
      app.show(end === "end" ? stop - 1 : start);
    };
    const storeEnds = () => {
      const same = start === interval.start && stop === interval.end;
      const name = same ? bar.dataset.interval : store(start, stop);
      if (same && (app.frame < interval.start || app.frame >= interval.end)) app.show(interval.start);
      this.rows.querySelector(`[data-interval="${name}"]`)?.focus({ preventScroll: true });
    };
    followPointer(move, storeEnds);
    event.preventDefault();
    bar.focus({ preventScroll: true });
  }

  #contactBar() {
    const { app, contact } = this, { info } = app, selected = contact.selectedAt(app.frame);
    const choose = make("select", { id: "part", "aria-label": "Add contact at this frame", onchange: () => {
      if (!choose.value) return;
      this.extra.add(choose.value);
      contact.add(choose.value, app.frame, Math.min(app.info.frames, app.frame + Math.ceil(app.info.fps / 2)));
    } }, new Option("add contact here…", ""), ...["any", ...contact.regions].map((part) => new Option(readable(part), part)));
    const state = contact.stated ? !contact.stated.length ? "annotated: no contact in the whole sequence"
      : `${contact.stated.length} annotated, ${contact.stated.filter((interval) => !contact.isConfirmed(interval)).length} not yet confirmed`
      : contact.probability ? "estimated contact: the first edit copies it into the annotation" : "no contact has been estimated yet";
    refill(find("contact-bar"), contact.stated?.length === 0 ? make("b", {}, state) : make("span", { class: "dim" }, state), choose, ...(selected ? [
      make("b", {}, `${readable(selected.part)} ${selected.start}–${selected.end - 1}`),
      button("Confirm", () => contact.confirm(selected), { title: "C" }),
      ...Object.keys(OTHER).map((end) => make("label", { title: `A run may move an uncertain ${end} by ${info.uncertainty_frames} frames (joint.annotation_uncertainty_frames), and keeps an exact one` },
        make("input", { type: "checkbox", checked: !isUncertain(selected, end), data: { exact: end }, onchange: (event) => contact.setExact(selected, end, event.target.checked) }),
        ` ${end} exact${isUncertain(selected, end) ? ` (± ${info.uncertainty_frames} frames)` : ""}`)),
      button("Starts here", () => contact.change(selected, app.frame, selected.end), { title: "[" }),
      button("Ends here", () => contact.change(selected, selected.start, app.frame + 1), { title: "]" }),
      button("Split here", () => contact.split(selected, app.frame), { title: "K" }),
      button("Delete", () => contact.remove(selected), { title: "Delete" }),
    ] : []), ...(!contact.stated && contact.probability ? [button("Copy the estimate", () => contact.copyEstimate(), { title: "Copy all estimated intervals into the annotation" })] : []),
    ...(contact.stated?.length === 0 ? [] : [button("No contact at all", () => contact.stateNone(), { title: "No part touches the object in the whole sequence" })]),
    ...(contact.stated ? [button("Discard, use the estimate", () => contact.unstate(), { title: "Remove contact from the annotation" })] : []));
  }

  cursor() {
    const { app } = this;
    find("frame").value = app.frame;
    const cursor = this.rows.querySelector(".cursor");
    if (cursor) this.#place(cursor, app.frame, app.frame + 1);
    for (const bar of this.rows.querySelectorAll(".unfinished")) {
      const from = Number(bar.dataset.from);
      this.#place(bar, Math.min(from, app.frame), Math.max(from, app.frame) + 1);
    }
  }
}
