/* Saving of edits after their difference to the file was shown, runs of stale stages, and the
 * comparison of the new result with the old one. */
import { get, post } from "./api.js";
import { ask, banner, button, diff, find, make, readable } from "./dom.js";
import { normalize, same } from "./draft.js";

const CHECK_MS = 250; // delay from an edit to its check
const POLL_MS = 4000; // interval of checks for changes of file and results by others
const RUN_MS = 1000; // interval at which the progress of a run is read
const IN_PROGRESS = ["running", "ending"];
const POSES = ["object_poses", "object_pose"]; // two forms of one section; a file has at most one

export class Saving {
  constructor(app) {
    this.app = app;
    this.faults = [];
    this.run = { state: "none" };
    this.stale = null;
    this.comparison = null;
    app.draft.addEventListener("change", () => this.checkSoon());
    find("undo").onclick = () => app.undo();
    find("redo").onclick = () => app.redo();
    find("save").onclick = () => this.save();
    window.addEventListener("beforeunload", (event) => { if (app.draft.dirty || app.paint?.changed) event.preventDefault(); });
    this.showStatus();
    setInterval(() => this.poll(), POLL_MS);
    this.check();
    this.offerOrphans();
    this.progress();
  }

  /* Offer the latest unsaved edits of closed tabs. */
  offerOrphans() {
    const { draft } = this.app, [copy, ...older] = draft.orphans();
    if (!copy) return;
    const more = older.length ? ` There ${older.length > 1 ? "are" : "is"} ${older.length} older.` : "";
    banner("orphans", `Unsaved edits from ${new Date(copy.at).toLocaleString()} were found (${Object.keys(copy.changes).map(readable).join(", ")}).${more}`, [
      ["Restore", () => this.restore(copy)], ["Discard", () => { draft.discard(copy); this.offerOrphans(); }]]);
  }

  /* Restore the edits of a closed tab. If the file has changed since, they are handled like a conflict
   * with another annotator. */
  async restore(copy) {
    const { app } = this, now = app.draft.file;
    if (copy.digest !== now.digest && app.draft.dirty) {
      app.say("save or undo your current edits first: the stored edits belong to an earlier version of the file");
      this.offerOrphans();
      return;
    }
    app.draft.restore(copy);
    if (copy.digest !== now.digest) await this.resolveConflict({ now, difference: lineDiff(copy.text, now.text) });
    this.offerOrphans();
  }

  checkSoon() {
    clearTimeout(this.checkTimer);
    this.checkTimer = setTimeout(() => this.check(), CHECK_MS);
    this.showStatus();
  }

  /* Let the server check the edits, and show the first fault. */
  async check() {
    const { app } = this, request = this.lastCheck = {}; // answers may arrive out of order
    let faults;
    try { faults = (await post(`${this.app.path}/check`, { changes: app.draft.changes() })).faults; } catch (error) { faults = [{ where: "", message: error.message }]; }
    if (request !== this.lastCheck) return;
    this.faults = faults;
    this.showStatus();
  }

  showStatus() {
    const { app } = this, changed = Object.keys(app.draft.changes());
    find("undo").disabled = !app.draft.undoSteps.length;
    find("redo").disabled = !app.draft.redoSteps.length;
    find("save").disabled = !changed.length || Boolean(app.info.read_only);
    const fault = this.faults[0];
    find("status").className = fault ? "fault" : changed.length ? "open" : "dim";
    find("status").textContent = fault ? fault.message : changed.length ? `not saved: ${changed.map(readable).join(", ")}` : app.draft.file.text ? "saved" : "no annotation yet";
  }

  /* Save once at a time. */
  async save() {
    if (this.busy) return;
    this.busy = true;
    try {
      await this.app.pose?.settle();
      await this.#save();
    } finally { this.busy = false; }
  }

