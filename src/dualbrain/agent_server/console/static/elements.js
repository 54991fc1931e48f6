// Elements with text. All text comes from untrusted sources and is never markup.
export const byId = (id) => document.getElementById(id);

export function element(tag, text = "", attributes = {}) {
  const made = document.createElement(tag);
  made.textContent = text;
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  return made;
}

export function number(value, digits, unit = "") {
  return typeof value === "number" && isFinite(value) ? value.toFixed(digits) + unit : "-";
}

const GOOD = ["succeeded", "active"], BAD = ["failed", "emergency", "revoked"];
export function badge(word) {
  return element("span", word.replaceAll("_", " "), { class: `badge ${GOOD.includes(word) ? "good" : BAD.includes(word) ? "bad" : "warn"}` });
}

// A table that a click on a head sorts. Each column has a name, a cell for a row, and optionally a value to sort by.
export function table(columns, rows, order = { column: -1, down: true }) {
  const made = element("table"), head = made.createTHead().insertRow(), body = made.createTBody();
  const value = columns[order.column]?.value;
  const sorted = value ? [...rows].sort((a, b) => (order.down ? -1 : 1) * compare(value(a), value(b))) : rows;
  columns.forEach((column, k) => {
    const cell = element("th", column.value ? "" : column.name, { scope: "col" });
    if (column.number) cell.className = "number";
    if (column.value) {
      const mark = order.column === k ? (order.down ? " ▾" : " ▴") : "";
      const button = cell.appendChild(element("button", column.name + mark, { type: "button" }));
      if (mark) cell.setAttribute("aria-sort", order.down ? "descending" : "ascending");
      button.addEventListener("click", () => {
        const again = table(columns, rows, { column: k, down: order.column === k ? !order.down : true });
        made.replaceWith(again);
        again.querySelectorAll("th")[k].querySelector("button").focus();
      });
    }
    head.appendChild(cell);
  });
  for (const row of sorted) {
    const line = body.insertRow();
    for (const column of columns) {
      const cell = line.insertCell(), content = column.cell(row);
      if (column.number) cell.className = "number";
      cell.append(...(Array.isArray(content) ? content : [content]));
    }
  }
  return made;
}

function compare(a, b) {
  return typeof a === "string" ? a.localeCompare(b) : (a ?? -Infinity) - (b ?? -Infinity);
}
