// The live page: one websocket in, three commands out.
import { NisChart, showEvents, showHealth, showPose, showStates } from "./figures.js";
import { MapView } from "./map.js";
import { showRecordings } from "./recordings.js";
import { follow as followRobot, link, post, say, shell } from "./shell.js";

const byId = (id) => document.getElementById(id);
const FINE_M = 0.01;
const COARSE_M = 0.1;
const TURN_RAD = Math.PI / 180;

const map = new MapView(byId("map"), showNewPose);
const nis = new NisChart(byId("nis"));
window.ceilvo = { map }; // for whoever looks at it from the browser's console
let pose = null;
let pictureOnScreen = false;
let pictureUrl = "";
let readOnly = false;

// -- what comes in

const handlers = {
  hello(d) {
    byId("robot").textContent = d.robot;
    document.title = `${d.robot}: ceilvo`;
    readOnly = d.read_only;
    byId("read-only").hidden = !readOnly;
    for (const id of ["set-pose", "relocalise", "save-map", "record"]) byId(id).disabled = readOnly;
    byId("leave").hidden = !d.signed_in;
  },
  link(d) {
    const ok = d.alive && !d.silent;
    link(ok, ok ? "running" : d.alive ? "daemon sends no poses" : "daemon not running");
    document.querySelector("main").classList.toggle("stale", !ok);
    byId("state").classList.toggle("old", !ok);
  },
  path(d) {
    map.path = d.xy_m;
  },
  pose(d) {
    if (pose && pose.map_id !== d.map_id) map.path = [];
    pose = d;
    showPose(d);
    nis.add(d);
    if (d.map_id) addFloor(d.map_id);
    if (Number.isFinite(d.x_m) && Number.isFinite(d.y_m) && Number.isFinite(d.theta_rad)) map.setPose(d);
  },
  health(d) {
    showHealth(d.counters, pose);
    nis.setBounds(d.counters.filter?.nis_low, d.counters.filter?.nis_high);
  },
  landmarks(d) {
    map.setLandmarks(d.rows);
  },
  particles(d) {
    map.particles = d;
    map.draw();
  },
  recordings: (d) => showRecordings(d, readOnly),
  states: showStates,
  events: showEvents,
};

const tell = followRobot("/live", {
  handlers,
  picture: showPicture,
  opened: want,
  closed: () => byId("state").classList.add("old"),
});

/** What costs the daemon work is asked for only while somebody looks at it. */
function want() {
  const topics = document.hidden ? [] : ["landmarks", "particles"];
  if (!document.hidden && pictureOnScreen && byId("show-picture").checked) topics.push("image");
  tell({ want: topics });
}

function showPicture(blob) {
  if (!byId("show-picture").checked) return;
  const image = byId("picture");
  const old = pictureUrl;
  pictureUrl = URL.createObjectURL(blob);
  image.src = pictureUrl;
  image.hidden = false;
  byId("no-picture").hidden = true;
  if (old) URL.revokeObjectURL(old);
}

byId("show-picture").addEventListener("change", () => {
  if (!byId("show-picture").checked) {
    byId("picture").hidden = true;
    byId("no-picture").hidden = false;
    byId("no-picture").textContent = "not shown";
  } else byId("no-picture").textContent = "no picture yet";
  want();
});
document.addEventListener("visibilitychange", want);
new IntersectionObserver(([seen]) => {
  pictureOnScreen = seen.isIntersecting;
  want();
}).observe(document.querySelector(".frame"));

// -- commands

async function command(name, fields, done) {
  say(byId("reply"), null, "sent");
  const said = await post(`/cmd/${name}`, fields);
  say(byId("reply"), Boolean(said.ok), said.ok ? done(said.result ?? {}) : said.error);
  return Boolean(said.ok);
}

byId("save-map").addEventListener("click", () =>
  command("save_map", {}, (r) => `map saved: ${r.landmarks} landmarks in ${r.folder}`));
byId("relocalise").addEventListener("click", () => byId("ask").showModal());
byId("ask").addEventListener("close", () => {
  if (byId("ask").returnValue === "yes") command("relocalise", {}, () => "looking for its place");
  byId("ask").returnValue = "";
});

