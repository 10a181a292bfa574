// Starting and stopping a recording, and taking it home.
import { post, say } from "./shell.js";

const byId = (id) => document.getElementById(id);
let on = null;

const size = (bytes) => (bytes < 1e6 ? `${(bytes / 1e3).toFixed(0)} kB` : `${(bytes / 1e6).toFixed(1)} MB`);

export function showRecordings({ on: now, files, error, most_bytes: most }, readOnly) {
  on = now;
  byId("record").textContent = now ? "Stop recording" : "Record";
  byId("record").setAttribute("aria-pressed", String(Boolean(now)));
  const how = now?.lossless ? "the daemon runs for it, without loss" : "what the robot says, and its pictures";
  byId("record").disabled = readOnly || now?.seconds === null;
  byId("recording").textContent = now?.seconds === null ? "the recording begins" : now
    ? `● recording ${now.seconds} s, ${size(now.bytes)} of ${size(most)}: ${how}`
    : error;
  byId("recordings").hidden = !files.length;
  byId("recording-list").replaceChildren(...files.map((file) => {
    const li = document.createElement("li");
    const link = document.createElement("a");
    const out = document.createElement("button");
    link.href = `/recording/file/${encodeURIComponent(file.name)}`;
    link.download = file.name;
    link.textContent = `${file.name}, ${size(file.bytes)}`;
    out.type = "button";
    out.textContent = "Delete";
    out.disabled = readOnly;
    out.setAttribute("aria-label", `Delete ${file.name}`);
    out.addEventListener("click", () => send("delete", { name: file.name }, () => `${file.name} deleted`));
    li.append(link, out);
    return li;
  }));
}

async function send(what, fields, done) {
  const answer = await post(`/recording/${what}`, fields);
  say(byId("reply"), answer.ok, answer.ok ? done(answer.result ?? {}) : answer.error);
}

byId("record").addEventListener("click", () => {
  if (on) send("stop", {}, (r) => `recorded: ${r.name}`);
  else send("start", {}, (r) => `recording into ${r.name}`);
});