  async #save() {
    const { app } = this, changes = app.draft.changes();
    if (!Object.keys(changes).length) { app.say(app.paint?.changed ? "the painted surface has its own save button, under Object" : "there is nothing to save"); return; }
    if (app.info.read_only) { app.say(app.info.read_only); return; }
    let result;
    try { result = await post(`${this.app.path}/check`, { changes }); } catch (error) { app.say(error.message); return; }
    this.faults = result.faults;
    this.showStatus();
    if (result.faults.length) {
      await ask("Not saved: the annotation has faults", make("ul", {}, result.faults.map(({ where, message }) => make("li", {}, `${where}: ${message}`))), [["", "Back", true]]);
      return;
    }
    const effect = make("p", { data: { part: "stale" } }, "Determining the stages that a run would compute…");
    post(`${this.app.path}/check`, { changes, plan: true }).then(({ stale }) => {
      effect.textContent = stale?.length ? `A run would compute: ${stale.map(({ stage }) => readable(stage)).join(", ")}.` : "Nothing needs to be run.";
    }, (error) => { effect.textContent = error.message; });
    const unfinished = [app.sides.open.size ? "left and right" : "", app.dropped.from === null ? "" : "frames to drop"].filter(Boolean);
    const warning = unfinished.length ? [make("p", { class: "fault" }, `Not included, because their last frame is not set: ${unfinished.join(", ")}.`)] : [];
    const answer = await ask(`Save ${app.draft.file.path}`, [diff(result.difference), ...warning, effect],
      [["save", "Save", true], ...(app.info.profile ? [] : [["run", "Save and run"]]), ["", "Cancel"]]);
    if (!answer) return;
    try {
      app.saved(await post(`${this.app.path}/save`, { digest: app.draft.file.digest, text: app.draft.file.text, changes }));
      app.say("saved");
      app.questions.saved();
    } catch (error) {
      if (error.status === 409) await this.resolveConflict(error.details);
      else await ask("Not saved", make("p", {}, error.message), [["", "Back", true]]);
      return;
    }
    if (answer === "run") this.start(); else this.plan(); // takes seconds; further saves do not wait for it
  }

  /* Another annotator saved: show their change, and merge or choose. `now` is the file's content. */
  async resolveConflict({ now, difference }) {
    const { app } = this, mine = app.draft.changes();
    if (now.problem) {
      await ask("The annotation file is now invalid", [make("p", { class: "fault" }, now.problem),
        make("p", {}, "Nothing was saved. The page shows the earlier file with your edits; save them after the file is corrected.")], [["", "Back", true]]);
      return;
    }
    if (POSES.some((name) => name in mine)) for (const name of POSES) mine[name] = app.draft.get(name);
    const both = Object.keys(mine).filter((name) => !same(normalize(name, now.sections[name]), app.draft.saved[name]));
    const answer = await ask("Another annotator changed this annotation", [
      make("p", {}, "Their change in the file:"), diff(difference || "(only the layout changed)"),
      make("p", {}, both.length ? `Both of you changed ${both.map(readable).join(", ")}: there, your version would replace theirs.` : "You changed other sections: both changes can be kept.")],
    [["mine", both.length ? "Keep mine there, theirs elsewhere" : "Keep both", !both.length], ["theirs", "Keep theirs, discard mine"], ["", "Decide later", both.length > 0]]);
    if (!answer) return;
    const edits = structuredClone(mine);
    app.draft.rebase(now, true);
    app.draft.reapply(edits);
    banner("changed", "");
    if (answer === "theirs") { app.draft.revert("their version"); return; }
    await this.#save();
  }

  /* Look for changes of the file or the results by others. */
  async poll() {
    const { app } = this;
    if (document.hidden) return;
    let now;
    try { now = await get(`${this.app.path}/state`); } catch (error) {
      banner("server", error.message);
      this.disconnected = true;
      return;
    }
    if (this.disconnected) { banner("server", ""); this.disconnected = false; app.redraw(); this.check(); }
    if (now.annotation !== app.draft.file.digest && this.reportedAnnotation !== now.annotation) {
      this.reportedAnnotation = now.annotation;
      banner("changed", "The annotation was changed in another tab or by another annotator.", [["Show", () => this.showChange()]]);
    }
    if (now.result !== app.info.result && !IN_PROGRESS.includes(this.run.state) && this.reportedResult !== now.result) {
      this.reportedResult = now.result;
      banner("result", "The results have changed.", [["Load them", () => app.reload()]]);
    }
  }

  async showChange() {
    const { app } = this;
    let now;
    try { now = await get(`${this.app.path}/annotation`); } catch (error) { app.say(error.message); this.reportedAnnotation = null; return; }
    if (!app.draft.dirty && !now.problem) { app.saved(now, true); app.draft.revert("their version"); app.draft.undoSteps.pop(); app.draft.notify(); return; }
    await this.resolveConflict({ now, difference: lineDiff(app.draft.file.text, now.text) });
  }

  /* List the stages that a run would compute. */
  async plan() {
    try { this.stale = (await post(`${this.app.path}/check`, { changes: {}, plan: true })).stale ?? []; } catch (error) { this.app.say(error.message); }
    this.app.panels();
  }

  async start() {
    const { app } = this;
    if (app.draft.dirty) { app.say("save first: a run reads the saved annotation"); return; }
    app.tab("run");
    try { this.run = await post(`${this.app.path}/run`, { do: "start" }); } catch (error) { app.say(error.message); }
    app.panels();
    this.progress();
  }

  async progress() {
    clearTimeout(this.runTimer);
    const { app } = this, before = this.run.state;
    try { this.run = await get(`${this.app.path}/run`); } catch { /* poll() reports a lost connection */ }
    if (IN_PROGRESS.includes(before) && !IN_PROGRESS.includes(this.run.state) && this.run.sequence === app.info.sequence) {
      this.stale = null;
      await app.reload();
      await this.compare();
      app.say({ done: "the new result is shown; B also shows the old one", stopped: "the run was stopped; finished results are kept" }[this.run.state] ?? "the run failed");
    }
    if (IN_PROGRESS.includes(this.run.state)) this.runTimer = setTimeout(() => this.progress(), RUN_MS);
    if (before !== "none" || this.run.state !== "none") app.panels();
  }

  async stop() {
    try { this.run = await post(`${this.app.path}/run`, { do: "stop" }); } catch (error) { this.app.say(error.message); }
    this.app.panels();
  }

  /* Show the old result next to the new one. */
  async compare() {
    const { app } = this;
    try {
      this.comparison = await get(`${this.app.path}/comparison`);
      if (this.comparison.exists) await app.loadBefore(); else app.say("no run from this page has replaced a result yet");
    } catch (error) { app.say(error.message); }
    app.panels();
  }

  panel() {
    const { app, run } = this, own = run.sequence === app.info.sequence;
    if (IN_PROGRESS.includes(run.state)) return make("div", { class: "run" }, this.#runningPart(own));
    const parts = [];
    const command = (text) => make("pre", { tabIndex: 0 }, text);
    if (own && run.state === "stopped") parts.push(make("p", {}, "The run was stopped; finished results are kept."));
    if (own && run.state === "failed") parts.push(make("p", { class: "fault" }, "The run failed:"), command(run.message));
    if (own && run.state === "done") parts.push(make("p", {}, `Done in ${run.seconds.toFixed(0)} s.`));
    if (this.stale) parts.push(this.stale.length ? make("div", {}, make("p", {}, "A run would compute:"),
      make("ol", {}, this.stale.map(({ stage, reasons }) => make("li", {}, make("b", {}, readable(stage)), make("span", { class: "dim" }, ` ${reasons.join("; ")}`))))) : make("p", {}, "All results are up to date."));
    if (run.cluster) parts.push(make("p", {}, "Jobs run on a cluster. Run there:"), command(run.command));
    else parts.push(button("Recompute outdated stages", () => this.start(), { class: "main" }));
    parts.push(button("Show outdated stages", () => this.plan()));
    if (!run.cluster && run.command) parts.push(make("details", {}, make("summary", {}, "Command for a terminal"), command(run.command)));
    if (this.comparison?.edits?.length) parts.push(...this.#editsPart());
    if (this.comparison?.exists) parts.push(...this.#comparisonPart());
    else if (!this.comparison) parts.push(button("Compare with the old result", () => this.compare()));
    return make("div", { class: "run" }, parts);
  }

  #runningPart(own) {
    const { run } = this, ending = run.state === "ending";
    const stages = run.stages.map((stage) => make("li", { data: { state: stage.state } }, make("b", {}, readable(stage.stage)), ` ${stageText(stage)} `,
      stage.state === "running" && stage.expected_s ? make("progress", { value: Math.min(stage.seconds, stage.expected_s), max: stage.expected_s, ariaLabel: `${stage.stage}, share of its expected duration` }) : null));
    const state = own ? `Running for ${duration(run.seconds)}; ${remaining(run.stages)}.` : `A run of ${run.sequence} is in progress; ${remaining(run.stages)}.`;
    return [
      make("p", {}, ending ? `Ending for ${run.ending_s.toFixed(0)} s; unfinished results are removed, which takes at most ${run.ends_within_s.toFixed(0)} s.` : state),
      make("ol", { class: "stages" }, stages),
      ending && run.ending_s <= run.ends_within_s ? null : button(ending ? "Force stop" : "Stop", () => this.stop())];
  }

  /* Each entry of the annotation with the result, those that differ first. */
  #editsPart() {
    const { edits } = this.comparison, differ = edits.filter(({ same }) => !same).length;
    return [make("h3", {}, differ ? `The result differs from ${differ} of ${edits.length} entries of the annotation` : `The result agrees with all ${edits.length} entries of the annotation`),
      make("table", { class: "edits" }, make("tr", {}, ["annotated", "result"].map((text) => make("th", {}, text))),
        edits.map(({ frame, annotated, result, same, why }) => make("tr", { class: same ? "" : "differs" },
          make("td", {}, button(annotated, () => this.app.show(frame), { class: "plain" })),
          make("td", {}, result, why ? make("div", { class: "dim" }, why) : null))))];
  }

  #comparisonPart() {
    const { rows, made_at, kept_at, unfinished, body_moved_mm, object_moved_mm } = this.comparison;
    const when = (text) => new Date(text).toLocaleString();
    const show = (value) => (value === null || value === undefined ? "–" : String(value));
    const moved = (name, mm) => (mm ? make("p", { class: "dim" }, `${name} moved by at most ${Math.max(...mm).toFixed(1)} mm, in frame ${mm.indexOf(Math.max(...mm))}.`) : null);
    return [
      make("h3", {}, "Old and new result"),
      make("p", { class: "dim", data: { part: "before" } }, `Old: the result of ${when(made_at)}, kept before the run of ${when(kept_at)}`,
        unfinished ? ". That run did not succeed: the next one keeps this old result." : "."),
      make("table", { class: "comparison" }, make("tr", {}, make("th", {}, "figure"), make("th", {}, "old"), make("th", {}, "new")),
        rows.map((row) => make("tr", { class: row.old === row.new ? "" : "differs" }, make("td", {}, row.name), make("td", {}, show(row.old)), make("td", {}, show(row.new))))),
      moved("The body", body_moved_mm), moved("The object", object_moved_mm)];
  }
}

