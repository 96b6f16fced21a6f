/* The annotation as it is edited: its sections, undo and redo, and a copy in this browser, so that a
 * tab that closes or a tunnel that breaks loses nothing. */
export const SECTIONS = ["contact", "object_poses", "object_pose", "floor", "subject", "drop_frames", "left_right"];
const same = (a, b) => JSON.stringify(a ?? null) === JSON.stringify(b ?? null);
const empty = (value) => value === null || value === undefined || (Array.isArray(value) && !value.length);

export class Draft extends EventTarget {
  constructor(name, annotation) {
    super();
    this.key = `intercap-draft:${location.port}:${name}`;
    this.undone = [];
    this.done = [];
    this.base(annotation);
    this.sections = structuredClone(this.saved);
  }

  /* What the file holds by now; the edits stay. Of theirs no step back leads out: an earlier step
   * would take away what they saved. */
  base(annotation, theirs = false) {
    if (theirs) { this.done = []; this.undone = []; }
    this.file = annotation;
    this.saved = {};
    for (const name of SECTIONS) this.saved[name] = annotation.sections[name] ?? null;
  }

  get(section) { return this.sections[section] ?? null; }

  /* One step that can be undone; what is said of it is shown. */
  set(section, value, says = "") { this.put({ [section]: value }, says); }

  /* The same of several sections at once. */
  put(values, says = "") {
    const next = {};
    for (const [name, value] of Object.entries(values)) next[name] = empty(value) ? null : structuredClone(value);
    if (Object.keys(next).every((name) => same(next[name], this.sections[name]))) return;
    this.done.push({ sections: this.sections, says });
    this.undone = [];
    this.sections = { ...this.sections, ...next };
    this.told();
  }

  undo() { this.#swap(this.done, this.undone); }

  redo() { this.#swap(this.undone, this.done); }

  #swap(from, to) {
    const step = from.pop();
    if (!step) return;
    to.push({ sections: this.sections, says: step.says });
    this.sections = step.sections;
    this.told();
  }

  /* The sections that differ from the file's; null takes one away. */
  changes() {
    const found = {};
    for (const name of SECTIONS) {
      if (!same(this.sections[name], this.saved[name])) found[name] = this.sections[name] ?? null;
    }
    return found;
  }

  get dirty() { return Object.keys(this.changes()).length > 0; }

  /* The file's sections in place of the edits, as a step that can be undone. */
  takeFile(says) {
    this.done.push({ sections: this.sections, says });
    this.sections = structuredClone(this.saved);
    this.told();
  }

  told() {
    try {
      if (this.dirty) {
        const kept = { digest: this.file.digest, changes: this.changes(), at: Date.now() };
        localStorage.setItem(this.key, JSON.stringify(kept));
      } else localStorage.removeItem(this.key);
    } catch { /* a browser that keeps nothing */ }
    this.dispatchEvent(new Event("change"));
  }

  /* Edits that an earlier tab did not save, null = none. */
  left() {
    try {
      const kept = JSON.parse(localStorage.getItem(this.key) ?? "null");
      if (!kept || typeof kept.changes !== "object") return null;
      const open = Object.entries(kept.changes).filter(
        ([name, value]) => SECTIONS.includes(name) && !same(value, this.saved[name]));
      return open.length ? { ...kept, changes: Object.fromEntries(open) } : null;
    } catch { return null; }
  }

  takeLeft(kept) {
    this.done.push({ sections: this.sections, says: "taken up again" });
    this.sections = { ...this.sections, ...kept.changes };
    this.told();
  }

  dropLeft() { localStorage.removeItem(this.key); }
}
