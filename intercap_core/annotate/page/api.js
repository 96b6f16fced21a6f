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

export const blob = async (path) => (await request(path)).blob();

/* Fetch header and arrays by name, as `unpack` of the viewer returns them. */
export const fetchArrays = async (path) => window.unpack(await blob(path));

export const fromBase64 = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
