/* One time for all: flags, doubts and dropped frames, and a row of contact for each body part. */
import { button, find, make, refill, words } from "./dom.js";
import { id } from "./contact.js";
import { posedFrames } from "./pose.js";
import { sidesRows } from "./sides_panel.js";

const SHOWN = 0.25; // a part has a row where its probability reaches this

export class Timeline {
  constructor(app) {
    this.app = app;
    this.contact = app.contact;
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

  at(t) { return `${(100 * t) / this.app.told.frames}%`; }

  #frameAt(event) {
    const lane = this.rows.querySelector(".lane").getBoundingClientRect();
    return ((event.clientX - lane.left) / lane.width) * this.app.told.frames;
  }

  #seek(event) {
    if (event.target.closest("button, .bar") || !event.target.closest(".lane")) return;
    const go = (e) => this.app.show(Math.floor(this.#frameAt(e)));
    go(event);
    const end = () => { window.removeEventListener("pointermove", go); window.removeEventListener("pointerup", end); };
    window.addEventListener("pointermove", go);
    window.addEventListener("pointerup", end);
  }

  parts() {
    const { regions } = this.contact, stated = this.contact.intervals();
    const shown = regions.filter((part) => {
      if (this.extra.has(part) || stated.some((one) => one.part === part)) return true;
      for (let t = 0; t < this.app.told.frames; t += 1) if ((this.contact.p(part, t) ?? 0) >= SHOWN) return true;
      return false;
    });
    if (stated.some((one) => one.part === "any") || this.extra.has("any")) shown.unshift("any");
    return shown;
  }

  draw() {
    const { app } = this, { told } = app;
    find("frame").max = Math.max(0, told.frames - 1);
    const kept = document.activeElement?.dataset?.interval;
    const marks = this.#lane("doubts", "Flags and doubts");
    for (const place of told.places) {
      marks.lane.append(this.#mark(place.first, place.last + 1, `mark ${place.kind}`, place.words,
        () => app.go(place)));
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
      for (const t of posed) lane.append(this.#mark(t, t + 1, "mark posed", `the object was placed at frame ${t}`, () => app.show(t)));
      list.push(row);
    }
    for (const one of sidesRows(app)) list.push(this.#sides(one));
    if (told.object) for (const part of this.parts()) list.push(this.#part(part));
    this.rows.replaceChildren(...list, make("div", { class: "cursor-lane" }, make("div", { class: "cursor" })));
    if (told.object) this.#bar();
    this.cursor();
    if (kept) this.rows.querySelector(`[data-interval="${kept}"]`)?.focus({ preventScroll: true });
  }

  #lane(kind, label) {
    const lane = make("div", { class: `lane ${kind}` });
    return { lane, row: make("div", { class: "row" }, make("span", { class: "label", title: label }, label), lane) };
  }

  #mark(start, end, kind, says, act) {
    const mark = make("button", { type: "button", class: kind, title: says, onclick: act });
    mark.setAttribute("aria-label", says);
    mark.style.left = this.at(start);
    mark.style.width = this.at(Math.max(end - start, 0.5));
    return mark;
  }

  /* A shade by frame, shares of 0 to 1. */
  #heat(share) {
    const { frames } = this.app.told;
    const heat = make("canvas", { width: frames, height: 1 });
    heat.setAttribute("aria-hidden", "true");
    const brush = heat.getContext("2d");
    for (let t = 0; t < frames; t += 1) {
      brush.fillStyle = `rgba(237, 128, 16, ${(0.75 * share(t)).toFixed(3)})`;
      brush.fillRect(t, 0, 1, 1);
    }
    return heat;
  }

