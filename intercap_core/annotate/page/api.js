/* Requests to the server. The token comes with the address, after "#", which no server is told; it
 * stays with this tab and goes along in a header, which pages of other origins cannot set. */
const KEY = "intercap-token";

export function takeToken() {
  const given = /[#&]token=([\w-]+)/.exec(location.hash)?.[1];
  if (given) {
    sessionStorage.setItem(KEY, given);
    history.replaceState(null, "", location.pathname + location.hash.replace(/[#&]token=[\w-]+/, ""));
  }
  return sessionStorage.getItem(KEY);
}

export class Refused extends Error {
  constructor(status, told) {
    super(told.error ?? String(told));
    this.status = status;
    this.told = told;
  }
}

async function request(path, options = {}) {
  const headers = { "x-intercap-token": sessionStorage.getItem(KEY) ?? "", ...options.headers };
  let answer;
  try {
    answer = await fetch(`/api/${path}`, { ...options, headers });
  } catch {
    throw new Refused(0, { error: "the server does not answer: has `intercap annotate` ended, or the tunnel?" });
  }
  if (answer.ok) return answer;
  const text = await answer.text();
  let told;
  try { told = JSON.parse(text); } catch { told = { error: text.trim() || `status ${answer.status}` }; }
  throw new Refused(answer.status, told);
}

export const get = async (path) => (await request(path)).json();

export const post = async (path, told) =>
  (await request(path, {
    method: "POST", body: JSON.stringify(told), headers: { "content-type": "application/json" },
  })).json();

export const blob = async (path, signal) => (await request(path, { signal })).blob();

/* Header and arrays as intercap_core/output/viewer/package.py packs them, and the text for the viewer. */
export async function packed(path) {
  const data = await blob(path);
  const whole = await new Response(data.stream().pipeThrough(new DecompressionStream("deflate"))).arrayBuffer();
  const length = new DataView(whole).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(whole, 4, length)));
  const types = { float32: Float32Array, uint32: Uint32Array, uint16: Uint16Array, int16: Int16Array, uint8: Uint8Array };
  const arrays = {};
  for (const [name, { type, shape, offset }] of Object.entries(header.arrays)) {
    arrays[name] = new types[type](whole, 4 + length + offset, shape.reduce((a, b) => a * b, 1));
  }
  return { header, arrays, data };
}

export function base64(data) {
  return new Promise((resolve, reject) => {
    const reader = new FileReader();
    reader.onload = () => resolve(reader.result.slice(reader.result.indexOf(",") + 1));
    reader.onerror = () => reject(reader.error);
    reader.readAsDataURL(data);
  });
}

export const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
