/* Saving what was edited, with the difference shown before; running what it touches; new beside old. */
import { get, post } from "./api.js";
import { ask, banner, button, diff, find, make, words } from "./dom.js";
import { same, stated } from "./draft.js";

const CHECK_MS = 250;
const LOOK_MS = 4000;
const RUN_MS = 1000;
const GOES_ON = ["running", "ending"];
const POSES = ["object_poses", "object_pose"]; // two forms of the same: never one of each

export class Keep {
  constructor(app) {
    this.app = app;
    this.path = `sequences/${app.told.sequence}`;
    this.faults = [];
    this.run = { state: "none" };
    this.touched = null;
    this.beside = null;
    app.draft.addEventListener("change", () => this.checkSoon());
    find("undo").onclick = () => app.undo();
    find("redo").onclick = () => app.redo();
    find("save").onclick = () => this.save();
    window.addEventListener("beforeunload", (event) => { if (app.draft.dirty || app.paint?.changed) event.preventDefault(); });
    this.state();
    setInterval(() => this.look(), LOOK_MS);
    this.check();
    this.offer();
    this.progress();
  }

  /* Edits that were not saved, the latest first. Where the file is another one by now, they meet what
   * was saved meanwhile like any edit. */
  offer() {
    const { draft } = this.app, [left, ...older] = draft.left();
    if (!left) return;
    const more = older.length ? ` ${older.length} older ${older.length > 1 ? "ones follow" : "one follows"}.` : "";
    banner("left", `Edits that were not saved are here, from ${new Date(left.at).toLocaleString()} (${Object.keys(left.changes).map(words).join(", ")}).${more}`, [
      ["Take them up again", () => this.takeUp(left)], ["Discard them", () => { draft.dropLeft(left); this.offer(); }]]);
  }

  async takeUp(left) {
    const { app } = this, now = app.draft.file;
    if (left.digest !== now.digest && app.draft.dirty) {
      app.say("save or undo what you edited here first: these edits were made on an earlier file");
      this.offer();
      return;
    }
    app.draft.takeLeft(left);
    if (left.digest !== now.digest) await this.conflict({ now, difference: lineDiff(left.text, now.text) });
    this.offer();
  }

  checkSoon() {
    clearTimeout(this.soon);
    this.soon = setTimeout(() => this.check(), CHECK_MS);
    this.state();
  }

  async check() {
    const { app } = this, asked = this.asked = {}; // an earlier answer may come later
    let faults;
    try { faults = (await post(`${this.path}/check`, { changes: app.draft.changes() })).faults; } catch (error) { faults = [{ where: "", words: error.message }]; }
    if (asked !== this.asked) return;
    this.faults = faults;
    this.state();
  }

  state() {
    const { app } = this, count = Object.keys(app.draft.changes()).length;
    find("undo").disabled = !app.draft.done.length;
    find("redo").disabled = !app.draft.undone.length;
    find("save").disabled = !count || Boolean(app.told.read_only);
    const fault = this.faults[0];
    find("status").className = fault ? "fault" : count ? "open" : "dim";
    find("status").textContent = fault ? fault.words : count ? `not saved: ${Object.keys(app.draft.changes()).map(words).join(", ")}` : app.told.annotation.text ? "saved" : "no annotation yet";
  }

  /* One save at a time, however often it is asked for. */
  async save() {
    if (this.saving) return;
    this.saving = true;
    this.app.pose?.settle();
    try { await this.#save(); } finally { this.saving = false; }
  }

  async #save() {
    const { app } = this, changes = app.draft.changes();
    if (!Object.keys(changes).length) { app.say(app.paint?.changed ? "what is painted is saved by its own button, under Object" : "there is nothing to save"); return; }
    if (app.told.read_only) { app.say(app.told.read_only); return; }
    let found;
    try { found = await post(`${this.path}/check`, { changes }); } catch (error) { app.say(error.message); return; }
    this.faults = found.faults;
    this.state();
    if (found.faults.length) {
      await ask("Not saved: this is not right yet", make("ul", {}, found.faults.map((one) => make("li", {}, `${one.where}: ${one.words}`))), [["", "Back", true]]);
      return;
    }
    const touches = make("p", { data: { part: "touches" } }, "What a run then makes anew is looked up…");
    post(`${this.path}/check`, { changes, plan: true }).then(({ touched }) => {
      touches.textContent = touched?.length ? `A run then makes anew: ${touched.map((one) => words(one.stage)).join(", ")}.` : "Nothing has to be run again.";
    }, (error) => { touches.textContent = error.message; });
    const begun = [app.sides.open.size ? "left and right" : "", app.dropped.from === null ? "" : "frames to drop"].filter(Boolean);
    const open = begun.length ? [make("p", { class: "fault" }, `Begun and not ended, so not in it: ${begun.join(", ")}.`)] : [];
    const answer = await ask(`Save ${app.draft.file.path}`, [diff(found.difference), ...open, touches],
      [["save", "Save", true], ...(app.told.profile ? [] : [["run", "Save and run"]]), ["", "Cancel"]]);
    if (!answer) return;
    try {
      app.saved(await post(`${this.path}/save`, { digest: app.draft.file.digest, text: app.draft.file.text, changes }));
      app.say("saved");
      app.questions.saved();
    } catch (error) {
      if (error.status === 409) await this.conflict(error.told);
      else await ask("Not saved", make("p", {}, error.message), [["", "Back", true]]);
      return;
    }
    if (answer === "run") this.start(); else this.plan(); // which takes seconds: the next save need not wait
  }

