// Requests to the server of this page. The token is taken from the fragment of the address, which no server receives.
const KEY = "dualbrain-token";

export class Refusal extends Error {
  constructor(status, sentence) { super(sentence); this.status = status; }
}

export function takeToken() {
  const given = new URLSearchParams(location.hash.slice(1)).get("token");
  if (given) keepToken(given);
  if (location.hash) history.replaceState(null, "", location.pathname);
  return Boolean(sessionStorage.getItem(KEY));
}

export function keepToken(token) {
  sessionStorage.setItem(KEY, token);
}

export async function request(path, options = {}) {
  const headers = { Authorization: `Bearer ${sessionStorage.getItem(KEY) || ""}` };
  let answer;
  try {
    answer = await fetch(`/console/api/${path}`, { ...options, headers, cache: "no-store", redirect: "error" });
  } catch (error) {
    if (error.name === "AbortError") throw error;
    throw new Refusal(0, "The server does not answer. Is the command in the terminal still running?");
  }
  if (answer.ok) return answer;
  if (answer.status === 401) document.dispatchEvent(new Event("no-access"));
  const body = await answer.json().catch(() => ({}));
  throw new Refusal(answer.status, body.error || `The server answered with status ${answer.status}.`);
}

export async function json(path, options) {
  return (await request(path, options)).json();
}

// Server-sent events over fetch, because an EventSource cannot send the token.
export async function* messages(path, signal) {
  const reader = (await request(path, { signal })).body.pipeThrough(new TextDecoderStream()).getReader();
  let rest = "";
  for (;;) {
    const { value, done } = await reader.read();
    if (done) return;
    const parts = (rest + value).split("\n\n");
    rest = parts.pop();
    for (const part of parts) {
      const [kind, data] = part.split("\n");
      yield { kind: kind.slice("event: ".length), data: JSON.parse(data.slice("data: ".length)) };
    }
  }
}
