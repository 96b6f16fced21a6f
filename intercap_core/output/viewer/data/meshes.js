"use strict";
/* Data and meshes of the viewer (viewer.js): bodies and objects of each version, clouds, cameras. */
const COLOURS = { joint: [0.42, 0.66, 0.92], sequential: [0.66, 0.6, 0.78], truth: [0.45, 0.74, 0.5] }; // by version

/* Header and arrays by name from the bytes of which `payload` in viewer/page.py makes a text. */
async function unpack(blob) {
  const stream = blob.stream().pipeThrough(new DecompressionStream("deflate"));
  const whole = await new Response(stream).arrayBuffer();
  const length = new DataView(whole).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(whole, 4, length)));
  const TYPES = {
    float32: Float32Array, uint32: Uint32Array, uint16: Uint16Array, int16: Int16Array, uint8: Uint8Array,
  };
  const arrays = {};
  for (const [name, { type, shape, offset }] of Object.entries(header.arrays)) {
    arrays[name] = new TYPES[type](whole, 4 + length + offset, shape.reduce((a, b) => a * b, 1));
  }
  return { header, arrays };
}

/* A mesh of `count` vertices, all with one colour; their positions are set later. */
function meshOf(count, faces, colour) {
  const geometry = new THREE.BufferGeometry();
  const place = new THREE.BufferAttribute(new Float32Array(3 * count), 3).setUsage(THREE.DynamicDrawUsage);
  geometry.setAttribute("position", place);
  const colours = new Float32Array(3 * count);
  for (let i = 0; i < colours.length; i += 1) colours[i] = colour[i % 3];
  geometry.setAttribute("color", new THREE.BufferAttribute(colours, 3));
  geometry.setIndex(new THREE.BufferAttribute(faces, 1));
  const mesh = new THREE.Mesh(
    geometry, new THREE.MeshLambertMaterial({ vertexColors: true, side: THREE.DoubleSide }));
  mesh.frustumCulled = false;
  return mesh;
}

function centreOf(mesh) {
  return () => {
    mesh.geometry.computeBoundingBox();
    return mesh.geometry.boundingBox.getCenter(new THREE.Vector3());
  };
}

/* Linear blend skinning with modes of the residual, see SkinnedBody in
 * intercap_core/output/viewer/skinning.py. `transforms` holds 12 numbers (3x4, row by row) per joint. */
function skinnedBody(name, header, arrays) {
  const [rest, joints, weights, transforms, modes, amounts] = [
    "rest", "joints", "weights", "transforms", "modes", "amounts",
  ].map((key) => arrays[`${name}/${key}`]);
  const count = rest.length / 3;
  const kept = amounts.length / header.frames;
  const skeleton = transforms.length / header.frames;
  const mesh = meshOf(count, arrays.faces, COLOURS[name]);
  const place = mesh.geometry.attributes.position;
  const shaped = new Float32Array(rest.length);
  let shown = -1;
  const pose = (frame) => {
    if (frame === shown) return;
    shown = frame;
    shaped.set(rest);
    for (let k = 0; k < kept; k += 1) {
      const amount = amounts[frame * kept + k];
      const first = k * rest.length;
      for (let i = 0; i < rest.length; i += 1) shaped[i] += amount * modes[first + i];
    }
    const out = place.array;
    const base = frame * skeleton;
    for (let v = 0; v < count; v += 1) {
      const [x, y, z] = [shaped[3 * v], shaped[3 * v + 1], shaped[3 * v + 2]];
      let [px, py, pz] = [0, 0, 0];
      for (let k = 4 * v; k < 4 * v + 4; k += 1) {
        const w = weights[k] / 65535;
        if (w === 0) continue;
        const m = base + 12 * joints[k];
        px += w * (transforms[m] * x + transforms[m + 1] * y + transforms[m + 2] * z + transforms[m + 3]);
        py += w * (transforms[m + 4] * x + transforms[m + 5] * y + transforms[m + 6] * z + transforms[m + 7]);
        pz += w * (transforms[m + 8] * x + transforms[m + 9] * y + transforms[m + 10] * z + transforms[m + 11]);
      }
      out[3 * v] = px;
      out[3 * v + 1] = py;
      out[3 * v + 2] = pz;
    }
    place.needsUpdate = true;
    mesh.geometry.computeVertexNormals();
  };
  pose(0);
  const facing = (frame) => { // the z axis of the pelvis points forward
    const m = frame * skeleton;
    const ahead = new THREE.Vector3(transforms[m + 2], transforms[m + 6], 0);
    return ahead.length() > 0.1 ? ahead.normalize() : new THREE.Vector3(0, -1, 0);
  };
  return { mesh, pose, facing, centre: centreOf(mesh) };
}

