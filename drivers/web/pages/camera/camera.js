// Exposure and gain, and what they do to the picture.
import { colour, follow, link, post, prepared, say, shell } from "./shell.js";

const byId = (id) => document.getElementById(id);
const EDGE_PX = 0.5; // narrower there is no edge, only noise or white
const SOFT_PX = 5.5;
const BLURRED_PX = 7;
const SETTLE_MS = 120; // from the slider's last move to the camera

let state = null;
let told = null; // the latest of the camera
let image = null;
let readOnly = false;
let pending = 0;
let held = false; // the engineer chose something; the camera's own values do not move the sliders

shell(draw);

follow("/wizard", {
  handlers: {
    hello(d) {
      byId("robot").textContent = d.robot;
      document.title = `${d.robot}: camera`;
      readOnly = d.read_only;
      byId("read-only").hidden = !readOnly;
      byId("leave").hidden = !d.signed_in;
      link(true, "connected");
    },
    state(d) {
      state = d;
      byId("practice").checked = d.practice || byId("practice").checked;
      byId("practice").disabled = d.simulate || readOnly;
      if (!told) byId("source").textContent = d.practice ? "simulated camera" : d.camera;
      if (d.busy) say(byId("reply"), null, "the camera is busy with commissioning");
      buttons();
    },
    tuning(d) {
      const was = told?.on;
      told = d;
      if (d.error) say(byId("reply"), false, d.error);
      else if (d.note) say(byId("reply"), true, d.note);
      else if (d.on && !was) say(byId("reply"), null, "");
      if (d.on) show(d);
      buttons();
      draw();
    },
    lost(d) {
      told = null;
      say(byId("reply"), false, d.text);
      buttons();
    },
  },
  picture: async (blob) => {
    const next = await createImageBitmap(blob);
    image?.close();
    image = next;
    byId("picture").style.aspectRatio = `${image.width} / ${image.height}`;
    draw();
  },
});

async function command(name, fields) {
  const answer = await post(`/wizard/${name}`, fields);
  if (!answer.ok) say(byId("reply"), false, answer.error);
}

function buttons() {
  const on = Boolean(told?.on);
  byId("on").hidden = on;
  byId("off").hidden = !on;
  byId("on").disabled = readOnly || Boolean(state?.busy);
  for (const id of ["exposure-auto", "gain-auto"]) byId(id).disabled = !on || readOnly;
  for (const id of ["exposure", "exposure-us"]) byId(id).disabled = !on || readOnly || byId("exposure-auto").checked;
  for (const id of ["gain", "gain-value"]) byId(id).disabled = !on || readOnly || byId("gain-auto").checked;
  byId("save").disabled = readOnly || !on || !state?.target;
  byId("save").title = state && !state.target ? "No configuration file is known: start ceilvod web with --config FILE" : "";
}

function show(d) {
  byId("source").textContent = d.name;
  const { exposure_us: exposureRange, gain: gainRange } = d.ranges;
  if (exposureRange) {
    byId("exposure").min = Math.log10(Math.max(10, exposureRange[0]));
    byId("exposure").max = Math.log10(exposureRange[1]);
  }
  if (gainRange) [byId("gain").min, byId("gain").max] = gainRange;
  if (!held) {
    byId("exposure-auto").checked = d.values.exposure_us === null;
    byId("gain-auto").checked = d.values.gain === null;
    if (d.values.exposure_us !== null) setExposure(d.values.exposure_us);
    else if (!byId("exposure-us").value) setExposure(10000);
    if (d.values.gain !== null) setGain(d.values.gain);
    else if (!byId("gain-value").value) setGain(gainRange ? gainRange[0] : 0);
  }
  const edge = d.edge_px > EDGE_PX ? d.edge_px : null;
  const words = edge === null ? "none" : edge < SOFT_PX ? "sharp" : edge < BLURRED_PX ? "soft" : "blurred";
  meter("sharp", edge ?? 12, edge === null ? "no edges" : `${edge.toFixed(1)} px, ${words}`);
  meter("white", 100 * d.white_share, `${(100 * d.white_share).toFixed(1)} % of it`);
  meter("mean", d.mean, `${d.mean.toFixed(0)} of 255`);
  const flicker = byId("flicker");
  const seen = d.advice.length > 0;
  flicker.textContent = d.enough ? `flicker: ${d.flicker}` : "flicker: looking, 3 s";
  flicker.dataset.verdict = !d.enough ? "" : seen ? "open" : "PASS";
  byId("use-advice").hidden = !(d.enough && seen) || readOnly;
  byId("use-advice").textContent = seen ? `Expose for ${nearest(d.advice)} us` : "";
}

