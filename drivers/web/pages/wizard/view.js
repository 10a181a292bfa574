// The camera's picture with what is covered, what was found, and what to do next.
import { prepared } from "./shell.js";

const byId = (id) => document.getElementById(id);
const EDGE_PX = 0.5; // narrower there is no edge, only noise or white
const EDGES_FINE_PX = 5.5;
const EDGES_SOFT_PX = 7;

export class View {
  constructor(canvas) {
    this.canvas = canvas;
    this.image = null;
    this.look = null;
    this.corners = [];
    this.computing = "";
    this.ended = false;
    new ResizeObserver(() => this.draw()).observe(canvas);
  }

  async show(blob) {
    const image = await createImageBitmap(blob);
    this.image?.close();
    this.image = image;
    this.canvas.style.aspectRatio = `${image.width} / ${image.height}`;
    this.draw();
  }

  clear() {
    this.look = null;
    this.corners = [];
    this.computing = "";
    this.image?.close();
    this.image = null;
    byId("missing").replaceChildren();
    byId("progress").textContent = "";
    for (const id of ["sharp", "motion", "covered"]) meter(id, 0, "–");
    this.draw();
  }

  take(look) {
    this.look = look;
    this.computing = "";
    this.ended = false;
    const { edge_px: width, motion_px: motion, area } = look;
    const edge = width > EDGE_PX ? width : null;
    const words = edge === null ? "none" : edge < EDGES_FINE_PX ? "sharp" : edge < EDGES_SOFT_PX ? "soft" : "blurred";
    meter("sharp", edge ?? 12, edge === null ? "no edges" : `${edge.toFixed(1)} px, ${words}`);
    const still = motion < 2 ? "still" : motion < 8 ? "moving" : "too fast";
    if (motion === null) meter("motion", 0, "single pictures");
    else meter("motion", motion, `${motion.toFixed(1)} px, ${still}`);
    for (const e of document.querySelectorAll("#covered, #covered-text, [for=covered]")) e.hidden = area === undefined;
    if (area !== undefined) meter("covered", 100 * area, `${(100 * area).toFixed(0)} % of 70 %`);
    byId("progress").textContent = `${look.count} taken, ${look.rejected} not; ${look.text ?? look.name}`;
    items(byId("missing"), look.missing ?? []);
    this.draw();
  }

  /** What is said above the picture: why this one does not count, or what to do next. */
  get hint() {
    if (this.computing) return ["do", `computing: ${this.computing}`];
    const look = this.look;
    if (!look) return ["", "no picture yet"];
    if (this.ended) return ["", "the last picture of this step"];
    if (look.light) return ["no", look.light];
    if (look.reason && !/^(as one|board not seen)/.test(look.reason)) return ["no", look.reason];
    if (look.hint) return ["do", look.hint];
    return ["yes", "enough; more makes it better"];
  }

  draw() {
    const [c, w, h] = prepared(this.canvas);
    const [kind, text] = this.hint;
    const hint = byId("hint");
    if (hint.textContent !== text) hint.textContent = text;
    hint.dataset.kind = kind;
    if (this.image) c.drawImage(this.image, 0, 0, w, h);
    if (!this.look) return;
    const [k, l] = [w / this.look.size[0], h / this.look.size[1]];
    if (this.look.cells) this.cover(c, w, h);
    c.fillStyle = "#56b4e9";
    for (const view of this.corners) for (const [u, v] of view) c.fillRect(u * k - 1, v * l - 1, 2, 2);
    c.strokeStyle = this.look.taken ? "#2fd3a3" : "#ff8a3c";
    c.lineWidth = 1.5;
    for (const [u, v] of this.look.uv) {
      c.beginPath();
      if (this.look.taken) c.arc(u * k, v * l, 3.5, 0, 7);
      else {
        c.moveTo(u * k - 3, v * l - 3);
        c.lineTo(u * k + 3, v * l + 3);
        c.moveTo(u * k + 3, v * l - 3);
        c.lineTo(u * k - 3, v * l + 3);
      }
      c.stroke();
    }
  }

  /** Parts without a corner are hatched; the first empty ninth is framed: hold the board there. */
  cover(c, w, h) {
    const { cells, lit, empty } = this.look;
    const [rows, columns] = [cells.length, cells[0].length];
    c.strokeStyle = "rgb(255 200 60 / 75%)";
    c.lineWidth = 1;
    cells.forEach((row, i) => row.forEach((n, j) => {
      if (n || !lit[i][j]) return;
      const [x, y, dx, dy] = [(j * w) / columns, (i * h) / rows, w / columns, h / rows];
      c.save();
      c.beginPath();
      c.rect(x, y, dx, dy);
      c.clip();
      c.beginPath();
      for (let s = -dy; s < dx; s += 9) {
        c.moveTo(x + s, y + dy);
        c.lineTo(x + s + dy, y);
      }
      c.stroke();
      c.restore();
    }));
    if (!empty.length) return;
    const [i, j] = empty[0];
    c.lineWidth = 4;
    c.setLineDash([10, 6]);
    c.strokeStyle = "#fff";
    c.strokeRect((j * w) / 3 + 4, (i * h) / 3 + 4, w / 3 - 8, h / 3 - 8);
    c.setLineDash([]);
    c.font = "bold 15px system-ui, sans-serif";
    c.textAlign = "center";
    const [x, y] = [((j + 0.5) * w) / 3, ((i + 0.5) * h) / 3];
    c.fillStyle = "rgb(0 0 0 / 65%)";
    c.fillRect(x - 58, y - 14, 116, 24);
    c.fillStyle = "#fff";
    c.fillText("the board here", x, y + 4);
  }
}

function meter(id, value, text) {
  byId(id).value = value;
  byId(`${id}-text`).textContent = text;
}

export function items(ul, texts) {
  ul.replaceChildren(...texts.map((text) => {
    const li = document.createElement("li");
    li.textContent = text;
    return li;
  }));
}

