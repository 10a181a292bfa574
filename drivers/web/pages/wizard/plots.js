// Plots of results: residual vectors, a map over the picture, sigma(r).
import { colour, prepared } from "./shell.js";

const FONT = "11px system-ui, sans-serif";
const LOW = [68, 90, 170];
const HIGH = [255, 214, 60];

/** Figures for a step's plots, drawn; call again to draw anew. */
export function plotsInto(box, plots) {
  box.replaceChildren(...plots.map((plot) => {
    const figure = document.createElement("figure");
    const canvas = document.createElement("canvas");
    const caption = document.createElement("figcaption");
    canvas.setAttribute("role", "img");
    if (plot.size) canvas.style.aspectRatio = `${plot.size[0]} / ${plot.size[1]}`;
    figure.append(canvas, caption);
    const draw = () => {
      if (canvas.clientWidth) caption.textContent = DRAWN[plot.kind](canvas, plot);
      canvas.setAttribute("aria-label", caption.textContent);
    };
    new ResizeObserver(draw).observe(canvas);
    return figure;
  }));
}

function vectors(canvas, { size, vectors: rows, rms_px: rms }) {
  const [c, w, h] = prepared(canvas);
  const [k, l] = [w / size[0], h / size[1]];
  frame(c, canvas, w, h);
  const scale = Math.max(1, Math.round(12 / Math.max(rms, 0.01)));
  c.strokeStyle = colour(canvas, "path");
  c.fillStyle = colour(canvas, "robot");
  c.lineWidth = 1.2;
  for (const [u, v, du, dv] of rows) {
    c.beginPath();
    c.moveTo(u * k, v * l);
    c.lineTo((u + scale * du) * k, (v + scale * dv) * l);
    c.stroke();
    c.fillRect(u * k - 1, v * l - 1, 2, 2);
  }
  return `Reprojection errors, ${scale} times as long as they are; rms ${rms.toFixed(3)} px. They should point every way.`;
}

function map(canvas, { columns, rows, values, unit, title }) {
  const [c, w, h] = prepared(canvas);
  const known = values.filter((v) => v !== null);
  const [low, high] = [Math.min(...known), Math.max(...known)];
  values.forEach((v, n) => {
    if (v === null) return;
    const t = high > low ? (v - low) / (high - low) : 0;
    c.fillStyle = `rgb(${LOW.map((a, i) => Math.round(a + t * (HIGH[i] - a))).join(" ")})`;
    const [i, j] = [Math.floor(n / columns), n % columns];
    c.fillRect((j * w) / columns, (i * h) / rows, w / columns + 0.6, h / rows + 0.6);
  });
  c.font = FONT;
  c.textAlign = "center";
  for (const [i, j] of [[1, 1], [1, columns - 3], [rows - 2, 1], [rows - 2, columns - 3], [rows >> 1, columns >> 1]]) {
    const v = values[i * columns + j];
    if (v === null) continue;
    const text = figures(v);
    const [x, y] = [((j + 1) * w) / columns, ((i + 0.5) * h) / rows];
    c.fillStyle = "rgb(0 0 0 / 70%)";
    c.fillRect(x - 20, y - 9, 40, 16);
    c.fillStyle = "#fff";
    c.fillText(text, x, y + 3);
  }
  return `${title}: ${figures(low)} ${unit} (blue) to ${figures(high)} ${unit} (yellow)`;
}

function curves(canvas, { curves: both }) {
  const [c, w, h] = prepared(canvas);
  const all = Object.values(both);
  const rMost = Math.max(...all.flatMap((a) => a.r_m));
  const top = 1.05e3 * Math.max(...all.flatMap((a) => [...a.high_m, ...a.circle_sigma_m]));
  const [left, bottom] = [38, 30];
  const x = (r) => left + (r / rMost) * (w - left - 8);
  const y = (mm) => h - bottom - (mm / top) * (h - bottom - 8);
  axes(c, canvas, w, h, left, bottom, rMost, top);
  const styles = [["path", [], "disc"], ["robot", [6, 4], "cross"]];
  Object.entries(both).forEach(([name, a], n) => {
    const [tint, dash, sign] = styles[n % 2];
    c.fillStyle = colour(canvas, tint);
    c.globalAlpha = 0.18;
    c.beginPath();
    a.r_m.forEach((r, i) => c.lineTo(x(r), y(1e3 * a.high_m[i])));
    a.r_m.toReversed().forEach((r, i) => c.lineTo(x(r), y(1e3 * a.low_m.at(-1 - i))));
    c.fill();
    c.globalAlpha = 1;
    c.strokeStyle = colour(canvas, tint);
    c.lineWidth = 2;
    c.setLineDash(dash);
    c.beginPath();
    for (const r of a.r_m) c.lineTo(x(r), y(1e3 * a.coefficients.reduce((s, k, i) => s + k * r ** i, 0)));
    c.stroke();
    c.setLineDash([]);
    a.circle_r_m.forEach((r, i) => mark(c, sign, x(r), y(1e3 * a.circle_sigma_m[i])));
    c.font = FONT;
    c.fillText(`sigma_${name}`, left + 12, 18 + 15 * n);
    mark(c, sign, left + 5, 14 + 15 * n);
  });
  return "sigma(r) in mm with its 95 % band, and what was measured (x: discs and a line, y: crosses and dashes)";
}

function mark(c, sign, x, y) {
  c.beginPath();
  if (sign === "disc") {
    c.arc(x, y, 3, 0, 7);
    c.fill();
    return;
  }
  c.moveTo(x - 3, y - 3);
  c.lineTo(x + 3, y + 3);
  c.moveTo(x + 3, y - 3);
  c.lineTo(x - 3, y + 3);
  c.stroke();
}

function axes(c, canvas, w, h, left, bottom, rMost, top) {
  c.font = FONT;
  c.fillStyle = colour(canvas, "dim");
  c.strokeStyle = colour(canvas, "grid");
  c.lineWidth = 1;
  for (let i = 0; i <= 4; i++) {
    const y = h - bottom - (i / 4) * (h - bottom - 8);
    line(c, left, y, w - 8, y);
    c.textAlign = "right";
    c.fillText(figures((i / 4) * top), left - 4, y + 4);
    c.textAlign = "center";
    c.fillText(((i / 4) * rMost).toFixed(1), Math.min(left + (i / 4) * (w - left - 8), w - 10), h - 16);
  }
  c.fillText("r, metres from below the camera", left + (w - left) / 2, h - 3);
  c.textAlign = "left";
}

function line(c, x0, y0, x1, y1) {
  c.beginPath();
  c.moveTo(x0, y0);
  c.lineTo(x1, y1);
  c.stroke();
}

function frame(c, canvas, w, h) {
  c.fillStyle = colour(canvas, "bg");
  c.fillRect(0, 0, w, h);
  c.strokeStyle = colour(canvas, "line");
  c.strokeRect(0.5, 0.5, w - 1, h - 1);
}

function figures(value) {
  const digits = value >= 100 ? 0 : value >= 10 ? 1 : value >= 0.1 ? 2 : 3;
  return value.toFixed(digits);
}

const DRAWN = { vectors, map, curves };
