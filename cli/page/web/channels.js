// One bar for each channel: its change since the session began, and whether it can be trusted.
import { Surface, colour } from "./colours.js";

const SCALES = [0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500];
const LEFT = 48;

export class Channels {
  constructor(canvas, chosen, list, labels) {
    Object.assign(this, { canvas, chosen, list, labels });
    this.colours = { good: colour("estimate"), bad: colour("bad"), edge: colour("edge"), dim: colour("dim"), text: colour("text") };
    this.values = labels.map(() => null);
    this.bad = {};
    this.scale = 0;
    this.selected = -1;
    this.listed = "";
    this.surface = new Surface(canvas, (c, w, h) => this.draw(c, w, h));
    canvas.onpointermove = (event) => this.select(this.at(event.offsetX));
    canvas.onpointerleave = () => this.select(-1);
    canvas.onkeydown = (event) => this.key(event);
  }

  // `bad` says what is wrong with which channel, by its label.
  show(values, words) {
    const bad = Object.fromEntries(Object.entries(words).map(([label, what]) => [this.labels.indexOf(label), what]));
    Object.assign(this, { values, bad });
    const most = Math.max(...values.map((v, i) => (v === null || i in bad ? 0 : Math.abs(v))));
    const needed = SCALES.findIndex((s) => s >= most);
    const wanted = needed < 0 ? SCALES.length - 1 : needed;
    // It grows at once, and shrinks only where the bars have become small.
    if (wanted > this.scale || wanted < this.scale - 1) this.scale = wanted;
    this.surface.paint();
    this.say();
    this.name(bad);
  }

  at(x) {
    const place = Math.floor((x - LEFT) / (this.surface.width - LEFT) * this.values.length);
    return place >= 0 && place < this.values.length ? place : -1;
  }

  key(event) {
    const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (!step) return;
    event.preventDefault();
    this.select((this.selected + step + this.values.length) % this.values.length);
  }

  select(place) {
    this.selected = place;
    this.surface.paint();
    this.say();
  }

  say() {
    const i = this.selected, value = this.values[i];
    const text = i < 0 ? "change since the session began" :
      `${this.labels[i]}: ${i in this.bad ? this.bad[i] : value === null ? "unknown" : `${value > 0 ? "+" : ""}${value.toFixed(2)} %`}`;
    if (this.chosen.textContent !== text) this.chosen.textContent = text;
  }

  name(bad) {
    const kinds = new Map();
    for (const [i, what] of Object.entries(bad)) kinds.set(what, [...(kinds.get(what) || []), this.labels[i]]);
    const names = [...kinds].map(([what, labels]) => `${what}: ${labels.join(", ")}`);
    if (this.listed === names.join("|")) return;
    this.listed = names.join("|");
    this.list.replaceChildren(...names.map((text) => Object.assign(document.createElement("li"), { textContent: text })));
  }

  draw(c, width, height) {
    const most = SCALES[this.scale], middle = height / 2, room = middle - 8;
    const step = (width - LEFT) / this.values.length, thick = Math.max(2, 0.66 * step);
    c.font = "11px system-ui, sans-serif";
    c.textAlign = "right";
    c.textBaseline = "middle";
    for (const share of [1, 0, -1]) {
      c.fillStyle = this.colours.edge;
      c.fillRect(LEFT, Math.round(middle - share * room), width - LEFT, share ? 1 : 2);
      c.fillStyle = this.colours.dim;
      c.fillText(share ? `${share > 0 ? "+" : "−"}${most} %` : "0", LEFT - 5, middle - share * room);
    }
    this.values.forEach((value, i) => {
      const x = LEFT + (i + 0.5) * step - thick / 2;
      if (i === this.selected) {
        c.fillStyle = this.colours.edge;
        c.fillRect(LEFT + i * step, 0, step, height);
      }
      if (i in this.bad) {
        c.fillStyle = this.colours.bad;
        c.globalAlpha = 0.3;
        c.fillRect(x, middle - room, thick, 2 * room);
        c.globalAlpha = 1;
        c.fillRect(x, middle - 3, thick, 6);
      } else if (value !== null) {
        const reach = Math.max(-1, Math.min(1, value / most)) * room;
        c.fillStyle = this.colours.good;
        c.fillRect(x, Math.min(middle, middle - reach), thick, Math.max(1, Math.abs(reach)));
      }
    });
  }
}
