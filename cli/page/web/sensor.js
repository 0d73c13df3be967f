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
  float gloss = 0.30, covers = 1.0;
  if (material > 1.5) {
    base = vec3(0.82, 0.64, 0.36);
    gloss = 0.6;
    if (material > 2.5) covers = 0.4;
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
  colour = covers * vec4(base * lit + gloss * shine + 0.10 * rim, 1.0);
}`;

const FIELD = 26 * Math.PI / 180;
const FIRST = { yaw: -0.42, pitch: 0.62 };
const LIFT = 0.0013; // of electrodes over the side that they are on, and
const AWAY = 0.04; // of their numbers, in lengths of the sensor's longer side
const MARGIN = 1.04; // around the sensor
const SAG = 0.12; // height that a bend takes, in lengths of the sensor
const SOFTWARE = 0.75; // pixels for each of the screen's where the processor has to draw them
const SAME = 64; // of 255 levels of the touch map
const METAL = 2; // and above; the gel is 0, where the touch map lies 1, what is inside 3

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
        : "The 3D view needs the sensor’s design, which these positions were learned without.";
      note.hidden = false;
      canvas.hidden = true;
      return;
    }
    this.gl = gl;
    this.angles = { ...FIRST };
    this.drawn = "";
    this.levels = [];
    this.size = Math.max(sensor.length, sensor.width);
    this.mesh = this.decoded(sensor.shape);
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

  // Triangles between vertices, each at one of the points that the server sends.
  decoded({ points, vertices, kinds, faces, electrodes, opaque }) {
    const numbers = (text, Kind) => new Kind(bytes(text).buffer);
    return {
      flat: numbers(points, Int16Array), vertices: numbers(vertices, Uint16Array), kinds: bytes(kinds),
      faces: numbers(faces, Uint16Array), opaque: 3 * opaque, electrodes,
    };
  }

  prepare() {
    const gl = this.gl, { flat, vertices, kinds, faces } = this.mesh, { length, width, shape, grid } = this.sensor;
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

    const places = new Float32Array(2 * vertices.length);
    vertices.forEach((point, i) => {
      places[2 * i] = flat[3 * point] * shape.unit / length;
      places[2 * i + 1] = flat[3 * point + 1] * shape.unit / width;
    });
    this.positions = new Float32Array(3 * vertices.length);
    this.normals = new Float32Array(3 * vertices.length);

    const attribute = (name, size, data, usage) => {
      const buffer = gl.createBuffer(), where = gl.getAttribLocation(program, name);
      gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
      gl.bufferData(gl.ARRAY_BUFFER, data, usage);
      gl.enableVertexAttribArray(where);
      gl.vertexAttribPointer(where, size, gl.FLOAT, false, 0, 0);
      return buffer;
    };
    attribute("kind", 1, new Float32Array(kinds), gl.STATIC_DRAW);
    attribute("flat_place", 2, places, gl.STATIC_DRAW);
    this.placeBuffer = attribute("place", 3, this.positions, gl.DYNAMIC_DRAW);
    this.normalBuffer = attribute("normal", 3, this.normals, gl.DYNAMIC_DRAW);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, faces, gl.STATIC_DRAW);

    this.mapTexture = this.texture(0, "map");
    this.level(1, 1, new Uint8Array(1));
    this.texture(1, "colours");
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, 256, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(palette));
    gl.uniform2f(this.uniform("lines"), length / grid, width / grid);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
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
    const { length, width, shape: { unit } } = this.sensor, { vertices } = this.mesh, p = this.positions;
    let low = Infinity, high = -Infinity;
    for (let i = 2; i < steps.length; i += 3) {
      low = Math.min(low, steps[i]);
      high = Math.max(high, steps[i]);
    }
    const middle = [length / 2, width / 2, (low + high) / 2 * unit];
    for (let i = 0; i < vertices.length; i++) {
      for (let axis = 0; axis < 3; axis++) p[3 * i + axis] = steps[3 * vertices[i] + axis] * unit - middle[axis];
    }
    this.face();
    const gl = this.gl;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.placeBuffer);
    gl.bufferSubData(gl.ARRAY_BUFFER, 0, this.positions);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.normalBuffer);
    gl.bufferSubData(gl.ARRAY_BUFFER, 0, this.normals);
  }

  // Normals: means of the triangles around each vertex, larger ones counting more.
  face() {
    const p = this.positions, n = this.normals, { faces, kinds } = this.mesh;
    n.fill(0);
    for (let i = 0; i < faces.length; i += 3) {
      const a = 3 * faces[i], b = 3 * faces[i + 1], c = 3 * faces[i + 2];
      const ux = p[b] - p[a], uy = p[b + 1] - p[a + 1], uz = p[b + 2] - p[a + 2];
      const vx = p[c] - p[a], vy = p[c + 1] - p[a + 1], vz = p[c + 2] - p[a + 2];
      const x = uy * vz - uz * vy, y = uz * vx - ux * vz, z = ux * vy - uy * vx;
      for (const to of [a, b, c]) { n[to] += x; n[to + 1] += y; n[to + 2] += z; }
    }
    for (let i = 0; i < n.length; i += 3) {
      const size = Math.hypot(n[i], n[i + 1], n[i + 2]) || 1, lift = kinds[i / 3] === METAL ? LIFT * this.size : 0;
      for (let axis = i; axis < i + 3; axis++) {
        n[axis] /= size;
        p[axis] += lift * n[axis];
      }
    }
  }

  paint() {
    if (!this.drawn || !this.width) return;
    const gl = this.gl, { yaw, pitch } = this.angles;
    const aspect = this.width / this.height, { length, width, thickness } = this.sensor;
    const radius = 0.53 * Math.hypot(length, width, thickness), slope = Math.tan(FIELD / 2);
    const across = this.extent(1, 0) / aspect, upwards = this.extent(0, 1);
    const far = MARGIN * Math.max(across, upwards) / 2 / slope + 0.4 * this.extent(0, 0, 1);
    const f = 1 / slope, [near, end] = [Math.max(far - 2 * radius, 0.01 * far), far + 2 * radius];
    const depth = [(end + near) / (near - end), 2 * end * near / (near - end)];
    const projection = [f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, depth[0], -1, 0, 0, depth[1], 0];
    const [cy, sy, cp, sp] = [Math.cos(yaw), Math.sin(yaw), Math.cos(pitch), Math.sin(pitch)];
    // About z by yaw, then about the screen's x; the camera looks down its own -z.
    const view = [cy, sp * sy, -cp * sy, 0, -sy, sp * cy, -cp * cy, 0, 0, cp, sp, 0, 0, 0, -far, 1];
    gl.viewport(0, 0, this.canvas.width, this.canvas.height);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.uniformMatrix4fv(this.uniform("projection"), false, projection);
    gl.uniformMatrix4fv(this.uniform("view"), false, view);
    const { faces, opaque } = this.mesh;
    gl.enable(gl.DEPTH_TEST);
    gl.drawElements(gl.TRIANGLES, opaque, gl.UNSIGNED_SHORT, 0);
    if (opaque < faces.length) { // electrodes inside shine through
      gl.disable(gl.DEPTH_TEST);
      gl.enable(gl.BLEND);
      gl.drawElements(gl.TRIANGLES, faces.length - opaque, gl.UNSIGNED_SHORT, 2 * opaque);
      gl.disable(gl.BLEND);
    }
    this.number(view, projection);
  }

  // Extent of the sensor as it is first seen, across, upwards and away [m].
  extent(across, upwards, away = 0) {
    const { length, width, thickness } = this.sensor;
    const [c, s] = [Math.cos(FIRST.yaw), Math.abs(Math.sin(FIRST.yaw))];
    const deep = length * s + width * c, rise = Math.cos(FIRST.pitch), back = Math.sin(FIRST.pitch);
    return across * (length * c + width * s) + upwards * (back * deep + rise * (thickness + SAG * length)) + away * rise * deep;
  }

  // Each electrode's number, a little outside it; faint where it is behind.
  number(m, projection) {
    this.spans.forEach((span, i) => {
      const [first, count] = this.mesh.electrodes[i];
      const mean = (values, axis) => {
        let sum = 0;
        for (let k = first; k < first + count; k++) sum += values[3 * k + axis] / count;
        return sum;
      };
      const n = [0, 1, 2].map((axis) => mean(this.normals, axis));
      const [x, y, z] = [0, 1, 2].map((axis) => mean(this.positions, axis) + AWAY * this.size * n[axis]);
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
