/* Copies of what was edited and not saved, in this browser, so that a tab that closes or a tunnel that
 * breaks loses nothing: one for each project, sequence and tab. What a tab left that is gone is
 * offered to the next. */
const PREFIX = "intercap-draft:";
const TAB = "intercap-tab"; // in the tab's own storage: this tab's name
const LOCK = "intercap-tab:"; // held as long as the tab lives
const KEPT_MS = 30 * 24 * 3600 * 1000;

export class Copies {
  static async open(project, sequence) {
    const copies = new Copies();
    copies.of = `${PREFIX}${project}:${sequence}:`;
    copies.tab = await ownTab();
    copies.found = await copies.#left();
    return copies;
  }

  keep(what) { stored((all) => all.setItem(this.of + this.tab, JSON.stringify({ ...what, at: Date.now() }))); }

  drop(key = this.of + this.tab) { stored((all) => all.removeItem(key)); }

  /* Copies of tabs that are gone, the latest first. This tab's own, from before it was loaded again,
   * gets another name, so that new edits do not take its place. */
  async #left() {
    const living = await livingTabs(), found = [];
    for (const key of stored((all) => Object.keys(all)) ?? []) {
      if (!key.startsWith(PREFIX)) continue;
      const kept = read(key), tab = key.slice(this.of.length);
      if (!(Date.now() - kept?.at < KEPT_MS)) { this.drop(key); continue; }
      if (!key.startsWith(this.of) || (tab !== this.tab && living.has(tab)) || !kept.sections) continue;
      const own = tab === this.tab ? this.of + crypto.randomUUID() : key;
      if (own !== key) stored((all) => { all.setItem(own, JSON.stringify(kept)); all.removeItem(key); });
      found.push({ ...kept, key: own });
    }
    return found.sort((a, b) => b.at - a.at);
  }
}

const read = (key) => stored((all) => JSON.parse(all.getItem(key)));

/* null in a browser that keeps nothing, or no more. */
function stored(act) {
  try { return act(localStorage); } catch { return null; }
}

/* A tab that was duplicated has its storage twice, and gets a name of its own. */
async function ownTab() {
  let name = sessionStorage.getItem(TAB) ?? crypto.randomUUID();
  if (!(await hold(name))) await hold(name = crypto.randomUUID());
  sessionStorage.setItem(TAB, name);
  return name;
}

const hold = (name) => new Promise((resolve) => {
  navigator.locks.request(LOCK + name, { ifAvailable: true }, (lock) => {
    resolve(lock !== null);
    return lock && new Promise(() => {});
  });
});

async function livingTabs() {
  const { held } = await navigator.locks.query();
  return new Set(held.filter((one) => one.name.startsWith(LOCK)).map((one) => one.name.slice(LOCK.length)));
}
