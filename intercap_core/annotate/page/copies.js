/* Copies of unsaved edits in this browser's storage, one for each project, sequence and tab, so that a
 * closed tab or a broken tunnel loses nothing. Copies of closed tabs are offered to the next tab. */
const PREFIX = "intercap-draft:";
const TAB = "intercap-tab"; // key in the tab's own storage: name of this tab
const LOCK = "intercap-tab:"; // prefix of a lock that is held while the tab is open
const MAX_AGE_MS = 30 * 24 * 3600 * 1000;

export class Copies {
  static async open(project, sequence) {
    const copies = new Copies();
    copies.prefix = `${PREFIX}${project}:${sequence}:`;
    copies.tab = await nameTab();
    copies.orphans = await copies.#readOrphans();
    return copies;
  }

  keep(content) { access((storage) => storage.setItem(this.prefix + this.tab, JSON.stringify({ ...content, at: Date.now() }))); }

  drop(key = this.prefix + this.tab) { access((storage) => storage.removeItem(key)); }

  /* Copies of closed tabs, latest first. This tab's own copy, from before a reload, gets another name,
   * so that new edits do not overwrite it. */
  async #readOrphans() {
    const open = await openTabs(), orphans = [];
    for (const key of access((storage) => Object.keys(storage)) ?? []) {
      if (!key.startsWith(PREFIX)) continue;
      const copy = access((storage) => JSON.parse(storage.getItem(key))), tab = key.slice(this.prefix.length);
      if (!(Date.now() - copy?.at < MAX_AGE_MS)) { this.drop(key); continue; }
      if (!key.startsWith(this.prefix) || (tab !== this.tab && open.has(tab)) || !copy.sections) continue;
      const name = tab === this.tab ? this.prefix + crypto.randomUUID() : key;
      if (name !== key) access((storage) => { storage.setItem(name, JSON.stringify(copy)); storage.removeItem(key); });
      orphans.push({ ...copy, key: name });
    }
    return orphans.sort((a, b) => b.at - a.at);
  }
}

/* Use the browser's storage; null if it is disabled or full. */
export function access(act) {
  try { return act(localStorage); } catch { return null; }
}

/* Return the name of this tab. A duplicated tab has a copy of the tab's storage, with the name of a tab
 * that is open, and therefore gets a new name. */
async function nameTab() {
  let name = sessionStorage.getItem(TAB) ?? crypto.randomUUID();
  if (!(await lock(name))) await lock(name = crypto.randomUUID());
  sessionStorage.setItem(TAB, name);
  return name;
}

/* Hold a lock until the tab is closed; resolves to false if another tab holds it. */
const lock = (name) => new Promise((resolve) => {
  navigator.locks.request(LOCK + name, { ifAvailable: true }, (granted) => {
    resolve(granted !== null);
    return granted && new Promise(() => {});
  });
});

async function openTabs() {
  const { held } = await navigator.locks.query();
  return new Set(held.filter(({ name }) => name.startsWith(LOCK)).map(({ name }) => name.slice(LOCK.length)));
}
