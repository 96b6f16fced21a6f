/* Body and object rendered through each camera's lens. All views share one WebGL canvas, from which
 * each view copies its part. */
import { columnMajor } from "./geometry.js";

const CELLS_M = [0.01, 0.02, 0.04]; // cell sizes of the simplified meshes
const COARSE_PX = 4; // largest size of a cell in a view

// The vertex shader projects as `project` in geometry.js: `lens` are the 13 numbers of a lens, `crop` the
// shown part of the image (x, y, width, height in pixels). Depths of 0.05 to 20 m fill the depth buffer.
// The fragment shader lights each face by its angle to the viewing direction.
const VERTEX = `#version 300 es
in vec3 place; in vec3 colour;
uniform mat4 master_from_mesh, camera_from_master;
uniform float lens[13]; uniform vec4 crop;
out vec3 seen; out vec3 paint;
void main() {
  vec4 p = camera_from_master * (master_from_mesh * vec4(place, 1.0));
  float z = max(p.z, 1e-3);
  vec2 q = p.xy / z;
  float stretch = max(1.0, length(q) / lens[12]);
  q /= stretch;
  float s = dot(q, q);
  float d = (1.0 + s * (lens[4] + s * (lens[5] + s * lens[8]))) / (1.0 + s * (lens[9] + s * (lens[10] + s * lens[11])));
  vec2 bent = q * d + vec2(
    2.0 * lens[6] * q.x * q.y + lens[7] * (s + 2.0 * q.x * q.x),
    lens[6] * (s + 2.0 * q.y * q.y) + 2.0 * lens[7] * q.x * q.y);
  vec2 pixel = vec2(lens[0], lens[1]) * bent * stretch + vec2(lens[2], lens[3]) + 0.5;
  vec2 at = 2.0 * (pixel - crop.xy) / crop.zw - 1.0;
  seen = p.xyz;
  paint = colour;
  gl_Position = p.z < 0.05 ? vec4(2.0, 2.0, 2.0, 1.0) : vec4(at.x, -at.y, clamp(2.0 * (z - 0.05) / 20.0 - 1.0, -1.0, 1.0), 1.0);
}`;
const FRAGMENT = `#version 300 es
precision highp float;
in vec3 seen; in vec3 paint;
out vec4 shown;
void main() {
  vec3 across = cross(dFdx(seen), dFdy(seen));
  float light = 0.42 + 0.58 * abs(across.z) / max(length(across), 1e-12);
  shown = vec4(paint * light, 1.0);
}`;

