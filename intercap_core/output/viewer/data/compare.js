"use strict";
/* Colours of the viewer (viewer.js) by contact and by the distance between two results, the marks under the
 * slider, and the measurement of distances. */
const TOUCHING = [0.86, 0.2, 0.26];
const STATED = [[0.97, 0.84, 0.62], [0.93, 0.5, 0.06]]; // colours of probabilities 0.5 and 1
const DISTANCES = [[0.87, 0.88, 0.9], [0.95, 0.55, 0.1], [0.45, 0, 0.1]]; // colours of 0, half and the largest

/* Whether the body touches the object, or a region has a probability of contact from 0.5, by frame. */
function contactFrames({ frames }, arrays) {
  const bytes = arrays["contact/touching"] ?? arrays["contact/probability"]?.map((share) => share >= 128);
  const width = (bytes?.length ?? 0) / frames;
  return Array.from({ length: frames }, (_, t) => Boolean(bytes?.subarray(t * width, (t + 1) * width).some(Boolean)));
}

/* Colour the vertices that touch the object, and regions with a probability of contact from 0.5. */
function paintContact(mesh, frame, header, arrays, base, on) {
  const colours = mesh.geometry.attributes.color;
  const touching = on ? arrays["contact/touching"] : null;
  const width = touching ? touching.length / header.frames : 0;
  const region = on ? arrays["contact/region"] : null;
  const count = header.regions?.length ?? 0;
  for (let v = 0; v < colours.count; v += 1) {
    let colour = base;
    if (touching && (touching[frame * width + (v >> 3)] >> (v & 7)) & 1) colour = TOUCHING;
    else if (region && region[v] < 255) {
      const share = arrays["contact/probability"][frame * count + region[v]] / 255;
      if (share >= 0.5) colour = STATED[0].map((pale, k) => pale + (2 * share - 1) * (STATED[1][k] - pale));
    }
    colours.setXYZ(v, ...colour);
  }
  colours.needsUpdate = true;
}

/* Colour body and object of a version by the distances of their vertices to those of another version; returns
 * the scale and the mean in words. The end of the scale is 1, 2 or 5 times a power of ten. */
function paintDistances(shown, other) {
  const pairs = [[shown.mesh, other.mesh], [shown.object?.mesh, other.object?.mesh]].filter(([a, b]) => a?.visible && b?.visible);
  const known = pairs.map(([mesh, to]) => ({ mesh, distances: vertexDistances(mesh, to) })).filter(({ distances }) => distances);
  const all = known.flatMap(({ distances }) => [...distances]);
  const most = all.reduce((a, b) => Math.max(a, b), 1e-4), ten = 10 ** Math.floor(Math.log10(most));
  const largest = ten * [1, 2, 5, 10].find((step) => most <= step * ten);
  for (const { mesh, distances } of known) {
    const colours = mesh.geometry.attributes.color;
    distances.forEach((distance, v) => {
      const at = (2 * distance) / largest, k = at < 1 ? 0 : 1;
      colours.setXYZ(v, ...DISTANCES[k].map((low, i) => low + (at - k) * (DISTANCES[k + 1][i] - low)));
    });
    colours.needsUpdate = true;
  }
  const mm = (metres) => Number((1000 * metres).toPrecision(2));
  return `0 to ${mm(largest)} mm; mean ${mm(all.reduce((sum, distance) => sum + distance, 0) / all.length)} mm`;
}

/* Distances between the vertices of two posed meshes, metres; null if they are different meshes. */
function vertexDistances(a, b) {
  const [p, q] = [a, b].map((mesh) => mesh.geometry.attributes.position);
  if (p.count !== q.count) return null;
  const [u, v] = [new THREE.Vector3(), new THREE.Vector3()];
  return Float32Array.from({ length: p.count }, (_, i) =>
    u.fromBufferAttribute(p, i).applyMatrix4(a.matrix).distanceTo(v.fromBufferAttribute(q, i).applyMatrix4(b.matrix)));
}

/* Marks under the slider: frames with an unreliable body are red, those with other flags are pale red,
 * contact is blue. */
function paintMarks(canvas, header, contact) {
  Object.assign(canvas, { width: header.frames, height: 2 });
  const brush = canvas.getContext("2d");
  brush.fillStyle = "#2f6fdb";
  contact.forEach((touches, t) => { if (touches) brush.fillRect(t, 1, 1, 1); });
  for (const [t, , ofBody] of header.flags) {
    brush.fillStyle = ofBody ? "#d2383f" : "#eeb0b3";
    brush.fillRect(t, 0, 1, 1);
  }
}

/* The distance of two points that the user clicks. Points of a mesh move with it. */
class Measurement {
  constructor(scene, text) {
    this.on = false;
    this.text = text; // element that shows the distance
    this.points = []; // of each point a function that returns its position
    const shape = new THREE.BufferGeometry(), draws = { color: 0x8e24aa, depthTest: false, transparent: true };
    this.parts = [new THREE.LineSegments(shape, new THREE.LineBasicMaterial(draws)),
      new THREE.Points(shape, new THREE.PointsMaterial({ ...draws, size: 9, sizeAttenuation: false }))];
    for (const part of this.parts) {
      part.frustumCulled = false;
      part.renderOrder = 2;
      scene.add(part);
    }
    this.update();
  }

  toggle(on) {
    this.on = on;
    this.points = [];
    this.update();
  }

  /* Add the point in which a ray hits a mesh or the floor z = 0; a third point begins a new measurement. */
  click(ray, meshes, hasFloor) {
    for (const { geometry } of meshes) {
      geometry.computeBoundingBox();
      geometry.computeBoundingSphere();
    }
    const hit = ray.intersectObjects(meshes, false)[0];
    const { origin, direction } = ray.ray, far = -origin.z / direction.z;
    let point = null;
    if (hit) {
      const { a, b, c } = hit.face, { x, y, z } = hit.barycoord, { object: mesh } = hit, place = mesh.geometry.attributes.position;
      point = () => [[a, x], [b, y], [c, z]].reduce((sum, [vertex, weight]) =>
        sum.addScaledVector(new THREE.Vector3().fromBufferAttribute(place, vertex), weight), new THREE.Vector3()).applyMatrix4(mesh.matrix);
    } else if (hasFloor && far > 0) {
      const at = origin.clone().addScaledVector(direction, far);
      point = () => at;
    }
    if (point) this.points = this.points.length === 2 ? [point] : [...this.points, point];
    this.update(!point);
  }

  /* Update line and text after the meshes moved. */
  update(missed = false) {
    const at = this.points.map((point) => point());
    this.metres = at.length === 2 ? at[0].distanceTo(at[1]) : null;
    const values = new Float32Array(at.flatMap((point) => point.toArray()));
    this.parts[0].geometry.setAttribute("position", new THREE.BufferAttribute(values, 3));
    for (const part of this.parts) part.visible = values.length > 0;
    const next = missed ? "nothing is there: click on a mesh" : ["click the first point", "click the second point"][at.length];
    this.text.textContent = !this.on ? "" : this.metres === null ? next : `distance: ${this.metres.toFixed(3)} m`;
  }
}
