// The scene and the faults of a virtual board. One request at a time; of those that come
// meanwhile only the newest is sent.

import { post } from "./tasks.js";

const $ = (id) => document.getElementById(id);
const SETTLES = 1000; // ms after which the board's own scene is shown again

export class Controls {
  constructor(sensor, sheet) {
    Object.assign(this, { map: sheet, limits: sensor.controls });
    this.scene = { bend_deg: 0, touches: [] };
    this.wanted = null;
    this.sending = false;
    this.used = -SETTLES;
    $("controls").hidden = false;
    const [bend, force, fault] = [$("bend"), $("force"), $("fault")];
    [bend.min, bend.max] = this.limits.bend;
    [force.min, force.max] = this.limits.force;
    fault.append(...this.limits.faults.map((name) => new Option(name.replaceAll("_", " "), name)));
    bend.oninput = () => this.change({ bend_deg: Number(bend.value) });
    force.oninput = () => this.press_harder(Number(force.value));
    sheet.force = () => Number(force.value);
    sheet.pinned = () => $("pin").checked;
    $("release").onclick = () => {
      sheet.release();
      this.change({ touches: [] });
    };
    $("play").onclick = () => {
      sheet.release();
      this.post("/play", { play: true });
    };
    $("stop").onclick = () => this.post("/play", { play: false });
    $("inject").onclick = () => this.post("/fault", { fault: `${fault.value}:${$("index").value || 0}` });
    $("clear").onclick = () => this.post("/fault", { clear: true });
    this.label();
  }

  press(touches) {
    this.change({ touches: touches.map(({ x, y, force }) => ({ x, y, force })) });
  }

  press_harder(force) {
    this.map.pressing().forEach((press) => { press.force = force; });
    this.label();
    if (this.map.pressing().length) this.press(this.map.pressing());
  }

  change(part) {
    this.used = performance.now();
    Object.assign(this.scene, part);
    this.label();
    this.wanted = this.scene;
    this.send();
  }

  async send() {
    if (this.sending) return;
    this.sending = true;
    while (this.wanted) {
      const scene = this.wanted;
      this.wanted = null;
      await this.post("/scene", scene);
    }
    this.sending = false;
  }

  async post(path, body) {
    $("said").textContent = await post(path, body);
  }

  // Show the board's scene, whoever has set it, unless a finger is at it here.
  show({ commanded, faults }) {
    const text = faults.length ? `active: ${faults.join(", ").replaceAll("_", " ")}` : "";
    if ($("faults").textContent !== text) $("faults").textContent = text;
    $("faults").hidden = !text;
    if (this.sending || this.map.busy() || performance.now() - this.used < SETTLES) return;
    const touches = commanded.touches.map((touch) => ({ ...touch, force: touch.force ?? this.map.force() }));
    if (JSON.stringify([touches, commanded.bend_deg]) === this.known) return;
    this.known = JSON.stringify([touches, commanded.bend_deg]);
    this.scene = { bend_deg: commanded.bend_deg ?? 0, touches };
    this.map.pins = touches.map((touch) => ({ ...touch }));
    $("bend").value = this.scene.bend_deg;
    this.label();
  }

  label() {
    const angle = this.scene.bend_deg;
    $("bend-value").textContent = `${angle > 0 ? "+" : ""}${angle}°`;
    $("force-value").textContent = `${$("force").value} N`;
  }
}
