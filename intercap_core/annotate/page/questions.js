/* A queue of questions, those first whose answer changes most; each answered in seconds. An answer that
 * edits counts as given when the edit is saved: an edit that is lost or undone is asked again. */
import { get, post } from "./api.js";
import { button, make } from "./dom.js";
import { UNSEEN, same } from "./draft.js";
import { putPose } from "./pose.js";

const POSES = ["object_poses", "object_pose"];
const EDITED = { subject: ["subject"], sides: ["left_right"], lost: POSES, turn: POSES, contact: ["contact", UNSEEN] };

export class Questions {
  constructor(app) {
    this.app = app;
    this.list = [];
    this.current = null;
    this.pending = []; // answers that edit: { told, depth: steps of the draft with the edit, of: what it edits, was: before }
    app.draft.addEventListener("change", () => {
      const kept = this.pending.filter((one) => one.depth <= app.draft.done.length);
      if (kept.length === this.pending.length) return;
      this.pending = kept;
      this.load();
    });
  }

  async load() {
    if (!this.app.told.frames) return;
    try { this.#take(await get(`sequences/${this.app.told.sequence}/questions`)); } catch (error) { this.app.say(error.message); }
    this.app.panels();
  }

  #take(list) { this.list = list.filter((one) => !this.pending.some(({ told }) => told.id === one.id)); }

  /* The draft was saved: what was answered by it is kept. */
  async saved() {
    const given = this.pending.filter(({ of, was }) => !same(this.#state(of), was)); // or nobody placed, turned or marked
    const open = given.length < this.pending.length;
    this.pending = [];
    if (open) await this.load();
    for (const { told } of given) {
      try { this.#take((await post(`sequences/${this.app.told.sequence}/answer`, told)).questions); } catch (error) { this.app.say(error.message); }
    }
    this.app.panels();
  }

  #state(sections) { return sections.map((name) => this.app.draft.get(name)); }

  ask(question) {
    const { app } = this;
    this.current = question;
    if (question.camera) app.views.prefer([question.camera]);
    if (question.kind === "sides") app.layer("sides", true);
    app.show(question.frame);
    app.tab("questions");
    if (question.camera) app.whole(); else app.nearby();
    app.panels();
  }

  next() { if (this.list.length) this.ask(this.list[0]); else this.app.say("no question is open"); }

  async answer(question, answer) {
    const { app } = this, { contact, pose, draft } = app;
    const edits = (question.kind === "sides" ? ["view", "all", "mark"] : ["yes", "no", "place"]).includes(answer);
    const opens = { mark: app.sides, place: pose, no: question.kind === "turn" ? pose : question.kind === "subject" ? app.subject : null }[answer];
    const told = { ...question, answer };
    // before the edit, so that the steps tell whether it is there
    const of = EDITED[question.kind], was = this.#state(of);
    if (edits) this.pending.push({ told, of, was, depth: draft.done.length + (opens ? 1 : 0) });
    if (question.kind === "contact" && answer === "yes") contact.add(question.part, question.first, question.last + 1);
    if (question.kind === "contact" && answer === "no") contact.clear(question.part, question.first, question.last + 1);
    if (question.kind === "turn" && answer === "yes" && pose?.found(question.frame)) {
      putPose(draft, question.frame, pose.found(question.frame), "turn confirmed");
    }
    if (answer === "view" || answer === "all") app.sides.change(answer === "view" ? question.camera : null, question.first, question.last, true);
    if (question.kind === "subject" && answer === "yes") {
      const { camera, frame, x, y } = question;
      const set = app.setOf(app.told.cameras.findIndex((one) => one.name === camera), frame);
      draft.set("subject", [...(draft.get("subject") ?? []), { camera, frame: set, x, y }], "subject confirmed");
    }
    const nothing = edits && !opens && same(this.#state(of), was); // it is as answered already
    if (nothing) this.pending = this.pending.filter((one) => one.told !== told);
    if (edits && !nothing) {
      this.list = this.list.filter((one) => one.id !== question.id);
      this.pending.at(-1).depth = draft.done.length + (opens ? 1 : 0);
    } else {
      try { this.#take((await post(`sequences/${app.told.sequence}/answer`, told)).questions); } catch (error) { app.say(error.message); return; }
    }
    this.current = null;
    app.panels();
    if (opens === pose && pose) { app.show(question.frame); pose.start(); app.tab("object"); }
    else if (opens === app.sides) app.tab("sides");
    else if (opens) { app.setMode(opens); app.tab("marks"); }
    else if (this.list.length) this.ask(this.list[0]);
    else app.say("all questions are answered: save, then run");
  }

  /* Keys 1 to 9 answer the question that is shown. */
  key(number) {
    const choice = this.current?.choices[number - 1];
    if (choice) this.answer(this.current, choice.answer);
    return Boolean(choice);
  }

  mark(view, brush) {
    const one = this.current, { app } = this;
    if (one?.kind !== "subject" || one.camera !== view.camera.name || one.frame !== app.frame) return;
    const [x, y] = app.views.spot(view, one.x, one.y);
    brush.strokeStyle = "#ffd60a";
    brush.lineWidth = 3;
    brush.strokeRect(x - 14, y - 14, 28, 28);
  }

  panel() {
    const { app } = this, one = this.current;
    const seconds = (q) => `${q.from_s.toFixed(1)}–${q.to_s.toFixed(1)} s`;
    return make("div", { class: "questions" },
      one ? make("div", { class: "question" }, make("p", { class: "ask" }, one.words),
        make("p", { class: "dim" }, `frames ${one.first} to ${one.last}${one.why ? `; ${one.why}` : ""}`),
        make("div", {}, one.choices.map((choice, k) => button(`${k + 1}  ${choice.label}`, () => this.answer(one, choice.answer), { data: { answer: choice.answer } }))))
        : make("p", {}, this.list.length ? `${this.list.length} questions, those first that change most.` : "No question is open."),
      this.list.length && !one ? button("Ask me", () => this.next(), { class: "main", title: "Q" }) : null,
      make("ol", {}, this.list.filter((q) => q !== one).slice(0, 12).map((q) => make("li", {},
        button(q.words, () => this.ask(q), { class: "plain" }), make("span", { class: "dim" }, ` ${seconds(q)}`)))),
      make("p", { class: "dim" }, "What is answered is never asked again. Answers that edit count when the annotation is saved."));
  }
}
