/* Rigid transforms, stored as the three rows of a 3x4 matrix, rotation vectors, and the lens model of
 * intercap_core/geometry/camera/projection.py. A lens is the array fx, fy, cx, cy, k1, k2, p1, p2, k3, k4,
 * k5, k6 (OpenCV), and the largest sqrt(x^2 + y^2) at z = 1 at which the model is valid. */
export const IDENTITY = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]];

export const compose = (a, b) => a.map((row) => [0, 1, 2, 3].map((k) =>
  row[0] * b[0][k] + row[1] * b[1][k] + row[2] * b[2][k] + (k === 3 ? row[3] : 0)));

export const invert = (a) => [0, 1, 2].map((k) => [
  a[0][k], a[1][k], a[2][k], -(a[0][k] * a[0][3] + a[1][k] * a[1][3] + a[2][k] * a[2][3])]);

export const apply = (a, [x, y, z]) => a.map((row) => row[0] * x + row[1] * y + row[2] * z + row[3]);

export const rotate = (a, [x, y, z]) => a.map((row) => row[0] * x + row[1] * y + row[2] * z);

export const norm = (v) => Math.hypot(...v);

/* The 4x4 matrix in WebGL's order. */
export const columnMajor = (a) => new Float32Array([
  a[0][0], a[1][0], a[2][0], 0, a[0][1], a[1][1], a[2][1], 0, a[0][2], a[1][2], a[2][2], 0, a[0][3], a[1][3], a[2][3], 1]);

/* A transform from 12 numbers in row-major order. */
export const rows = (flat) => [flat.slice(0, 4), flat.slice(4, 8), flat.slice(8, 12)].map((row) => [...row]);

/* Transform of a rotation vector (axis times angle) and a translation. */
export function rigid(vector, translation) {
  const angle = norm(vector);
  const [x, y, z] = angle > 1e-12 ? vector.map((v) => v / angle) : [0, 0, 0];
  const [c, s] = [Math.cos(angle), Math.sin(angle)];
  const d = 1 - c;
  return [
    [c + x * x * d, x * y * d - z * s, x * z * d + y * s, translation[0]],
    [y * x * d + z * s, c + y * y * d, y * z * d - x * s, translation[1]],
    [z * x * d - y * s, z * y * d + x * s, c + z * z * d, translation[2]],
  ];
}

/* Rotation vector of a transform, radians. */
export function rotationVector(a) {
  const trace = a[0][0] + a[1][1] + a[2][2];
  const angle = Math.acos(Math.max(-1, Math.min(1, (trace - 1) / 2)));
  const off = [a[2][1] - a[1][2], a[0][2] - a[2][0], a[1][0] - a[0][1]];
  if (angle < 1e-7) return off.map((v) => v / 2);
  if (Math.PI - angle > 1e-4) return off.map((v) => (v * angle) / (2 * Math.sin(angle)));
  // near half a turn, the axis is in the symmetric part of the matrix
  const k = [0, 1, 2].reduce((best, i) => (a[i][i] > a[best][best] ? i : best), 0);
  const axis = [0, 1, 2].map((i) => (a[i][k] + a[k][i]) / 2 + (i === k ? 1 : 0));
  const length = norm(axis);
  const sign = axis.reduce((sum, v, i) => sum + v * off[i], 0) < 0 ? -1 : 1;
  return axis.map((v) => (sign * v * angle) / length);
}

/* Rotate a pose by a rotation vector about a point; both are in the pose's outer frame. */
export function rotateAbout(pose, vector, point) {
  const turn = rigid(vector, [0, 0, 0]);
  const shift = rotate(turn, point).map((v, i) => point[i] - v);
  return compose(turn.map((row, i) => [row[0], row[1], row[2], shift[i]]), pose);
}

/* Project a point of the camera's frame, metres: [x, y in pixels, depth]. Beyond the valid radius, the
 * distortion at the radius is used. */
export function project(lens, [px, py, pz]) {
  const [fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6, limit] = lens;
  const depth = Math.max(pz, 1e-3);
  let [x, y] = [px / depth, py / depth];
  const stretch = Math.max(1, Math.hypot(x, y) / limit);
  x /= stretch;
  y /= stretch;
  const s = x * x + y * y;
  const d = (1 + s * (k1 + s * (k2 + s * k3))) / (1 + s * (k4 + s * (k5 + s * k6)));
  const u = (x * d + 2 * p1 * x * y + p2 * (s + 2 * x * x)) * stretch;
  const v = (y * d + p1 * (s + 2 * y * y) + 2 * p2 * x * y) * stretch;
  return [fx * u + cx, fy * v + cy, pz];
}
