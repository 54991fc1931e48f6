// The table from above: x (forward) points up, y (left) to the left; lengths in metres.
const objects = DATA.objects, byId = (id) => document.getElementById(id), svg = byId("table");
const [x0, x1] = DATA.table.x, [y0, y1] = DATA.table.y;
svg.setAttribute("viewBox", `${-y1 - 0.08} ${-x1 - 0.08} ${y1 - y0 + 0.16} ${x1 - x0 + 0.16}`);
let chosen = null, dragged = null, timer = 0;

function node(tag, attributes, parent) {
  const made = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const name in attributes) made.setAttribute(name, attributes[name]);
  parent.appendChild(made);
  return made;
}

function draw() {
  svg.replaceChildren();
  node("rect", { x: -y1, y: -x1, width: y1 - y0, height: x1 - x0, rx: 0.01, fill: "#d6c5ac" }, svg);
  node("circle", { cx: 0, cy: 0, r: 0.09, fill: "#8a929a" }, svg);
  node("text", { x: 0, y: 0.125, "text-anchor": "middle" }, svg).textContent = "robot";
  for (const place of DATA.places) {
    node("circle", { cx: -place.y, cy: -place.x, r: 0.06, fill: "none", stroke: "#7d735f", "stroke-width": 0.002, "stroke-dasharray": 0.01 }, svg);
    node("text", { x: -place.y, y: -place.x, "text-anchor": "middle", opacity: 0.7 }, svg).textContent = place.name;
  }
  for (const one of objects) {
    const turn = (-180 / Math.PI) * one.yaw;
    const group = node("g", { class: one === chosen ? "object chosen" : "object", transform: `translate(${-one.y} ${-one.x})` }, svg);
    const path = one.outline.map(([u, v], k) => `${k ? "L" : "M"}${-v} ${-u}`).join("") + "Z";
    node("path", { d: path, transform: `rotate(${turn})`, fill: DATA.colours[one.colour] || "#999", stroke: "#0006", "stroke-width": 0.002 }, group);
    const low = Math.max(...one.outline.map(([u, v]) => Math.hypot(u, v)));
    node("text", { x: 0, y: low + 0.028, "text-anchor": "middle" }, group).textContent = one.name;
    group.addEventListener("pointerdown", (event) => { choose(one); dragged = [event, one.x, one.y]; svg.setPointerCapture(event.pointerId); });
  }
}

function choose(one) {
  chosen = one;
  byId("chosen").hidden = !one;
  byId("none").hidden = Boolean(one);
  if (one) {
    byId("name").value = one.name;
    byId("colour").value = one.colour;
    byId("yaw").value = Math.round((180 / Math.PI) * one.yaw);
    byId("where").textContent = `x ${(100 * one.x).toFixed(1)} cm forward, y ${(100 * one.y).toFixed(1)} cm left`;
  }
  draw();
}

function changed() {
  choose(chosen);
  byId("saved").textContent = "";
  clearTimeout(timer);
  timer = setTimeout(() => send("/check"), 150);
}

async function send(path) {
  const kept = objects.map(({ name, kind, colour, x, y, yaw, source }) => ({ name, kind, colour, x, y, yaw, source: source || "" }));
  const body = JSON.stringify({ objects: kept, person: byId("person").checked });
  let answer;
  try {
    answer = await (await fetch(path, { method: "POST", body, headers: { "X-Editor-Token": TOKEN } })).json();
  } catch {
    answer = { problems: ["The editor was closed in the terminal: start it again."], saved: "" };
  }
  const list = byId("problems");
  list.replaceChildren();
  for (const line of answer.problems.length ? answer.problems : ["none"]) {
    const item = document.createElement("li");
    item.textContent = line;
    item.className = answer.problems.length ? "bad" : "good";
    list.appendChild(item);
  }
  if (path === "/save") {
    byId("saved").textContent = answer.saved ? `Saved: ${answer.saved}` : "Not saved: correct the problems first.";
    byId("saved").className = answer.saved ? "good" : "bad";
  }
}

svg.addEventListener("pointermove", (event) => {
  if (!dragged) return;
  const metre = svg.getScreenCTM().a, [start, x, y] = dragged;
  chosen.x = Math.min(2, Math.max(-2, x - (event.clientY - start.clientY) / metre));
  chosen.y = Math.min(2, Math.max(-2, y - (event.clientX - start.clientX) / metre));
  changed();
});
svg.addEventListener("pointerup", () => { dragged = null; });
svg.addEventListener("pointerdown", (event) => { if (event.target === svg) choose(null); });
document.addEventListener("keydown", (event) => {
  if (!chosen || ["INPUT", "SELECT"].includes(event.target.tagName)) return;
  const step = { ArrowUp: [0.005, 0], ArrowDown: [-0.005, 0], ArrowLeft: [0, 0.005], ArrowRight: [0, -0.005] }[event.key];
  if (step) { chosen.x += step[0]; chosen.y += step[1]; event.preventDefault(); }
  else if (event.key === "r" || event.key === "R") chosen.yaw = ((chosen.yaw + Math.PI / 12 + Math.PI) % (2 * Math.PI)) - Math.PI;
  else if (event.key === "Delete") { remove(); return; }
  else return;
  changed();
});

function remove() {
  if (chosen) objects.splice(objects.indexOf(chosen), 1);
  chosen = null;
  changed();
}

function add(kind) {
  const colours = Object.keys(DATA.colours), taken = new Set(objects.map((one) => one.name));
  const colour = colours.find((one) => !taken.has(`${one}_${kind}`)) || colours[0];
  const one = { name: `${colour}_${kind}`, kind, colour, x: 0.35, y: 0, yaw: 0, outline: DATA.kinds[kind] };
  objects.push(one);
  chosen = one;
  changed();
}

for (const kind of Object.keys(DATA.kinds)) {
  const button = document.createElement("button");
  button.textContent = kind;
  button.addEventListener("click", () => add(kind));
  byId("kinds").appendChild(button);
}
for (const name of Object.keys(DATA.colours)) byId("colour").add(new Option(name));
byId("person").checked = DATA.person;
byId("person").addEventListener("change", changed);
byId("name").addEventListener("input", (event) => { chosen.name = event.target.value; draw(); changed(); });
byId("colour").addEventListener("change", (event) => { chosen.colour = event.target.value; changed(); });
byId("yaw").addEventListener("input", (event) => { chosen.yaw = (Math.PI / 180) * event.target.value; changed(); });
byId("remove").addEventListener("click", remove);
byId("save").addEventListener("click", () => send("/save"));
choose(null);
send("/check");
