"use strict";
// The field for instructions in the bar. Enter sends the whole text at once.
(() => {
  const MAX_LETTERS = 401;  // one more than the server accepts, so that it states its limit

  async function send(text) {
    const letters = [...(text.toWellFormed?.() ?? text)].slice(0, MAX_LETTERS).join("");
    const headers = {
      "X-Dualbrain-Text": encodeURIComponent(letters),
      "X-Dualbrain-Page": document.getElementById("db-page")?.dataset.token ?? "",
    };
    try {
      const reply = await fetch("/instruction", { cache: "no-store", headers });
      return reply.ok ? await reply.text() : `not sent: ${await reply.text()}`;
    } catch {
      return "not sent: no connection";
    }
  }

  function addForm() {
    if (document.getElementById("db-form")) return;
    const form = document.createElement("form");
    form.id = "db-form";
    form.innerHTML = '<input id="db-instruction" autocomplete="off" aria-label="instruction"' +
      ' placeholder="Instruction; Enter sends it, and “stop” needs no code"><output id="db-answer"></output>';
    const [field, answer] = form.children;
    form.addEventListener("submit", async event => {
      event.preventDefault();
      const text = field.value;
      field.value = answer.textContent = "";
      if (text.trim()) answer.textContent = await send(text);
    });
    document.body.append(form);
  }

  addEventListener("db-can-instruct", addForm);
})();
