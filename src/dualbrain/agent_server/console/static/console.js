// Start of the page: access, the tabs, and the parts of the page.
import { keepToken, takeToken } from "./api.js";
import { byId } from "./elements.js";
import { connectEditor } from "./editor.js";
import { connectEvents } from "./events.js";
import { connectRecords, loadMemory, loadRuns } from "./records.js";
import { connectStops } from "./stops.js";

const tabs = [...document.querySelectorAll("[role=tab]")], loaders = { runs: loadRuns, memory: loadMemory };

function select(tab) {
  for (const one of tabs) {
    const chosen = one === tab, panel = one.getAttribute("aria-controls");
    one.setAttribute("aria-selected", String(chosen));
    one.tabIndex = chosen ? 0 : -1;
    byId(panel).hidden = !chosen;
    if (chosen) loaders[panel]?.();
  }
}

function move(event) {
  const k = tabs.indexOf(event.currentTarget), to = { ArrowRight: k + 1, ArrowLeft: k - 1, Home: 0, End: -1 }[event.key];
  if (to === undefined) return;
  event.preventDefault();
  const tab = tabs.at(to % tabs.length);
  tab.focus();
  select(tab);
}

function start() {
  byId("access").hidden = true;
  byId("main").hidden = false;
  connectEditor();
  connectEvents();
  connectRecords();
  select(tabs[0]);
}

for (const tab of tabs) {
  tab.addEventListener("click", () => select(tab));
  tab.addEventListener("keydown", move);
}
byId("access").addEventListener("submit", (event) => {
  event.preventDefault();
  keepToken(byId("token").value.trim());
  location.reload();
});
document.addEventListener("no-access", () => {
  byId("access").hidden = false;
  byId("main").hidden = true;
  byId("access-reason").textContent = "The server does not accept this token. It is in the file that the command printed at its start.";
  byId("token").focus();
});
connectStops();
if (takeToken()) start();
else {
  byId("access").hidden = false;
  byId("token").focus();
}
