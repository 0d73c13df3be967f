// The last ten minutes, or a recording: angle, force and channels over time, with events. Any
// moment of it can be shown again.
import { Surface, colour, diverging } from "./colours.js";

const SECONDS = 600;
const LEAST = 30; // of an axis [s]
const PACE = 0.2; // between two moments that are remembered, and two pictures [s]
const GAP = 1; // over which nothing is drawn, unless a board is slower [s]
const SCALES = [0.5, 1, 2, 3, 5, 10, 20, 50, 100, 200, 500]; // of channels [%]
const LEFT = 44, EVENTS = 20, PART = 4; // pixels: labels, row of events, between parts
const NEAR = 9; // of a click to an event, pixels
const SPEED = 5; // pictures a second of a recording that plays

// What has happened between two readings, in words, each with its kind.
export function happened(before, now) {
  const happenings = [], say = (kind, text) => happenings.push({ kind, text });
  if (!before) return happenings;
  const state = (data) => (data.estimate ? data.estimate.state : null), force = (data) => total(data.estimate);
  if (now.session !== before.session) say("bad", "board restarted: new session");
  else if (state(now) !== state(before) && state(now)) {
    say(state(now), state(now) === "touch" && force(now) ? `touch, ${force(now).toFixed(1)} N` : state(now));
  }
  if (now.problem && !before.problem) say("bad", now.problem);
  const lost = Object.keys(now.bad).filter((label) => !(label in before.bad));
  if (lost.length) say("bad", `channel ${lost.join(", ")}: ${now.bad[lost[0]]}`);
  const back = Object.keys(before.bad).filter((label) => !(label in now.bad));
  if (back.length) say("good", `channel ${back.join(", ")} is good again`);
  const zero = (data) => data.estimate && data.estimate.zero;
  if (zero(now) && zero(before) && zero(now) !== zero(before)) say("good", `reference: ${zero(now)}`);
  return happenings;
}

// Force of all touches [N]; null where a force is unknown.
export function total(estimate) {
  const touches = (estimate && estimate.touches) || [];
  return touches.some(({ force }) => force === null) ? null : touches.reduce((sum, { force }) => sum + force, 0);
}

export class Timeline {
  // `shown(data)` is called with the moment to show; null for the newest.
  constructor(canvas, { labels, period }, shown) {
    Object.assign(this, { canvas, labels, shown, gap: Math.max(GAP, 4 * (period || 0)) });
    this.live = { moments: [], events: [] };
    this.chosen = null; // time of the moment that is shown; null for the newest
    this.hover = null;
    this.scale = 0;
    this.painted = -PACE;
    this.strip = document.createElement("canvas");
    this.surface = new Surface(canvas, (c, w, h) => this.draw(c, w, h));
    this.source = this.live;
    canvas.onpointerdown = (event) => this.down(event);
    canvas.onpointermove = (event) => this.move(event);
    canvas.onpointerleave = () => this.over(null);
    canvas.onkeydown = (event) => this.key(event);
  }

  add(time, data) {
    const { moments, events } = this.live, last = moments[moments.length - 1];
    const news = happened(last && last.data, data);
    for (const each of news) events.push({ time, ...each });
    if (!last || news.length || time - last.time >= PACE) moments.push({ time, data });
    while (moments[0].time < time - SECONDS) moments.shift();
    while (events.length && events[0].time < moments[0].time) events.shift();
    if (this.source !== this.live || time - this.painted < PACE) return;
    this.painted = time;
    this.surface.paint();
  }

  // Take over moments of before, oldest first.
  recall(moments) {
    this.painted = Infinity; // once, by the next one
    for (const { time, data } of moments) this.add(time, data);
    this.painted = -PACE;
  }

  note(time, kind, text) {
    this.live.events.push({ time, kind, text });
  }

  // Show a recording's moments, or what is live again.
  load(readings) {
    this.source = this.live;
    if (readings) {
      const moments = readings.map((data) => ({ time: data.time, data })), events = [];
      moments.forEach(({ time, data }, i) => events.push(...happened(i ? moments[i - 1].data : null, data).map((each) => ({ time, ...each }))));
      this.source = { moments, events };
    }
    this.choose(readings ? this.source.moments[0].time : null);
  }

  // Show the moment at a time, or the newest; nothing plays on.
  choose(time) {
    clearInterval(this.playing);
    this.playing = null;
    this.go(time);
  }

  go(time) {
    this.chosen = time;
    this.surface.paint();
    this.shown(time === null ? null : this.at(time).data);
  }

  // Play on from the moment that is shown, from the beginning where that is the last one.
  play() {
    const { moments } = this.source, end = moments[moments.length - 1].time;
    let time = this.chosen === null || this.chosen >= end ? moments[0].time : this.chosen;
    this.playing = setInterval(() => {
      time = Math.min(end, time + 1 / SPEED);
      if (time < end) this.go(time);
      else this.choose(end);
    }, 1000 / SPEED);
  }

  at(time) {
    const { moments } = this.source;
    let low = 0, high = moments.length - 1;
    while (low < high) {
      const middle = (low + high + 1) >> 1;
      if (moments[middle].time <= time) low = middle;
      else high = middle - 1;
    }
    return moments[low];
  }

