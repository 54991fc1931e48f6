"use strict";
(() => {
  const POLL_MS = 300, LOST_MS = 1500, SLOW_MS = 1500;
  const SHAPES = {
    MOVING: '<path d="M22 10 L86 50 L22 90 Z"/>',
    GIVING_WAY: '<path d="M6 12 L94 12 L50 92 Z M28 26 L50 66 L72 26 Z" fill-rule="evenodd"/>',
    HOLDING: '<path d="M20 10 H42 V90 H20 Z M58 10 H80 V90 H58 Z"/>',
    STOPPED: '<rect x="12" y="12" width="76" height="76"/>',
    EMERGENCY_STOP: '<path d="M31 4 H69 L96 31 V69 L69 96 H31 L4 69 V31 Z M26 42 V58 H74 V42 Z" fill-rule="evenodd"/>',
    NO_CONNECTION: '<path d="M14 4 L50 40 L86 4 L96 14 L60 50 L96 86 L86 96 L50 60 L14 96 L4 86 L40 50 L4 14 Z"/>',
  };
  const LOST = {
    state: "NO_CONNECTION", word: "NO CONNECTION", steps: [],
    reason: "This page receives nothing from the robot's program: the image is old, and the robot may still move.",
    next: "Use the emergency stop at the robot, because this page may not reach it. Then look at the terminal in which the run was started.",
  };
  const address = new URL(location.href);
  if (!document.createElement("canvas").getContext("webgl2")) {
    location.replace("/text");
    return;
  }
  if (matchMedia("(prefers-color-scheme: dark)").matches && !address.searchParams.has("darkMode")) {
    address.searchParams.set("darkMode", "");
    history.replaceState(null, "", address);
  }
  // A worker asks for the state, because drawing the scene may block this thread for seconds in a slow browser.
  const WORKER = `
    const until = (ms) => new Promise(done => setTimeout(done, ms));
    let ended = false, last = Date.now();
    const loop = async () => {
      for (;;) {
        try {
          const reply = await fetch("${address.origin}/status", {cache: "no-store", signal: AbortSignal.timeout(${LOST_MS})});
          const status = await reply.json();
          last = Date.now();
          ended = status.ended;
          postMessage({status, at: last});
        } catch (error) {
          if (!ended && Date.now() - last > ${LOST_MS}) postMessage({status: null, at: Date.now()});
        }
        await until(${POLL_MS});
      }
    };
    loop();`;
  let shown = "";

  function stop() {
    fetch("/estop", { cache: "no-store" }).catch(() => show(LOST));
  }

  function build() {
    const bar = document.createElement("div");
    bar.id = "db-bar";
    bar.setAttribute("role", "status");
    bar.setAttribute("aria-live", "assertive");
    bar.innerHTML = '<svg viewBox="0 0 100 100" fill="currentColor" aria-hidden="true"></svg>' +
      '<div class="words"><div id="db-state"></div><div id="db-reason"></div><div id="db-next"></div><ol id="db-steps"></ol></div>' +
      '<div id="db-side"><span id="db-slow" title="This browser draws slowly. The words and the emergency stop are not affected; the text view needs no drawing." hidden>slow browser: the image is late</span>' +
      '<a href="/text">text view</a></div>';
    document.body.prepend(bar);
  }

  function addStop() {
    const button = document.createElement("button");
    button.id = "db-stop";
    button.innerHTML = "EMERGENCY<br>STOP";
    button.title = "Escape; needs no code";
    button.addEventListener("click", stop);
    document.getElementById("db-side").prepend(button);
  }

  function show(status) {
    const text = JSON.stringify(status);
    if (text === shown) return;
    shown = text;
    const bar = document.getElementById("db-bar");
    bar.className = status.state;
    bar.style.setProperty("--letters", Math.max(8, status.word.length));
    bar.querySelector("svg").innerHTML = SHAPES[status.state];
    document.getElementById("db-state").textContent = status.word;
    document.getElementById("db-reason").textContent = status.reason;
    document.getElementById("db-next").textContent = status.next;
    document.getElementById("db-steps").replaceChildren(...status.steps.map((step, k) => {
      const item = document.createElement("li");
      item.textContent = `${k + 1}. ${step}`;
      return item;
    }));
    document.title = `${status.word} – dualbrain`;
    if (status.can_stop && !document.getElementById("db-stop")) addStop();
    const stopButton = document.getElementById("db-stop");
    if (stopButton) stopButton.innerHTML = status.state === "EMERGENCY_STOP" ? "STOP<br>IS ACTIVE" : "EMERGENCY<br>STOP";
    if (status.can_instruct) dispatchEvent(new Event("db-can-instruct"));
  }

  function receive({ data }) {
    show(data.status ?? LOST);
    document.getElementById("db-slow").hidden = Date.now() - data.at < SLOW_MS;
  }

  function poll() {
    new Worker(URL.createObjectURL(new Blob([WORKER], { type: "text/javascript" }))).onmessage = receive;
  }

  addEventListener("keydown", event => {
    if (event.key === "Escape" && document.getElementById("db-stop")) stop();
  }, true);
  addEventListener("DOMContentLoaded", () => { build(); poll(); });
})();
