/* Camera views of the same frame, some large and the others in a strip: image, overlay and marks. */
import { access } from "./copies.js";
import { find, followPointer, make } from "./dom.js";
import { apply, project } from "./geometry.js";

const PREFETCHED = 4; // frames that are fetched ahead
const MAX_ZOOM = 16;
const PADDING = 8; // of the views' box, CSS pixels
const QUALITY = "intercap-images"; // storage key of the chosen image size

export class Views {
  constructor(app) {
    this.app = app;
    this.views = app.info.cameras.map((camera, index) => this.#view(camera, index));
    this.order = this.views.map((view) => view.index);
    this.large = Number(find("large").value);
    find("large").onchange = () => { this.large = Number(find("large").value); this.arrange(); };
    find("quality").value = access((storage) => storage.getItem(QUALITY)) ?? "1";
    find("quality").onchange = () => { access((storage) => storage.setItem(QUALITY, find("quality").value)); app.show(app.frame); };
    new ResizeObserver(() => this.#fit()).observe(find("views"));
    this.arrange();
  }

  #view(camera, index) {
    const canvas = make("canvas", { role: "img", tabIndex: 0, "aria-label": `Camera ${camera.name}` });
    const figure = make("figure", { class: "view", data: { camera: camera.name } }, canvas,
      make("figcaption", {}, camera.name));
    const [w, h] = camera.size;
    // crop: shown part of the recorded image (x, y, width, height, pixels); last: the image drawn last
    const view = { camera, index, figure, canvas, brush: canvas.getContext("2d"), crop: [0, 0, w, h], last: null };
    view.pixel = (event) => { // pixel of the recorded image under the pointer
      const box = canvas.getBoundingClientRect();
      const [x, y, wide, high] = view.crop;
      return [
        x + ((event.clientX - box.left) / box.width) * wide - 0.5,
        y + ((event.clientY - box.top) / box.height) * high - 0.5];
    };
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      if (this.app.mode?.wheel?.(view, event)) return;
      this.zoom(view, view.pixel(event), event.deltaY < 0 ? 1 / 1.25 : 1.25);
    }, { passive: false });
    canvas.addEventListener("pointerdown", (event) => this.#press(view, event));
    canvas.addEventListener("dblclick", () => { if (!this.app.mode) this.enlarge(view); });
    canvas.addEventListener("keydown", (event) => {
      if (event.key === "Enter" && !this.app.mode) { this.enlarge(view); event.preventDefault(); }
    });
    for (const what of ["pointerenter", "focus"]) canvas.addEventListener(what, () => { this.active = view; });
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    return view;
  }

