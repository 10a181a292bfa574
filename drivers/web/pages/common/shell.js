// What all pages share: theme, sign-out, one websocket in, commands out.
const byId = (id) => document.getElementById(id);
const LONGEST_WAIT_MS = 5000;
const THEMES = ["auto", "light", "dark"];

/** The header's buttons; `redraw` is called when colours change. */
export function shell(redraw) {
  const apply = (name) => {
    if (name === "auto") delete document.documentElement.dataset.theme;
    else document.documentElement.dataset.theme = name;
    byId("theme").textContent = `Theme: ${name}`;
    redraw();
  };
  let chosen = localStorage.getItem("theme") ?? "auto";
  if (!THEMES.includes(chosen)) chosen = "auto";
  byId("theme").addEventListener("click", () => {
    chosen = THEMES[(THEMES.indexOf(chosen) + 1) % THEMES.length];
    localStorage.setItem("theme", chosen);
    apply(chosen);
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
  byId("leave").addEventListener("click", async () => {
    await fetch("/logout", { method: "POST" });
    location.replace("/login");
  });
  apply(chosen);
}

export function link(ok, text) {
  byId("link").textContent = text;
  byId("link").dataset.ok = String(ok);
}

async function signedOut() {
  try {
    return (await fetch("/", { method: "GET", redirect: "manual" })).type === "opaqueredirect";
  } catch {
    return false;
  }
}

/** A websocket that comes back; `handlers` by topic, `picture` gets blobs. Returns what says something to the server. */
export function follow(path, { handlers, picture = () => {}, opened = () => {}, closed = () => {} }) {
  let socket = null;
  let waitMs = 500;
  const connect = () => {
    socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}${path}`);
    socket.binaryType = "blob";
    let was = false;
    socket.onopen = () => {
      was = true;
      waitMs = 500;
      opened();
    };
    socket.onmessage = (event) => {
      if (typeof event.data !== "string") {
        picture(event.data);
        return;
      }
      const { topic, data } = JSON.parse(event.data);
      handlers[topic]?.(data);
    };
    socket.onclose = async () => {
      link(false, "no connection");
      closed();
      if (!was && (await signedOut())) {
        location.replace("/login");
        return;
      }
      setTimeout(connect, waitMs);
      waitMs = Math.min(2 * waitMs, LONGEST_WAIT_MS);
    };
  };
  connect();
  return (message) => {
    if (socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify(message));
  };
}

/** The answer to a command: {ok, error, result}. */
export async function post(path, fields) {
  try {
    const answer = await fetch(path, {
      method: "POST",
      headers: { "Content-Type": "application/json" },
      body: JSON.stringify(fields),
    });
    const text = await answer.text();
    const json = answer.headers.get("Content-Type")?.startsWith("application/json");
    return json ? JSON.parse(text) : { ok: false, error: text || `refused: ${answer.status}` };
  } catch {
    return { ok: false, error: "the pages' server does not answer" };
  }
}

/** A line that says whether something went well. */
export function say(line, ok, text) {
  if (ok === null) line.removeAttribute("data-ok");
  else line.dataset.ok = String(ok);
  line.textContent = text;
}

/** Rows of name and value; nodes are kept, so that a reader's place and selection stay. */
export function list(dl, rows) {
  while (dl.children.length > rows.length) dl.lastChild.remove();
  rows.forEach(([name, value], i) => {
    let row = dl.children[i];
    if (!row) {
      row = document.createElement("div");
      row.append(document.createElement("dt"), document.createElement("dd"));
      dl.append(row);
    }
    if (row.firstChild.textContent !== name) row.firstChild.textContent = name;
    if (row.lastChild.textContent !== value) row.lastChild.textContent = value;
  });
}

/** The canvas in the screen's own pixels; its context and size in CSS pixels. */
export function prepared(canvas) {
  const ratio = window.devicePixelRatio || 1;
  const [w, h] = [canvas.clientWidth, canvas.clientHeight];
  if (canvas.width !== Math.round(w * ratio) || canvas.height !== Math.round(h * ratio)) {
    canvas.width = Math.round(w * ratio);
    canvas.height = Math.round(h * ratio);
  }
  const context = canvas.getContext("2d");
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, w, h);
  return [context, w, h];
}

export function colour(element, name) {
  return getComputedStyle(element).getPropertyValue(`--${name}`).trim();
}
