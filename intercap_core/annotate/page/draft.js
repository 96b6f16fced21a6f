/* The edited annotation (draft): its sections, with undo and redo. `file` is the annotation file that the
 * page has read last, `saved` its sections. A copy of unsaved edits is stored in this browser. */
export const SECTIONS = ["contact", "object_poses", "object_pose", "floor", "subject", "drop_frames", "left_right"];
/* Not a section of the file: ids of estimated contact intervals that nobody has confirmed. */
export const UNCONFIRMED = "unconfirmed";
const canonical = (value) => JSON.stringify(value ?? null, (_, item) => // independent of the order of keys
  (item && typeof item === "object" && !Array.isArray(item) ? Object.fromEntries(Object.entries(item).sort()) : item));
export const same = (a, b) => canonical(a) === canonical(b);
/* An empty list equals a missing section, except for contact: there it states that nothing touches. */
export const normalize = (name, value) => (Array.isArray(value) && !value.length && name !== "contact" ? null : value ?? null);

export class Draft extends EventTarget {
  constructor(annotation, copies) {
    super();
    this.copies = copies;
    this.redoSteps = [];
    this.undoSteps = [];
    this.rebase(annotation);
    this.sections = structuredClone(this.saved);
  }

  /* Replace the saved sections by those of the file; edits stay. After a save by another annotator
   * (`theirs`), undo is cleared: an earlier step would remove their changes. */
  rebase(annotation, theirs = false) {
    if (theirs) { this.undoSteps = []; this.redoSteps = []; }
    this.file = annotation;
    this.saved = {};
    for (const name of SECTIONS) this.saved[name] = normalize(name, annotation.sections[name]);
  }

  get(section) { return this.sections[section] ?? null; }

  set(section, value, label = "") { this.put({ [section]: value }, label); }

  /* Set several sections as one undo step with a label. */
  put(values, label = "") {
    const next = {};
    for (const [name, value] of Object.entries(values)) next[name] = structuredClone(normalize(name, value));
    if (Object.keys(next).every((name) => same(next[name], this.sections[name]))) return;
    this.undoSteps.push({ sections: this.sections, label });
    this.redoSteps = [];
    this.sections = { ...this.sections, ...next };
    this.notify();
  }

  undo() { this.#step(this.undoSteps, this.redoSteps); }

  redo() { this.#step(this.redoSteps, this.undoSteps); }

  #step(from, to) {
    const step = from.pop();
    if (!step) return;
    to.push({ sections: this.sections, label: step.label });
    this.sections = step.sections;
    this.notify();
  }

  /* Sections that differ from the file; null removes a section. */
  changes() {
    const changes = {};
    for (const name of SECTIONS) {
      if (!same(this.sections[name], this.saved[name])) changes[name] = this.sections[name] ?? null;
    }
    return changes;
  }

  get dirty() { return Object.keys(this.changes()).length > 0; }

  /* Apply edits to the saved sections. */
  reapply(edits) {
    this.sections = { ...structuredClone(this.saved), ...structuredClone(edits), [UNCONFIRMED]: this.get(UNCONFIRMED) };
    this.notify();
  }

  /* Replace the edits by the file's sections, as one undo step. */
  revert(label) {
    this.undoSteps.push({ sections: this.sections, label });
    this.sections = structuredClone(this.saved);
    this.notify();
  }

  /* Update the copy in the browser, and notify listeners. */
  notify() {
    if (this.dirty) {
      const { digest, text } = this.file;
      this.copies.keep({ digest, text, sections: this.saved, changes: this.changes(), [UNCONFIRMED]: this.get(UNCONFIRMED) });
    } else this.copies.drop();
    this.dispatchEvent(new Event("change"));
  }

  /* Unsaved edits of closed tabs, latest first; copies without a difference to the file are dropped. */
  orphans() {
    return this.copies.orphans.filter((copy) => {
      const differs = SECTIONS.some((name) => name in copy.changes && !same(copy.changes[name], this.saved[name]));
      if (!differs) this.copies.drop(copy.key);
      return differs;
    });
  }

  /* Continue the edits of a closed tab on the file that they were made on. */
  restore(copy) {
    if (copy.digest === this.file.digest) this.undoSteps.push({ sections: this.sections, label: "edits restored" });
    else {
      this.rebase({ ...this.file, digest: copy.digest, text: copy.text, sections: copy.sections }, true);
      this.sections = structuredClone(this.saved);
    }
    this.sections = { ...this.sections, ...structuredClone({ ...copy.changes, [UNCONFIRMED]: copy[UNCONFIRMED] ?? null }) };
    this.notify();
    this.discard(copy);
  }

  /* Delete the edits of a closed tab. */
  discard(copy) {
    this.copies.orphans = this.copies.orphans.filter((other) => other !== copy);
    this.copies.drop(copy.key);
  }
}
