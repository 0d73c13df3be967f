// The sensor in three dimensions, with the touch map on its upper face. Its points come bent and
// pressed from the server, which knows the geometry; here they are only lit, seen and pointed at.
import { LIGHT, bytes, diverging, palette } from "./colours.js";

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
uniform float signed; // 1 for a picture whose middle level is no change
uniform vec3 gel;
in vec3 seen, facing;
in vec2 at;
in float material;
out vec4 colour;
void main() {
  vec3 n = normalize(facing), toEye = normalize(-seen);
  if (dot(n, toEye) < 0.0) n = -n;
  vec3 light = normalize(vec3(-0.45, 0.7, 0.6));
  vec3 base = gel;
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
    float shown = mix(level, 2.0 * abs(level - 0.5), signed);
    base = mix(base, 0.72 * touched, 0.75 * smoothstep(0.04, 0.5, shown));
  }
  float lit = 0.30 + 0.70 * max(dot(n, light), 0.0) + 0.42 * max(dot(n, toEye), 0.0);
  float shine = pow(max(dot(reflect(-light, n), toEye), 0.0), 24.0);
  float rim = pow(1.0 - max(dot(n, toEye), 0.0), 3.0);
  colour = covers * vec4(base * lit + gloss * shine + 0.10 * rim, 1.0);
}`;

const FIELD = 26 * Math.PI / 180;
const FIRST = { yaw: -0.16, pitch: 0.95 }, ABOVE = { yaw: 0, pitch: Math.PI / 2 };
const LIFT = 0.0013; // of electrodes over the side that they are on, and
const AWAY = 0.04; // of their numbers, in lengths of the sensor's longer side
const MARGIN = 1.0; // around the sensor
const SAG = 0.10; // height that a bend takes, in lengths of the sensor
const SOFTWARE = 0.75; // pixels for each of the screen's where the processor has to draw them
const SAME = 64; // of 255 levels of the touch map
const FACE = 1, METAL = 2; // the gel is 0, where the touch map lies 1, what is inside 3
const CELLS = 24; // of the search for a place, along each side

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

export class Solid {
  // `painted()` is called after each picture, for what is drawn over it.
  constructor(canvas, sensor, painted) {
    Object.assign(this, { canvas, sensor, painted });
    const slow = software();
    this.gl = canvas.getContext("webgl2", { antialias: !slow, alpha: true });
    if (!this.gl) return;
    this.angles = { ...FIRST };
    this.drawn = "";
    this.levels = [];
    this.size = Math.max(sensor.length, sensor.width);
    this.mesh = this.decoded(sensor.shape);
    this.prepare();
    this.sort();
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
    this.colour(false);
    gl.uniform3fv(this.uniform("gel"), LIGHT ? [0.34, 0.46, 0.58] : [0.17, 0.25, 0.34]);
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

  // Colours of the touch map, or of a picture whose middle is no change.
  colour(signed) {
    const gl = this.gl, colours = new Uint8Array(signed ? diverging : palette);
    this.signed = signed;
    gl.activeTexture(gl.TEXTURE1);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, 256, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, colours);
    gl.uniform1f(this.uniform("signed"), signed ? 1 : 0);
  }

  show({ points }, map, signed) {
    const levels = map ? bytes(map.data) : new Uint8Array(1);
    const still = points === this.drawn, same = alike(levels, this.levels) && signed === this.signed;
    if (signed !== this.signed) this.colour(signed);
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
    Object.assign(this, { view, projection });
    this.painted();
  }

  // Extent of the sensor as it is first seen, across, upwards and away [m].
  extent(across, upwards, away = 0) {
    const { length, width, thickness } = this.sensor;
    const [c, s] = [Math.cos(FIRST.yaw), Math.abs(Math.sin(FIRST.yaw))];
    const deep = length * s + width * c, rise = Math.cos(FIRST.pitch), back = Math.sin(FIRST.pitch);
    return across * (length * c + width * s) + upwards * (back * deep + rise * (thickness + SAG * length)) + away * rise * deep;
  }

  // --- between places on the flat sensor and pixels ---

  // Pixel of a point (x, y, z), and how far it is away.
  pixel(x, y, z) {
    const see = (row) => this.view[row] * x + this.view[4 + row] * y + this.view[8 + row] * z + this.view[12 + row];
    const deep = -see(2), [across, , , , , up] = this.projection;
    return [(0.5 + 0.5 * across * see(0) / deep) * this.width, (0.5 - 0.5 * up * see(1) / deep) * this.height, deep];
  }

  // Triangles of the upper face by the cells of the flat sensor that they reach.
  sort() {
    const { flat, vertices, kinds, faces } = this.mesh, { shape: { unit } } = this.sensor;
    this.cells = new Map();
    for (let i = 0; i < faces.length; i += 3) {
      const corners = [0, 1, 2].map((k) => faces[i + k]);
      if (corners.some((v) => kinds[v] !== FACE)) continue;
      const at = corners.map((v) => [0, 1].map((axis) => flat[3 * vertices[v] + axis] * unit));
      const reach = (axis) => [Math.min, Math.max].map((f) => this.cell(axis, f(...at.map((p) => p[axis]))));
      const [[x0, x1], [y0, y1]] = [reach(0), reach(1)];
      for (let x = x0; x <= x1; x++) {
        for (let y = y0; y <= y1; y++) {
          if (!this.cells.has(CELLS * x + y)) this.cells.set(CELLS * x + y, []);
          this.cells.get(CELLS * x + y).push({ corners, at });
        }
      }
    }
  }

  cell(axis, value) {
    const share = value / (axis ? this.sensor.width : this.sensor.length);
    return Math.min(CELLS - 1, Math.max(0, Math.floor(CELLS * share)));
  }

  // Pixel of a place [m]; null where the upper face is not.
  project(x, y) {
    if (!this.view) return null;
    const [x0, y0] = this.sensor.origin, place = [x - x0, y - y0];
    for (const { corners, at } of this.cells.get(CELLS * this.cell(0, place[0]) + this.cell(1, place[1])) || []) {
      const shares = within(place, at);
      if (!shares) continue;
      const along = (axis) => corners.reduce((sum, v, k) => sum + shares[k] * this.positions[3 * v + axis], 0);
      return this.pixel(along(0), along(1), along(2));
    }
    return null;
  }

  // The place [m] that a pixel shows; null beside the upper face.
  locate(px, py) {
    if (!this.view) return null;
    const { faces, kinds, flat, vertices } = this.mesh, p = this.positions, { origin, shape: { unit } } = this.sensor;
    const seen = Array.from(vertices, (_, v) => this.pixel(p[3 * v], p[3 * v + 1], p[3 * v + 2]));
    let nearest = Infinity, found = null;
    for (let i = 0; i < faces.length; i += 3) {
      const corners = [0, 1, 2].map((k) => faces[i + k]), shares = within([px, py], corners.map((v) => seen[v]));
      if (!shares || kinds[corners[0]] >= METAL) continue;
      const deep = shares.reduce((sum, share, k) => sum + share * seen[corners[k]][2], 0);
      if (deep >= nearest) continue;
      nearest = deep;
      const at = (axis) => corners.reduce((sum, v, k) => sum + shares[k] * flat[3 * vertices[v] + axis] * unit, origin[axis]);
      found = kinds[corners[0]] === FACE ? { x: at(0), y: at(1) } : null;
    }
    return found;
  }

  // Pixel of each electrode's number, a little outside it, and whether it is behind.
  *electrodes() {
    if (!this.view) return;
    for (const [first, count] of this.mesh.electrodes) {
      const mean = (values, axis) => {
        let sum = 0;
        for (let k = first; k < first + count; k++) sum += values[3 * k + axis] / count;
        return sum;
      };
      const n = [0, 1, 2].map((axis) => mean(this.normals, axis));
      const [px, py] = this.pixel(...n.map((value, axis) => mean(this.positions, axis) + AWAY * this.size * value));
      yield [px, py, this.view[2] * n[0] + this.view[6] * n[1] + this.view[10] * n[2] < 0];
    }
  }

  turn(dx, dy) {
    this.angles.yaw += dx;
    this.angles.pitch = Math.max(-1.5, Math.min(Math.PI / 2, this.angles.pitch + dy));
    this.paint();
  }

  // As it is first seen, or from above.
  reset(above = false) {
    this.angles = { ...(above ? ABOVE : FIRST) };
    this.paint();
  }
}

// Shares of a triangle's corners at a point, three; null outside it.
function within([x, y], [[ax, ay], [bx, by], [cx, cy]]) {
  const size = (by - cy) * (ax - cx) + (cx - bx) * (ay - cy);
  const a = ((by - cy) * (x - cx) + (cx - bx) * (y - cy)) / size, b = ((cy - ay) * (x - cx) + (ax - cx) * (y - cy)) / size;
  return Math.min(a, b, 1 - a - b) >= -1e-6 ? [a, b, 1 - a - b] : null;
}
