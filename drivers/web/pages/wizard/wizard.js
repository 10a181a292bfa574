// Commissioning, step by step: what the wizard's process says is shown, what the engineer wants is sent to it.
import { MarksDialog } from "./marks.js";
import { plotsInto } from "./plots.js";
import { follow, link, list, post, say, shell } from "./shell.js";
import { items, View } from "./view.js";

const byId = (id) => document.getElementById(id);
const PART_NAMES = { "mount-spin": "turn on the spot", "mount-run": "straight run" };
const BAD_RMS = 2; // times the median

const view = new View(byId("picture"));
const marks = new MarksDialog(byId("marks"), (uv) => command("clicks", { uv }), () => command("stop"));
let state = null;
let shown = ""; // the step that is looked at
let chosen = false; // by a person, not because it is next
let readOnly = false;
const plots = {};
const views = {};
let drawnPlots = null;

shell(() => {
  view.draw();
  drawnPlots = null;
  if (state) showResult();
});

follow("/wizard", {
  handlers: {
    hello(d) {
      byId("robot").textContent = d.robot;
      document.title = `${d.robot}: commission`;
      readOnly = d.read_only;
      byId("read-only").hidden = !readOnly;
      byId("leave").hidden = !d.signed_in;
      link(true, "connected");
    },
    state(d) {
      const worked = state?.busy && !d.busy;
      state = d;
      if (worked) {
        view.computing = "";
        view.ended = true;
      }
      if (d.busy) {
        if (shown !== d.busy.step) showStep(d.busy.step);
        if (!worked) view.clear();
        if (d.busy.computing) view.computing = "starting";
      } else if (!shown || (worked && !d.error && !chosen)) showStep(shown || next());
      if (!d.busy) marks.close();
      show();
    },
    source(d) {
      byId("source").textContent = [d.name, ...(d.notes ?? [])].join("; ");
    },
    look(d) {
      view.take(d);
    },
    computing(d) {
      view.computing = d.text;
      view.draw();
    },
    views(d) {
      views[d.part] = d.rows;
      if (d.corners.length || state?.busy) view.corners = d.corners;
      if (state) showViews();
    },
    result(d) {
      plots[d.step] = d.plots;
      drawnPlots = null;
      if (state) showResult();
    },
    click(d) {
      marks.begin(d.names);
    },
    clicked(d) {
      marks.close();
      if (d.off_px) say(byId("reply"), true, `practice: off by ${d.off_px.map((v) => v.toFixed(1)).join(", ")} px`);
    },
    lost(d) {
      state = state && { ...state, busy: null, error: d.text };
      if (state) show();
    },
  },
  picture: async (blob) => {
    const head = new Uint8Array(await blob.slice(0, 1).arrayBuffer())[0];
    if (head === 0x89) marks.picture(blob);
    else view.show(blob);
  },
});

async function command(name, fields = {}) {
  const answer = await post(`/wizard/${name}`, fields);
  if (!answer.ok) say(byId("reply"), false, answer.error);
  return answer.ok;
}

const step = () => state.steps.find((s) => s.step === shown);
const next = () => (state.steps.find((s) => !s.optional && (!s.done || s.verdict !== "PASS" || s.outdated)) ?? state.steps.at(-1)).step;

function showStep(name) {
  if (shown === name) return;
  shown = name;
  chosen = false;
  fill();
}

function choose(name) {
  if (state.busy) return;
  showStep(name);
  view.clear();
  show();
  byId("step-title").focus({ preventScroll: true });
}

// -- how things stand

