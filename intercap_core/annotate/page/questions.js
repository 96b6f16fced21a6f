/* Questions to the annotator, those with the largest effect first. An answer that edits the annotation
 * counts when the edit is saved; if the edit is undone, the question is asked again. */
import { get, post } from "./api.js";
import { button, make } from "./dom.js";
import { UNCONFIRMED, same } from "./draft.js";
import { putPose } from "./pose.js";

const POSES = ["object_poses", "object_pose"];
const EDITED_SECTIONS = { subject: ["subject"], sides: ["left_right"], lost: POSES, turn: POSES, contact: ["contact", UNCONFIRMED] };

export class Questions {
  constructor(app) {
    this.app = app;
    this.list = [];
    this.current = null;
    /* Answers that edit: { answered, sections: those that it edits, before: their earlier values,
     * steps: number of undo steps that include the edit }. */
    this.pending = [];
    app.draft.addEventListener("change", () => {
      const kept = this.pending.filter(({ steps }) => steps <= app.draft.undoSteps.length);
      if (kept.length === this.pending.length) return;
      this.pending = kept;
      this.load();
    });
  }

  async load() {
    if (!this.app.info.frames) return;
    try { this.#setList(await get(`${this.app.path}/questions`)); } catch (error) { this.app.say(error.message); }
    this.app.panels();
  }

  #setList(list) { this.list = list.filter(({ id }) => !this.pending.some(({ answered }) => answered.id === id)); }

  /* After a save: store the answers whose edits were saved. */
  async saved() {
    const effective = this.pending.filter(({ sections, before }) => !same(this.#values(sections), before));
    const unanswered = effective.length < this.pending.length; // such as "I place it" without a pose
    this.pending = [];
    if (unanswered) await this.load();
    for (const { answered } of effective) {
      try { this.#setList((await post(`${this.app.path}/answer`, answered)).questions); } catch (error) { this.app.say(error.message); }
    }
    this.app.panels();
  }

  #values(sections) { return sections.map((name) => this.app.draft.get(name)); }

  ask(question) {
    const { app } = this;
    this.current = question;
    if (question.camera) app.views.prefer([question.camera]);
    if (question.kind === "sides") app.setLayer("sides", true);
    app.show(question.frame);
    app.tab("questions");
    if (question.camera) app.showWhole(); else app.showNear();
    app.panels();
  }

  next() { if (this.list.length) this.ask(this.list[0]); else this.app.say("there is no open question"); }

  /* Apply an answer: edit the annotation, start the mode in which the user edits it, or only store it. */
  async answer(question, answer) {
    const { app } = this, { contact, pose, draft } = app;
    const edits = (question.kind === "sides" ? ["view", "all", "mark"] : ["yes", "no", "place"]).includes(answer);
    const mode = { mark: app.sides, place: pose, no: question.kind === "turn" ? pose : question.kind === "subject" ? app.subject : null }[answer];
    const answered = { ...question, answer };
    const sections = EDITED_SECTIONS[question.kind], before = this.#values(sections);
    const pending = { answered, sections, before, steps: draft.undoSteps.length + (mode ? 1 : 0) };
    if (edits) this.pending.push(pending); // before the edit, which notifies the listener above
    if (question.kind === "contact" && answer === "yes") contact.add(question.part, question.first, question.last + 1, "both");
    if (question.kind === "contact" && answer === "no") contact.clear(question.part, question.first, question.last + 1);
    if (question.kind === "turn" && answer === "yes" && pose?.resultAt(question.frame)) {
      putPose(draft, question.frame, pose.resultAt(question.frame), "rotation confirmed");
    }
    if (answer === "view" || answer === "all") app.sides.change(answer === "view" ? question.camera : null, question.first, question.last, true);
    if (question.kind === "subject" && answer === "yes") {
      const { camera, frame, x, y } = question;
      const set = app.setOf(app.info.cameras.findIndex(({ name }) => name === camera), frame);
      draft.set("subject", [...(draft.get("subject") ?? []), { camera, frame: set, x, y }], "subject confirmed");
    }
    const unchanged = edits && !mode && same(this.#values(sections), before); // the annotation agrees already
    if (unchanged) this.pending = this.pending.filter((other) => other !== pending);
    if (edits && !unchanged) {
      this.list = this.list.filter(({ id }) => id !== question.id);
      this.pending.at(-1).steps = draft.undoSteps.length + (mode ? 1 : 0);
    } else {
      try { this.#setList((await post(`${app.path}/answer`, answered)).questions); } catch (error) { app.say(error.message); return; }
    }
    this.current = null;
    app.panels();
    if (mode === pose && pose) { app.show(question.frame); pose.start(); app.tab("object"); }
    else if (mode === app.sides) app.tab("sides");
    else if (mode) { app.setMode(mode); app.tab("marks"); }
    else if (this.list.length) this.ask(this.list[0]);
    else app.say("all questions are answered: save, then run");
  }

  /* Answer the shown question by the number of a choice. */
  key(number) {
    const choice = this.current?.choices[number - 1];
    if (choice) this.answer(this.current, choice.answer);
    return Boolean(choice);
  }

  mark(view, brush) {
    const question = this.current, { app } = this;
    if (question?.kind !== "subject" || question.camera !== view.camera.name || question.frame !== app.frame) return;
    const [x, y] = app.views.spot(view, question.x, question.y);
    brush.strokeStyle = "#ffd60a";
    brush.lineWidth = 3;
    brush.strokeRect(x - 14, y - 14, 28, 28);
  }

  panel() {
    const { current } = this;
    const seconds = (q) => `${q.from_s.toFixed(1)}–${q.to_s.toFixed(1)} s`;
    return make("div", { class: "questions" },
      current ? make("div", { class: "question" }, make("p", { class: "ask" }, current.message),
        make("p", { class: "dim" }, `frames ${current.first} to ${current.last}${current.why ? `; ${current.why}` : ""}`),
        make("div", {}, current.choices.map((choice, k) => button(`${k + 1}  ${choice.label}`, () => this.answer(current, choice.answer), { data: { answer: choice.answer } }))))
        : make("p", {}, this.list.length ? `${this.list.length} open questions, those with the largest effect first.` : "There is no open question."),
      this.list.length && !current ? button("Answer questions", () => this.next(), { class: "main", title: "Q" }) : null,
      make("ol", {}, this.list.filter((q) => q !== current).slice(0, 12).map((q) => make("li", {},
        button(q.message, () => this.ask(q), { class: "plain" }), make("span", { class: "dim" }, ` ${seconds(q)}`)))),
      make("p", { class: "dim" }, "An answered question is not asked again. An answer that edits the annotation counts when it is saved."));
  }
}
