"use strict";
/* Sorting of tables by a click on a column's head. */
for (const table of document.querySelectorAll("table.sortable")) {
  const heads = [...table.tHead.rows[0].cells];
  heads.forEach((head, column) => {
    const isText = column === 0 || head.classList.contains("left");
    const button = document.createElement("button");
    button.type = "button";
    button.append(...head.childNodes);
    head.append(button);
    button.addEventListener("click", () => {
      const now = head.getAttribute("aria-sort");
      const up = now ? now === "descending" : isText; // numbers are first sorted in descending order
      heads.forEach((other) => other.removeAttribute("aria-sort"));
      head.setAttribute("aria-sort", up ? "ascending" : "descending");
      const body = table.tBodies[0];
      const key = (row) => row.cells[column].textContent.trim();
      const rows = [...body.rows];
      rows.sort((a, b) => {
        const [x, y] = [key(a), key(b)];
        if (isText) return (up ? 1 : -1) * x.localeCompare(y, "en", { numeric: true });
        const [p, q] = [parseFloat(x), parseFloat(y)];
        if (Number.isNaN(p) || Number.isNaN(q)) return Number.isNaN(p) - Number.isNaN(q); // missing values last
        return up ? p - q : q - p;
      });
      body.append(...rows);
    });
  });
}
/* Filters of the table of sequences: text fields search, other fields compare whole values. */
for (const form of document.querySelectorAll("form.filters")) {
  const rows = [...document.getElementById(form.dataset.filters).tBodies[0].rows];
  const fields = [...form.querySelectorAll("[data-column]")];
  const flagged = form.querySelector("[data-flagged]");
  const update = () => {
    let shown = 0;
    for (const row of rows) {
      const kept = fields.every((field) => {
        const value = row.dataset[field.dataset.column].toLowerCase();
        const pattern = field.value.trim().toLowerCase();
        return !pattern || (field.type === "search" ? value.includes(pattern) : value === pattern);
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

/* Thumbnails of sequences whose page has no picture are removed. */
for (const image of document.querySelectorAll(".thumbnail")) {
  const drop = () => image.remove();
  if (image.complete && !image.naturalWidth) drop();
  else image.addEventListener("error", drop);
}

/* Give areas a tab stop only while they can be scrolled. */
const observer = new ResizeObserver((entries) => {
  for (const { target } of entries) {
    const area = target.closest(".scroll");
    const more = area.scrollWidth > area.clientWidth || area.scrollHeight > area.clientHeight;
    if (more) area.tabIndex = 0;
    else area.removeAttribute("tabindex");
  }
});
for (const area of document.querySelectorAll(".scroll")) {
  observer.observe(area);
  observer.observe(area.firstElementChild);
}

/* Enlargement of pictures. */
const dialog = document.querySelector("dialog");
const large = dialog.querySelector("img");
const enlarge = (image) => {
  large.src = image.src;
  large.alt = image.alt;
  dialog.querySelector("p").textContent = image.alt;
  dialog.showModal();
  // fit the window, but do not shrink the picture; larger pictures are scrolled
  const room = [dialog.clientWidth - 8, dialog.clientHeight - 48];
  const [wide, tall] = [Number(image.getAttribute("width")), Number(image.getAttribute("height"))];
  const scale = Math.max(1, Math.min(room[0] / wide, room[1] / tall));
  large.width = Math.round(scale * wide);
  large.height = Math.round(scale * tall);
};
for (const image of document.querySelectorAll("main figure > img")) {
  const button = document.createElement("button");
  button.type = "button";
  button.className = "zoom";
  button.setAttribute("aria-haspopup", "dialog");
  image.replaceWith(button);
  button.append(image);
  button.addEventListener("click", () => enlarge(image));
}
dialog.addEventListener("click", () => dialog.close());