/* The true body has no skeleton. Its vertices are stored in the frames `moments`, as quantised positions in
 * the first of them and as differences to the previous one in the others. */
function trueBody(header, arrays) {
  const { moments, low, step } = header.truth;
  const moved = arrays["truth/vertices"];
  const size = moved.length / moments.length;
  const steps = new Uint16Array(moved);
  for (let i = size; i < steps.length; i += 1) steps[i] += steps[i - size]; // uint16 arithmetic wraps around
  const mesh = meshOf(size / 3, arrays.faces, COLOURS.truth);
  const place = mesh.geometry.attributes.position;
  const indexAt = (frame) => Math.max(0, moments.findLastIndex((at) => at <= frame));
  const pose = (frame) => {
    const at = indexAt(frame);
    for (let i = 0; i < size; i += 1) place.array[i] = low[i % 3] + step * steps[at * size + i];
    place.needsUpdate = true;
    mesh.geometry.computeVertexNormals();
  };
  return { mesh, pose, centre: centreOf(mesh), storedAt: (frame) => moments[indexAt(frame)] };
}

/* The object of a version (joint, sequential or truth); null if it has no poses. */
function objectOf(name, header, arrays) {
  const poses = arrays[`${name}/object`];
  const prefix = name === "truth" ? "truth/object_" : "object/";
  const vertices = arrays[`${prefix}vertices`];
  if (!poses || !vertices) return null;
  const mesh = meshOf(vertices.length / 3, arrays[`${prefix}faces`], COLOURS[name]);
  mesh.geometry.attributes.position.array.set(vertices);
  if (name === "joint") {
    const linear = (value) => Math.pow(value / 255, 2.2); // vertex colours are linear in three.js
    mesh.geometry.attributes.color.array.set(Float32Array.from(arrays["object/colours"], linear));
  }
  mesh.geometry.computeVertexNormals();
  mesh.matrixAutoUpdate = false;
  const object = { mesh, shown: true, colours: mesh.geometry.attributes.color.array.slice() };
  object.pose = (frame) => {
    const m = poses.subarray(12 * frame, 12 * frame + 12);
    mesh.visible = object.shown && Number.isFinite(m[0]);
    if (mesh.visible) mesh.matrix.set(...m, 0, 0, 0, 1);
    mesh.matrixWorldNeedsUpdate = true;
  };
  return object;
}

/* Points of person and object: `show(moment)` sets the points of one of the frames `header.moments`. */
function cloudsOf(header, arrays, dark) {
  const group = new THREE.Group();
  const parts = [["person", 0x31405a], ["object", 0x8a4b10]].filter(([name]) => arrays[`clouds/${name}`]).map(([name, colour]) => {
    const steps = arrays[`clouds/${name}`], starts = arrays[`clouds/${name}_starts`];
    const { low, step } = header.clouds[name];
    const points = new THREE.Points(
      new THREE.BufferGeometry(), new THREE.PointsMaterial({ color: dark ? 0xd7dde6 : colour, size: 2, sizeAttenuation: false }));
    points.frustumCulled = false;
    group.add(points);
    return (moment) => {
      const [first, last] = [3 * starts[moment], 3 * starts[moment + 1]];
      const place = new Float32Array(last - first);
      for (let i = 0; i < place.length; i += 1) place[i] = low[i % 3] + step * steps[first + i];
      points.geometry.setAttribute("position", new THREE.BufferAttribute(place, 3));
    };
  });
  return { group, empty: !parts.length, show: (moment) => parts.forEach((part) => part(moment)) };
}

