// Runs the steps of a scenario with the TypeScript SDK of the Model Context Protocol, and prints one JSON line a step.
// Usage: node client.mjs SDK_FOLDER SCENARIO, with the server in DUALBRAIN_COMMAND (JSON array) or DUALBRAIN_URL.
import { readFileSync, writeSync } from "node:fs";
import { pathToFileURL } from "node:url";

const [sdk, scenario] = process.argv.slice(2);
const load = (name) => import(pathToFileURL(`${sdk}/node_modules/@modelcontextprotocol/sdk/dist/esm/client/${name}.js`));
const { Client } = await load("index");

async function transport() {
  if (process.env.DUALBRAIN_URL) {
    const { StreamableHTTPClientTransport } = await load("streamableHttp");
    const headers = { Authorization: `Bearer ${process.env.DUALBRAIN_TOKEN}` };
    return new StreamableHTTPClientTransport(new URL(process.env.DUALBRAIN_URL), { requestInit: { headers } });
  }
  const { StdioClientTransport } = await load("stdio");
  const [command, ...args] = JSON.parse(process.env.DUALBRAIN_COMMAND);
  return new StdioClientTransport({ command, args, env: process.env });
}

async function step(client, one) {
  let progress = 0;
  const onprogress = () => (progress += 1);
  switch (one.do) {
    case "list_tools":
      return { value: (await client.listTools()).tools.map((tool) => tool.name) };
    case "call": {
      const call = { name: one.tool, arguments: one.arguments };
      const found = await client.callTool(call, undefined, one.progress ? { onprogress } : undefined);
      return { value: found.structuredContent, is_error: Boolean(found.isError), progress };
    }
    case "read":
      return { value: JSON.parse((await client.readResource({ uri: one.uri })).contents[0].text) };
    case "prompt":
      return { value: (await client.getPrompt({ name: one.name, arguments: one.arguments })).messages[0].content.text };
  }
}

const client = new Client({ name: "npm test client", version: "1" });
await client.connect(await transport());
const scene = (await client.callTool({ name: "get_scene", arguments: {} })).structuredContent;
const text = readFileSync(scenario, "utf8").replaceAll("$id", scene.next_id).replaceAll("$registry", scene.registry);
for (const one of JSON.parse(text)) {
  let result;
  try {
    result = await step(client, one);
  } catch (error) {
    result = { error_code: error.code ?? null, message: String(error.message) };
  }
  writeSync(1, JSON.stringify(result) + "\n");
}
await client.close();
process.exit(0);
