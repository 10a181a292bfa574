// Figures as text, bars and one chart. What others wrote is only ever set as text.
import { fitToScreen } from "./map.js";
import { list as listInto } from "./shell.js";

const byId = (id) => document.getElementById(id);
const NIS_SECONDS = 120;
const NIS_PERIOD_MS = 400;
const DASH = "–";

export function number(value, digits = 2, unit = "") {
  if (typeof value !== "number" || !Number.isFinite(value)) return DASH;
  const text = value.toFixed(digits);
  const plain = Number(text) === 0 ? text.replace("-", "") : text;
  return unit ? `${plain} ${unit}` : plain;
}

const count = (value) => (Number.isFinite(value) ? String(value) : DASH);
const degrees = (rad) => (Number.isFinite(rad) ? (rad * 180) / Math.PI : NaN);
const millimetres = (m) => (Number.isFinite(m) ? 1000 * m : NaN);

function time(unixNs) {
  return new Date(Number(unixNs) / 1e6).toLocaleTimeString([], { hour12: false });
}

const list = (id, rows) => listInto(byId(id), rows);

function log(id, rows) {
  byId(id).replaceChildren(
    ...rows.map(({ at, attribute, value, text }) => {
      const row = document.createElement("li");
      const stamp = document.createElement("time");
      const words = document.createElement("span");
      stamp.textContent = time(at);
      words.dataset[attribute] = value;
      words.textContent = text;
      row.append(stamp, words);
      return row;
    }),
  );
}

export function showPose(p) {
  const badge = byId("state");
  if (badge.dataset.state !== p.state) {
    badge.dataset.state = p.state;
    badge.textContent = p.state.replaceAll("_", " ");
  }
  byId("reason").textContent = p.reason || "";
  byId("quality").value = p.quality ?? 0;
  byId("quality-text").textContent = number(p.quality);
  list("pose", [
    ["x", `${number(p.x_m, 3)} ± ${number(p.sigma_x_m, 3)} m`],
    ["y", `${number(p.y_m, 3)} ± ${number(p.sigma_y_m, 3)} m`],
    ["heading", `${number(degrees(p.theta_rad))} ± ${number(degrees(p.sigma_theta_rad))}°`],
    ["age when sent", number(p.age_ms, 0, "ms")],
  ]);
  byId("floor").textContent = p.map_id ? `${p.map_id}${p.map_version == null ? "" : `, version ${p.map_version}`}` : "";
}

export function showStates(states) {
  log("states", states.toReversed().map((s) => ({
    at: s.stamp_unix_ns, attribute: "state", value: s.state, text: `${s.state.replaceAll("_", " ")}: ${s.reason}`,
  })));
}

export function showEvents(events) {
  log("events", events.toReversed().map((e) => ({
    at: e.stamp_unix_ns, attribute: "severity", value: e.severity, text: e.text,
  })));
}

export function showHealth(counters, pose) {
  const f = counters.filter ?? {};
  const share = f.particles ? ` of ${f.particles} (${number((100 * f.ess) / f.particles, 0)} %)` : "";
  list("figures", [
    ["frame rate used", number(counters.used_rate_hz ?? counters.fps, 1, "Hz")],
    ["camera gives", number(counters.camera_rate_hz, 1, "Hz")],
    ["frames", count(counters.frames)],
    ["dropped", count(counters.drops)],
    ["left out", count(counters.skipped_frames)],
    ["ESS", `${number(f.ess, 0)}${share}`],
    ["at another place", number(100 * counters.elsewhere, 2, "%")],
    ["outliers refused", count(f.outliers)],
    ["landmarks", count(pose?.landmarks)],
    ["crossings seen", count(pose?.crossings)],
    ["inliers", count(pose?.inliers)],
    ["camera", counters.camera_connected === false ? `lost: ${counters.camera_error}` : "connected"],
  ]);
  byId("stale").hidden = !counters.calibration_stale;
  byId("stale").textContent = counters.calibration_stale_reason ?? "";
  showBase(counters);
  showLatency(counters.latency_ms ?? {});
}

function showBase(c) {
  const state = byId("base-state");
  if (!("base_up" in c)) {
    state.textContent = "no base configured";
    delete state.dataset.ok;
    list("base", []);
    return;
  }
  state.textContent = c.base_up ? "answers" : "does not answer";
  state.dataset.ok = String(Boolean(c.base_up));
  list("base", [
    ["last answer", Number.isFinite(c.base_link_age_s) ? `${number(1000 * c.base_link_age_s, 0)} ms ago` : "never"],
    ["telegrams sent", count(c.telegrams_sent)],
    ["failed", count(c.telegrams_failed)],
    ["reopened", count(c.base_reconnects)],
  ]);
  byId("base-error").textContent = c.base_error ? `last error: ${c.base_error}` : "";
}