/* A camera's frustum, and the plane of its image; `place(depth)` moves the plane. */
function cameraOf(camera) {
  const [[a, b, x, p], [d, e, y, q], [f, g, z, r]] = camera.pose;
  const pose = new THREE.Matrix4().set(a, b, x, p, d, e, y, q, f, g, z, r, 0, 0, 0, 1);
  const [w, h] = camera.size;
  const rim = (depth) => [[0, 0], [w, 0], [w, h], [0, h]].map(([u, v]) => [
    ((u - 0.5 - camera.centre[0]) / camera.focal[0]) * depth, ((v - 0.5 - camera.centre[1]) / camera.focal[1]) * depth, depth]);
  const attribute = (values, size) => new THREE.BufferAttribute(new Float32Array(values), size);
  const shape = new THREE.BufferGeometry();
  shape.setAttribute("position", attribute(
    rim(0.28).flatMap((point, i, all) => [0, 0, 0, ...point, ...point, ...all[(i + 1) % 4]]), 3));
  const frustum = new THREE.LineSegments(shape, new THREE.LineBasicMaterial({ color: 0x2f6fdb }));
  const plane = new THREE.Mesh(
    new THREE.BufferGeometry(), new THREE.MeshBasicMaterial({ side: THREE.DoubleSide, toneMapped: false }));
  const place = (depth) => {
    plane.geometry.setAttribute("position", attribute(rim(depth).flat(), 3));
    plane.geometry.computeBoundingSphere();
  };
  place(0.28);
  plane.geometry.setAttribute("uv", attribute([0, 1, 1, 1, 1, 0, 0, 0], 2));
  plane.geometry.setIndex([0, 1, 2, 0, 2, 3]);
  plane.visible = false;
  for (const part of [frustum, plane]) part.applyMatrix4(pose);
  return { ...camera, pose, frustum, plane, place };
}

/* Images on the planes of the cameras. That of the camera through which the user looks is also drawn over body
 * and object, by `overlay` with its opacity. */
class CameraImages {
  constructor(cameras, arrays, draw) {
    Object.assign(this, { cameras, arrays, draw, through: undefined });
    this.overlay = new THREE.Mesh(new THREE.BufferGeometry(), new THREE.MeshBasicMaterial(
      { side: THREE.DoubleSide, toneMapped: false, transparent: true, opacity: 0.3, depthTest: false, depthWrite: false }));
    this.overlay.matrixAutoUpdate = false;
    this.overlay.renderOrder = 1;
    this.overlay.visible = false;
  }

  /* Look through a camera; undefined = none. */
  lookThrough(camera) {
    this.through = camera;
    this.overlay.visible = false;
    if (!camera) return;
    this.overlay.geometry = camera.plane.geometry;
    this.overlay.matrix.copy(camera.pose);
  }

  hide(camera) {
    camera.request = null;
    camera.plane.visible = false;
    if (camera === this.through) this.overlay.visible = false;
  }

  /* Show the image of a moment. */
  show(camera, moment) {
    const starts = this.arrays["images/starts"] ?? [], place = moment * this.cameras.length + camera.index;
    const [first, last] = [starts[place], starts[place + 1]];
    if (first === last) {
      this.hide(camera);
      return;
    }
    const url = URL.createObjectURL(new Blob([this.arrays["images/data"].subarray(first, last)], { type: "image/webp" }));
    const image = new Image();
    const request = (camera.request = Symbol("image"));
    image.onload = () => {
      URL.revokeObjectURL(url);
      if (camera.request !== request) return; // a later request replaced this one
      const texture = new THREE.Texture(image);
      texture.colorSpace = THREE.SRGBColorSpace;
      texture.needsUpdate = true;
      camera.plane.material.map?.dispose();
      for (const mesh of [camera.plane, ...(camera === this.through ? [this.overlay] : [])]) {
        mesh.material.map = texture;
        mesh.material.needsUpdate = true;
        mesh.visible = true;
      }
      this.draw();
    };
    image.src = url;
  }
}
