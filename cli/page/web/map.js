// The touch map: what is found on the flat sensor, what is true, and the fingers that press it.
import { Surface, bytes, colour, diverging, palette } from "./colours.js";

const INDENTER = 0.0075; // radius of what presses a virtual board [m]
const WIDEST = 17 / 8.2; // shape of the map, as in style.css
const RIM = 0.001; // least distance of a finger from the rim [m]
const STEP = 0.002; // of the keyboard's finger [m]

export class TouchMap {
  // `press(touches)` is called with what the fingers do; null where nothing can be pressed.
  constructor(canvas, sensor, press) {
    Object.assign(this, { canvas, sensor, press });
    const aspect = Math.min(WIDEST, Math.max(1, sensor.length / sensor.width));
    canvas.parentElement.style.setProperty("--aspect", aspect); // on a phone
    this.colours = { text: colour("text"), truth: colour("truth"), dim: colour("dim"), estimate: colour("estimate"), edge: colour("edge"), ground: colour("raised") };
    this.found = [];
    this.truth = [];
    this.pins = []; // presses that stay: {x, y, force}
    this.fingers = new Map(); // by pointer: {press, pinned, moved}
    this.cursor = null;
    this.asked = null;
    this.force = () => 8;
    this.pinned = () => false;
    this.picture = document.createElement("canvas");
    this.empty = true;
    this.shown = "";
    this.colourOf = palette;
    this.surface = new Surface(canvas, (c, w, h) => this.draw(c, w, h));
    if (press) this.listen();
  }

  // Where somebody is asked to press, or null.
  point(place) {
    this.asked = place && { x: place[0], y: place[1] };
    this.surface.paint();
  }

  // `picture` is shown instead of the map where there is one.
  show(map, found, truth, picture) {
    const shown = JSON.stringify([found, truth, Boolean(picture)]), image = picture || map;
    if (!image && this.empty && shown === this.shown) return;
    Object.assign(this, { found, truth, shown, colourOf: picture ? diverging : palette });
    this.empty = !image;
    if (image) this.paint(image);
    this.surface.paint();
  }

  paint({ rows, columns, data }) {
    const levels = bytes(data);
    if (this.picture.width !== columns || this.picture.height !== rows) {
      [this.picture.width, this.picture.height] = [columns, rows];
      this.pixels = this.picture.getContext("2d").createImageData(columns, rows);
    }
    for (let row = 0; row < rows; row++) { // rows grow with y, a picture's downwards
      for (let column = 0; column < columns; column++) {
        const from = 4 * levels[(rows - 1 - row) * columns + column], to = 4 * (row * columns + column);
        for (let k = 0; k < 4; k++) this.pixels.data[to + k] = this.colourOf[from + k];
      }
    }
    this.picture.getContext("2d").putImageData(this.pixels, 0, 0);
  }

  // Metres of the sensor to pixels of the canvas and back.
  place(width, height) {
    const { length, width: across, origin: [x0, y0] } = this.sensor;
    const scale = Math.min((width - 44) / length, (height - 44) / across);
    const left = (width - scale * length) / 2 - scale * x0, bottom = (height + scale * across) / 2 + scale * y0;
    return {
      scale,
      x: (metres) => left + scale * metres,
      y: (metres) => bottom - scale * metres,
      back: (px, py) => ({ x: (px - left) / scale, y: (bottom - py) / scale }),
    };
  }

  draw(c, width, height) {
    const at = this.place(width, height);
    const { length, width: across, outline, origin: [x0, y0] } = this.sensor;
    c.beginPath();
    for (const [x, y] of outline) c.lineTo(at.x(x), at.y(y));
    c.closePath();
    c.save();
    c.clip();
    c.fillStyle = `rgb(${palette.slice(0, 3).join(",")})`;
    c.fillRect(0, 0, width, height);
    if (!this.empty) c.drawImage(this.picture, at.x(x0), at.y(y0 + across), at.scale * length, at.scale * across);
    this.grid(c, at);
    c.restore();
    c.strokeStyle = "#3a4a5c";
    c.lineWidth = 1.5;
    c.stroke();
    this.drawElectrodes(c, at);
    for (const touch of this.truth) this.circle(c, at, touch, this.colours.truth, [6, 5], 2);
    for (const touch of this.pressing()) this.circle(c, at, touch, "#ffffff66", [], 1);
    for (const touch of this.found) this.drawFound(c, at, touch);
    if (this.asked) this.drawAsked(c, at);
    if (this.cursor && document.activeElement === this.canvas) this.drawCursor(c, at);
  }