function show() {
  showSteps();
  const now = step();
  const busy = state.busy;
  const taken = Object.values(now.counts).reduce((a, b) => a + b, 0);
  byId("step-title").textContent = `${now.title}${now.optional ? " (if you like)" : ""}`;
  byId("todo").textContent = now.todo;
  byId("go").textContent = now.done ? "Take more" : taken ? "Go on" : "Start";
  byId("go").hidden = Boolean(busy) || (now.done && !now.parts.length);
  document.querySelector("main").classList.toggle("busy", Boolean(busy));
  const good = now.done && now.verdict === "PASS" && !now.outdated && !now.changed;
  const following = state.steps[state.steps.indexOf(now) + 1];
  byId("go").classList.toggle("main", !good && !now.changed);
  byId("next").hidden = Boolean(busy) || !good || !following;
  byId("next").textContent = following ? `Next: ${following.title}` : "";
  byId("enough").hidden = byId("stop").hidden = !busy;
  byId("compute").hidden = Boolean(busy) || !taken;
  byId("compute").classList.toggle("main", now.changed);
  byId("anew").hidden = Boolean(busy) || !(taken || now.done);
  byId("undo").disabled = readOnly || (!busy && !state.undo);
  byId("undo").title = busy ? "Take the latest view out" : state.undo ? `Take back: ${state.undo}` : "Nothing to take back";
  for (const id of ["go", "enough", "stop", "compute", "anew"]) byId(id).disabled = readOnly;
  for (const field of byId("answers").elements) field.disabled = readOnly || Boolean(busy);
  if (state.error) say(byId("reply"), false, state.error);
  else if (state.note) say(byId("reply"), true, state.note);
  else if (busy) say(byId("reply"), null, busy.computing ? "computing" : "taking pictures");
  else say(byId("reply"), null, now.changed ? "views have changed since: compute again" : "");
  byId("practice").checked = state.practice;
  byId("practice").disabled = state.simulate || readOnly || Boolean(busy);
  byId("practice-label").title = state.simulate ? "the simulated robot: there is no other camera" : "";
  byId("where").textContent = `${state.practice ? "simulated camera" : state.camera}; all is kept in ${state.folder}`;
  if (!busy && !view.image) byId("source").textContent = "";
  showViews();
  showResult();
  showFile();
  view.draw();
}

function showSteps() {
  const buttons = byId("steps");
  if (buttons.children.length !== state.steps.length) {
    buttons.replaceChildren(...state.steps.map((s) => {
      const li = document.createElement("li");
      const button = document.createElement("button");
      button.type = "button";
      button.id = `step-${s.step}`;
      button.addEventListener("click", () => {
        choose(s.step);
        chosen = true;
      });
      li.append(button);
      return li;
    }));
  }
  state.steps.forEach((s, i) => {
    const button = buttons.children[i].firstChild;
    const busy = state.busy?.step === s.step;
    button.textContent = s.title;
    button.dataset.done = busy ? "busy" : !s.done ? "" : s.outdated ? "old" : s.verdict;
    button.setAttribute("aria-current", s.step === shown ? "step" : "false");
    button.setAttribute("aria-pressed", String(s.step === shown));
    button.disabled = Boolean(state.busy) && !busy;
  });
}

/** The step's questions with the answers given before. */
function fill() {
  byId("answers").replaceChildren(...step().fields.map((f) => {
    const label = document.createElement("label");
    const input = document.createElement(f.kind === "choice" ? "select" : f.kind === "text" ? "textarea" : "input");
    input.id = `answer-${f.word}`;
    input.dataset.word = f.word;
    if (f.kind === "choice") input.append(...f.choices.map((c) => new Option(c, c)));
    if (f.kind === "number") input.inputMode = "decimal";
    if (f.kind === "check") {
      input.type = "checkbox";
      input.checked = Boolean(f.value);
      label.className = "check";
      label.append(input, f.label);
      return label;
    }
    if (f.kind === "text") label.className = "wide";
    input.value = f.value;
    label.append(f.label, f.unit ? ` [${f.unit}]` : "", input);
    if (f.why) {
      const why = document.createElement("small");
      why.textContent = f.why;
      label.append(why);
    }
    return label;
  }));
}

function answers() {
  const out = {};
  for (const field of byId("answers").elements) {
    if (field.dataset.word) out[field.dataset.word] = field.type === "checkbox" ? field.checked : field.value;
  }
  return out;
}

