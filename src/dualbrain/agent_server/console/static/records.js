// Runs with their reports, and the memory with weights and citations.
import { json } from "./api.js";
import { badge, byId, element, number, table } from "./elements.js";

const count = (n, one, many) => `${n} ${n === 1 ? one : many}`;
const citations = (row) => element("small", row.cites.length ? `cites ${row.cites.join(", ")}` : "");

async function load(name, path, show) {
  const note = byId(`${name}-note`);
  note.textContent = "loading …";
  try {
    const answer = await json(path);
    note.textContent = show(answer);
  } catch (error) {
    note.textContent = error.message;
  }
}

function reportButton(run) {
  if (!run.report) return "";
  const button = element("button", "Report", { type: "button", class: "small", "aria-label": `Report of ${run.name}` });
  button.addEventListener("click", async () => {
    try {
      const { path } = await json("tickets", { method: "POST", body: JSON.stringify({ run: run.name }) });
      byId("report").hidden = false;
      byId("report-title").textContent = run.name;
      byId("report-frame").src = path;
      byId("report-close").focus();
    } catch (error) {
      byId("runs-note").textContent = error.message;
    }
  });
  return button;
}

export const loadRuns = () => load("runs", "runs", ({ runs, omitted }) => {
  const columns = [
    { name: "started", cell: (run) => run.started.replace("T", " ").slice(0, 19), value: (run) => run.started },
    { name: "instruction", cell: (run) => [run.instruction || "(a given contract)", citations(run)], value: (run) => run.instruction },
    { name: "outcome", cell: (run) => [badge(run.outcome), element("small", run.reason)], value: (run) => run.outcome },
    { name: "senses", cell: (run) => run.senses },
    { name: "Δ", number: true, cell: (run) => number(run.delta, 4), value: (run) => run.delta },
    { name: "clearance", number: true, cell: (run) => number(run.clearance === null ? null : 1000 * run.clearance, 1, " mm"), value: (run) => run.clearance },
    { name: "motion", number: true, cell: (run) => number(run.duration, 1, " s"), value: (run) => run.duration },
    { name: "report", cell: reportButton },
  ];
  byId("runs-table").replaceChildren(table(columns, runs));
  return `${count(runs.length, "run", "runs")}${omitted ? `; ${omitted} more are older or have no readable episode` : ""}`;
});

export const loadMemory = () => load("memory", "memory", ({ memories, total, reason }) => {
  const weight = (row) => [element("meter", "", { min: 0, max: 1, value: row.weight, "aria-label": "weight" }), number(row.weight, 3)];
  const columns = [
    { name: "memory", cell: (row) => [row.id, citations(row)], value: (row) => row.time },
    { name: "instruction", cell: (row) => row.instruction || "(a given contract)", value: (row) => row.instruction },
    { name: "outcome", cell: (row) => badge(row.outcome), value: (row) => row.outcome },
    { name: "Δ", number: true, cell: (row) => number(row.delta, 4), value: (row) => row.delta },
    { name: "weight w", number: true, cell: weight, value: (row) => row.weight },
    { name: "changes", cell: (row) => `+${row.reinforced} −${row.suppressed}` },
    { name: "cited", number: true, cell: (row) => String(row.cited), value: (row) => row.cited },
    { name: "status", cell: (row) => badge(row.status), value: (row) => row.status },
    { name: "source", cell: (row) => row.source.replace(/(\+[0-9a-f]{8})[0-9a-f]+$/, "$1…") },
  ];
  byId("memory-table").replaceChildren(table(columns, memories));
  return reason || `${memories.length} of ${count(total, "memory", "memories")}; "cited" counts the prompts in which a memory was`;
});

export function connectRecords() {
  byId("runs-again").addEventListener("click", loadRuns);
  byId("memory-again").addEventListener("click", loadMemory);
  byId("report-close").addEventListener("click", () => {
    byId("report").hidden = true;
    byId("report-frame").removeAttribute("src");
    byId("runs-again").focus();
  });
}