  #press(view, event) {
    const canvas = view.canvas;
    canvas.focus({ preventScroll: true });
    const drag = this.app.mode?.press?.(view, event) ?? this.#pan(view, event);
    if (!drag) return;
    canvas.setPointerCapture(event.pointerId);
    followPointer((next) => drag.move?.(next), (next) => drag.end?.(next));
  }

  #pan(view, event) {
    const from = [event.clientX, event.clientY], [x, y] = view.crop;
    return {
      move: (next) => {
        this.app.following = false;
        const scale = view.crop[2] / view.canvas.clientWidth;
        view.crop[0] = x - (next.clientX - from[0]) * scale;
        view.crop[1] = y - (next.clientY - from[1]) * scale;
        this.#bound(view);
        this.app.redraw();
      },
    };
  }

  zoom(view, [px, py], factor) {
    this.app.following = false;
    const [w, h] = view.camera.size;
    const wide = Math.min(w, Math.max(w / MAX_ZOOM, view.crop[2] * factor));
    const high = (wide * h) / w, by = wide / view.crop[2];
    view.crop = [px - (px - view.crop[0]) * by, py - (py - view.crop[1]) * by, wide, high];
    this.#bound(view);
    this.app.redraw();
  }

  #bound(view) {
    const [w, h] = view.camera.size;
    view.crop[0] = Math.min(Math.max(0, view.crop[0]), w - view.crop[2]);
    view.crop[1] = Math.min(Math.max(0, view.crop[1]), h - view.crop[3]);
  }

  /* Zoom all views to a sphere (centre in the master frame, radius, metres); null shows whole images. */
  zoomTo(point, radius) {
    for (const view of this.views) {
      const [w, h] = view.camera.size;
      view.crop = [0, 0, w, h];
      if (!point || !view.camera.pose) continue;
      const at = apply(view.camera.pose, point);
      if (at[2] < 0.2) continue;
      const [x, y] = project(view.camera.lens, at);
      if (x < 0 || y < 0 || x > w || y > h) continue;
      const high = Math.min(h, Math.max(h / MAX_ZOOM, (2 * radius * view.camera.lens[1]) / at[2]));
      view.crop = [x - (high * w) / h / 2, y - high / 2, (high * w) / h, high];
      this.#bound(view);
    }
    this.app.redraw();
  }

  enlarge(view) {
    this.order = [view.index, ...this.order.filter((index) => index !== view.index)];
    this.arrange();
  }

  /* The view that a key acts on: under the pointer or in focus, or else the first large one. */
  get selected() { return this.active ?? this.views[this.order[0]]; }

  /* Show these cameras first. */
  prefer(names) {
    const first = this.views.filter((view) => names.includes(view.camera.name)).map((view) => view.index);
    this.order = [...first, ...this.order.filter((index) => !first.includes(index))];
    this.arrange();
  }

  arrange() {
    const cells = this.order.map((index) => this.views[index]);
    find("big").replaceChildren(...cells.slice(0, this.large).map((view) => view.figure));
    find("strip").replaceChildren(...cells.slice(this.large).map((view) => view.figure));
    this.#fit();
  }

  /* Choose the numbers of columns with the largest images that fit into the page without scrolling. A small
   * window is scrolled instead. */
  #fit() {
    const [big, strip] = [find("big"), find("strip")], box = find("views"), [l, s] = [big.children.length, strip.children.length];
    const width = box.clientWidth - 2 * PADDING;
    const height = getComputedStyle(box).overflowY === "auto" ? box.clientHeight - find("bar").offsetHeight - 3 * PADDING : Infinity;
    const ratio = Math.max(...this.views.map(({ camera }) => camera.size[1] / camera.size[0]), 0.1);
    let best = { area: 0 };
    for (let columns = 1; columns <= Math.max(l, 1); columns += 1) {
      for (let small = columns + 1; small <= Math.max(s, columns + 1); small += 1) { // smaller than the large views
        const rows = Math.ceil(l / columns) / columns + Math.ceil(s / small) / small; // in widths of the page
        const share = Math.min(1, height / (rows * ratio * width)), area = share ** 2 * (l / columns ** 2 + s / small ** 2);
        if (area > best.area) best = { area, columns, small, share };
      }
    }
    for (const [grid, columns] of [[big, best.columns], [strip, best.small]]) {
      grid.style.gridTemplateColumns = `repeat(${columns}, minmax(0, 1fr))`;
      grid.style.width = `${best.share * width}px`;
    }
    this.app.redraw();
  }

  /* Draw all views; missing images are fetched and drawn when they arrive. */
  draw() {
    const { app } = this, { pictures, frame } = app;
    for (const view of this.views) {
      const width = view.canvas.clientWidth;
      view.width = Math.max(1, Math.round(width * Math.min(devicePixelRatio, 1.5)));
      view.height = Math.max(1, Math.round((view.width * view.camera.size[1]) / view.camera.size[0]));
      if (view.canvas.width !== view.width || view.canvas.height !== view.height) {
        view.canvas.width = view.width;
        view.canvas.height = view.height;
      }
      const zoom = view.camera.size[0] / view.crop[2];
      const wanted = view.width * zoom * Number(find("quality").value);
      view.fetched = pictures.width(Math.min(wanted, view.camera.size[0]));
    }
    const drawables = app.drawables();
    if (app.overlay && drawables.length) app.overlay.draw(this.views, drawables);
    let missing = 0;
    for (const view of this.views) missing += this.#paint(view, drawables.length > 0) ? 0 : 1;
    if (missing === 0) app.drawn();
    for (let k = 1; k <= PREFETCHED; k += 1) {
      const next = frame + k * app.direction;
      if (next < 0 || next >= app.info.frames) break;
      for (const view of this.views) {
        if (app.has(view.index, next)) pictures.fetch(view.camera.name, next, view.fetched, false);
      }
    }
  }

  /* Draw one view; returns whether its image was cached. */
  #paint(view, overlaid) {
    const { app } = this, { pictures, frame } = app, brush = view.brush;
    const { name } = view.camera;
    let complete = true;
    let image = null;
    if (app.has(view.index, frame)) {
      image = pictures.cached(name, frame, view.fetched);
      if (image === undefined) {
        complete = false;
        pictures.fetch(name, frame, view.fetched).then((bitmap) => { if (bitmap !== undefined && app.frame === frame) app.redraw(); });
        image = pictures.cachedAny(name, frame);
      }
    }
    const [w, h] = [view.width, view.height];
    if (image) {
      const scale = image.width / view.camera.size[0];
      brush.drawImage(image, ...view.crop.map((v) => v * scale), 0, 0, w, h);
      view.last = image;
    } else {
      brush.fillStyle = "#30343b";
      brush.fillRect(0, 0, w, h);
      if (!complete && view.last?.width) { // an earlier frame, dimmed
        brush.globalAlpha = 0.3;
        brush.drawImage(view.last, ...view.crop.map((v) => (v * view.last.width) / view.camera.size[0]), 0, 0, w, h);
        brush.globalAlpha = 1;
      }
      brush.fillStyle = "#e7eaef";
      brush.font = "13px system-ui";
      brush.fillText(complete ? "no image" : `loading frame ${frame}…`, 10, h - 12);
    }
    if (overlaid && app.overlay && view.camera.pose) {
      brush.globalAlpha = app.opacity;
      brush.drawImage(app.overlay.canvas, ...view.part, 0, 0, w, h);
      brush.globalAlpha = 1;
    }
    if (app.draft.get("drop_frames")?.includes(frame)) {
      brush.fillStyle = "rgba(194, 47, 54, 0.35)";
      brush.fillRect(0, 0, w, h);
    }
    app.mark(view, brush);
    return complete;
  }

  /* Project a point of the master frame onto a view's canvas; null if it is behind the camera. */
  place(view, point) {
    if (!view.camera.pose) return null;
    const at = apply(view.camera.pose, point);
    if (at[2] < 0.05) return null;
    const [x, y] = project(view.camera.lens, at);
    return this.spot(view, x, y);
  }

  /* Convert a pixel of the recorded image to a position on a view's canvas. */
  spot(view, x, y) {
    return [
      ((x + 0.5 - view.crop[0]) / view.crop[2]) * view.width,
      ((y + 0.5 - view.crop[1]) / view.crop[3]) * view.height];
  }
}