const duration = (seconds) => (seconds < 90 ? `${Math.round(seconds)} s` : `${Math.round(seconds / 60)} min`);

function stageText({ state, message, seconds, expected_s }) {
  const about = expected_s ? `about ${duration(expected_s)}` : "";
  if (state === "running") return `${duration(seconds)}${about ? ` of ${about}` : ""}`;
  return { waits: about, finished: `done in ${message}`, failed: `failed: ${message}` }[state];
}

/* Remaining time of a run: the sum over its stages, as long as the last run of each one took. */
function remaining(stages) {
  const open = stages.filter(({ state }) => ["running", "waits"].includes(state));
  const unknown = open.filter(({ expected_s }) => !expected_s).map(({ stage }) => readable(stage));
  const seconds = open.reduce((sum, stage) => sum + Math.max(0, (stage.expected_s ?? 0) - stage.seconds), 0);
  const known = unknown.length < open.length ? `about ${duration(seconds)} left` : "remaining time unknown";
  return unknown.length && unknown.length < open.length ? `${known}, without ${unknown.join(", ")}` : known;
}

/* Lines that only one of two texts contains, as a diff. */
function lineDiff(before, now) {
  const [a, b] = [before.split(/\r?\n/), now.split(/\r?\n/)];
  return [...a.filter((line) => !b.includes(line)).map((line) => `-${line}`), ...b.filter((line) => !a.includes(line)).map((line) => `+${line}`)].join("\n");
}