export class Overlay {
  constructor() {
    this.canvas = document.createElement("canvas");
    const gl = this.canvas.getContext("webgl2", { antialias: false, alpha: true, premultipliedAlpha: true, powerPreference: "high-performance" });
    if (!gl) throw new Error("this browser cannot draw in 3D (WebGL is disabled or missing)");
    this.gl = gl;
    this.program = link(gl);
    this.at = {};
    for (const name of ["master_from_mesh", "camera_from_master", "lens", "crop"]) {
      this.at[name] = gl.getUniformLocation(this.program, name);
    }
    this.meshes = new Map();
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.SCISSOR_TEST);
  }

  /* Add a mesh with one colour (3,), which `move` can replace by a colour per vertex. If the vertices of
   * a rest pose (metres) are given, simplified meshes are made for views that show the mesh small. */
  mesh(name, faces, colour, rest = null) {
    const gl = this.gl;
    const mesh = { colour, vao: gl.createVertexArray(), place: gl.createBuffer(), paint: null, levels: [] };
    gl.bindVertexArray(mesh.vao);
    gl.bindBuffer(gl.ARRAY_BUFFER, mesh.place);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 0, 0);
    gl.bindVertexArray(null);
    for (const cell of rest ? [0, ...CELLS_M] : [0]) {
      const kept = cell ? simplify(faces, rest, cell) : faces;
      const buffer = gl.createBuffer();
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, buffer);
      gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, kept, gl.STATIC_DRAW);
      mesh.levels.push({ cell, buffer, count: kept.length });
    }
    this.meshes.set(name, mesh);
  }

  /* Set the positions (3 V numbers, metres) and, if given, the colours of a mesh's vertices. */
  move(name, places, colours = null) {
    const gl = this.gl, mesh = this.meshes.get(name);
    gl.bindBuffer(gl.ARRAY_BUFFER, mesh.place);
    gl.bufferData(gl.ARRAY_BUFFER, places, gl.DYNAMIC_DRAW);
    if (!colours) return;
    gl.bindVertexArray(mesh.vao);
    mesh.paint ??= gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, mesh.paint);
    gl.bufferData(gl.ARRAY_BUFFER, colours, gl.DYNAMIC_DRAW);
    gl.enableVertexAttribArray(1);
    gl.vertexAttribPointer(1, 3, gl.FLOAT, false, 0, 0);
    gl.bindVertexArray(null);
  }

  /* Draw `drawables` ({ name, pose: master_from_mesh }) for `views` ({ camera, crop, width, height }).
   * Sets view.part, the rectangle of each view on this.canvas. */
  draw(views, drawables) {
    const gl = this.gl;
    let top = 0, width = 1;
    for (const view of views) {
      view.part = [0, top, view.width, view.height];
      top += view.height;
      width = Math.max(width, view.width);
    }
    if (this.canvas.width < width || this.canvas.height < top || this.canvas.width > 2 * width) {
      this.canvas.width = width;
      this.canvas.height = Math.max(1, top);
    }
    gl.useProgram(this.program);
    gl.scissor(0, 0, this.canvas.width, this.canvas.height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    for (const drawable of drawables) drawable.matrix = columnMajor(drawable.pose);
    for (const view of views) {
      if (!view.camera.pose) continue;
      const [x, y, w, h] = view.part;
      const bottom = this.canvas.height - y - h;
      gl.viewport(x, bottom, w, h);
      gl.scissor(x, bottom, w, h);
      gl.uniformMatrix4fv(this.at.camera_from_master, false, columnMajor(view.camera.pose));
      gl.uniform1fv(this.at.lens, view.camera.lens);
      gl.uniform4fv(this.at.crop, view.crop);
      for (const { name, matrix, colour } of drawables) {
        const mesh = this.meshes.get(name), level = levelFor(mesh, view, matrix);
        gl.bindVertexArray(mesh.vao);
        gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, level.buffer);
        if (!mesh.paint) gl.vertexAttrib3f(1, ...(colour ?? mesh.colour));
        gl.uniformMatrix4fv(this.at.master_from_mesh, false, matrix);
        gl.drawElements(gl.TRIANGLES, level.count, gl.UNSIGNED_INT, 0);
      }
    }
    gl.bindVertexArray(null);
  }
}

/* The coarsest level whose cells are at most COARSE_PX large in a view. */
function levelFor(mesh, view, matrix) {
  const [, , ahead] = view.camera.pose;
  const depth = Math.max(0.5, ahead[0] * matrix[12] + ahead[1] * matrix[13] + ahead[2] * matrix[14] + ahead[3]);
  const pixels = (view.camera.lens[0] / depth) * (view.width / view.crop[2]); // pixels per metre
  return mesh.levels.findLast((level) => level.cell * pixels <= COARSE_PX) ?? mesh.levels[0];
}

/* Simplify a mesh by vertex clustering: merge the vertices of each grid cell, drop collapsed faces. */
function simplify(faces, rest, cell) {
  const first = new Map(), merged = new Uint32Array(rest.length / 3);
  for (let v = 0; v < merged.length; v += 1) {
    const key = [0, 1, 2].map((k) => Math.floor(rest[3 * v + k] / cell)).join();
    if (!first.has(key)) first.set(key, v);
    merged[v] = first.get(key);
  }
  const kept = [];
  for (let f = 0; f < faces.length; f += 3) {
    const [a, b, c] = [merged[faces[f]], merged[faces[f + 1]], merged[faces[f + 2]]];
    if (a !== b && b !== c && c !== a) kept.push(a, b, c);
  }
  return new Uint32Array(kept);
}

function link(gl) {
  const program = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(program, shader);
  }
  gl.bindAttribLocation(program, 0, "place");
  gl.bindAttribLocation(program, 1, "colour");
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
  return program;
}
