// The sensor in three dimensions. Its points come bent and pressed from the server, which knows
// the geometry; here they are only lit and seen.
import { bytes, palette } from "./colours.js";

const VERTEX = `#version 300 es
uniform mat4 projection, view;
in vec3 place, normal;
in vec2 flat_place;
in float kind;
out vec3 seen, facing;
out vec2 at;
out float material;
void main() {
  vec4 moved = view * vec4(place, 1.0);
  seen = moved.xyz;
  facing = mat3(view) * normal;
  at = flat_place;
  material = kind;
  gl_Position = projection * moved;
}`;

const FRAGMENT = `#version 300 es
precision mediump float;
uniform sampler2D map, colours;
uniform vec2 lines;
in vec3 seen, facing;
in vec2 at;
in float material;
out vec4 colour;
void main() {
  vec3 n = normalize(facing), toEye = normalize(-seen);
  if (dot(n, toEye) < 0.0) n = -n;
  vec3 light = normalize(vec3(-0.45, 0.7, 0.6));
  vec3 base = vec3(0.17, 0.25, 0.34);
  float gloss = 0.30;
  if (material > 1.5) {
    base = vec3(0.82, 0.64, 0.36);
    gloss = 0.6;
  } else if (material > 0.5) {
    float level = texture(map, at).r;
    vec3 touched = texture(colours, vec2(level, 0.5)).rgb;
    vec2 apart = abs(fract(at * lines + 0.5) - 0.5) / fwidth(at * lines);
    float line = 1.0 - min(min(apart.x, apart.y), 1.0);
    base = mix(base, vec3(0.45, 0.60, 0.74), 0.34 * line);
    base = mix(base, 0.72 * touched, 0.75 * smoothstep(0.04, 0.5, level));
  }
  float lit = 0.10 + 0.90 * max(dot(n, light), 0.0) + 0.42 * max(dot(n, toEye), 0.0);
  float shine = pow(max(dot(reflect(-light, n), toEye), 0.0), 24.0);
  float rim = pow(1.0 - max(dot(n, toEye), 0.0), 3.0);
  colour = vec4(base * lit + gloss * shine + 0.10 * rim, 1.0);
}`;

const FIELD = 26 * Math.PI / 180;
const FIRST = { yaw: -0.42, pitch: 0.62 };
const LIFT = 0.0002; // of electrodes over the side that they are on [m]
const SOFTWARE = 0.75; // pixels for each of the screen's where the processor has to draw them
const SAME = 64; // of 255 levels of the touch map
const GEL = 0, FACE = 1, METAL = 2;

// Whether there is no graphics card: then a picture must be small to be in time.
function software() {
  const gl = document.createElement("canvas").getContext("webgl2");
  const info = gl && gl.getExtension("WEBGL_debug_renderer_info");
  const name = info ? gl.getParameter(info.UNMASKED_RENDERER_WEBGL) : "";
  if (gl) gl.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|software/i.test(name);
}

// Whether two maps differ by noise only.
function alike(one, other) {
  return one.length === other.length && one.every((value, i) => Math.abs(value - other[i]) < SAME);
}

export class Sensor {
  constructor(canvas, labels, note, sensor) {
    Object.assign(this, { canvas, labels, sensor });
    const slow = software();
    const gl = sensor.shape && canvas.getContext("webgl2", { antialias: !slow, alpha: true });
    if (!gl) {
      note.textContent = sensor.shape ? "The 3D view is not available: this browser has no WebGL 2."
        : "The 3D view is drawn for rectangular sensors only.";
      note.hidden = false;
      canvas.hidden = true;
      return;
    }
    this.gl = gl;
    this.angles = { ...FIRST };
    this.drawn = "";
    this.levels = [];
    this.sheets = this.layout();
    this.prepare();
    this.listen();
    this.spans = sensor.electrodes.map((_, i) => labels.appendChild(Object.assign(document.createElement("span"), { textContent: i })));
    new ResizeObserver(([entry]) => {
      const scale = slow ? SOFTWARE : Math.min(2, window.devicePixelRatio || 1);
      [this.width, this.height] = [entry.contentRect.width, entry.contentRect.height];
      canvas.width = Math.max(1, Math.round(this.width * scale));
      canvas.height = Math.max(1, Math.round(this.height * scale));
      this.paint();
    }).observe(canvas);
  }