  /* Where a camera, or all, is stated to have left and right exchanged; shaded where its points are on
   * other sides than the body's. */
  #sides({ label, camera, entries, open, shade }) {
    const { app } = this, { sides } = app;
    const { row, lane } = this.#lane("sides", label);
    row.dataset.sides = camera ?? "all";
    if (shade) lane.append(this.#heat((t) => (shade[t] ? 1 : 0)));
    for (const one of entries) {
      const [start, end] = sides.moments(one);
      const says = `left and right exchanged in ${camera ?? "all views"}, frames ${start} to ${end - 1}`;
      const bar = this.#ended(says, `sides:${camera ?? ""}:${start}:${end}`, "stated", "exchanged");
      this.#put(bar, start, end);
      bar.onfocus = () => { app.contact.selected = null; sides.selected = one; };
      bar.onblur = () => { if (sides.selected === one) sides.selected = null; };
      bar.onpointerdown = (event) => this.#drag(event, bar, { start, end }, (from, to) => {
        sides.move(one, from, to);
        return `sides:${camera ?? ""}:${from}:${to}`;
      });
      lane.append(bar);
    }
    if (open) {
      const begun = make("div", { class: "bar found begun" });
      this.#put(begun, Math.min(open.from, app.frame), Math.max(open.from, app.frame) + 1);
      begun.dataset.from = open.from;
      lane.append(begun);
    }
    return row;
  }

  #put(bar, start, end) {
    bar.style.left = this.at(start);
    bar.style.width = this.at(end - start);
  }

  /* A bar whose ends are dragged. */
  #ended(says, interval, kind, text) {
    const bar = make("button", { type: "button", class: `bar ${kind}`, title: says, data: { interval } },
      make("i", { class: "end left", data: { end: "start" } }), make("span", {}, text), make("i", { class: "end right", data: { end: "end" } }));
    bar.setAttribute("aria-label", says);
    return bar;
  }

  #part(part) {
    const { app, contact } = this;
    const { row, lane } = this.#lane("contact", words(part));
    row.dataset.part = part;
    if (part !== "any" && contact.probability) {
      lane.append(this.#heat((t) => contact.p(part, t)));
    }
    for (const one of contact.intervals()) if (one.part === part) lane.append(this.#interval(one));
    return row;
  }

  #interval(one) {
    const { app, contact } = this;
    const looked = contact.looked(one), share = Math.round(100 * contact.mean(one));
    const says = `${words(one.part)}, frames ${one.start} to ${one.end - 1}, ${looked ? "stated" : `found, ${share} % likely`}`;
    const bar = this.#ended(says, id(one), looked ? "stated" : "found", looked ? "" : `${share} %`);
    bar.setAttribute("aria-pressed", String(contact.selected !== null && id(contact.selected) === id(one)));
    this.#put(bar, one.start, one.end);
    bar.onfocus = () => { app.sides.selected = null; contact.selected = one; this.#bar(); };
    bar.onpointerdown = (event) => {
      contact.selected = one;
      this.#drag(event, bar, one, (start, end) => {
        contact.change(one, start, end);
        return id(contact.selected ?? one);
      });
    };
    return bar;
  }

  /* `done` with the new ends, where they are others, returns by which name the bar is found again. */
  #drag(event, bar, one, done) {
    const { app } = this;
    const end = event.target.dataset.end, from = this.#frameAt(event);
    let [start, stop] = [one.start, one.end];
    const move = (next) => {
      const lowest = end === "end" ? one.start + 1 - one.end : -one.start; // a whole bar keeps its length
      const highest = end === "start" ? one.end - 1 - one.start : app.told.frames - one.end;
      const by = Math.min(Math.max(Math.round(this.#frameAt(next) - from), lowest), highest);
      start = one.start + (end === "end" ? 0 : by);
      stop = one.end + (end === "start" ? 0 : by);
      this.#put(bar, start, stop);
      app.show(end === "end" ? stop - 1 : start);
    };
    const up = () => {
      window.removeEventListener("pointermove", move);
      window.removeEventListener("pointerup", up);
      const same = start === one.start && stop === one.end;
      const name = same ? bar.dataset.interval : done(start, stop);
      if (same && (app.frame < one.start || app.frame >= one.end)) app.show(one.start);
      this.rows.querySelector(`[data-interval="${name}"]`)?.focus({ preventScroll: true });
    };
    window.addEventListener("pointermove", move);
    window.addEventListener("pointerup", up);
    event.preventDefault();
    bar.focus({ preventScroll: true });
  }

  #bar() {
    const { app, contact } = this, one = contact.chosen(app.frame);
    const choose = make("select", { id: "part", onchange: () => {
      if (!choose.value) return;
      this.extra.add(choose.value);
      contact.add(choose.value, app.frame, Math.min(app.told.frames, app.frame + Math.ceil(app.told.fps / 2)));
    } }, new Option("add contact here…", ""), ...["any", ...contact.regions].map((part) => new Option(words(part), part)));
    choose.setAttribute("aria-label", "Add contact at this frame");
    const state = contact.stated ? !contact.stated.length ? "nothing touches, as annotated"
      : `${contact.stated.length} intervals stated, ${contact.stated.filter((i) => !contact.looked(i)).length} of them as found`
      : contact.probability ? "contact as found: an edit takes it into the annotation" : "no contact is found yet";
    refill(find("contact-bar"), contact.stated?.length === 0 ? make("b", {}, state) : make("span", { class: "dim" }, state), choose, ...(one ? [
      make("b", {}, `${words(one.part)} ${one.start}–${one.end - 1}`),
      button("Confirm", () => contact.confirm(one), { title: "C" }),
      button("Starts here", () => contact.change(one, app.frame, one.end), { title: "[" }),
      button("Ends here", () => contact.change(one, one.start, app.frame + 1), { title: "]" }),
      button("Split here", () => contact.split(one, app.frame), { title: "K" }),
      button("Delete", () => contact.remove(one), { title: "Delete" }),
    ] : []), ...(!contact.stated && contact.probability ? [button("Take all as found", () => contact.takeAll())] : []),
    ...(contact.stated?.length === 0 ? [] : [button("Nothing touches", () => contact.nothing(), { title: "No part touches the object in the whole sequence" })]),
    ...(contact.stated ? [button("As found again", () => contact.asFound(), { title: "Take the annotation of contact away" })] : []));
  }

  cursor() {
    const { app } = this;
    find("frame").value = app.frame;
    const cursor = this.rows.querySelector(".cursor");
    if (cursor) {
      this.#put(cursor, app.frame, app.frame + 1);
    }
    for (const bar of this.rows.querySelectorAll(".begun")) {
      const from = Number(bar.dataset.from);
      this.#put(bar, Math.min(from, app.frame), Math.max(from, app.frame) + 1);
    }
  }
}

export function runs(frames) {
  const found = [];
  for (const t of [...frames].sort((a, b) => a - b)) {
    if (found.length && found.at(-1)[1] === t - 1) found.at(-1)[1] = t;
    else found.push([t, t]);
  }
  return found;
}
