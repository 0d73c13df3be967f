// The sensor from above, where its shape is not known or the browser has no WebGL 2; asked for
// pixels and places as the solid one is.
import { Surface, bytes, colour, diverging, palette } from "./colours.js";

const MARGIN = 44; // pixels, of both sides together

export class Plan {
  constructor(canvas, sensor, painted) {
    Object.assign(this, { sensor, painted });
    this.picture = document.createElement("canvas");
    this.image = null;
    this.surface = new Surface(canvas, (c, width, height) => this.draw(c, width, height));
  }

  show(_, map, signed) {
    Object.assign(this, { image: map, colours: signed ? diverging : palette });
    if (map) this.paint(map);
    this.surface.paint();
  }

  paint({ rows, columns, data }) {
    const levels = bytes(data), context = this.picture.getContext("2d");
    [this.picture.width, this.picture.height] = [columns, rows];
    const pixels = context.createImageData(columns, rows);
    for (let row = 0; row < rows; row++) { // rows grow with y, a picture's downwards
      for (let column = 0; column < columns; column++) {
        const from = 4 * levels[(rows - 1 - row) * columns + column];
        pixels.data.set(this.colours.subarray(from, from + 4), 4 * (row * columns + column));
      }
    }
    context.putImageData(pixels, 0, 0);
  }

  draw(c, width, height) {
    const { length, width: across, origin: [x0, y0], outline, grid } = this.sensor;
    this.scale = Math.min((width - MARGIN) / length, (height - MARGIN) / across);
    this.left = (width - this.scale * length) / 2 - this.scale * x0;
    this.bottom = (height + this.scale * across) / 2 + this.scale * y0;
    this.rim = new Path2D();
    for (const [x, y] of outline) this.rim.lineTo(...this.pixel(x, y));
    this.rim.closePath();
    const corner = this.pixel(x0, y0 + across), size = [this.scale * length, this.scale * across];
    c.save();
    c.clip(this.rim);
    c.fillStyle = `rgb(${palette.slice(0, 3).join(",")})`;
    c.fillRect(...corner, ...size);
    if (this.image) c.drawImage(this.picture, ...corner, ...size);
    c.fillStyle = "#ffffff12";
    for (let x = grid; x < length - grid / 2; x += grid) c.fillRect(Math.round(this.pixel(x0 + x, 0)[0]), corner[1], 1, size[1]);
    for (let y = grid; y < across - grid / 2; y += grid) c.fillRect(corner[0], Math.round(this.pixel(0, y0 + y)[1]), size[0], 1);
    c.restore();
    c.strokeStyle = colour("dim");
    c.stroke(this.rim);
    this.painted();
  }

  pixel(x, y) {
    return [this.left + this.scale * x, this.bottom - this.scale * y];
  }

  place(px, py) {
    return { x: (px - this.left) / this.scale, y: (this.bottom - py) / this.scale };
  }

  inside(px, py) {
    const c = this.surface.context;
    c.save();
    c.resetTransform();
    const found = Boolean(this.rim) && c.isPointInPath(this.rim, px, py);
    c.restore();
    return found;
  }

  project(x, y) {
    return this.rim && this.inside(...this.pixel(x, y)) ? this.pixel(x, y) : null;
  }

  locate(px, py) {
    return this.inside(px, py) ? this.place(px, py) : null;
  }

  *electrodes() {
    if (this.rim) for (const [x, y] of this.sensor.electrodes) yield [...this.pixel(x, y), false];
  }

  turn() {}

  reset() {}
}
