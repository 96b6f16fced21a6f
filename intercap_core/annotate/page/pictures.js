/* Images by camera, frame and width: fetched once, decoded, the next ones ahead of time. */
import { Refused, blob } from "./api.js";

const KEPT_BYTES = 300e6;
const AT_ONCE = 6; // requests: what a browser sends to one server
const WIDTHS = [240, 320, 480, 640, 960, 1280];

export class Pictures {
  constructor(sequence, stamp) {
    this.path = `sequences/${sequence}/image`;
    this.stamp = stamp;
    this.kept = new Map();
    this.bytes = 0;
    this.waiting = new Map(); // by key: { promise, urgent }
    this.queue = [];
    this.running = 0;
  }

  width(pixels) { return WIDTHS.find((one) => one >= 0.9 * pixels) ?? 0; }

  #key(camera, frame, width) { return `${camera}/${frame}/${width}`; }

  /* The decoded image where it is there, else undefined; null = there is none. */
  now(camera, frame, width) {
    const key = this.#key(camera, frame, width), found = this.kept.get(key);
    if (found !== undefined) { this.kept.delete(key); this.kept.set(key, found); }
    return found?.bitmap;
  }

  /* Any image of this camera and frame, to stand in for the right one. */
  any(camera, frame) {
    for (const width of [...WIDTHS, 0]) {
      const found = this.now(camera, frame, width);
      if (found) return found;
    }
    return undefined;
  }

  /* Fetch an image; those that are `urgent` first. Resolves to undefined where nothing is known of it. */
  want(camera, frame, width, urgent = true) {
    const key = this.#key(camera, frame, width);
    if (this.kept.has(key)) return Promise.resolve(this.kept.get(key).bitmap);
    const known = this.waiting.get(key);
    if (known) {
      if (urgent && !known.urgent) {
        known.urgent = true;
        const place = this.queue.indexOf(known);
        if (place >= 0) { this.queue.splice(place, 1); this.queue.unshift(known); }
      }
      return known.promise;
    }
    const job = { key, camera, frame, width, urgent };
    job.promise = new Promise((resolve) => (job.resolve = resolve));
    this.waiting.set(key, job);
    if (urgent) this.queue.unshift(job);
    else this.queue.push(job);
    this.#next();
    return job.promise;
  }

  /* Forget what was asked for and has not begun: another frame is wanted by now. */
  calm() {
    for (const job of this.queue) {
      this.waiting.delete(job.key);
      job.resolve(undefined);
    }
    this.queue = [];
  }

  async #next() {
    if (this.running >= AT_ONCE || !this.queue.length) return;
    const job = this.queue.shift();
    this.running += 1;
    let bitmap = null;
    try {
      bitmap = await createImageBitmap(
        await blob(`${this.path}/${encodeURIComponent(job.camera)}/${job.frame}?width=${job.width}&v=${this.stamp}`));
    } catch (error) {
      if (error instanceof Refused && error.status === 0) bitmap = undefined; // the server is away: it is asked again
    } // else a gap in the recording, or an image that does not decode: none is shown
    this.running -= 1;
    this.waiting.delete(job.key);
    if (bitmap === undefined) { job.resolve(bitmap); this.#next(); return; }
    const size = bitmap ? 4 * bitmap.width * bitmap.height : 0;
    this.kept.set(job.key, { bitmap, size });
    this.bytes += size;
    for (const [key, old] of this.kept) {
      if (this.bytes <= KEPT_BYTES || key === job.key) break;
      this.kept.delete(key);
      this.bytes -= old.size;
      old.bitmap?.close();
    }
    job.resolve(bitmap);
    this.#next();
  }
}
