/* Contact by body part: the intervals that the program estimated, and those of the annotation.
 * An interval is { part, start, end, uncertain }: contact in the frames from start to end - 1. The fit
 * may move the ends that `uncertain` names ("start", "end", "both"); without it they hold exactly. If an
 * annotation states contact, nothing touches outside of its intervals. The first edit therefore copies
 * all estimated intervals into the draft, with uncertain ends. An end that is moved is exact. */
import { fromBase64 } from "./api.js";
import { UNCONFIRMED } from "./draft.js";
import { intervals } from "./runs.js";

const TOUCHING = 0.5; // least probability of estimated contact

export class Contact {
  constructor(app) {
    this.app = app;
    const { contact, regions } = app.info;
    this.regions = contact?.regions ?? regions;
    this.probability = contact ? fromBase64(contact.probability) : null;
    this.selected = null; // { part, start, end }
  }

  /* Probability of contact of a part in a frame; null if unknown. */
  probabilityAt(part, frame) {
    const r = this.regions.indexOf(part);
    return this.probability && r >= 0 ? this.probability[frame * this.regions.length + r] / 255 : null;
  }

  /* Mean probability of contact over an interval. */
  mean(interval) {
    let sum = 0;
    for (let t = interval.start; t < interval.end; t += 1) sum += this.probabilityAt(interval.part, t) ?? 0;
    return sum / Math.max(1, interval.end - interval.start);
  }

  /* Runs of frames of each part with a probability of at least TOUCHING. */
  estimated() {
    const frames = Array.from({ length: this.app.info.frames }, (_, t) => t);
    return this.regions.flatMap((part) =>
      intervals(frames.map((t) => (this.probabilityAt(part, t) ?? 0) >= TOUCHING)).map(([start, end]) => ({ part, start, end, uncertain: "both" })));
  }

  /* Intervals of the draft; null if it states nothing about contact. */
  get stated() { return this.app.draft.get("contact"); }

  intervals() { return this.stated ?? this.estimated(); }

