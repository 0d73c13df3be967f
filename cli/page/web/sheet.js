// The sheet: the sensor with its touch map, and over it what is found, what is true, and the
// fingers that press it.
import { Surface, colour } from "./colours.js";
import { Plan } from "./plan.js";
import { Solid } from "./solid.js";

const INDENTER = 0.0075; // radius of what presses a virtual board [m]
const STEP = 0.002; // of the keyboard's finger [m]
const TURN = 0.008; // of the view by a pixel [rad]
const CORNERS = 28; // of a circle

export class Sheet {
  // `press(touches)` is called with what the fingers do; null where nothing can be pressed.
  constructor(canvas, overlay, note, sensor, press) {
    Object.assign(this, { canvas: overlay, sensor, press });
    this.names = ["text", "truth", "estimate", "metal", "card"];
    this.found = [];
    this.truth = [];
    this.pins = []; // presses that stay: {x, y, force}
    this.fingers = new Map(); // by pointer: {press, pinned, moved}, or {turned} where it turns the view
    this.cursor = null;
    this.asked = null;
    this.force = () => 8;
    this.pinned = () => false;
    const painted = () => this.surface && this.surface.paint();
    this.view = sensor.shape ? new Solid(canvas, sensor, painted) : null;
    if (!this.view || !this.view.gl) {
      note.textContent = sensor.shape ? "Flat: this browser has no WebGL 2." : "Flat: this pipeline does not know the shape of its sensor.";
      this.view = new Plan(canvas, sensor, painted);
    }
    this.surface = new Surface(overlay, (c) => this.draw(c));
    this.listen();
  }

  // Where somebody is asked to press, or null.
  point(place) {
    this.asked = place && { x: place[0], y: place[1] };
    this.surface.paint();
  }

  // `picture` is shown instead of the map where there is one.
  show(estimate, truth, picture, past) {
    Object.assign(this, { found: (estimate && estimate.touches) || [], truth, past });
    if (estimate) this.view.show(estimate, picture || estimate.map, Boolean(picture));
    this.surface.paint();
  }

  draw(c) {
    this.colours = Object.fromEntries(this.names.map((name) => [name, colour(name)]));
    c.font = "600 12px system-ui, sans-serif";
    c.textAlign = "center";
    c.textBaseline = "middle";
    c.fillStyle = this.colours.metal;
    let number = 0;
    for (const [px, py, behind] of this.view.electrodes()) {
      c.globalAlpha = behind ? 0.5 : 1;
      c.fillText(number++, px, py);
    }
    c.globalAlpha = 1;
    for (const touch of this.truth) this.circle(c, touch, this.colours.truth, [6, 5], 2);
    for (const touch of this.past ? [] : this.pressing()) this.circle(c, touch, "#ffffff66", [], 1);
    for (const touch of this.found) this.drawFound(c, touch);
    if (this.asked) this.circle(c, this.asked, this.colours.estimate, [], 4, true);
    if (this.cursor && document.activeElement === this.canvas) this.circle(c, this.cursor, this.colours.text, [], 1.5, true);
  }

  // The rim of an indenter on the sheet, perhaps with its cross.
  circle(c, { x, y }, stroke, dash, width, cross = false) {
    const at = (angle, share = 1) => this.view.project(x + share * INDENTER * Math.cos(angle), y + share * INDENTER * Math.sin(angle));
    c.beginPath();
    let last = null;
    for (let i = 0; i <= CORNERS; i++) {
      const point = at(2 * Math.PI * i / CORNERS); // none beyond the sheet
      if (point) c[last ? "lineTo" : "moveTo"](...point);
      last = point;
    }
    for (const angle of cross ? [0, 1, 2, 3] : []) {
      const [from, to] = [at(angle * Math.PI / 2, 0.3), at(angle * Math.PI / 2, 1.5)];
      if (!from || !to) continue;
      c.moveTo(...from);
      c.lineTo(...to);
    }
    c.setLineDash(dash);
    c.strokeStyle = stroke;
    c.lineWidth = width;
    c.stroke();
    c.setLineDash([]);
  }

