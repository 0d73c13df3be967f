// One colour map for the touch map and the sensor: lightness rises evenly, in Oklab
// (B. Ottosson, "A perceptual color space for image processing", 2020).

const gamma = (c) => 255 * (c <= 0.0031308 ? 12.92 * c : 1.055 * Math.pow(c, 1 / 2.4) - 0.055);

function rgb(L, chroma, hue) {
  const a = chroma * Math.cos(hue), b = chroma * Math.sin(hue);
  const l = (L + 0.3963377774 * a + 0.2158037573 * b) ** 3;
  const m = (L - 0.1055613458 * a - 0.0638541728 * b) ** 3;
  const s = (L - 0.0894841775 * a - 1.2914855480 * b) ** 3;
  return [
    gamma(Math.max(0, 4.0767416621 * l - 3.3077115913 * m + 0.2309699292 * s)),
    gamma(Math.max(0, -1.2684380046 * l + 2.6097574011 * m - 0.3413193965 * s)),
    gamma(Math.max(0, -0.0041960863 * l - 0.7034186147 * m + 1.7076147010 * s)),
  ].map((c) => Math.min(255, Math.round(c)));
}

// From the card's blue over magenta to a light yellow; 256 times red, green, blue, alpha.
export const palette = new Uint8ClampedArray(256 * 4);
for (let i = 0; i < 256; i++) {
  const t = i / 255;
  const chroma = 0.025 + 0.165 * Math.sin(Math.PI * Math.min(1, 0.93 * t));
  const hue = (262 + 195 * t) * Math.PI / 180;
  palette.set([...rgb(0.22 + 0.70 * t, chroma, hue), 255], 4 * i);
}

export const LIGHT = matchMedia("(prefers-color-scheme: light)").matches;

// From blue (less) over the card's ground to orange, for pictures and channels; 128 is no change.
export const diverging = new Uint8ClampedArray(256 * 4);
for (let i = 0; i < 256; i++) {
  const t = Math.min(1, Math.abs(i - 128) / 127);
  const hue = (i < 128 ? 250 : 55) * Math.PI / 180;
  diverging.set([...rgb(LIGHT ? 0.95 - 0.4 * t : 0.24 + 0.55 * t, 0.01 + 0.15 * t, hue), 255], 4 * i);
}

const style = getComputedStyle(document.documentElement);
export const colour = (name) => style.getPropertyValue(`--${name}`).trim();

// Another theme changes all colours: begin again with them.
matchMedia("(prefers-color-scheme: light)").addEventListener("change", () => location.reload());

export function bytes(base64) {
  const text = atob(base64), out = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) out[i] = text.charCodeAt(i);
  return out;
}

// A canvas whose pixels are the screen's; `draw(context, width, height)` in CSS pixels.
export class Surface {
  constructor(canvas, draw) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
    this.draw = draw;
    this.width = this.height = 0;
    new ResizeObserver(([entry]) => {
      const { width, height } = entry.contentRect;
      const scale = Math.min(2, window.devicePixelRatio || 1);
      canvas.width = Math.max(1, Math.round(width * scale));
      canvas.height = Math.max(1, Math.round(height * scale));
      this.context.setTransform(scale, 0, 0, scale, 0, 0);
      [this.width, this.height] = [width, height];
      this.paint();
    }).observe(canvas);
  }

  paint() {
    if (!this.width) return;
    this.context.clearRect(0, 0, this.width, this.height);
    this.draw(this.context, this.width, this.height);
  }
}
