"use strict";
/* Show a sequence in 4D (body, object, point clouds, cameras, contact) in the element with class "viewer".
 * `payload` is the base64 text that `payload` in intercap_core/output/viewer/page.py makes, or the result of
 * `unpack`. A version is one result (joint, sequential or truth); the first one is opaque and shows contact.
 * Clouds and images exist only in the frames `header.moments`; a moment is an index into that list.
 * Coordinates are z up, metres. */
const COLOURS = { joint: [0.42, 0.66, 0.92], sequential: [0.66, 0.6, 0.78], truth: [0.45, 0.74, 0.5] }; // by version

async function showInterCap(payload) {
  const root = document.querySelector(".viewer");
  const find = (name) => root.querySelector(`[data-part="${name}"]`);
  const say = (text) => {
    find("message").textContent = text;
    find("message").hidden = !text;
  };
  say("Loading");
  let data;
  try {
    data = typeof payload === "string"
      ? await unpack(new Blob([Uint8Array.from(atob(payload), (letter) => letter.charCodeAt(0))])) : payload;
  } catch (error) {
    say(`This browser cannot read the data of the sequence: ${error.message}`);
    return;
  }
  const { header, arrays } = data;

  let renderer;
  try {
    renderer = new THREE.WebGLRenderer({ canvas: find("canvas"), antialias: true });
  } catch {
    say("This browser cannot draw in 3D (WebGL is disabled or missing).");
    return;
  }
  renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
  const scene = new THREE.Scene();
  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  const paintGround = () => (scene.background = new THREE.Color(dark.matches ? 0x171b21 : 0xe9ecf0));
  dark.addEventListener("change", () => { paintGround(); draw(); });
  paintGround();
  scene.add(new THREE.HemisphereLight(0xffffff, 0x8d8a84, 1.9));
  const sun = new THREE.DirectionalLight(0xffffff, 1.6);
  scene.add(sun);
  const floor = new THREE.GridHelper(6, 12, 0x8a919c, 0xb9bec6);
  floor.rotation.x = Math.PI / 2; // the grid of three.js is normal to y, the floor to z
  scene.add(floor);
  const eye = new THREE.PerspectiveCamera(40, 1, 0.05, 60);
  eye.up.set(0, 0, 1);
  const controls = new THREE.OrbitControls(eye, renderer.domElement);
  controls.enableDamping = false;

  // ------------------------------------------------------------------ bodies and objects
  const TOUCHING = [0.86, 0.2, 0.26];
  const STATED = [[0.97, 0.84, 0.62], [0.93, 0.5, 0.06]]; // colours of probabilities 0.5 and 1
  const names = Object.keys(header.versions);
  const versions = {};
  for (const name of names) {
    const body = name === "truth" ? trueBody(header, arrays) : skinnedBody(name, header, arrays);
    body.mesh.material.transparent = name !== names[0];
    body.mesh.material.opacity = name === names[0] ? 1 : 0.55;
    const group = new THREE.Group();
    group.add(body.mesh);
    const object = objectOf(name, header, arrays);
    if (object) group.add(object.mesh);
    group.visible = name === names[0];
    scene.add(group);
    versions[name] = { ...body, object, group };
  }

  // ------------------------------------------------------------------ clouds
  const clouds = new THREE.Group();
  const cloudParts = [];
  for (const [name, colour] of [["person", 0x31405a], ["object", 0x8a4b10]]) {
    const steps = arrays[`clouds/${name}`];
    if (!steps) continue;
    const starts = arrays[`clouds/${name}_starts`];
    const { low, step } = header.clouds[name];
    const points = new THREE.Points(
      new THREE.BufferGeometry(),
      new THREE.PointsMaterial({ color: dark.matches ? 0xd7dde6 : colour, size: 2, sizeAttenuation: false }),
    );
    points.frustumCulled = false;
    clouds.add(points);
    cloudParts.push((moment) => {
      const [first, last] = [3 * starts[moment], 3 * starts[moment + 1]];
      const place = new Float32Array(last - first);
      for (let i = 0; i < place.length; i += 1) place[i] = low[i % 3] + step * steps[first + i];
      points.geometry.setAttribute("position", new THREE.BufferAttribute(place, 3));
    });
  }
  clouds.visible = false;
  scene.add(clouds);

  // ------------------------------------------------------------------ cameras and their images
  const frusta = new THREE.Group();
  const planes = new THREE.Group();
  const cameras = header.cameras.map((camera, c) => {
    const [[a, b, x, p], [d, e, y, q], [f, g, z, r]] = camera.pose;
    const pose = new THREE.Matrix4().set(a, b, x, p, d, e, y, q, f, g, z, r, 0, 0, 0, 1);
    const corner = (u, v, depth) => [
      ((u - 0.5 - camera.centre[0]) / camera.focal[0]) * depth,
      ((v - 0.5 - camera.centre[1]) / camera.focal[1]) * depth,
      depth,
    ];
    const [w, h] = camera.size;
    const rim = [[0, 0], [w, 0], [w, h], [0, h]].map(([u, v]) => corner(u, v, 0.28));
    const lines = [];
    rim.forEach((point, i) => lines.push(0, 0, 0, ...point, ...point, ...rim[(i + 1) % 4]));
    const shape = new THREE.BufferGeometry();
    shape.setAttribute("position", new THREE.BufferAttribute(new Float32Array(lines), 3));
    const frustum = new THREE.LineSegments(shape, new THREE.LineBasicMaterial({ color: 0x2f6fdb }));
    frustum.applyMatrix4(pose);
    frusta.add(frustum);
    const plane = new THREE.Mesh(
      new THREE.BufferGeometry(),
      new THREE.MeshBasicMaterial({ side: THREE.DoubleSide, toneMapped: false }),
    );
    const place = (depth) => {
      const at = [[0, 0], [w, 0], [w, h], [0, h]].flatMap(([u, v]) => corner(u, v, depth));
      plane.geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(at), 3));
      plane.geometry.computeBoundingSphere();
    };
    place(0.28);
    plane.geometry.setAttribute(
      "uv", new THREE.BufferAttribute(new Float32Array([0, 1, 1, 1, 1, 0, 0, 0]), 2));
    plane.geometry.setIndex([0, 1, 2, 0, 2, 3]);
    plane.applyMatrix4(pose);
    plane.visible = false;
    planes.add(plane);
    return { ...camera, pose, plane, place, index: c };
  });
  scene.add(frusta, planes);
  let through = -1; // camera whose view is shown, -1 = free view
  /* Show the image of a moment on the camera's plane. */
  const showImage = (camera, moment) => {
    const starts = arrays["images/starts"];
    const place = moment * cameras.length + camera.index;
    const [first, last] = [starts[place], starts[place + 1]];
    if (first === last) {
      camera.plane.visible = false;
      return;
    }
    const url = URL.createObjectURL(
      new Blob([arrays["images/data"].subarray(first, last)], { type: "image/jpeg" }));
    const image = new Image();
    const request = (camera.request = Symbol("image"));
    image.onload = () => {
      URL.revokeObjectURL(url);
      if (camera.request !== request) return; // a later request replaced this one
      const texture = new THREE.Texture(image);
      texture.colorSpace = THREE.SRGBColorSpace;
      texture.needsUpdate = true;
      camera.plane.material.map?.dispose();
      camera.plane.material.map = texture;
      camera.plane.material.needsUpdate = true;
      camera.plane.visible = true;
      draw();
    };
    image.src = url;
  };

  // ------------------------------------------------------------------ controls
  const state = { frame: 0, playing: false, speed: 1, contact: true, images: false };
  const layers = [];
  const addLayer = (key, text, on, change) => {
    const label = document.createElement("label");
    const box = document.createElement("input");
    box.type = "checkbox";
    box.checked = on;
    box.addEventListener("change", () => { change(box.checked); show(state.frame, true); });
    const number = layers.length + 1;
    label.append(box, ` ${text} `);
    if (number < 10) {
      const hint = document.createElement("kbd");
      hint.textContent = number;
      label.append(hint);
    }
    label.dataset.layer = key;
    find("layers").append(label);
    layers.push(box);
  };
  for (const name of names) {
    addLayer(name, header.versions[name], name === names[0], (on) => (versions[name].group.visible = on));
  }
  if (header.object) {
    addLayer("object", header.object, true, (on) => {
      for (const version of Object.values(versions)) if (version.object) version.object.shown = on;
    });
  }
  if (arrays["contact/touching"] || arrays["contact/probability"]) {
    addLayer("contact", "contact", true, (on) => (state.contact = on));
  }
  if (cloudParts.length) addLayer("clouds", "points", false, (on) => (clouds.visible = on));
  addLayer("cameras", "cameras", true, (on) => (frusta.visible = on));
  addLayer("images", "images", false, (on) => (state.images = on));
  const views = find("views");
  cameras.forEach((camera, c) => views.append(new Option(`through ${camera.name}`, c)));
  views.addEventListener("change", () => look(Number(views.value)));
  find("speed").addEventListener("change", (event) => (state.speed = Number(event.target.value)));
  const scrub = find("scrub");
  scrub.max = header.frames - 1;
  scrub.addEventListener("input", () => { pause(); show(Number(scrub.value)); });
  find("play").addEventListener("click", () => (state.playing ? pause() : play()));
  find("reset").addEventListener("click", () => { views.value = "-1"; look(-1); overview(); draw(); });
  paintMarks(find("marks"), header, arrays);

  const play = () => {
    if (state.frame >= header.frames - 1) show(0);
    state.playing = true;
    state.since = performance.now();
    state.from = state.frame;
    find("play").textContent = "Pause";
    requestAnimationFrame(tick);
  };
  const pause = () => {
    if (!state.playing) return;
    state.playing = false;
    find("play").textContent = "Play";
    updateAddress();
  };
  const tick = (now) => {
    if (!state.playing) return;
    const frame = state.from + Math.max(0, Math.floor(((now - state.since) / 1000) * header.fps * state.speed));
    if (frame >= header.frames) {
      show(header.frames - 1);
      pause();
      return;
    }
    if (frame !== state.frame) show(frame);
    requestAnimationFrame(tick);
  };
  const step = (by) => { pause(); show(state.frame + by); };
  root.addEventListener("keydown", (event) => {
    const typed = event.target.tagName;
    if (event.ctrlKey || event.metaKey || event.altKey || typed === "SELECT") return;
    const far = event.shiftKey ? 10 : 1;
    const keys = {
      " ": () => (state.playing ? pause() : play()),
      ArrowLeft: () => step(-far), ArrowRight: () => step(far),
      Home: () => step(-header.frames), End: () => step(header.frames),
      f: () => { overview(); draw(); },
    };
    if (/^[1-9]$/.test(event.key) && layers[event.key - 1]) {
      layers[event.key - 1].click();
    } else if (keys[event.key] && !(event.key === " " && (typed === "BUTTON" || typed === "INPUT"))) {
      keys[event.key]();
    } else return;
    event.preventDefault();
  });

  // ------------------------------------------------------------------ drawing
  const moments = header.moments;
  /* The moment nearest to a frame. */
  const momentOf = (frame) => moments.reduce(
    (best, at, i) => (Math.abs(at - frame) < Math.abs(moments[best] - frame) ? i : best), 0);
  const reasons = new Map(header.flags);
  let moment = -1;
  /* Show a frame; `redraw` also updates clouds and images if the moment is the same. */
  const show = (number, redraw = false) => {
    const frame = Math.max(0, Math.min(header.frames - 1, Math.round(number)));
    state.frame = frame;
    for (const [name, version] of Object.entries(versions)) {
      if (!version.group.visible) continue;
      version.pose(frame);
      if (name === names[0]) paintContact(version, frame);
      version.object?.pose(frame);
    }
    const now = momentOf(frame);
    if (redraw || now !== moment) {
      moment = now;
      if (clouds.visible) for (const part of cloudParts) part(now);
      for (const camera of cameras) {
        if (state.images || camera.index === through) showImage(camera, now);
        else camera.plane.visible = false;
      }
    }
    scrub.value = frame;
    const why = reasons.get(frame);
    find("time").textContent = `${(frame / header.fps).toFixed(2)} s, frame ${frame}`;
    find("flag").textContent = why ? `flagged: ${why}` : "";
    root.dataset.frame = frame;
    if (!state.playing) updateAddress();
    draw();
  };
  /* Colour the vertices that touch the object, and regions with a probability of contact from 0.5. */
  const paintContact = (version, frame) => {
    const colours = version.mesh.geometry.attributes.color;
    const base = COLOURS[names[0]];
    const touching = state.contact ? arrays["contact/touching"] : null;
    const width = touching ? touching.length / header.frames : 0;
    const region = state.contact ? arrays["contact/region"] : null;
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
  };
  const draw = () => {
    const { clientWidth: width, clientHeight: height } = renderer.domElement;
    if (!width || !height) return;
    const size = renderer.getSize(new THREE.Vector2());
    if (size.x !== width || size.y !== height) renderer.setSize(width, height, false);
    eye.aspect = width / height;
    if (through >= 0) {
      const camera = cameras[through];
      const tall = (2 * Math.atan(camera.size[1] / 2 / camera.focal[1]) * 180) / Math.PI;
      const wide = camera.size[0] / camera.size[1];
      // the whole image fits into the canvas
      eye.fov = eye.aspect >= wide ? tall
        : (2 * Math.atan((Math.tan((tall * Math.PI) / 360) * wide) / eye.aspect) * 180) / Math.PI;
    }
    eye.updateProjectionMatrix();
    sun.position.copy(eye.position).add(new THREE.Vector3(0.6, 0.3, 1.5));
    renderer.render(scene, eye);
  };
  /* Look through camera c; -1 = free view. */
  const look = (c) => {
    if (through >= 0) cameras[through].place(0.28);
    through = c;
    controls.enabled = c < 0;
    if (c < 0) {
      eye.fov = 40;
      eye.up.set(0, 0, 1);
      eye.clearViewOffset();
      overview();
    } else {
      const { pose, place } = cameras[c];
      const x = new THREE.Vector3(), y = new THREE.Vector3(), z = new THREE.Vector3();
      pose.extractBasis(x, y, z);
      eye.position.setFromMatrixPosition(pose);
      eye.up.copy(y.negate());
      eye.lookAt(eye.position.clone().add(z));
      place(12); // the image is behind the scene
    }
    show(state.frame, true);
  };
  const overview = () => {
    const version = versions[names[0]];
    const middle = version.centre(state.frame);
    const ahead = version.facing(state.frame); // the viewer is in front of the body, slightly to the side and above
    const aside = new THREE.Vector3(-ahead.y, ahead.x, 0);
    controls.target.copy(middle);
    const { clientWidth: width, clientHeight: height } = renderer.domElement;
    const far = Math.max(1, (1.1 * height) / Math.max(width, 1)); // a narrow canvas needs a larger distance
    eye.position.copy(middle).addScaledVector(ahead, 2.6 * far).addScaledVector(aside, 1.3 * far);
    eye.position.z += 0.7 * far;
    controls.update();
  };
  renderer.domElement.addEventListener("dblclick", (event) => {
    const box = renderer.domElement.getBoundingClientRect();
    const at = new THREE.Vector2(
      (2 * (event.clientX - box.left)) / box.width - 1, 1 - (2 * (event.clientY - box.top)) / box.height);
    const ray = new THREE.Raycaster();
    ray.params.Line.threshold = 0.04;
    ray.setFromCamera(at, eye);
    const hit = ray.intersectObjects(frusta.children)[0];
    if (!hit) return;
    const c = frusta.children.indexOf(hit.object);
    views.value = String(c);
    look(c);
  });
  controls.addEventListener("change", draw);
  new ResizeObserver(draw).observe(renderer.domElement);

  // ------------------------------------------------------------------ time in the address: #t=3.2 (seconds)
  const timeInAddress = () => /(?:^#|&)t=([0-9.]+)/.exec(location.hash)?.[1];
  const updateAddress = () => {
    const hash = `#t=${(state.frame / header.fps).toFixed(2)}`;
    if (timeInAddress() !== undefined || state.touched) history.replaceState(null, "", hash);
    state.touched = true;
  };
  const followAddress = () => {
    const seconds = Number(timeInAddress());
    if (timeInAddress() !== undefined && Number.isFinite(seconds)) {
      pause();
      show(seconds * header.fps);
    }
  };
  window.addEventListener("hashchange", followAddress);

  const first = Number(timeInAddress() ?? 0) * header.fps;
  show(Number.isFinite(first) ? first : 0);
  overview();
  draw();
  say("");
  root.dataset.loadedMs = Math.round(performance.now());
  root.dataset.ready = "yes";

  // Interface for tests and the browser's console
  window.intercapViewer = { header, show, look, play, pause, state, versions, cameras, eye, draw };
}

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
  const pose = (frame) => {
    let at = 0;
    while (at + 1 < moments.length && moments[at + 1] <= frame) at += 1;
    for (let i = 0; i < size; i += 1) place.array[i] = low[i % 3] + step * steps[at * size + i];
    place.needsUpdate = true;
    mesh.geometry.computeVertexNormals();
  };
  return { mesh, pose, centre: centreOf(mesh) };
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
  const object = { mesh, shown: true };
  object.pose = (frame) => {
    const m = poses.subarray(12 * frame, 12 * frame + 12);
    mesh.visible = object.shown && Number.isFinite(m[0]);
    if (mesh.visible) mesh.matrix.set(...m, 0, 0, 0, 1);
    mesh.matrixWorldNeedsUpdate = true;
  };
  return object;
}

/* Marks under the slider: flagged frames are red, contact is blue. */
function paintMarks(canvas, header, arrays) {
  canvas.width = header.frames;
  canvas.height = 2;
  const brush = canvas.getContext("2d");
  const touching = arrays["contact/touching"];
  const width = touching ? touching.length / header.frames : 0;
  brush.fillStyle = "#2f6fdb";
  for (let t = 0; t < header.frames && touching; t += 1) {
    if (touching.subarray(t * width, (t + 1) * width).some((byte) => byte)) brush.fillRect(t, 1, 1, 1);
  }
  brush.fillStyle = "#d2383f";
  for (const [t] of header.flags) brush.fillRect(t, 0, 1, 1);
}