const nearest = (all) => all.reduce((a, b) => (Math.abs(b - exposure()) < Math.abs(a - exposure()) ? b : a));

function meter(id, value, text) {
  byId(id).value = value;
  byId(`${id}-text`).textContent = text;
}

function hint() {
  const d = told;
  if (!d?.on) return ["", "the camera is off"];
  if (d.light) return ["no", d.light];
  if (!(d.edge_px > EDGE_PX) || d.edge_px > BLURRED_PX) return ["no", "blurred: turn the lens until edges are narrowest"];
  if (d.white_share > 0.05) return ["do", "much is white: shorten the exposure"];
  if (d.mean < 40) return ["do", "rather dark: lengthen the exposure, then raise the gain"];
  if (d.enough && d.advice.length) return ["do", `lamps flicker: expose for ${d.advice.join(" or ")} us`];
  if (d.values.exposure_us === null) return ["do", "fix the exposure before you calibrate"];
  return ["yes", "good"];
}

function draw() {
  const [kind, text] = hint();
  byId("hint").textContent = text;
  byId("hint").dataset.kind = kind;
  const [c, w, h] = prepared(byId("picture"));
  if (image && told?.on) {
    c.drawImage(image, 0, 0, w, h);
    hatch(c, w, h);
  }
  if (told?.histogram) histogram();
}

function hatch(c, w, h) {
  const [rows, columns] = [told.white.length, told.white[0].length];
  c.lineWidth = 1.5;
  told.white.forEach((row, i) => row.forEach((share, j) => {
    if (share < 0.1) return;
    const [x, y, dx, dy] = [(j * w) / columns, (i * h) / rows, w / columns, h / rows];
    c.strokeStyle = share > 0.5 ? "#d55e00" : "#0072b2";
    c.save();
    c.beginPath();
    c.rect(x, y, dx, dy);
    c.clip();
    c.beginPath();
    for (let s = -dy; s < dx; s += 6) {
      c.moveTo(x + s, y);
      c.lineTo(x + s + dy, y + dy);
    }
    c.stroke();
    c.restore();
  }));
}

function histogram() {
  const canvas = byId("histogram");
  const [c, w, h] = prepared(canvas);
  const bins = told.histogram;
  const most = Math.max(...bins.slice(1, -1), 1);
  const wide = w / bins.length;
  bins.forEach((n, i) => {
    const tall = Math.min(1, n / most) * (h - 14);
    c.fillStyle = i === bins.length - 1 ? colour(canvas, "bad") : colour(canvas, "path");
    c.fillRect(i * wide, h - 12 - tall, Math.max(1, wide - 1), tall);
  });
  c.font = "11px system-ui, sans-serif";
  c.fillStyle = colour(canvas, "dim");
  c.fillText("0 black", 0, h - 1);
  c.textAlign = "right";
  c.fillText("255 white", w, h - 1);
  c.textAlign = "left";
}

// -- what the engineer chooses

const exposure = () => Number(byId("exposure-us").value);
const values = () => ({
  exposure_us: byId("exposure-auto").checked ? null : exposure(),
  gain: byId("gain-auto").checked ? null : Number(byId("gain-value").value),
});

function setExposure(us) {
  byId("exposure").value = Math.log10(us);
  byId("exposure-us").value = Math.round(us);
}

function setGain(value) {
  byId("gain").value = value;
  byId("gain-value").value = value;
}

function changed() {
  held = true;
  buttons();
  clearTimeout(pending);
  pending = setTimeout(() => command("tune", { ...values(), practice: byId("practice").checked }), SETTLE_MS);
}

byId("on").addEventListener("click", () => {
  held = false;
  command("tune", { practice: byId("practice").checked });
});
byId("off").addEventListener("click", () => command("stop", {}));
byId("exposure").addEventListener("input", () => {
  byId("exposure-us").value = Math.round(10 ** Number(byId("exposure").value));
  changed();
});
byId("exposure-us").addEventListener("change", () => {
  if (!byId("exposure-us").reportValidity()) return;
  setExposure(exposure());
  changed();
});
byId("gain").addEventListener("input", () => {
  byId("gain-value").value = byId("gain").value;
  changed();
});
byId("gain-value").addEventListener("change", () => {
  if (!byId("gain-value").reportValidity()) return;
  setGain(Number(byId("gain-value").value));
  changed();
});
for (const id of ["exposure-auto", "gain-auto"]) byId(id).addEventListener("change", changed);
byId("use-advice").addEventListener("click", () => {
  byId("exposure-auto").checked = false;
  setExposure(nearest(told.advice));
  changed();
});
byId("save").addEventListener("click", () => command("save_camera", values()));
