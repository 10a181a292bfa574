// Clicking marks in a picture: with mouse, finger or keys, as near as zoom allows.
import { colour, prepared } from "./shell.js";

const byId = (id) => document.getElementById(id);
const STILL_PX = 5; // of a pointer that clicks and does not drag
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

export class MarksDialog {
  constructor(dialog, send, stop) {
    this.dialog = dialog;
    this.canvas = byId("marks-canvas");
    this.send = send;
    this.names = [];
    this.uv = [];
    this.image = null;
    this.zoom = 1;
    this.at = [0, 0]; // pixel in the middle
    this.down = null;
    new ResizeObserver(() => this.draw()).observe(this.canvas);
    byId("marks-in").addEventListener("click", () => this.zoomBy(1.5));
    byId("marks-out").addEventListener("click", () => this.zoomBy(1 / 1.5));
    byId("marks-undo").addEventListener("click", () => this.undo());
    byId("marks-send").addEventListener("click", () => this.done());
    byId("marks-stop").addEventListener("click", stop);
    dialog.addEventListener("cancel", (e) => e.preventDefault());
    this.canvas.addEventListener("keydown", (e) => this.key(e));
    this.canvas.addEventListener("wheel", (e) => {
      e.preventDefault();
      this.zoomBy(e.deltaY < 0 ? 1.25 : 0.8, this.place(e));
    }, { passive: false });
    this.canvas.addEventListener("pointerdown", (e) => {
      this.canvas.setPointerCapture(e.pointerId);
      this.down = { from: this.place(e), at: [...this.at], moved: false };
    });
    this.canvas.addEventListener("pointermove", (e) => this.move(e));
    this.canvas.addEventListener("pointerup", (e) => {
      if (this.down && !this.down.moved) this.set(this.pixel(this.place(e)));
      this.down = null;
    });
  }

  begin(names) {
    if (this.dialog.open && String(names) === String(this.names)) return;
    this.names = names;
    this.uv = [];
    if (!this.dialog.open) this.dialog.showModal();
    this.canvas.focus();
    this.draw();
  }

  close() {
    if (this.dialog.open) this.dialog.close();
  }

  async picture(blob) {
    this.image = await createImageBitmap(blob);
    this.at = [this.image.width / 2, this.image.height / 2];
    this.zoom = Math.min(this.canvas.clientWidth / this.image.width, this.canvas.clientHeight / this.image.height);
    this.draw();
  }

  place(event) {
    const box = this.canvas.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  }

  /** Pixels of the picture count from the middle of the first one. */
  pixel([x, y]) {
    const [w, h] = [this.canvas.clientWidth, this.canvas.clientHeight];
    return [this.at[0] + (x - w / 2) / this.zoom - 0.5, this.at[1] + (y - h / 2) / this.zoom - 0.5];
  }

  screen([u, v]) {
    const [w, h] = [this.canvas.clientWidth, this.canvas.clientHeight];
    return [w / 2 + (u + 0.5 - this.at[0]) * this.zoom, h / 2 + (v + 0.5 - this.at[1]) * this.zoom];
  }

  move(event) {
    if (!this.down) return;
    const [x, y] = this.place(event);
    const [dx, dy] = [x - this.down.from[0], y - this.down.from[1]];
    if (!this.down.moved && Math.hypot(dx, dy) < STILL_PX) return;
    this.down.moved = true;
    this.at = [this.down.at[0] - dx / this.zoom, this.down.at[1] - dy / this.zoom];
    this.draw();
  }

  zoomBy(factor, about = null) {
    const centre = about ?? [this.canvas.clientWidth / 2, this.canvas.clientHeight / 2];
    const [u, v] = this.pixel(centre);
    this.zoom = Math.min(40, Math.max(0.1, this.zoom * factor));
    const [u2, v2] = this.pixel(centre);
    this.at = [this.at[0] + u - u2, this.at[1] + v - v2];
    this.draw();
  }

  set(uv) {
    if (this.uv.length < this.names.length) this.uv.push(uv);
    this.draw();
  }

  undo() {
    this.uv.pop();
    this.draw();
  }

  done() {
    if (this.uv.length === this.names.length) this.send(this.uv);
  }

  key(event) {
    const { key } = event;
    if (key in ARROWS) {
      const step = (event.shiftKey ? 1 : 12) / this.zoom;
      this.at = [this.at[0] + step * ARROWS[key][0], this.at[1] + step * ARROWS[key][1]];
      this.draw();
    } else if (key === " ") this.set([this.at[0] - 0.5, this.at[1] - 0.5]);
    else if (key === "+" || key === "=") this.zoomBy(1.25);
    else if (key === "-") this.zoomBy(0.8);
    else if (key === "u" || key === "U") this.undo();
    else if (key === "Enter") this.done();
    else return;
    event.preventDefault();
  }

  draw() {
    const all = this.uv.length === this.names.length;
    byId("marks-send").disabled = !all;
    byId("marks-ask").textContent = all
      ? "All are set: look once more, then send"
      : `Click ${this.names[this.uv.length]} (${this.uv.length + 1} of ${this.names.length})`;
    if (!this.canvas.clientWidth) return;
    const [c, w, h] = prepared(this.canvas);
    c.imageSmoothingEnabled = this.zoom < 4;
    if (this.image) {
      const [x, y] = this.screen([-0.5, -0.5]);
      c.drawImage(this.image, x, y, this.image.width * this.zoom, this.image.height * this.zoom);
    }
    c.strokeStyle = "rgb(255 255 255 / 60%)";
    cross(c, w / 2, h / 2, 14);
    c.strokeStyle = c.fillStyle = colour(this.canvas, "robot");
    c.lineWidth = 2;
    c.font = "bold 14px system-ui, sans-serif";
    this.uv.forEach((uv, i) => {
      const [x, y] = this.screen(uv);
      cross(c, x, y, 9);
      c.fillText(String(i + 1), x + 7, y - 7);
    });
  }
}

function cross(c, x, y, size) {
  c.beginPath();
  c.moveTo(x - size, y);
  c.lineTo(x + size, y);
  c.moveTo(x, y - size);
  c.lineTo(x, y + size);
  c.stroke();
}