  /* Somebody else saved meanwhile: their change is shown, and nothing of either is lost. */
  async conflict(told) {
    const { app } = this, theirs = told.now.sections, mine = app.draft.changes();
    if (told.now.problem) {
      await ask("The annotation's file is broken by now", [make("p", { class: "fault" }, told.now.problem),
        make("p", {}, "Nothing was saved, and what you see is as the file was before, with your edits. They stay here: save when the file is mended.")], [["", "Back", true]]);
      return;
    }
    if (POSES.some((name) => name in mine)) for (const name of POSES) mine[name] = app.draft.get(name);
    const both = Object.keys(mine).filter((name) => !same(stated(name, theirs[name]), app.draft.saved[name]));
    const answer = await ask("Somebody else changed this annotation meanwhile", [
      make("p", {}, "Their change, which is in the file:"), diff(told.difference || "(only the layout changed)"),
      make("p", {}, both.length ? `Both of you changed ${both.map(words).join(", ")}: yours would replace theirs there.` : "You changed other sections: both changes can stand.")],
    [["mine", both.length ? "Keep mine there, theirs elsewhere" : "Keep both", !both.length], ["theirs", "Take theirs, drop mine"], ["", "Decide later", both.length > 0]]);
    if (!answer) return;
    const edited = structuredClone(mine);
    app.draft.base(told.now, true);
    app.told.annotation = told.now;
    app.draft.over(edited);
    banner("changed", "");
    if (answer === "theirs") { app.draft.takeFile("theirs taken"); return; }
    await this.#save();
  }

  /* Has the file or the result changed behind this page? */
  async look() {
    const { app } = this;
    if (document.hidden) return;
    let now;
    try { now = await get(`${this.path}/state`); } catch (error) {
      banner("server", error.message);
      this.lost = true;
      return;
    }
    if (this.lost) { banner("server", ""); this.lost = false; app.redraw(); this.check(); }
    if (now.annotation !== app.draft.file.digest && this.known !== now.annotation) {
      this.known = now.annotation;
      banner("changed", "The annotation was changed meanwhile, in another tab or by somebody else.", [["Show", () => this.showChange()]]);
    }
    if (now.result !== app.told.result && !GOES_ON.includes(this.run.state) && this.seen !== now.result) {
      this.seen = now.result;
      banner("result", "The results are others by now.", [["Load them", () => app.reload()]]);
    }
  }

  async showChange() {
    const { app } = this;
    let now;
    try { now = await get(`${this.path}/annotation`); } catch (error) { app.say(error.message); this.known = null; return; }
    if (!app.draft.dirty && !now.problem) { app.saved(now, true); app.draft.takeFile("theirs taken"); app.draft.done.pop(); app.draft.told(); return; }
    await this.conflict({ now, difference: lineDiff(app.draft.file.text, now.text) });
  }

  async plan() {
    try { this.touched = (await post(`${this.path}/check`, { changes: {}, plan: true })).touched ?? []; } catch (error) { this.app.say(error.message); }
    this.app.panels();
  }

  async start() {
    const { app } = this;
    if (app.draft.dirty) { app.say("save first: a run reads the saved annotation"); return; }
    app.tab("run");
    try { this.run = await post(`${this.path}/run`, { do: "start" }); } catch (error) { app.say(error.message); }
    app.panels();
    this.progress();
  }

