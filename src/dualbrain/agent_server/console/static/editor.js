// The contract editor: the robot's own gate checks the text while it is typed. Nothing is executed.
import { json } from "./api.js";
import { byId, element } from "./elements.js";
import { findPlace } from "./pointer.js";

const DELAY_MS = 120;
let timer = 0, running = null, pointer = null, scene = null;

function show(tone, title, rows = []) {
  const list = element("dl"), box = byId("verdict");
  for (const [name, value] of rows) list.append(element("dt", name), element("dd", typeof value === "string" ? value : JSON.stringify(value)));
  box.className = tone;
  box.replaceChildren(element("b", title), list);
}

function showVerdict(verdict) {
  pointer = verdict.accepted ? null : verdict.pointer;
  byId("place").disabled = !pointer;
  if (verdict.accepted) return show("good", "The gate accepts this contract.", [["note", "The scene can change before it is submitted; the gate checks it again then."]]);
  const { stage, pointer: at, got, allowed, hint } = verdict;
  return show("bad", `Rejected at the stage ${stage}.`, [["at", at || "the whole contract"], ["got", got], ["allowed", allowed], ["hint", hint]]);
}

async function check() {
  running?.abort();
  running = new AbortController();
  try {
    showVerdict(await json("check", { method: "POST", body: byId("text").value, signal: running.signal }));
  } catch (error) {
    if (error.name !== "AbortError") show("warn", "Not checked.", [["reason", error.message]]);
  }
}

function changed() {
  clearTimeout(timer);
  byId("place").disabled = true;
  timer = setTimeout(check, DELAY_MS);
}

async function loadScene() {
  try {
    scene = await json("scene");
  } catch (error) {
    byId("scene").textContent = error.message;
    return;
  }
  byId("robot").textContent = `robot: ${scene.name}`;
  byId("scene").textContent = scene.summary;
  byId("skills").textContent = scene.skills;
  if (!byId("text").value) writeTemplate();
  else changed();
}

function writeTemplate() {
  if (!scene) return;
  const context = { robot: scene.robot, registry: scene.registry };
  const idle = scene.skills.includes("hold(") ? { skill: "hold", params: { duration: 1.0 } } : { skill: "decline", params: { reason: "an example" } };
  const contract = { id: scene.next_id, context, action_sequence: [idle] };
  byId("text").value = JSON.stringify(contract, null, 2);
  changed();
}

function showPlace() {
  const place = findPlace(byId("text").value, pointer), text = byId("text");
  text.focus();
  if (place) text.setSelectionRange(...place);
}

export function connectEditor() {
  byId("text").addEventListener("input", changed);
  byId("scene-again").addEventListener("click", loadScene);
  byId("template").addEventListener("click", async () => { await loadScene(); writeTemplate(); });
  byId("place").addEventListener("click", showPlace);
  loadScene();
}
