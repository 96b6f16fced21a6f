/* Contact by body part: what was found, as a draft, and what the annotation states. Once a section
 * states contact, nothing touches outside of its intervals; so the first edit takes all that was
 * found into the draft. */
import { bytes } from "./api.js";
import { UNSEEN } from "./draft.js";

const TOUCHING = 0.5;

export class Contact {
  constructor(app) {
    this.app = app;
    const told = app.told.contact;
    this.regions = told?.regions ?? app.told.regions;
    this.probability = told ? bytes(told.probability) : null;
    this.selected = null; // { part, start, end }
  }

  p(part, frame) {
    const r = this.regions.indexOf(part);
    return this.probability && r >= 0 ? this.probability[frame * this.regions.length + r] / 255 : null;
  }

  mean(interval) {
    let sum = 0;
    for (let t = interval.start; t < interval.end; t += 1) sum += this.p(interval.part, t) ?? 0;
    return sum / Math.max(1, interval.end - interval.start);
  }

  found() {
    const intervals = [];
    for (const part of this.regions) {
      let start = -1;
      for (let t = 0; t <= this.app.told.frames; t += 1) {
        const on = t < this.app.told.frames && (this.p(part, t) ?? 0) >= TOUCHING;
        if (on && start < 0) start = t;
        if (!on && start >= 0) { intervals.push({ part, start, end: t }); start = -1; }
      }
    }
    return intervals;
  }

  get stated() { return this.app.draft.get("contact"); }

  intervals() { return this.stated ?? this.found(); }

  /* The intervals to change: the draft's, or what was found, which becomes the draft; and those of them
   * that nobody has looked at. */
  #taken() {
    if (this.stated) return { all: structuredClone(this.stated), unseen: new Set(this.app.draft.get(UNSEEN) ?? []) };
    const all = this.found();
    return { all, unseen: new Set(all.map(id)) };
  }

  looked(interval) { return this.stated !== null && !this.app.draft.get(UNSEEN)?.includes(id(interval)); }

  #put(intervals, unseen, says) {
    intervals.sort((a, b) => order(this.regions, a) - order(this.regions, b) || a.start - b.start);
    this.app.draft.put({ contact: intervals, [UNSEEN]: intervals.map(id).filter((one) => unseen.has(one)) }, says);
  }

  change(interval, start, end) {
    const { all, unseen } = this.#taken(), k = all.findIndex((one) => id(one) === id(interval));
    if (k < 0) return;
    const bound = (v) => Math.max(0, Math.min(this.app.told.frames, Math.round(v)));
    const next = { ...all[k], start: bound(start), end: bound(end) };
    if (next.end <= next.start) { this.app.say("contact would end before it starts"); return; }
    all[k] = next;
    unseen.delete(id(interval));
    this.selected = next;
    this.#put(all, unseen, "contact moved");
  }

  confirm(interval) {
    const { all, unseen } = this.#taken();
    unseen.delete(id(interval));
    this.selected = interval;
    this.#put(all, unseen, "contact confirmed");
  }

  remove(interval) {
    this.selected = null;
    const { all, unseen } = this.#taken(), left = all.filter((one) => id(one) !== id(interval));
    this.#put(left, unseen, "contact deleted");
    if (!left.length) this.app.say("nothing touches any more, and that is annotated; \"As found again\" takes the statement away");
  }

  split(interval, frame) {
    if (frame <= interval.start || frame >= interval.end) { this.app.say("go to a frame within the interval to split it there"); return; }
    const { all, unseen } = this.#taken(), rest = all.filter((one) => id(one) !== id(interval));
    const parts = [{ ...interval, end: frame }, { ...interval, start: frame }];
    if (unseen.has(id(interval))) parts.forEach((one) => unseen.add(id(one)));
    this.selected = parts[1];
    this.#put([...rest, ...parts], unseen, "contact split");
  }

  add(part, start, end) {
    const { all, unseen } = this.#taken(), meets = all.filter((one) => one.part === part && one.start < end && one.end > start);
    const next = {
      part, start: Math.min(start, ...meets.map((one) => one.start)),
      end: Math.max(end, ...meets.map((one) => one.end)),
    };
    this.selected = next;
    unseen.delete(id(next));
    this.#put([...all.filter((one) => !meets.includes(one)), next], unseen, "contact added");
  }

  /* No contact of a part in these frames. */
  clear(part, start, end) {
    const { all, unseen } = this.#taken(), left = [];
    for (const one of all) {
      if (one.part !== part || one.end <= start || one.start >= end) { left.push(one); continue; }
      if (one.start < start) left.push({ ...one, end: start });
      if (one.end > end) left.push({ ...one, start: end });
    }
    this.#put(left, unseen, "contact denied");
  }

  /* No part touches in the whole sequence; an empty list says so. */
  nothing() {
    this.selected = null;
    this.#put([], new Set(), "nothing touches");
  }

  /* The annotation says nothing of contact: it is found again. */
  asFound() {
    this.selected = null;
    this.app.draft.put({ contact: null, [UNSEEN]: null }, "contact as found again");
  }

  takeAll() {
    const { all, unseen } = this.#taken();
    this.#put(all, unseen, "found contact taken");
  }

  /* The chosen interval; where a step back has changed it, that of the same part at the frame. */
  chosen(frame) {
    const of = this.selected && this.intervals().filter((one) => one.part === this.selected.part);
    return of?.find((one) => id(one) === id(this.selected)) ?? of?.find((one) => one.start <= frame && frame < one.end) ?? null;
  }
}

export const id = (one) => `${one.part}:${one.start}:${one.end}`;
const order = (regions, one) => (one.part === "any" ? 99 : regions.indexOf(one.part));
