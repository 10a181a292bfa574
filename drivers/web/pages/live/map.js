// The map on a canvas: metres to pixels, what is drawn, zoom and pan, and the pose that somebody sets.
const NEAR_PX = 26; // of a finger's or a mouse's aim
const HANDLE_PX = 62; // from the new pose's middle to the handle that turns it
const ROBOT = [[15, 0], [-10, 9], [-5, 0], [-10, -9]];
const TEXT_PX = 11;

export class MapView {
  constructor(canvas, onSet) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
    this.onSet = onSet; // told of every change of the new pose
    this.centre = [0, 0];
    this.scale = 60; // px a metre
    this.follow = true;
    this.landmarks = [];
    this.path = [];
    this.particles = null;
    this.pose = null;
    this.ghost = null;
    this.pointers = new Map();
    this.fitted = false;
    this.drawing = false;
    new ResizeObserver(() => this.draw()).observe(canvas);
    canvas.addEventListener("wheel", (e) => this.wheel(e), { passive: false });
    canvas.addEventListener("pointerdown", (e) => this.down(e));
    canvas.addEventListener("pointermove", (e) => this.move(e));
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (e) => this.up(e));
  }

  get size() {
    return [this.canvas.clientWidth, this.canvas.clientHeight];
  }

  toScreen([x, y]) {
    const [w, h] = this.size;
    return [w / 2 + (x - this.centre[0]) * this.scale, h / 2 - (y - this.centre[1]) * this.scale];
  }

  toMap([u, v]) {
    const [w, h] = this.size;
    return [this.centre[0] + (u - w / 2) / this.scale, this.centre[1] - (v - h / 2) / this.scale];
  }

  setPose(pose) {
    this.pose = pose;
    const last = this.path.at(-1);
    if (!last || Math.hypot(pose.x_m - last[0], pose.y_m - last[1]) > 0.05) {
      this.path.push([pose.x_m, pose.y_m]);
      if (this.path.length > 1000) this.path.shift();
    }
    if (this.follow && !this.ghost && !this.pointers.size) this.centre = [pose.x_m, pose.y_m];
    this.draw();
  }

  setLandmarks(rows) {
    this.landmarks = rows;
    if (!this.fitted && rows.length > 10) {
      this.fit();
      this.fitted = true;
    }
    this.draw();
  }

  fit() {
    const seen = [...this.landmarks, ...this.path];
    if (this.pose) seen.push([this.pose.x_m, this.pose.y_m]);
    if (!seen.length) return;
    let [x0, y0, x1, y1] = [Infinity, Infinity, -Infinity, -Infinity];
    for (const [x, y] of seen) {
      [x0, y0, x1, y1] = [Math.min(x0, x), Math.min(y0, y), Math.max(x1, x), Math.max(y1, y)];
    }
    const [w, h] = this.size;
    this.centre = [(x0 + x1) / 2, (y0 + y1) / 2];
    this.setScale(Math.min((w - 60) / Math.max(x1 - x0, 1), (h - 60) / Math.max(y1 - y0, 1)));
  }

  setScale(scale) {
    this.scale = Math.min(Math.max(scale, 0.5), 5000);
    this.draw();
  }

  zoom(factor, at = null) {
    const [w, h] = this.size;
    const where = at ?? [w / 2, h / 2];
    const before = this.toMap(where);
    this.setScale(this.scale * factor);
    if (at === null) return;
    const after = this.toMap(where);
    this.centre = [this.centre[0] + before[0] - after[0], this.centre[1] + before[1] - after[1]];
  }

  pan(dx, dy) {
    this.centre = [this.centre[0] - dx / this.scale, this.centre[1] + dy / this.scale];
    this.draw();
  }

  // -- the pose that is set

  begin(pose) {
    const [x, y] = this.centre;
    this.ghost = pose ? { x: pose.x_m, y: pose.y_m, theta: pose.theta_rad } : { x, y, theta: 0 };
    this.canvas.classList.add("setting");
    this.changed();
  }

  end() {
    this.ghost = null;
    this.canvas.classList.remove("setting");
    this.draw();
  }

  changed() {
    this.ghost.theta = Math.atan2(Math.sin(this.ghost.theta), Math.cos(this.ghost.theta));
    this.onSet(this.ghost);
    this.draw();
  }

  handle() {
    const [u, v] = this.toScreen([this.ghost.x, this.ghost.y]);
    return [u + HANDLE_PX * Math.cos(this.ghost.theta), v - HANDLE_PX * Math.sin(this.ghost.theta)];
  }

  // -- mouse, pen and fingers

  where(event) {
    const box = this.canvas.getBoundingClientRect();
    return [event.clientX - box.left - this.canvas.clientLeft, event.clientY - box.top - this.canvas.clientTop];
  }

  wheel(event) {
    event.preventDefault();
    this.zoom(Math.exp(-0.0015 * event.deltaY), this.follow && !this.ghost ? null : this.where(event));
  }

  down(event) {
    this.canvas.setPointerCapture(event.pointerId);
    const at = this.where(event);
    let what = "pan";
    if (this.ghost && this.pointers.size === 0) {
      const middle = this.toScreen([this.ghost.x, this.ghost.y]);
      if (distance(at, this.handle()) < NEAR_PX) what = "turn";
      else if (distance(at, middle) < NEAR_PX) what = "carry";
    }
    this.pointers.set(event.pointerId, { at, what });
  }

  move(event) {
    const mine = this.pointers.get(event.pointerId);
    if (!mine) return;
    const at = this.where(event);
    const [dx, dy] = [at[0] - mine.at[0], at[1] - mine.at[1]];
    if (this.pointers.size === 2) {
      const other = [...this.pointers.values()].find((p) => p !== mine);
      this.zoom(distance(at, other.at) / Math.max(distance(mine.at, other.at), 1), other.at);
    } else if (mine.what === "carry") {
      this.ghost.x += dx / this.scale;
      this.ghost.y -= dy / this.scale;
      this.changed();
    } else if (mine.what === "turn") {
      const [u, v] = this.toScreen([this.ghost.x, this.ghost.y]);
      this.ghost.theta = Math.atan2(v - at[1], at[0] - u);
      this.changed();
    } else {
      if (Math.hypot(dx, dy) > 0) this.onPan?.();
      this.pan(dx, dy);
    }
    mine.at = at;
  }

  up(event) {
    this.pointers.delete(event.pointerId);
    this.draw();
  }

  // -- drawing, at most once a frame of the screen

  draw() {
    if (this.drawing) return;
    this.drawing = true;
    requestAnimationFrame(() => {
      this.drawing = false;
      this.paint();
    });
  }

  paint() {
    const { context: c } = this;
    const style = getComputedStyle(this.canvas);
    const colour = (name) => style.getPropertyValue(`--${name}`).trim();
    fitToScreen(this.canvas, c);
    const [w, h] = this.size;
    c.clearRect(0, 0, w, h);
    this.paintGrid(c, w, h, colour);
    c.fillStyle = colour("landmark");
    for (const [x, y, kind] of this.landmarks) {
      const [u, v] = this.toScreen([x, y]);
      if (u < -4 || v < -4 || u > w + 4 || v > h + 4) continue;
      if (kind >= 10) {
        c.beginPath();
        c.arc(u, v, 3, 0, 2 * Math.PI);
        c.fill();
      } else c.fillRect(u - 2, v - 2, 4, 4);
    }
    this.paintPath(c, colour("path"));
    this.paintParticles(c, colour("particle"));
    if (this.pose) this.paintRobot(c, colour("robot"));
    if (this.ghost) this.paintGhost(c, colour("ghost"), colour("card"));
  }

  paintGrid(c, w, h, colour) {
    const step = [0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200].find((s) => s * this.scale >= 56) ?? 500;
    const [x0, y1] = this.toMap([0, 0]);
    const [x1, y0] = this.toMap([w, h]);
    const digits = step < 0.1 ? 2 : step < 1 ? 1 : 0;
    c.strokeStyle = colour("grid");
    c.fillStyle = colour("dim");
    c.lineWidth = 1;
    c.font = `${TEXT_PX}px system-ui, sans-serif`;
    c.beginPath();
    for (let x = Math.ceil(x0 / step) * step; x <= x1; x += step) {
      const [u] = this.toScreen([x, 0]);
      c.moveTo(u, 0);
      c.lineTo(u, h);
      if (u > 50 && u < w - 40) c.fillText(`${plain(x, digits)}`, u + 3, h - 4);
    }
    for (let y = Math.ceil(y0 / step) * step; y <= y1; y += step) {
      const [, v] = this.toScreen([0, y]);
      c.moveTo(0, v);
      c.lineTo(w, v);
      if (v > 34 && v < h - 22) c.fillText(`${plain(y, digits)}`, 4, v - 3);
    }
    c.stroke();
    c.fillText("y m", 4, TEXT_PX + 2);
    c.fillText("x m", w - 24, h - 4);
  }

  paintPath(c, colour) {
    c.strokeStyle = colour;
    c.lineWidth = 2;
    c.beginPath();
    let before = null;
    for (const at of this.path) {
      const [u, v] = this.toScreen(at);
      if (before && distance(before, at) < 1) c.lineTo(u, v);
      else c.moveTo(u, v); // it was carried, or found elsewhere
      before = at;
    }
    c.stroke();
  }

  paintParticles(c, colour) {
    if (!this.particles) return;
    c.fillStyle = colour;
    const { x_m: xs, y_m: ys } = this.particles;
    for (let i = 0; i < xs.length; i++) {
      const [u, v] = this.toScreen([xs[i], ys[i]]);
      c.beginPath();
      c.arc(u, v, 2, 0, 2 * Math.PI);
      c.fill();
    }
  }

  paintRobot(c, colour) {
    const p = this.pose;
    const [u, v] = this.toScreen([p.x_m, p.y_m]);
    c.strokeStyle = c.fillStyle = colour;
    const [xx, xy, , , yy] = p.cov;
    if ([xx, xy, yy].every(Number.isFinite)) {
      const mean = (xx + yy) / 2;
      const off = Math.hypot((xx - yy) / 2, xy);
      const radii = [mean + off, mean - off].map((r) => 2 * Math.sqrt(Math.max(r, 0)) * this.scale);
      c.lineWidth = 2;
      c.beginPath();
      c.ellipse(u, v, radii[0], radii[1], -0.5 * Math.atan2(2 * xy, xx - yy), 0, 2 * Math.PI);
      c.stroke();
    }
    arrow(c, u, v, p.theta_rad);
    c.fill();
  }

  paintGhost(c, colour, inside) {
    const [u, v] = this.toScreen([this.ghost.x, this.ghost.y]);
    const [hu, hv] = this.handle();
    c.strokeStyle = colour;
    c.lineWidth = 2;
    c.setLineDash([5, 4]);
    arrow(c, u, v, this.ghost.theta, 1.4);
    c.stroke();
    c.beginPath();
    c.moveTo(u, v);
    c.lineTo(hu, hv);
    c.stroke();
    c.setLineDash([]);
    c.fillStyle = inside;
    c.beginPath();
    c.arc(hu, hv, 9, 0, 2 * Math.PI);
    c.fill();
    c.stroke();
  }
}

export function fitToScreen(canvas, context) {
  const ratio = window.devicePixelRatio || 1;
  const [w, h] = [Math.round(canvas.clientWidth * ratio), Math.round(canvas.clientHeight * ratio)];
  if (canvas.width !== w || canvas.height !== h) [canvas.width, canvas.height] = [w, h];
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
}

function arrow(c, u, v, theta, size = 1) {
  c.beginPath();
  for (const [x, y] of ROBOT) {
    c.lineTo(u + size * (x * Math.cos(theta) - y * Math.sin(theta)), v - size * (x * Math.sin(theta) + y * Math.cos(theta)));
  }
  c.closePath();
}

function distance(a, b) {
  return Math.hypot(a[0] - b[0], a[1] - b[1]);
}

function plain(value, digits) {
  const text = value.toFixed(digits);
  return Number(text) === 0 ? (0).toFixed(digits) : text;
}
