/* The table of sequences, worst first. */
import { get } from "./api.js";
import { find, make } from "./dom.js";

const PARTS = ["body", "hands", "object", "contact"]; // of which frames are flagged

export async function showList() {
  const { dataset, sequences } = await get("sequences");
  document.title = `Annotate ${dataset}`;
  find("list").hidden = false;
  find("dataset").textContent = dataset;
  const parts = [...new Set(sequences.flatMap(({ errors }) => Object.keys(errors ?? {})))];
  const number = (value) => make("td", { class: "number" }, value === null || value === undefined ? "–" : String(value));
  const titles = ["sequence", "subject", "object", "frames", ...PARTS.map((part) => `${part} flagged`), ...parts.map((part) => `${part}, mm`), "annotation"];
  const head = make("thead", {}, make("tr", {}, titles.map((text) => make("th", { scope: "col" }, text))));
  const body = make("tbody", {}, sequences.map((s) => make("tr", { data: { text: `${s.name} ${s.subject} ${s.object}`.toLowerCase() } },
    make("th", { scope: "row" }, make("a", { href: `/sequence/${encodeURIComponent(s.name)}` }, s.name)),
    make("td", {}, s.subject), make("td", {}, s.object || "–"), number(s.frames), ...PARTS.map((_, p) => number(s.flagged?.[p])),
    ...parts.map((part) => number(s.errors?.[part])),
    make("td", {}, s.annotated ? "yes" : "", s.note ? make("span", { class: "dim" }, ` ${s.note}`) : null))));
  find("sequences").replaceChildren(head, body);
  find("filter").oninput = () => {
    const pattern = find("filter").value.toLowerCase();
    for (const row of body.rows) row.hidden = !row.dataset.text.includes(pattern);
  };
}