  grid(c, at) {
    const { length, width: across, origin: [x0, y0], grid } = this.sensor;
    c.fillStyle = "#ffffff12";
    for (let x = grid; x < length - grid / 2; x += grid) c.fillRect(Math.round(at.x(x0 + x)), at.y(y0 + across), 1, at.scale * across);
    for (let y = grid; y < across - grid / 2; y += grid) c.fillRect(at.x(x0), Math.round(at.y(y0 + y)), at.scale * length, 1);
  }

  drawElectrodes(c, at) {
    c.font = "600 12px system-ui, sans-serif";
    c.textAlign = "center";
    c.textBaseline = "middle";
    c.fillStyle = c.strokeStyle = "#d9b070";
    c.lineWidth = 5;
    this.sensor.electrodes.forEach(({ path, closed, outward: [dx, dy] }, number) => {
      const x = path.map((point) => at.x(point[0])), y = path.map((point) => at.y(point[1]));
      c.beginPath();
      path.forEach((_, i) => c.lineTo(x[i], y[i]));
      const mean = (values) => values.reduce((sum, value) => sum + value, 0) / values.length;
      const middle = [mean(x), mean(y)];
      if (!closed) {
        // The line's middle, which in a bow is not the mean; a line is at least 8 pixels long.
        middle.splice(0, 2, x[x.length >> 1], y[y.length >> 1]);
        const short = 8 - Math.hypot(x[0] - x[x.length - 1], y[0] - y[y.length - 1]);
        if (short > 0) {
          c.moveTo(middle[0] - 4 * dy, middle[1] - 4 * dx);
          c.lineTo(middle[0] + 4 * dy, middle[1] + 4 * dx);
        }
        c.stroke();
      } else {
        c.fill();
      }
      const level = closed && !dx && !dy, above = level ? middle[1] - Math.min(...y) + 9 : 0;
      c.fillText(number, middle[0] + 13 * dx, middle[1] - 13 * dy - above);
    });
  }

  circle(c, at, { x, y }, stroke, dash, width) {
    c.beginPath();
    c.arc(at.x(x), at.y(y), INDENTER * at.scale, 0, 2 * Math.PI);
    c.setLineDash(dash);
    c.strokeStyle = stroke;
    c.lineWidth = width;
    c.stroke();
    c.setLineDash([]);
  }

  drawFound(c, at, { x, y, force, strength }) {
    const px = at.x(x), py = at.y(y);
    c.beginPath();
    c.arc(px, py, 6, 0, 2 * Math.PI);
    c.fillStyle = "#0a0e13aa";
    c.fill();
    c.strokeStyle = "#fff";
    c.lineWidth = 2.5;
    c.stroke();
    const label = force === null ? strength.toFixed(2) : `${force.toFixed(1)} N`;
    c.font = "600 14px system-ui, sans-serif";
    c.textBaseline = "middle";
    const right = px < at.x(this.sensor.origin[0] + this.sensor.length) - 90, aside = INDENTER * at.scale + 7;
    c.textAlign = right ? "left" : "right";
    c.lineWidth = 3;
    c.strokeStyle = "#0a0e13cc";
    c.strokeText(label, px + (right ? aside : -aside), py);
    c.fillStyle = "#fff";
    c.fillText(label, px + (right ? aside : -aside), py);
  }

  drawAsked(c, at) {
    this.circle(c, at, this.asked, this.colours.estimate, [], 4);
    const px = at.x(this.asked.x), py = at.y(this.asked.y), reach = INDENTER * at.scale + 8;
    c.beginPath();
    for (const [dx, dy] of [[1, 0], [0, 1], [-1, 0], [0, -1]]) {
      c.moveTo(px + 4 * dx, py + 4 * dy);
      c.lineTo(px + reach * dx, py + reach * dy);
    }
    c.lineWidth = 2;
    c.stroke();
  }

  drawCursor(c, at) {
    const px = at.x(this.cursor.x), py = at.y(this.cursor.y);
    c.strokeStyle = this.colours.text;
    c.lineWidth = 1.5;
    c.beginPath();
    c.moveTo(px - 9, py); c.lineTo(px + 9, py);
    c.moveTo(px, py - 9); c.lineTo(px, py + 9);
    c.stroke();
  }

  // --- pressing ---

  pressing() {
    return [...this.pins, ...[...this.fingers.values()].filter((f) => !f.pinned).map((f) => f.press)];
  }

  busy() {
    return this.fingers.size > 0;
  }