function showLatency(stages) {
  const body = byId("latency");
  const rows = Object.entries(stages);
  const most = Math.max(1, ...rows.map(([, s]) => s.p99 ?? 0));
  while (body.rows.length > rows.length) body.deleteRow(-1);
  rows.forEach(([stage, { median, p99 }], i) => {
    let row = body.rows[i];
    if (!row) {
      row = body.insertRow();
      for (let k = 0; k < 4; k++) row.insertCell();
      const range = document.createElement("div");
      range.className = "range";
      range.append(document.createElement("i"));
      row.cells[1].append(range);
    }
    row.cells[0].textContent = stage.replaceAll("_", " ");
    const bar = row.cells[1].firstChild.firstChild;
    bar.style.left = `${(100 * median) / most}%`;
    bar.style.width = `${(100 * Math.max(p99 - median, 0)) / most}%`;
    row.cells[2].textContent = number(median, 1);
    row.cells[3].textContent = number(p99, 1);
  });
}

/** NIS of the last minutes against the bounds that chance keeps. */
export class NisChart {
  constructor(canvas) {
    this.canvas = canvas;
    this.points = [];
    this.bounds = [NaN, NaN];
    this.lastMs = -Infinity;
    new ResizeObserver(() => this.paint()).observe(canvas);
  }

  add(pose) {
    const now = performance.now();
    if (now - this.lastMs < NIS_PERIOD_MS || !pose.nis_dof || !Number.isFinite(pose.nis)) return;
    this.lastMs = now;
    this.points.push([now, pose.nis]);
    while (this.points[0][0] < now - 1000 * NIS_SECONDS) this.points.shift();
    this.paint();
  }

  setBounds(low, high) {
    if (!Number.isFinite(low) || !Number.isFinite(high)) return;
    this.bounds = [low, high];
    this.paint();
  }

  paint() {
    const c = this.canvas.getContext("2d");
    const style = getComputedStyle(this.canvas);
    const colour = (name) => style.getPropertyValue(`--${name}`).trim();
    fitToScreen(this.canvas, c);
    const [w, h] = [this.canvas.clientWidth, this.canvas.clientHeight];
    const [low, high] = this.bounds;
    const top = Math.min(Math.max(2, 1.2 * (high || 0), ...this.points.map(([, nis]) => 1.1 * nis)), 20);
    const left = 26;
    const x = (ms) => w - 6 - ((performance.now() - ms) / (1000 * NIS_SECONDS)) * (w - left - 6);
    const y = (nis) => h - 6 - (Math.min(nis, top) / top) * (h - 14);
    c.clearRect(0, 0, w, h);
    if (Number.isFinite(high)) {
      c.fillStyle = colour("band");
      c.fillRect(left, y(high), w - left, y(low) - y(high));
    }
    c.font = "11px system-ui, sans-serif";
    c.strokeStyle = colour("line");
    c.lineWidth = 1;
    for (const level of [0, top <= 4 ? 1 : Math.round(top / 2)]) {
      c.fillStyle = colour("dim");
      c.fillText(String(level), 2, y(level) + 4);
      c.beginPath();
      c.moveTo(left, y(level));
      c.lineTo(w, y(level));
      c.stroke();
    }
    for (const [ms, nis] of this.points) {
      const [u, v] = [x(ms), y(nis)];
      if (nis > high) {
        c.strokeStyle = colour("bad");
        c.lineWidth = 2;
        c.beginPath();
        c.moveTo(u - 3, v - 3);
        c.lineTo(u + 3, v + 3);
        c.moveTo(u + 3, v - 3);
        c.lineTo(u - 3, v + 3);
        c.stroke();
      } else {
        c.fillStyle = colour("path");
        c.fillRect(u - 1.5, v - 1.5, 3, 3);
      }
    }
    const last = this.points.at(-1);
    if (!last) return;
    const chance = Number.isFinite(high) ? `; by chance ${number(low)} to ${number(high)} (band)` : "";
    document.getElementById("nis-text").textContent = `now ${number(last[1])}${chance}; crosses are above`;
  }
}