  /* A copy of the intervals to edit, and the ids of those that nobody has confirmed. */
  #editable() {
    if (this.stated) return { all: structuredClone(this.stated), unconfirmed: new Set(this.app.draft.get(UNCONFIRMED) ?? []) };
    const all = this.estimated();
    return { all, unconfirmed: new Set(all.map(id)) };
  }

  isConfirmed(interval) { return this.stated !== null && !this.app.draft.get(UNCONFIRMED)?.includes(id(interval)); }

  /* Put intervals into the draft as one undo step; `unconfirmed` are the ids of unconfirmed ones. */
  #store(intervals, unconfirmed, label) {
    intervals.sort((a, b) => order(this.regions, a) - order(this.regions, b) || a.start - b.start);
    this.app.draft.put({ contact: intervals, [UNCONFIRMED]: intervals.map(id).filter((key) => unconfirmed.has(key)) }, label);
  }

  /* Replace an interval by others, of which the last one is selected. */
  #replace(interval, parts, label, confirmed = true) {
    const { all, unconfirmed } = this.#editable(), others = all.filter((other) => id(other) !== id(interval));
    if (others.length === all.length) return;
    unconfirmed.delete(id(interval));
    if (!confirmed) parts.forEach((part) => unconfirmed.add(id(part)));
    this.selected = parts.at(-1) ?? null;
    this.#store([...others, ...parts], unconfirmed, label);
  }

  /* Move the ends of an interval, which confirms it. */
  change(interval, start, end) {
    const clamp = (v) => Math.max(0, Math.min(this.app.info.frames, Math.round(v)));
    let changed = { ...interval, start: clamp(start), end: clamp(end) };
    for (const end of ["start", "end"]) if (changed[end] !== interval[end]) changed = exact(changed, end);
    if (changed.end > changed.start) this.#replace(interval, [changed], "contact moved");
    else this.app.say("contact would end before it starts");
  }

  /* Mark the "start" or "end" as exact or uncertain. */
  setExact(interval, end, on) {
    const uncertain = { ...interval, uncertain: isUncertain(interval, OTHER[end]) ? "both" : end };
    this.#replace(interval, [on ? exact(interval, end) : uncertain], "uncertainty of contact changed");
  }

  confirm(interval) { this.#replace(interval, [interval], "contact confirmed"); }

  remove(interval) {
    this.#replace(interval, [], "contact deleted");
    if (this.stated?.length === 0) this.app.say("Annotated: no contact at all. \"Discard, use the estimate\" removes this.");
  }

  split(interval, frame) {
    if (frame <= interval.start || frame >= interval.end) { this.app.say("go to a frame inside the interval to split it there"); return; }
    const parts = [exact({ ...interval, end: frame }, "end"), exact({ ...interval, start: frame }, "start")];
    this.#replace(interval, parts, "contact split", this.isConfirmed(interval));
  }

  /* Add contact; overlapping intervals of the part are merged. Ends of `start` to `end` are exact, or those that
   * `uncertain` names are not; ends of an overlapping interval keep their state. */
  add(part, start, end, uncertain = null) {
    const { all, unconfirmed } = this.#editable();
    const overlapping = all.filter((other) => other.part === part && other.start < end && other.end > start);
    const parts = [...overlapping, { part, start, end, uncertain }];
    const first = parts.reduce((a, b) => (b.start < a.start ? b : a)), last = parts.reduce((a, b) => (b.end > a.end ? b : a));
    const open = [isUncertain(first, "start") && "start", isUncertain(last, "end") && "end"].filter(Boolean);
    const added = { part, start: first.start, end: last.end, ...(open.length && { uncertain: open.length === 2 ? "both" : open[0] }) };
    this.selected = added;
    unconfirmed.delete(id(added));
    this.#store([...all.filter((other) => !overlapping.includes(other)), added], unconfirmed, "contact added");
  }

  /* State that a part does not touch in frames `start` to `end` - 1. */
  clear(part, start, end) {
    const { all, unconfirmed } = this.#editable(), kept = [];
    for (const interval of all) {
      if (interval.part !== part || interval.end <= start || interval.start >= end) { kept.push(interval); continue; }
      if (interval.start < start) kept.push(exact({ ...interval, end: start }, "end"));
      if (interval.end > end) kept.push(exact({ ...interval, start: end }, "start"));
    }
    this.#store(kept, unconfirmed, "contact denied");
  }

  /* State that no part touches in the whole sequence, by an empty list. */
  stateNone() {
    this.selected = null;
    this.#store([], new Set(), "no contact at all");
  }

  /* Remove contact from the annotation, so that the program estimates it. */
  unstate() {
    this.selected = null;
    this.app.draft.put({ contact: null, [UNCONFIRMED]: null }, "contact estimated");
  }

  /* Copy all estimated intervals into the draft. */
  copyEstimate() {
    const { all, unconfirmed } = this.#editable();
    this.#store(all, unconfirmed, "estimated contact copied");
  }

  /* The selected interval; if undo has changed it, the interval of the same part at the frame. */
  selectedAt(frame) {
    const same = this.selected && this.intervals().filter((interval) => interval.part === this.selected.part);
    return same?.find((interval) => id(interval) === id(this.selected))
      ?? same?.find((interval) => interval.start <= frame && frame < interval.end) ?? null;
  }
}

export const OTHER = { start: "end", end: "start" };
export const isUncertain = ({ uncertain }, end) => uncertain === "both" || uncertain === end;

/* The interval with an exact "start" or "end". */
function exact({ uncertain, ...interval }, end) {
  return isUncertain({ uncertain }, OTHER[end]) ? { ...interval, uncertain: OTHER[end] } : interval;
}

export const id = (interval) => `${interval.part}:${interval.start}:${interval.end}`;
const order = (regions, interval) => (interval.part === "any" ? 99 : regions.indexOf(interval.part));
