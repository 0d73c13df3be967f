// The bend angle over the last seconds: what is estimated, how surely, and what is true.
import { Surface, colour } from "./colours.js";

const SECONDS = 30;
const GAP = 1; // over which nothing is drawn [s]
const PAUSE = 0.09; // between two pictures [s]
const LEFT = 34, TOP = 6, BOTTOM = 6;

export class Trace {
  constructor(canvas) {
    this.points = [];
    this.painted = -PAUSE;
    this.surface = new Surface(canvas, (c, w, h) => this.draw(c, w, h));
    this.colours = { estimate: colour("estimate"), truth: colour("truth"), edge: colour("edge"), dim: colour("dim") };
  }

  add(point) {
    this.points.push(point);
    const oldest = point.time - SECONDS;
    let old = 0;
    while (this.points[old].time < oldest) old++;
    if (old > 100) this.points.splice(0, old);
    // So long an axis moves by less than a pixel from one frame to the next.
    if (point.time - this.painted < PAUSE) return;
    this.painted = point.time;
    this.surface.paint();
  }

  // A new session has nothing to do with the old one's angles.
  clear() {
    this.points = [];
  }

  range() {
    let least = -5, most = 5;
    for (const { angle, truth } of this.points) {
      for (const value of [angle, truth]) {
        if (value === null) continue;
        least = Math.min(least, value);
        most = Math.max(most, value);
      }
    }
    const room = 0.08 * (most - least);
    return [least - room, most + room];
  }

  draw(c, width, height) {
    if (!this.points.length) return;
    const now = this.points[this.points.length - 1].time;
    const [least, most] = this.range();
    const x = (time) => LEFT + (width - LEFT - 2) * (1 - (now - time) / SECONDS);
    const y = (angle) => TOP + (height - TOP - BOTTOM) * (most - angle) / (most - least);
    this.grid(c, width, least, most, y);
    c.save();
    c.beginPath();
    c.rect(LEFT, 0, width - LEFT, height);
    c.clip();
    this.band(c, x, y);
    c.setLineDash([5, 4]);
    this.line(c, "truth", x, y, 1.5);
    c.setLineDash([]);
    this.line(c, "angle", x, y, 2);
    c.restore();
  }

  grid(c, width, least, most, y) {
    const step = [5, 10, 20, 30, 60].find((s) => (most - least) / s <= 5) || 90;
    c.font = "11px system-ui, sans-serif";
    c.textAlign = "right";
    c.textBaseline = "middle";
    for (let angle = Math.ceil(least / step) * step; angle <= most; angle += step) {
      c.fillStyle = this.colours.edge;
      c.fillRect(LEFT, Math.round(y(angle)), width - LEFT, angle === 0 ? 2 : 1);
      c.fillStyle = this.colours.dim;
      c.fillText(`${angle < 0 ? "−" : ""}${Math.abs(angle)}°`, LEFT - 6, y(angle));
    }
  }

  // Points that follow each other closely and all know `name`.
  *runs(name) {
    let run = [], last = -Infinity;
    for (const point of this.points) {
      if (run.length && (point[name] === null || point.time - last > GAP)) {
        yield run;
        run = [];
      }
      if (point[name] !== null) run.push(point);
      last = point.time;
    }
    if (run.length) yield run;
  }

  // Twice the standard error, either way.
  band(c, x, y) {
    c.fillStyle = this.colours.estimate;
    c.globalAlpha = 0.2;
    for (const run of this.runs("deviation")) {
      c.beginPath();
      for (const p of run) c.lineTo(x(p.time), y(p.angle + 2 * p.deviation));
      for (const p of run.reverse()) c.lineTo(x(p.time), y(p.angle - 2 * p.deviation));
      c.fill();
    }
    c.globalAlpha = 1;
  }

  line(c, name, x, y, width) {
    c.beginPath();
    for (const run of this.runs(name)) {
      c.moveTo(x(run[0].time), y(run[0][name]));
      for (const p of run) c.lineTo(x(p.time), y(p[name]));
    }
    c.strokeStyle = name === "truth" ? this.colours.truth : this.colours.estimate;
    c.lineWidth = width;
    c.lineJoin = "round";
    c.stroke();
  }
}
