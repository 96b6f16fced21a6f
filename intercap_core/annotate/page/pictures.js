/* Cache of decoded images by camera, frame and width, with prefetching. */
import { RequestError, blob } from "./api.js";

const MAX_BYTES = 300e6; // size of all cached images, decoded
const MAX_REQUESTS = 6; // browsers open at most six connections to a server
const WIDTHS = [240, 320, 480, 640, 960, 1280]; // pixels, as in opened.py

export class Pictures {
  constructor(sequence, stamp) {
    this.path = `sequences/${sequence}/image`;
    this.stamp = stamp;
    this.cache = new Map();
    this.bytes = 0;
    this.waiting = new Map(); // jobs by key
    this.queue = [];
    this.running = 0;
  }

  /* Width to fetch for an image that is shown `pixels` wide, enlarged by up to 11 %; 0 = full size. */
  width(pixels) { return WIDTHS.find((width) => width >= 0.9 * pixels) ?? 0; }

  #key(camera, frame, width) { return `${camera}/${frame}/${width}`; }

  /* The decoded image: undefined if it is not cached, null if it does not exist. */
  cached(camera, frame, width) {
    const key = this.#key(camera, frame, width), entry = this.cache.get(key);
    if (entry !== undefined) { this.cache.delete(key); this.cache.set(key, entry); }
    return entry?.bitmap;
  }

  /* A cached image of any width, shown until the requested width arrives. */
  cachedAny(camera, frame) {
    for (const width of [...WIDTHS, 0]) {
      const image = this.cached(camera, frame, width);
      if (image) return image;
    }
    return undefined;
  }

  /* Fetch an image, `urgent` ones first. Resolves to undefined if the request was cancelled or failed. */
  fetch(camera, frame, width, urgent = true) {
    const key = this.#key(camera, frame, width);
    if (this.cache.has(key)) return Promise.resolve(this.cache.get(key).bitmap);
    let job = this.waiting.get(key);
    if (!job) {
      job = { key, camera, frame, width };
      job.promise = new Promise((resolve) => (job.resolve = resolve));
      this.waiting.set(key, job);
      this.queue.push(job);
    }
    if (urgent && this.queue.includes(job)) this.queue = [job, ...this.queue.filter((other) => other !== job)];
    this.#next();
    return job.promise;
  }

  /* Cancel requests that have not started, because another frame is shown. */
  cancel() {
    for (const job of this.queue) {
      this.waiting.delete(job.key);
      job.resolve(undefined);
    }
    this.queue = [];
  }

  async #next() {
    if (this.running >= MAX_REQUESTS || !this.queue.length) return;
    const job = this.queue.shift();
    this.running += 1;
    let bitmap = null;
    try {
      bitmap = await createImageBitmap(
        await blob(`${this.path}/${encodeURIComponent(job.camera)}/${job.frame}?width=${job.width}&v=${this.stamp}`));
    } catch (error) {
      if (error instanceof RequestError && error.status === 0) bitmap = undefined; // connection lost: requested again later
    } // otherwise the image is missing or does not decode
    this.running -= 1;
    this.waiting.delete(job.key);
    if (bitmap === undefined) { job.resolve(bitmap); this.#next(); return; }
    const size = bitmap ? 4 * bitmap.width * bitmap.height : 0;
    this.cache.set(job.key, { bitmap, size });
    this.bytes += size;
    for (const [key, old] of this.cache) {
      if (this.bytes <= MAX_BYTES || key === job.key) break;
      this.cache.delete(key);
      this.bytes -= old.size;
      old.bitmap?.close();
    }
    job.resolve(bitmap);
    this.#next();
  }
}
