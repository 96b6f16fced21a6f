/* The annotation as it is edited: its sections, undo and redo; a copy of it is kept in this browser. */
export const SECTIONS = ["contact", "object_poses", "object_pose", "floor", "subject", "drop_frames", "left_right"];
/* Not of the file: intervals of contact, as they were found, that nobody has looked at. */
export const UNSEEN = "unseen";
const plain = (value) => JSON.stringify(value ?? null, (_, one) => // whatever the order of its keys
  (one && typeof one === "object" && !Array.isArray(one) ? Object.fromEntries(Object.entries(one).sort()) : one));
export const same = (a, b) => plain(a) === plain(b);
/* An empty list says as much as no section, but of contact: there it says that nothing touches. */
export const stated = (name, value) => (Array.isArray(value) && !value.length && name !== "contact" ? null : value ?? null);

export class Draft extends EventTarget {
  constructor(annotation, copies) {
    super();
    this.copies = copies;
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
    for (const name of SECTIONS) this.saved[name] = stated(name, annotation.sections[name]);
  }

  get(section) { return this.sections[section] ?? null; }

  /* One step that can be undone; what is said of it is shown. */
  set(section, value, says = "") { this.put({ [section]: value }, says); }

  /* The same of several sections at once. */
  put(values, says = "") {
    const next = {};
    for (const [name, value] of Object.entries(values)) next[name] = structuredClone(stated(name, value));
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

  /* Edits upon what the file has by now. */
  over(edits) {
    this.sections = { ...structuredClone(this.saved), ...structuredClone(edits), [UNSEEN]: this.get(UNSEEN) };
    this.told();
  }

  /* The file's sections in place of the edits, as a step that can be undone. */
  takeFile(says) {
    this.done.push({ sections: this.sections, says });
    this.sections = structuredClone(this.saved);
    this.told();
  }

  told() {
    if (this.dirty) {
      const { digest, text } = this.file;
      this.copies.keep({ digest, text, sections: this.saved, changes: this.changes(), [UNSEEN]: this.get(UNSEEN) });
    } else this.copies.drop();
    this.dispatchEvent(new Event("change"));
  }

  /* Edits that tabs which are gone did not save, the latest first. */
  left() {
    return this.copies.found.filter((kept) => {
      const open = SECTIONS.some((name) => name in kept.changes && !same(kept.changes[name], this.saved[name]));
      if (!open) this.copies.drop(kept.key);
      return open;
    });
  }

  /* Go on with such edits, upon the file that they were made on. */
  takeLeft(kept) {
    if (kept.digest === this.file.digest) this.done.push({ sections: this.sections, says: "taken up again" });
    else {
      this.base({ ...this.file, digest: kept.digest, text: kept.text, sections: kept.sections }, true);
      this.sections = structuredClone(this.saved);
    }
    this.sections = { ...this.sections, ...structuredClone({ ...kept.changes, [UNSEEN]: kept[UNSEEN] ?? null }) };
    this.told();
    this.dropLeft(kept);
  }

  dropLeft(kept) {
    this.copies.found = this.copies.found.filter((one) => one !== kept);
    this.copies.drop(kept.key);
  }
}
