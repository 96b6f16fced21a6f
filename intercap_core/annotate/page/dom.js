/* Elements, always by text and never by HTML: what files and users say is shown as it is. */
export const find = (id) => document.getElementById(id);

export function make(tag, properties = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (name === "class") element.className = value;
    else if (name === "data") Object.assign(element.dataset, value);
    else if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (name in element) element[name] = value;
    else element.setAttribute(name, value);
  }
  element.append(...children.flat().filter((child) => child !== null && child !== undefined));
  return element;
}

export const button = (text, click, properties = {}) =>
  make("button", { type: "button", onclick: click, ...properties }, text);

export const words = (name) => name.replaceAll("_", " ");

/* New children of a box. What was in focus by the keyboard stays so: the nearest that is called the same,
 * else the box's first. */
export function refill(box, ...children) {
  const all = () => [...box.querySelectorAll("button, input, select, summary")];
  const called = (one) => `${one.tagName} ${one.title || one.textContent}`;
  const old = document.activeElement, at = old?.matches(":focus-visible") ? all().indexOf(old) : -1;
  box.replaceChildren(...children);
  if (at < 0) return;
  const now = all(), alike = now.filter((one) => called(one) === called(old));
  const [next] = alike.sort((a, b) => Math.abs(now.indexOf(a) - at) - Math.abs(now.indexOf(b) - at));
  (next ?? now[0])?.focus({ preventScroll: true });
}

/* A dialog with buttons; resolves to the value of the one that was pressed, "" = it was closed. */
export function ask(title, body, choices) {
  const dialog = find("dialog");
  find("dialog-title").textContent = title;
  find("dialog-body").replaceChildren(...[body].flat());
  dialog.onclose?.(); // another dialog was open: it is not answered
  return new Promise((resolve) => {
    let answer = "";
    const close = (value) => { answer = value; dialog.close(); };
    find("dialog-buttons").replaceChildren(...choices.map(([value, text, main]) =>
      button(text, () => close(value), { class: main ? "main" : "", data: { answer: value } })));
    dialog.onclose = () => { dialog.onclose = null; resolve(answer); };
    if (!dialog.open) dialog.showModal();
    (dialog.querySelector("button.main") ?? dialog.querySelector("button"))?.focus();
  });
}

/* A sentence above the views, with what can be done about it. */
export function banner(id, text, actions = []) {
  find("banners").querySelector(`[data-banner="${id}"]`)?.remove();
  if (!text) return;
  const box = make("div", { class: "banner", role: "status", data: { banner: id } }, make("span", {}, text));
  for (const [label, act] of [...actions, ["Close", () => {}]]) {
    box.append(button(label, () => { box.remove(); act(); }));
  }
  find("banners").append(box);
}

export function diff(text) {
  const block = make("pre", { class: "diff", tabIndex: 0 });
  for (const line of text.split("\n")) {
    const kind = line.startsWith("+") ? "added" : line.startsWith("-") ? "removed" : "";
    block.append(make("span", { class: kind }, `${line}\n`));
  }
  return block;
}