  // Grids of points that make the body: each lists the server's points that it is made of.
  layout() {
    const { columns, rows } = this.sensor.shape, face = columns * rows, bottom = [face, face + columns];
    const row = (start, count, step = 1) => Array.from({ length: count }, (_, i) => start + i * step);
    const sheets = [{ kind: FACE, rows, points: row(0, face) }];
    sheets.push({ kind: GEL, rows: 2, points: [...row(bottom[0], columns), ...row(0, columns)] });
    sheets.push({ kind: GEL, rows: 2, points: [...row(bottom[1], columns), ...row(face - columns, columns)] });
    sheets.push({ kind: GEL, rows: 2, points: [...row(bottom[0], columns), ...row(bottom[1], columns)] });
    for (const end of [0, columns - 1]) {
      // The bottom's short edges are straight: its corners, repeated, meet each point above.
      const under = row(0, rows).map((i) => [bottom[0] + end, bottom[1] + end, i / (rows - 1)]);
      sheets.push({ kind: GEL, rows: 2, points: [...under, ...row(end, rows, columns)] });
    }
    this.sensor.electrodes.forEach((_, i) => {
      const first = face + 2 * columns + 4 * i;
      sheets.push({ kind: METAL, rows: 2, points: [first, first + 1, first + 3, first + 2] });
    });
    return sheets;
  }

  prepare() {
    const gl = this.gl, { columns, rows } = this.sensor.shape;
    const program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    gl.useProgram(program);
    this.uniform = (name) => gl.getUniformLocation(program, name);

    const kinds = [], places = [], indices = [];
    let count = 0;
    for (const sheet of this.sheets) {
      const wide = sheet.points.length / sheet.rows;
      sheet.first = count;
      sheet.wide = wide;
      sheet.points.forEach((_, i) => {
        kinds.push(sheet.kind);
        places.push((i % wide) / (wide - 1), Math.floor(i / wide) / (sheet.rows - 1));
      });
      for (let r = 0; r + 1 < sheet.rows; r++) {
        for (let k = 0; k + 1 < wide; k++) {
          const a = count + r * wide + k, b = a + wide;
          indices.push(a, a + 1, b, b, a + 1, b + 1);
        }
      }
      count += sheet.points.length;
    }
    this.positions = new Float32Array(3 * count);
    this.normals = new Float32Array(3 * count);
    this.count = indices.length;

    const attribute = (name, size, data, usage) => {
      const buffer = gl.createBuffer(), where = gl.getAttribLocation(program, name);
      gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
      gl.bufferData(gl.ARRAY_BUFFER, data, usage);
      gl.enableVertexAttribArray(where);
      gl.vertexAttribPointer(where, size, gl.FLOAT, false, 0, 0);
      return buffer;
    };
    attribute("kind", 1, new Float32Array(kinds), gl.STATIC_DRAW);
    attribute("flat_place", 2, new Float32Array(places), gl.STATIC_DRAW);
    this.placeBuffer = attribute("place", 3, this.positions, gl.DYNAMIC_DRAW);
    this.normalBuffer = attribute("normal", 3, this.normals, gl.DYNAMIC_DRAW);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, new Uint16Array(indices), gl.STATIC_DRAW);