// -- the pose that somebody sets

function addFloor(name) {
  const floors = byId("floors");
  if ([...floors.children].some((o) => o.value === name)) return;
  const option = document.createElement("option");
  option.value = name;
  floors.append(option);
}

function showNewPose({ x, y, theta }) {
  byId("set-x").value = x.toFixed(3);
  byId("set-y").value = y.toFixed(3);
  byId("set-theta").value = ((theta * 180) / Math.PI).toFixed(1);
}

function beginPose() {
  if (readOnly) return;
  byId("pose-form").hidden = false;
  byId("set-pose").setAttribute("aria-pressed", "true");
  byId("set-floor").value = pose?.map_id ?? "";
  map.begin(pose && Number.isFinite(pose.x_m) ? pose : null);
  map.canvas.focus({ preventScroll: true });
}

function endPose() {
  byId("pose-form").hidden = true;
  byId("set-pose").setAttribute("aria-pressed", "false");
  map.end();
}

async function sendPose() {
  if (!byId("pose-form").reportValidity()) return;
  const fields = {
    x_m: Number(byId("set-x").value),
    y_m: Number(byId("set-y").value),
    theta_rad: (Number(byId("set-theta").value) * Math.PI) / 180,
    sigma_m: Number(byId("set-sigma").value),
    sigma_theta_rad: Math.min((Number(byId("set-sigma-theta").value) * Math.PI) / 180, 3.14159),
  };
  const floor = byId("set-floor").value.trim();
  if (floor) fields.map_id = floor;
  const told = () => `pose sent: x ${fields.x_m.toFixed(3)} m, y ${fields.y_m.toFixed(3)} m`;
  if (await command("initial_pose", fields, told)) endPose();
}

byId("set-pose").addEventListener("click", () => (map.ghost ? endPose() : beginPose()));
byId("cancel-pose").addEventListener("click", endPose);
byId("pose-form").addEventListener("submit", (event) => {
  event.preventDefault();
  sendPose();
});
for (const id of ["set-x", "set-y", "set-theta"]) {
  byId(id).addEventListener("input", () => {
    const [x, y, deg] = ["set-x", "set-y", "set-theta"].map((name) => byId(name).valueAsNumber);
    if (!map.ghost || ![x, y, deg].every(Number.isFinite)) return;
    map.ghost = { x, y, theta: (deg * Math.PI) / 180 };
    map.draw();
  });
}

// -- the map's buttons and keys

function follow(on) {
  map.follow = on;
  byId("follow").setAttribute("aria-pressed", String(on));
  if (on && pose) map.setPose(pose);
}

map.onPan = () => follow(false);
byId("zoom-in").addEventListener("click", () => map.zoom(1.4));
byId("zoom-out").addEventListener("click", () => map.zoom(1 / 1.4));
byId("fit").addEventListener("click", fitAll);
byId("follow").addEventListener("click", () => follow(!map.follow));

function fitAll() {
  follow(false);
  map.fit();
}

const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
const KEYS = {
  "+": () => map.zoom(1.4), "=": () => map.zoom(1.4), "-": () => map.zoom(1 / 1.4),
  0: fitAll, f: () => follow(!map.follow), p: () => (map.ghost ? endPose() : beginPose()),
};
const POSE_KEYS = { "[": 1, "]": -1 };

byId("map").addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.altKey || event.metaKey) return;
  const { key, shiftKey } = event;
  if (map.ghost && (key in ARROWS || key in POSE_KEYS)) {
    const step = shiftKey ? FINE_M : COARSE_M;
    const [dx, dy] = ARROWS[key] ?? [0, 0];
    map.ghost.x += step * dx;
    map.ghost.y += step * dy;
    map.ghost.theta += (POSE_KEYS[key] ?? 0) * TURN_RAD;
    map.changed();
  } else if (map.ghost && key === "Enter") sendPose();
  else if (map.ghost && key === "Escape") endPose();
  else if (key in ARROWS) {
    follow(false);
    map.pan(-40 * ARROWS[key][0], 40 * ARROWS[key][1]);
  } else if (key in KEYS) KEYS[key]();
  else return;
  event.preventDefault();
});

shell(() => {
  map.draw();
  nis.paint();
});
