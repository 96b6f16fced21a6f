/* Creation of page elements. Text from files and users is inserted as text, never as HTML. */
export const find = (id) => document.getElementById(id);

/* Create an element. Properties are `class`, `data` (data attributes), `on...` (listeners), properties of
 * the element, or else attributes. */
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

export const readable = (name) => (name === "any" ? "any part" : name.replaceAll("_", " "));

/* Replace the children of a box. A control that had the keyboard focus passes it to the nearest new control
 * with the same label, or else to the first one. */
export function refill(box, ...children) {
  const all = () => [...box.querySelectorAll("button, input, select, summary")];
  const label = (control) => `${control.tagName} ${control.title || control.textContent}`;
  const old = document.activeElement, at = old?.matches(":focus-visible") ? all().indexOf(old) : -1;
  box.replaceChildren(...children);
  if (at < 0) return;
  const now = all(), same = now.filter((control) => label(control) === label(old));
  const [next] = same.sort((a, b) => Math.abs(now.indexOf(a) - at) - Math.abs(now.indexOf(b) - at));
  (next ?? now[0])?.focus({ preventScroll: true });
}

/* Call `move` with the events of the pointer until it is released, then `end`. */
export function followPointer(move, end = () => {}) {
  const up = (event) => {
    removeEventListener("pointermove", move);
    for (const kind of ["pointerup", "pointercancel"]) removeEventListener(kind, up);
    end(event);
  };
  addEventListener("pointermove", move);
  for (const kind of ["pointerup", "pointercancel"]) addEventListener(kind, up);
}

/* Show a dialog; resolves to the value of the pressed button, "" if the dialog was closed.
 * `choices`: [value, text, whether it is the main button] of each button. */
export function ask(title, body, choices) {
  const dialog = find("dialog");
  find("dialog-title").textContent = title;
  find("dialog-body").replaceChildren(...[body].flat());
  dialog.onclose?.(); // an open dialog is closed without an answer
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

/* Show a message above the views with buttons for actions; "" removes it. */
export function banner(id, text, actions = []) {
  find("banners").querySelector(`[data-banner="${id}"]`)?.remove();
  if (!text) return;
  const box = make("div", { class: "banner", role: "status", data: { banner: id } }, make("span", {}, text));
  for (const [label, act] of [...actions, ["Close", () => {}]]) {
    box.append(button(label, () => { box.remove(); act(); }));
  }
  find("banners").append(box);
}

/* A unified diff as an element with coloured lines. */
export function diff(text) {
  const block = make("pre", { class: "diff", tabIndex: 0 });
  for (const line of text.split("\n")) {
    const kind = line.startsWith("+") ? "added" : line.startsWith("-") ? "removed" : "";
    block.append(make("span", { class: kind }, `${line}\n`));
  }
  return block;
}
