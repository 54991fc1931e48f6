// The two stops. They need no connection of the event stream, and never wait for another request of this page.
import { request } from "./api.js";
import { byId } from "./elements.js";

async function stop(emergency) {
  const words = emergency ? "Emergency stop" : "Stop", answer = byId("stop-answer");
  answer.className = "warn";
  answer.textContent = `${words}: sending …`;
  try {
    const body = JSON.stringify({ emergency });
    const { state } = await (await request("stop", { method: "POST", body, keepalive: true, priority: "high" })).json();
    answer.className = "good";
    answer.textContent = `${words}: the robot confirms it (${state}).`;
  } catch (error) {
    answer.className = "bad";
    answer.textContent = `${words} NOT CONFIRMED: ${error.message} Use the emergency stop of the robot, or \`dualbrain operate estop\`.`;
  }
}

export function connectStops() {
  byId("estop").addEventListener("click", () => stop(true));
  byId("stop").addEventListener("click", () => stop(false));
}