    this.mapTexture = this.texture(0, "map");
    this.level(1, 1, new Uint8Array(1));
    this.texture(1, "colours");
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, 256, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(palette));
    gl.uniform2f(this.uniform("lines"), this.sensor.length / 0.015, this.sensor.width / 0.015);
    gl.enable(gl.DEPTH_TEST);
    gl.clearColor(0, 0, 0, 0);
  }

  texture(unit, name) {
    const gl = this.gl, texture = gl.createTexture();
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    for (const wrap of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, wrap, gl.CLAMP_TO_EDGE);
    for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, filter, gl.LINEAR);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    gl.uniform1i(this.uniform(name), unit);
    return texture;
  }

  level(columns, rows, data) {
    const gl = this.gl;
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.mapTexture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.R8, columns, rows, 0, gl.RED, gl.UNSIGNED_BYTE, data);
  }

  show(points, map) {
    if (!this.gl) return;
    const levels = map ? bytes(map.data) : new Uint8Array(1);
    const still = points === this.drawn, same = alike(levels, this.levels);
    if (still && same) return; // nothing that could be seen
    if (!same) {
      this.level(map ? map.columns : 1, map ? map.rows : 1, levels);
      this.levels = levels;
    }
    if (!still) this.move(new Int16Array(bytes(points).buffer));
    this.drawn = points;
    this.paint();
  }

  move(steps) {
    const { unit } = this.sensor.shape, { length, width } = this.sensor;
    const p = this.positions;
    let low = Infinity, high = -Infinity;
    for (let i = 2; i < steps.length; i += 3) {
      low = Math.min(low, steps[i]);
      high = Math.max(high, steps[i]);
    }
    const middle = [length / 2, width / 2, (low + high) / 2 * unit];
    const coordinate = (index, axis) => steps[3 * index + axis] * unit - middle[axis];
    for (const sheet of this.sheets) {
      sheet.points.forEach((point, i) => {
        const to = 3 * (sheet.first + i);
        for (let axis = 0; axis < 3; axis++) {
          if (typeof point === "number") p[to + axis] = coordinate(point, axis);
          else p[to + axis] = (1 - point[2]) * coordinate(point[0], axis) + point[2] * coordinate(point[1], axis);
        }
      });
      this.face(sheet);
    }
    const gl = this.gl;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.placeBuffer);
    gl.bufferSubData(gl.ARRAY_BUFFER, 0, this.positions);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.normalBuffer);
    gl.bufferSubData(gl.ARRAY_BUFFER, 0, this.normals);
  }

  // Normals of a grid: the cross product of its central differences.
  face({ first, rows, wide, kind }) {
    const p = this.positions, n = this.normals;
    for (let r = 0; r < rows; r++) {
      const low = Math.max(r - 1, 0), high = Math.min(r + 1, rows - 1);
      for (let k = 0; k < wide; k++) {
        const at = (row, column) => 3 * (first + row * wide + column);
        const to = at(r, k), w = at(r, Math.max(k - 1, 0)), e = at(r, Math.min(k + 1, wide - 1));
        const s = at(low, k), t = at(high, k);
        const ux = p[e] - p[w], uy = p[e + 1] - p[w + 1], uz = p[e + 2] - p[w + 2];
        const vx = p[t] - p[s], vy = p[t + 1] - p[s + 1], vz = p[t + 2] - p[s + 2];
        const x = uy * vz - uz * vy, y = uz * vx - ux * vz, z = ux * vy - uy * vx;
        const size = Math.hypot(x, y, z) || 1;
        n[to] = x / size; n[to + 1] = y / size; n[to + 2] = z / size;
      }
    }
    if (kind !== METAL) return;
    for (let i = 3 * first; i < 3 * (first + 4); i++) p[i] += LIFT * n[i];
  }

  paint() {
    if (!this.drawn || !this.width) return;
    const gl = this.gl, { yaw, pitch } = this.angles;
    const aspect = this.width / this.height, { length, width } = this.sensor;
    const radius = 0.53 * Math.hypot(length, width), slope = Math.tan(FIELD / 2);
    const far = Math.max(0.56 * length / aspect, 0.25 * length) / slope + 0.25 * length;
    const f = 1 / slope, [near, end] = [far - 2 * radius, far + 2 * radius];
    const depth = [(end + near) / (near - end), 2 * end * near / (near - end)];
    const projection = [f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, depth[0], -1, 0, 0, depth[1], 0];
    const [cy, sy, cp, sp] = [Math.cos(yaw), Math.sin(yaw), Math.cos(pitch), Math.sin(pitch)];
    // About z by yaw, then about the screen's x; the camera looks down its own -z.
    const view = [cy, sp * sy, -cp * sy, 0, -sy, sp * cy, -cp * cy, 0, 0, cp, sp, 0, 0, 0, -far, 1];
    gl.viewport(0, 0, this.canvas.width, this.canvas.height);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.uniformMatrix4fv(this.uniform("projection"), false, projection);
    gl.uniformMatrix4fv(this.uniform("view"), false, view);
    gl.drawElements(gl.TRIANGLES, this.count, gl.UNSIGNED_SHORT, 0);
    this.number(view, projection);
  }

  // Each electrode's number, a little outside it; faint where it is behind.
  number(m, projection) {
    this.spans.forEach((span, i) => {
      const first = 3 * this.sheets[this.sheets.length - this.spans.length + i].first;
      const corner = (axis) => {
        let sum = 0;
        for (let k = 0; k < 4; k++) sum += this.positions[first + 3 * k + axis] / 4;
        return sum + 0.006 * this.normals[first + axis];
      };
      const [x, y, z] = [corner(0), corner(1), corner(2)];
      const n = [0, 1, 2].map((axis) => this.normals[first + axis]);
      const see = (row) => m[row] * x + m[4 + row] * y + m[8 + row] * z + m[12 + row];
      const away = m[2] * n[0] + m[6] * n[1] + m[10] * n[2] < 0;
      const deep = -see(2);
      const px = (0.5 + 0.5 * projection[0] * see(0) / deep) * this.width;
      const py = (0.5 - 0.5 * projection[5] * see(1) / deep) * this.height;
      span.style.transform = `translate(${px.toFixed(1)}px, ${py.toFixed(1)}px)`;
      span.style.opacity = away ? 0.4 : 1;
    });
  }

  listen() {
    let held = null;
    const turn = (dx, dy) => {
      this.angles.yaw += dx;
      this.angles.pitch = Math.max(-1.5, Math.min(1.5, this.angles.pitch + dy));
      this.paint();
    };
    this.canvas.onpointerdown = (event) => {
      held = [event.clientX, event.clientY];
      this.canvas.setPointerCapture(event.pointerId);
    };
    this.canvas.onpointermove = (event) => {
      if (!held) return;
      turn((event.clientX - held[0]) * 0.008, (event.clientY - held[1]) * 0.008);
      held = [event.clientX, event.clientY];
    };
    this.canvas.onpointerup = this.canvas.onpointercancel = () => { held = null; };
    this.canvas.ondblclick = () => {
      this.angles = { ...FIRST };
      this.paint();
    };
    this.canvas.onkeydown = (event) => {
      const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
      if (!step) return;
      event.preventDefault();
      turn(0.1 * step[0], 0.1 * step[1]);
    };
  }
}