function showViews() {
  const rows = step().parts.flatMap((part) => (views[part] ?? []).map((row) => [part, ...row]));
  const rms = rows.map((r) => r[3]).filter((v) => v !== null).sort((a, b) => a - b);
  const limit = rms.length ? BAD_RMS * rms[rms.length >> 1] : Infinity;
  byId("views-count").textContent = rows.length ? `${rows.length}, latest first` : "none yet";
  byId("views").replaceChildren(...rows.toReversed().map(([part, index, name, value]) => {
    const li = document.createElement("li");
    const text = document.createElement("span");
    const residual = document.createElement("span");
    const out = document.createElement("button");
    text.textContent = PART_NAMES[part] ? `${PART_NAMES[part]}: ${name}` : name;
    residual.className = "rms";
    residual.textContent = value === null ? "" : `${value.toFixed(3)} px`;
    li.dataset.bad = String(value !== null && value > limit);
    out.type = "button";
    out.textContent = "Delete";
    out.setAttribute("aria-label", `Delete ${name}`);
    out.disabled = readOnly || Boolean(state.busy?.computing);
    out.addEventListener("click", () => command("drop", { part, index }));
    li.append(text, residual, out);
    return li;
  }));
}

function showResult() {
  const now = step();
  byId("verdict").textContent = now.words || "not done yet";
  byId("verdict").dataset.verdict = now.verdict;
  byId("outdated").hidden = !now.outdated;
  byId("outdated").textContent = "An earlier step was done since: do this one again.";
  list(byId("rows"), now.rows);
  if (drawnPlots !== plots[shown]) {
    drawnPlots = plots[shown] ?? null;
    plotsInto(byId("plots"), drawnPlots ?? []);
  }
}

function showFile() {
  const file = state.file;
  byId("scale").textContent = file ? file.error ?? file.scale_words : "";
  byId("scale").dataset.verdict = !file ? "" : { confirmed: "PASS", contradicted: "FAIL" }[file.scale] ?? "open";
  byId("file").textContent = file ? `${file.path} is written` : "put together as soon as lens and ceiling are there";
  items(byId("to-do"), file?.to_do ?? []);
  byId("get-file").hidden = !file;
  byId("get-report").hidden = byId("get-printed").hidden = !state.note.includes("report.html");
  byId("report").disabled = readOnly || Boolean(state.busy) || !state.steps.some((s) => s.done);
  const real = state.simulate || !state.practice;
  byId("apply").disabled = readOnly || Boolean(state.busy) || !file || Boolean(file.error) || !state.target || !real;
  byId("target").textContent = !state.target
    ? "No configuration file is known: start ceilvod web with --config FILE."
    : real ? `It would become ${state.target}${state.target_there ? "; the one that is there is kept" : ""}.`
      : "Practice is not put into a robot's configuration.";
}

// -- what the engineer wants

function ask(question, yes) {
  byId("question").textContent = question;
  byId("yes").textContent = yes;
  byId("ask").returnValue = "";
  byId("ask").showModal();
  return new Promise((done) => {
    byId("ask").addEventListener("close", () => done(byId("ask").returnValue === "yes"), { once: true });
  });
}

const start = (mode) => command("start", { step: shown, mode, answers: answers() });

byId("answers").addEventListener("submit", (event) => {
  event.preventDefault();
  if (!state?.busy) start("go");
});
byId("next").addEventListener("click", () => choose(state.steps[state.steps.indexOf(step()) + 1].step));
byId("enough").addEventListener("click", () => command("enough"));
byId("stop").addEventListener("click", () => command("stop"));
byId("compute").addEventListener("click", () => start("compute"));
byId("anew").addEventListener("click", async () => {
  if (await ask("Start this step over? Its views are put aside; Undo brings them back.", "Start over")) start("anew");
});
byId("undo").addEventListener("click", () => command("undo"));
byId("practice").addEventListener("change", () => {
  for (const known of [plots, views]) for (const name of Object.keys(known)) delete known[name];
  view.clear();
  command("practice", { on: byId("practice").checked });
});
byId("report").addEventListener("click", () => command("report"));
byId("apply").addEventListener("click", async () => {
  const to = `${state.target}${state.target_there ? " (the one that is there is kept as .bak)" : ""}`;
  const open = state.file.scale === "confirmed" ? "" : ` ${state.file.scale_words}.`;
  if (await ask(`Write this calibration to ${to}?${open}`, "Write")) command("apply");
});