  async progress() {
    clearTimeout(this.timer);
    const { app } = this, before = this.run.state;
    try { this.run = await get(`${this.path}/run`); } catch { /* told by look() */ }
    if (GOES_ON.includes(before) && !GOES_ON.includes(this.run.state) && this.run.sequence === app.told.sequence) {
      this.touched = null;
      await app.reload();
      await this.compare();
      app.say({ done: "the new result is drawn; B shows the old one beside it", stopped: "the run was stopped; what was done is kept" }[this.run.state] ?? "the run failed");
    }
    if (GOES_ON.includes(this.run.state)) this.timer = setTimeout(() => this.progress(), RUN_MS);
    if (before !== "none" || this.run.state !== "none") app.panels();
  }

  async stop() {
    try { this.run = await post(`${this.path}/run`, { do: "stop" }); } catch (error) { this.app.say(error.message); }
    this.app.panels();
  }

  /* The new result beside the old one. */
  async compare() {
    const { app } = this;
    try {
      this.beside = await get(`${this.path}/beside`);
      if (this.beside.there) await app.loadBefore(); else app.say("no run from this page has replaced a result yet");
    } catch (error) { app.say(error.message); }
    app.panels();
  }

  panel() {
    const { app, run } = this, parts = [];
    const own = run.sequence === app.told.sequence;
    if (GOES_ON.includes(run.state)) {
      const ending = run.state === "ending";
      parts.push(make("p", {}, ending ? `Ending… for ${run.ending_s.toFixed(0)} s; what is half done is cleared up, which takes ${run.ends_within_s.toFixed(0)} s at most.` : own ? `Running, ${run.seconds.toFixed(0)} s` : `A run of ${run.sequence} goes on.`),
        make("ol", { class: "stages" }, run.stages.map((one) => make("li", { data: { state: one.state } }, make("b", {}, words(one.stage)), ` ${one.state === "waits" ? "" : one.state} `, make("span", { class: "dim" }, one.words)))),
        ending && run.ending_s <= run.ends_within_s ? null : button(ending ? "Kill it" : "Stop", () => this.stop()));
      return make("div", { class: "run" }, parts);
    }
    if (own && run.state === "stopped") parts.push(make("p", {}, "The run was stopped; what was done is kept."));
    if (own && run.state === "failed") parts.push(make("p", { class: "fault" }, "The run failed:"), make("pre", { tabIndex: 0 }, run.words));
    if (own && run.state === "done") parts.push(make("p", {}, `Done in ${run.seconds.toFixed(0)} s.`));
    if (this.touched) parts.push(this.touched.length ? make("div", {}, make("p", {}, "A run makes anew:"),
      make("ol", {}, this.touched.map((one) => make("li", {}, make("b", {}, words(one.stage)), make("span", { class: "dim" }, ` ${one.reasons.join("; ")}`))))) : make("p", {}, "All results are up to date."));
    if (run.cluster) parts.push(make("p", {}, "Jobs go to a cluster. Run there:"), make("pre", { tabIndex: 0 }, run.command));
    else parts.push(button("Run what is out of date", () => this.start(), { class: "main" }));
    parts.push(button("What would run?", () => this.plan()));
    if (!run.cluster && run.command) parts.push(make("details", {}, make("summary", {}, "The same on a terminal"), make("pre", { tabIndex: 0 }, run.command)));
    if (this.beside?.there) {
      const when = (text) => new Date(text).toLocaleString();
      parts.push(make("p", { class: "dim", data: { part: "before" } }, `Old: the result of ${when(this.beside.made_at)}, kept before the run of ${when(this.beside.kept_at)}`,
        this.beside.unfinished ? ". That run did not end well: the next one keeps this old result." : "."));
      const show = (value) => (value === null || value === undefined ? "–" : String(value));
      parts.push(make("table", { class: "beside" }, make("tr", {}, make("th", {}, "verdict"), make("th", {}, "old"), make("th", {}, "new")),
        this.beside.rows.map((row) => make("tr", { class: row.old === row.new ? "" : "differs" }, make("td", {}, row.name), make("td", {}, show(row.old)), make("td", {}, show(row.new))))));
      const moved = (name, by) => (by ? make("p", { class: "dim" }, `${name} moved by ${Math.max(...by).toFixed(1)} mm at the most, in frame ${by.indexOf(Math.max(...by))}.`) : null);
      parts.push(moved("The body", this.beside.body_moved_mm), moved("The object", this.beside.object_moved_mm));
    } else if (!this.beside) {
      parts.push(button("New beside old", () => this.compare()));
    }
    return make("div", { class: "run" }, parts);
  }
}

function lineDiff(before, now) {
  const [a, b] = [before.split(/\r?\n/), now.split(/\r?\n/)];
  return [...a.filter((line) => !b.includes(line)).map((line) => `-${line}`), ...b.filter((line) => !a.includes(line)).map((line) => `+${line}`)].join("\n");
}
