"use strict";
for (const table of document.querySelectorAll("table.sortable")) {
  table.tHead.rows[0].querySelectorAll("th").forEach((head, column) => {
    head.tabIndex = 0;
    head.addEventListener("keydown", (event) => {
      if (event.key === "Enter") head.click();
    });
    head.addEventListener("click", () => {
      const up = head.dataset.order === "down";
      table.querySelectorAll("th").forEach((other) => delete other.dataset.order);
      head.dataset.order = up ? "up" : "down";
      table.querySelectorAll("th").forEach((other) => other.removeAttribute("aria-sort"));
      head.setAttribute("aria-sort", up ? "ascending" : "descending");
      const body = table.tBodies[0];
      const key = (row) => row.cells[column].dataset.value ?? row.cells[column].textContent.trim();
      const rows = [...body.rows];
      rows.sort((a, b) => {
        const [x, y] = [key(a), key(b)];
        const [p, q] = [parseFloat(x), parseFloat(y)];
        if (Number.isNaN(p) !== Number.isNaN(q)) return Number.isNaN(p) ? 1 : -1;
        const order = Number.isNaN(p) ? x.localeCompare(y) : p - q;
        return up ? order : -order;
      });
      body.append(...rows);
    });
  });
}
for (const form of document.querySelectorAll("form.filters")) {
  const rows = [...document.getElementById(form.dataset.filters).tBodies[0].rows];
  const fields = [...form.querySelectorAll("[data-column]")];
  const flagged = form.querySelector("[data-flagged]");
  const update = () => {
    let shown = 0;
    for (const row of rows) {
      const kept = fields.every((field) => {
        const has = row.dataset[field.dataset.column].toLowerCase();
        const wanted = field.value.trim().toLowerCase();
        return !wanted || (field.type === "search" ? has.includes(wanted) : has === wanted);
      });
      row.hidden = !kept || (flagged.checked && !(parseFloat(row.dataset.flagged) > 0));
      shown += row.hidden ? 0 : 1;
    }
    form.querySelector("output").textContent = `${shown} of ${rows.length}`;
  };
  form.addEventListener("input", update);
  form.addEventListener("submit", (event) => event.preventDefault());
  update();
}
const dialog = document.querySelector("dialog");
const large = dialog.querySelector("img");
for (const image of document.querySelectorAll("main img")) {
  image.tabIndex = 0;
  image.setAttribute("role", "button");
  image.addEventListener("keydown", (event) => {
    if (event.key === "Enter") image.click();
  });
  image.addEventListener("click", () => {
    large.src = image.src;
    large.alt = image.alt;
    dialog.showModal();
  });
}
dialog.addEventListener("click", () => dialog.close());