  drawFound(c, { x, y, force, strength }) {
    const place = this.view.project(x, y);
    if (!place) return;
    const [px, py] = place;
    c.beginPath();
    c.arc(px, py, 6, 0, 2 * Math.PI);
    c.fillStyle = "#0a0e13aa";
    c.fill();
    c.strokeStyle = "#fff";
    c.lineWidth = 2.5;
    c.stroke();
    const label = force === null ? strength.toFixed(2) : `${force.toFixed(1)} N`;
    const right = px < this.surface.width - 110;
    const rim = this.view.project(x + (right ? INDENTER : -INDENTER), y);
    const aside = (rim ? Math.abs(rim[0] - px) : 14) + 8;
    c.font = "650 17px system-ui, sans-serif";
    c.textAlign = right ? "left" : "right";
    c.lineWidth = 4;
    c.lineJoin = "round";
    c.strokeStyle = "#0a0e13dd";
    c.strokeText(label, px + (right ? aside : -aside), py);
    c.fillStyle = "#fff";
    c.fillText(label, px + (right ? aside : -aside), py);
  }

  // --- pressing and turning ---

  pressing() {
    return [...this.pins, ...[...this.fingers.values()].filter((f) => f.press && !f.pinned).map((f) => f.press)];
  }

  busy() {
    return [...this.fingers.values()].some((finger) => finger.press);
  }

  listen() {
    const { canvas } = this;
    canvas.classList.toggle("pressable", Boolean(this.press));
    if (this.press) {
      canvas.setAttribute("aria-label", "The sensor and where it is touched. Arrow keys move a finger, Enter presses or "
        + "releases, Escape releases all; with Shift, arrow keys turn the view");
    }
    canvas.onpointerdown = (event) => this.down(event);
    canvas.onpointermove = (event) => this.move(event);
    canvas.onpointerup = canvas.onpointercancel = (event) => this.up(event);
    canvas.ondblclick = (event) => this.locate(event) || this.view.reset();
    canvas.onkeydown = (event) => this.key(event);
    canvas.onfocus = canvas.onblur = () => this.surface.paint();
  }

  locate(event) {
    return this.view.locate(event.offsetX, event.offsetY);
  }

  near({ x, y }) {
    return this.pins.find((pin) => Math.hypot(pin.x - x, pin.y - y) < 1.2 * INDENTER);
  }

  down(event) {
    if (event.button) return;
    this.canvas.setPointerCapture(event.pointerId);
    const place = this.press && this.locate(event);
    if (!place) {
      this.fingers.set(event.pointerId, { turned: [event.clientX, event.clientY] });
      return;
    }
    const pin = this.near(place);
    if (pin) {
      this.fingers.set(event.pointerId, { press: pin, pinned: true, moved: false });
    } else if (this.pressing().length < this.sensor.controls.touches) {
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
    if (finger.turned) {
      const [x, y] = finger.turned;
      finger.turned = [event.clientX, event.clientY];
      this.view.turn(TURN * (event.clientX - x), TURN * (event.clientY - y));
      return;
    }
    const place = this.locate(event); // a finger that leaves the sheet stays where it left it
    if (!place) return;
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
    this.fingers.delete(event.pointerId);
    if (!finger || finger.turned) return;
    if (finger.pinned && !finger.moved) this.pins = this.pins.filter((pin) => pin !== finger.press);
    this.press(this.pressing());
    this.surface.paint();
  }

  key(event) {
    const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
    if (step && (event.shiftKey || !this.press)) {
      this.view.turn(0.1 * step[0], -0.1 * step[1]);
    } else if (!this.press) {
      return;
    } else if (step) {
      const { length, width, origin: [x0, y0] } = this.sensor;
      const { x, y } = this.cursor || { x: x0 + length / 2, y: y0 + width / 2 };
      const moved = { x: x + STEP * step[0], y: y + STEP * step[1] };
      if (this.view.project(moved.x, moved.y)) this.cursor = moved;
    } else if (event.key === "Escape") {
      this.release();
      this.press([]);
    } else if ((event.key === "Enter" || event.key === " ") && this.cursor) {
      const pin = this.near(this.cursor);
      if (pin) this.pins = this.pins.filter((other) => other !== pin);
      else if (this.pressing().length < this.sensor.controls.touches) this.pins.push({ ...this.cursor, force: this.force() });
      this.press(this.pressing());
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
