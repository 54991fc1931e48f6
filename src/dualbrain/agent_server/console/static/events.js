// Status and live events. A hidden page closes its stream, so that many open pages do not use up the connections.
import { messages } from "./api.js";
import { byId, element } from "./elements.js";

const KEPT = 500, RETRY_MS = 1000, SILENT_MS = 3000;
let last = 0, server = "", stream = null, heardAt = 0;

function showStatus({ state, reason, busy, reporting }) {
  const calm = ["NONE", "WARN"].includes(state), off = ["ESTOP", "LOCKOUT"].includes(state);
  const words = calm ? (busy ? "executing a contract" : "ready") : state.replaceAll("_", " ").toLowerCase();
  show(reporting ? (state === "ESTOP" ? "emergency stop" : words) : "the robot does not report", reporting && calm ? "good" : off || !reporting ? "bad" : "warn", reason);
}

function show(words, tone, reason = "") {
  byId("state").textContent = words;
  byId("state").className = `badge ${tone}`;
  byId("reason").textContent = reason.replaceAll("_", " ");
}

// The numbers of the events begin again with every server.
function begin(id) {
  if (id === server) return;
  byId("events").replaceChildren();
  [server, last] = [id, 0];
}

function showEvent(event) {
  const list = byId("events");
  last = event.number;
  if (event.kind === "perception" && !byId("perception").checked) return;
  const item = element("li"), text = element("span");
  text.append(element("b", event.kind), event.text);
  item.append(element("time", `${event.t.toFixed(2)} s`), text);
  list.prepend(item);
  while (list.children.length > KEPT) list.lastChild.remove();
  if (byId("follow").checked) list.scrollTop = 0;
}

async function follow(signal) {
  while (!signal.aborted) {
    try {
      for await (const { kind, data } of messages(`events?after=${last}&server=${server}`, signal)) {
        heardAt = performance.now();
        if (kind === "status") showStatus(data);
        else if (kind === "server") begin(data.id);
        else showEvent(data);
      }
    } catch (error) {
      if (signal.aborted || error.status === 401) return;
      show("no connection", "bad", error.message);
    }
    await new Promise((done) => setTimeout(done, RETRY_MS));
  }
}

export function connectEvents() {
  const restart = () => {
    stream?.abort();
    stream = null;
    if (document.hidden) return;
    stream = new AbortController();
    heardAt = performance.now();
    follow(stream.signal);
  };
  document.addEventListener("visibilitychange", restart);
  document.addEventListener("no-access", () => stream?.abort());
  setInterval(() => {
    if (stream && !stream.signal.aborted && performance.now() - heardAt > SILENT_MS) show("no connection", "bad", "The server is silent.");
  }, RETRY_MS);
  restart();
}