  span() {
    const { moments } = this.source;
    if (!moments.length) return [0, LEAST];
    const start = moments[0].time, end = moments[moments.length - 1].time;
    return this.source === this.live ? [Math.min(start, end - LEAST), end] : [start, Math.max(start + 1, end)];
  }

  time(px) {
    const [start, end] = this.span();
    return start + (end - start) * Math.min(1, Math.max(0, (px - LEFT) / (this.surface.width - LEFT)));
  }

  x(time) {
    const [start, end] = this.span();
    return LEFT + (this.surface.width - LEFT) * (time - start) / (end - start);
  }

  down(event) {
    if (!this.source.moments.length) return;
    this.canvas.setPointerCapture(event.pointerId);
    const close = this.source.events.filter((each) => Math.abs(this.x(each.time) - event.offsetX) < NEAR);
    this.choose(event.offsetY < EVENTS && close.length ? close[close.length - 1].time : this.time(event.offsetX));
  }

  move(event) {
    if (event.buttons && this.chosen !== null) this.choose(this.time(event.offsetX));
    this.over([event.offsetX, event.offsetY]);
  }

  key(event) {
    const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key], [start, end] = this.span();
    if (step) this.choose(Math.min(end, Math.max(start, (this.chosen === null ? end : this.chosen) + step)));
    else if (event.key === "End") this.choose(null);
    else return;
    event.preventDefault();
  }

  over(place) {
    this.hover = place;
    this.surface.paint();
  }

  // In words: the event or the channel that is pointed at, else the newest event.
  words() {
    const { moments, events } = this.source;
    if (!moments.length) return "";
    if (this.hover) {
      const [px, py] = this.hover, row = Math.floor((py - this.top) / this.high * this.labels.length);
      const close = events.filter((each) => Math.abs(this.x(each.time) - px) < NEAR);
      if (py < EVENTS && close.length) return this.ago(close[close.length - 1]);
      if (row >= 0 && row < this.labels.length) {
        const { data } = this.at(this.time(px)), label = this.labels[row], value = data.channels[row];
        return `${label}: ${data.bad[label] || (value === null ? "unknown" : `${value > 0 ? "+" : ""}${value.toFixed(2)} %`)}`;
      }
    }
    const last = events.filter((each) => this.chosen === null || each.time <= this.chosen + PACE).pop();
    return last ? this.ago(last) : "";
  }

  // The chosen moment in words.
  when() {
    const [, end] = this.span();
    return this.source === this.live ? `${(end - this.chosen).toFixed(1)} s ago` : `${this.chosen.toFixed(1)} s`;
  }

  ago({ time, text }) {
    const [, end] = this.span();
    return this.source === this.live ? `${text} (${Math.round(end - time)} s ago)` : `${text} (at ${time.toFixed(1)} s)`;
  }

  draw(c, width, height) {
    const { moments, events } = this.source;
    if (!moments.length) return;
    const names = ["estimate", "truth", "edge", "dim", "text", "touch", "bend", "idle", "good", "bad"];
    this.colours = Object.fromEntries(names.map((name) => [name, colour(name)]));
    const rest = height - EVENTS - 16;
    this.high = 0.46 * rest;
    this.top = EVENTS + rest - this.high;
    const angle = [EVENTS, 0.36 * rest], force = [EVENTS + 0.38 * rest, 0.14 * rest];
    c.font = "11px system-ui, sans-serif";
    c.textBaseline = "middle";
    this.drawStrip(c, width);
    const values = moments.flatMap(({ data: { estimate, stage } }) => [estimate && estimate.angle, stage && stage.truth && stage.truth.bend_deg]).filter((v) => v !== null);
    const low = Math.min(-5, ...values), high = Math.max(5, ...values);
    const y = (value) => angle[0] + PART + (angle[1] - 2 * PART) * (high - value) / (high - low);
    this.rule(c, y(0), "0°");
    if (y(0) - y(high) > 14) this.rule(c, y(high), `${high.toFixed(0)}°`);
    if (y(low) - y(0) > 14) this.rule(c, y(low), `−${Math.abs(low).toFixed(0)}°`);
    this.band(c, y);
    c.setLineDash([5, 4]);
    this.line(c, ({ stage }) => (stage && stage.truth ? stage.truth.bend_deg : null), y, this.colours.truth, 1.5);
    c.setLineDash([]);
    this.line(c, ({ estimate }) => (estimate ? estimate.angle : null), y, this.colours.estimate, 2);
    const most = Math.max(10, ...moments.map(({ data }) => total(data.estimate) || 0));
    this.rule(c, force[0] + force[1], `${most.toFixed(0)} N`, force[0] + force[1] / 2);
    this.line(c, ({ estimate }) => (estimate ? total(estimate) : null), (v) => force[0] + force[1] * (1 - v / most), this.colours.touch, 1.5);
    for (const { time, kind } of events) {
      c.fillStyle = this.colours[kind] || this.colours.text;
      c.beginPath();
      c.arc(this.x(time), EVENTS / 2, 4, 0, 2 * Math.PI);
      c.fill();
    }
    this.drawTimes(c, width, height);
    if (this.chosen !== null) {
      c.fillStyle = this.colours.text;
      c.fillRect(Math.round(this.x(this.chosen)) - 1, 0, 2, height - 14);
    }
  }

  rule(c, y, label, at = y) {
    c.fillStyle = this.colours.edge;
    c.fillRect(LEFT, Math.round(y), this.surface.width - LEFT, 1);
    c.fillStyle = this.colours.dim;
    c.textAlign = "right";
    c.fillText(label, LEFT - 6, at);
  }

  drawTimes(c, width, height) {
    const [start, end] = this.span(), length = end - start;
    const step = [1, 5, 10, 30, 60, 120, 300, 600].find((s) => length / s <= Math.max(3, width / 110)) || 1200;
    c.fillStyle = this.colours.dim;
    const live = this.source === this.live;
    for (let seconds = 0; seconds <= length; seconds += step) {
      const x = this.x(live ? end - seconds : start + seconds), rest = seconds % 60;
      const text = seconds < 60 ? `${seconds} s` : rest ? `${Math.floor(seconds / 60)}:${`${rest}`.padStart(2, "0")}` : `${seconds / 60} min`;
      c.textAlign = x > width - 24 ? "right" : x < LEFT + 14 ? "left" : "center";
      c.fillText(live && seconds ? `−${text}` : live ? "now" : text, x, height - 6);
    }
  }

  // One row for each channel; a column of pixels for each moment.
  drawStrip(c, width) {
    const rows = this.labels.length, columns = Math.max(1, Math.round((width - LEFT) / 2));
    const good = (data) => data.channels.map((v, i) => (v === null || this.labels[i] in data.bad ? 0 : Math.abs(v)));
    const seen = Array.from({ length: columns }, (_, k) => this.at(this.time(LEFT + 2 * k)));
    const most = Math.max(...[...new Set(seen)].map(({ data }) => Math.max(...good(data))));
    const needed = SCALES.findIndex((s) => s >= most);
    this.scale = needed < 0 ? SCALES.length - 1 : needed;
    [this.strip.width, this.strip.height] = [columns, rows];
    const context = this.strip.getContext("2d"), image = context.createImageData(columns, rows);
    const lost = [...bytesOf(this.colours.bad), 255];
    seen.forEach(({ time, data }, k) => {
      const age = this.time(LEFT + 2 * k) - time;
      if (age < -PACE || age > this.gap) return;
      for (let row = 0; row < rows; row++) {
        const value = data.channels[row];
        if (this.labels[row] in data.bad) image.data.set(lost, 4 * (row * columns + k));
        else if (value !== null) {
          const level = 128 + Math.round(127 * Math.max(-1, Math.min(1, value / SCALES[this.scale])));
          image.data.set(diverging.subarray(4 * level, 4 * level + 4), 4 * (row * columns + k));
        }
      }
    });
    context.putImageData(image, 0, 0);
    c.imageSmoothingEnabled = false;
    c.drawImage(this.strip, LEFT, this.top, width - LEFT, this.high);
    c.fillStyle = this.colours.dim;
    c.textAlign = "right";
    c.fillText(this.labels[0], LEFT - 6, this.top + 5);
    c.fillText(`±${SCALES[this.scale]} %`, LEFT - 6, this.top + this.high / 2);
    c.fillText(this.labels[rows - 1], LEFT - 6, this.top + this.high - 5);
  }

  // Moments that follow each other closely and all have a value.
  *runs(value) {
    let run = [], last = -Infinity;
    for (const { time, data } of this.source.moments) {
      const known = value(data);
      if (run.length && (known === null || known === undefined || time - last > this.gap)) {
        yield run;
        run = [];
      }
      if (known !== null && known !== undefined) run.push([time, known]);
      last = time;
    }
    if (run.length) yield run;
  }

  // Twice the standard error, either way.
  band(c, y) {
    c.fillStyle = this.colours.estimate;
    c.globalAlpha = 0.2;
    const both = ({ estimate }) => (estimate && estimate.deviation !== null ? [estimate.angle, 2 * estimate.deviation] : null);
    for (const run of this.runs(both)) {
      c.beginPath();
      for (const [time, [angle, twice]] of run) c.lineTo(this.x(time), y(angle + twice));
      for (const [time, [angle, twice]] of run.reverse()) c.lineTo(this.x(time), y(angle - twice));
      c.fill();
    }
    c.globalAlpha = 1;
  }

  line(c, value, y, stroke, width) {
    c.beginPath();
    for (const run of this.runs(value)) {
      c.moveTo(this.x(run[0][0]), y(run[0][1]));
      for (const [time, known] of run) c.lineTo(this.x(time), y(known));
    }
    Object.assign(c, { strokeStyle: stroke, lineWidth: width, lineJoin: "round" });
    c.stroke();
  }
}

// Red, green and blue of a colour as "#rrggbb".
function bytesOf(text) {
  return [1, 3, 5].map((from) => parseInt(text.slice(from, from + 2), 16));
}