  listen() {
    this.canvas.classList.add("pressable");
    this.canvas.tabIndex = 0;
    this.canvas.setAttribute("aria-label",
      "Where the sensor is touched. Arrow keys move a finger, Enter presses or releases, Escape releases all");
    this.canvas.onpointerdown = (event) => this.down(event);
    this.canvas.onpointermove = (event) => this.move(event);
    this.canvas.onpointerup = this.canvas.onpointercancel = (event) => this.up(event);
    this.canvas.onkeydown = (event) => this.key(event);
    this.canvas.onfocus = this.canvas.onblur = () => this.surface.paint();
  }

  // The place itself, or the nearest one on the sensor; a corner takes a step for each side.
  inside({ x, y }) {
    for (let turn = 0; turn < 3; turn++) {
      const [rim, away, within] = this.nearest(x, y);
      if (within && away >= RIM) break;
      [x, y] = rim;
    }
    return { x, y };
  }

  // The nearest point at `RIM` from the outline, the distance from the outline, and whether (x, y) is within it.
  nearest(x, y) {
    const { outline } = this.sensor;
    let best = [null, Infinity], within = false;
    outline.forEach(([ax, ay], i) => {
      const [bx, by] = outline[(i + 1) % outline.length], dx = bx - ax, dy = by - ay, size = Math.hypot(dx, dy);
      const share = Math.min(1, Math.max(0, ((x - ax) * dx + (y - ay) * dy) / size ** 2));
      const [px, py] = [ax + share * dx, ay + share * dy], away = Math.hypot(x - px, y - py);
      // Counter-clockwise: inwards is to the left.
      if (away < best[1]) best = [[px - RIM * dy / size, py + RIM * dx / size], away];
      if ((ay > y) !== (by > y) && x < ax + (y - ay) / dy * dx) within = !within;
    });
    return [...best, within];
  }

  pointed(event) {
    return this.inside(this.place(this.surface.width, this.surface.height).back(event.offsetX, event.offsetY));
  }

  near({ x, y }) {
    return this.pins.find((pin) => Math.hypot(pin.x - x, pin.y - y) < 1.2 * INDENTER);
  }

  down(event) {
    if (event.button) return;
    const place = this.pointed(event), pin = this.near(place);
    if (!pin && this.pressing().length >= this.sensor.controls.touches) return;
    this.canvas.setPointerCapture(event.pointerId);
    if (pin) {
      this.fingers.set(event.pointerId, { press: pin, pinned: true, moved: false });
    } else {
      const press = { ...place, force: this.force() };
      const pinned = this.pinned();
      if (pinned) this.pins.push(press);
      this.fingers.set(event.pointerId, { press, pinned, moved: pinned });
      this.press(this.pressing());
    }
    this.surface.paint();
  }

  move(event) {
    const finger = this.fingers.get(event.pointerId);
    if (!finger) return;
    const place = this.pointed(event);
    const far = Math.hypot(place.x - finger.press.x, place.y - finger.press.y) > 0.002;
    if (finger.pinned && !finger.moved && !far) return;
    finger.moved = true;
    Object.assign(finger.press, place);
    this.press(this.pressing());
    this.surface.paint();
  }

  // A pinned press that is tapped is taken off; any other ends with its finger.
  up(event) {
    const finger = this.fingers.get(event.pointerId);
    if (!finger) return;
    this.fingers.delete(event.pointerId);
    if (finger.pinned && !finger.moved) this.pins = this.pins.filter((pin) => pin !== finger.press);
    this.press(this.pressing());
    this.surface.paint();
  }

  key(event) {
    const { length, width, origin: [x0, y0] } = this.sensor;
    this.cursor ||= this.inside({ x: x0 + length / 2, y: y0 + width / 2 });
    const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
    if (step) {
      this.cursor = this.inside({ x: this.cursor.x + STEP * step[0], y: this.cursor.y + STEP * step[1] });
    } else if (event.key === "Enter" || event.key === " ") {
      const pin = this.near(this.cursor);
      if (pin) this.pins = this.pins.filter((other) => other !== pin);
      else if (this.pressing().length < this.sensor.controls.touches) this.pins.push({ ...this.cursor, force: this.force() });
      this.press(this.pressing());
    } else if (event.key === "Escape") {
      this.release();
      this.press([]);
    } else {
      return;
    }
    event.preventDefault();
    this.surface.paint();
  }

  release() {
    this.pins = [];
    this.fingers.clear();
    this.surface.paint();
  }
}
