/* The table of sequences, worst first. */
import { get } from "./api.js";
import { find, make } from "./dom.js";

export async function showList() {
  const told = await get("sequences");
  document.title = `Annotate ${told.dataset}`;
  find("list").hidden = false;
  find("dataset").textContent = told.dataset;
  const parts = [...new Set(told.sequences.flatMap((one) => Object.keys(one.errors ?? {})))];
  const number = (value) => make("td", { class: "number" }, value === null || value === undefined ? "–" : String(value));
  const head = make("thead", {}, make("tr", {}, ["sequence", "subject", "object", "frames", "flagged", ...parts.map((part) => `${part}, mm`), "annotation"].map((text) => make("th", { scope: "col" }, text))));
  const body = make("tbody", {}, told.sequences.map((one) => make("tr", { data: { words: `${one.name} ${one.subject} ${one.object}`.toLowerCase() } },
    make("th", { scope: "row" }, make("a", { href: `/sequence/${encodeURIComponent(one.name)}` }, one.name)),
    make("td", {}, one.subject), make("td", {}, one.object || "–"), number(one.frames), number(one.flagged),
    ...parts.map((part) => number(one.errors?.[part])),
    make("td", {}, one.annotated ? "yes" : "", one.note ? make("span", { class: "dim" }, ` ${one.note}`) : null))));
  find("sequences").replaceChildren(head, body);
  find("filter").oninput = () => {
    const wanted = find("filter").value.toLowerCase();
    for (const row of body.rows) row.hidden = !row.dataset.words.includes(wanted);
  };
}
