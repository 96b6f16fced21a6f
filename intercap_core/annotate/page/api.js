/* Requests to the server. The access token follows "#" in the address, which browsers do not send. It
 * is stored for this tab and sent in a header, which pages of other origins cannot set. */
const KEY = "intercap-token";

/* Move the token from the address into this tab's storage, and return it; null if there is none. */
export function readToken() {
  const token = /[#&]token=([\w-]+)/.exec(location.hash)?.[1];
  if (token) {
    sessionStorage.setItem(KEY, token);
    history.replaceState(null, "", location.pathname + location.hash.replace(/[#&]token=[\w-]+/, ""));
  }
  return sessionStorage.getItem(KEY);
}

/* The server refused a request, or did not answer (status 0). */
export class RequestError extends Error {
  constructor(status, details) {
    super(details.error ?? String(details));
    this.status = status;
    this.details = details;
  }
}

async function request(path, options = {}) {
  const headers = { "x-intercap-token": sessionStorage.getItem(KEY) ?? "", ...options.headers };
  let answer;
  try {
    answer = await fetch(`/api/${path}`, { ...options, headers });
  } catch {
    throw new RequestError(0, { error: "the server does not answer: check `intercap annotate` and the tunnel" });
  }
  if (answer.ok) return answer;
  const text = await answer.text();
  let details;
  try { details = JSON.parse(text); } catch { details = { error: text.trim() || `status ${answer.status}` }; }
  throw new RequestError(answer.status, details);
}

export const get = async (path) => (await request(path)).json();

/* Send JSON; returns the JSON of the answer. Raises RequestError, as do `get` and `blob`. */
export const post = async (path, content) =>
  (await request(path, {
    method: "POST", body: JSON.stringify(content), headers: { "content-type": "application/json" },
  })).json();

export const blob = async (path, signal) => (await request(path, { signal })).blob();

/* Fetch data as `payload` in intercap_core/output/viewer/page.py serializes it.
 * Returns header, arrays by name, and the compressed bytes for the viewer. */
export async function fetchArrays(path) {
  const data = await blob(path);
  const bytes = await new Response(data.stream().pipeThrough(new DecompressionStream("deflate"))).arrayBuffer();
  const length = new DataView(bytes).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(bytes, 4, length)));
  const types = { float32: Float32Array, uint32: Uint32Array, uint16: Uint16Array, int16: Int16Array, uint8: Uint8Array };
  const arrays = {};
  for (const [name, { type, shape, offset }] of Object.entries(header.arrays)) {
    arrays[name] = new types[type](bytes, 4 + length + offset, shape.reduce((a, b) => a * b, 1));
  }
  return { header, arrays, data };
}

export function toBase64(data) {
  return new Promise((resolve, reject) => {
    const reader = new FileReader();
    reader.onload = () => resolve(reader.result.slice(reader.result.indexOf(",") + 1));
    reader.onerror = () => reject(reader.error);
    reader.readAsDataURL(data);
  });
}

export const fromBase64 = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
