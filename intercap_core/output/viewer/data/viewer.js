"use strict";
/* Show a sequence in 4D (body, object, point clouds, cameras, contact) in the element with class "viewer".
 * `payload` is the base64 text that `payload` in intercap_core/output/viewer/page.py makes, or the result of
 * `unpack`. A version is one result (joint, sequential or truth). One version is shown, alone, beside another
 * one, or coloured by the distance to it. Clouds and images exist only in the frames `header.moments`; a moment
 * is an index into that list. Coordinates are z up, metres. A page may leave out controls. */

async function showInterCap(payload) {
  const root = document.querySelector(".viewer");
  const missing = {};
  const find = (name) => root.querySelector(`[data-part="${name}"]`) ?? (missing[name] ??= document.createElement("canvas"));
  const say = (text) => {
    find("message").textContent = text;
    find("message").hidden = !text;
  };
  say("Loading");
  let data;
  try {
    data = typeof payload === "string"
      ? await unpack(new Blob([Uint8Array.from(atob(payload), (letter) => letter.charCodeAt(0))])) : payload;
  } catch (error) { return say(`This browser cannot read the data of the sequence: ${error.message}`); }
  const { header, arrays } = data;

  let renderer;
  try {
    renderer = new THREE.WebGLRenderer({ canvas: find("canvas"), antialias: true });
  } catch { return say("This browser cannot draw in 3D (WebGL is disabled or missing)."); }
  renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
  const scene = new THREE.Scene();
  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  const floor = new THREE.GridHelper(6, 12, 0x8a919c, 0xb9bec6);
  floor.rotation.x = Math.PI / 2; // the grid of three.js is normal to y, the floor to z
  floor.material.transparent = true;
  floor.visible = Boolean(header.floor);
  scene.add(floor);
  const paintGround = () => {
    scene.background = new THREE.Color(dark.matches ? 0x171b21 : 0xe9ecf0);
    floor.material.opacity = dark.matches ? 0.3 : 1;
  };
  dark.addEventListener("change", () => { paintGround(); draw(); });
  paintGround();
  scene.add(new THREE.HemisphereLight(0xffffff, 0x8d8a84, 1.9));
  const sun = new THREE.DirectionalLight(0xffffff, 1.6);
  scene.add(sun);
  const eye = new THREE.PerspectiveCamera(40, 1, 0.05, 60);
  eye.up.set(0, 0, 1);
  const controls = new THREE.OrbitControls(eye, renderer.domElement);
  controls.enableDamping = false;

  // ------------------------------------------------------------------ bodies, objects, clouds, cameras
  const names = Object.keys(header.versions);
  const versions = {};
  for (const name of names) {
    const body = name === "truth" ? trueBody(header, arrays) : skinnedBody(name, header, arrays);
    const group = new THREE.Group();
    const object = objectOf(name, header, arrays);
    group.add(body.mesh);
    if (object) group.add(object.mesh);
    scene.add(group);
    versions[name] = { ...body, object, group };
  }
  const clouds = cloudsOf(header, arrays, dark.matches);
  clouds.group.visible = false;
  const cameras = header.cameras.map((camera, index) => ({ ...cameraOf(camera), index }));
  const frusta = new THREE.Group(), planes = new THREE.Group();
  for (const { frustum, plane } of cameras) {
    frusta.add(frustum);
    planes.add(plane);
  }
  const images = new CameraImages(cameras, arrays, () => draw());
  scene.add(clouds.group, frusta, planes, images.overlay);
  let through = -1; // camera whose view is shown, -1 = free view

  // ------------------------------------------------------------------ controls
  const state = {
    frame: 0, playing: false, speed: 1, loop: false, contact: true, images: false,
    shown: names[0], other: "", how: "split", // the shown version, the compared one, "split" or "distance"
  };
  const layers = new Map(); // checkbox by layer
  const addLayer = (key, text, on, change) => {
    const label = document.createElement("label"), box = document.createElement("input"), hint = document.createElement("kbd");
    box.type = "checkbox";
    box.checked = on;
    box.addEventListener("change", () => { change(box.checked); show(state.frame, true); });
    layers.set(key, box);
    hint.textContent = layers.size;
    label.append(box, ` ${text} `, hint);
    label.dataset.layer = key;
    find("layers").append(label);
  };
  if (header.object) {
    addLayer("object", header.object, true, (on) => {
      for (const version of Object.values(versions)) if (version.object) version.object.shown = on;
    });
  }
  if (arrays["contact/touching"] || arrays["contact/probability"]) {
    addLayer("contact", "contact", true, (on) => (state.contact = on));
  }
  if (!clouds.empty) addLayer("clouds", "point clouds", false, (on) => (clouds.group.visible = on));
  addLayer("cameras", "cameras", true, (on) => (frusta.visible = on));
  if (arrays["images/starts"]) addLayer("images", "images", false, (on) => (state.images = on));
  const defaults = [...layers].filter(([, box]) => box.checked).map(([key]) => key).join();

  const compare = (values) => {
    Object.assign(state, values);
    if (state.other === state.shown) state.other = "";
    find("result").replaceChildren(...names.map((name) => new Option(header.versions[name], name)));
    find("other").replaceChildren(new Option("none", ""), ...names.filter((name) => name !== state.shown).map((name) => new Option(header.versions[name], name)));
    for (const [part, key] of [["result", "shown"], ["other", "other"], ["how", "how"]]) find(part).value = state[key];
    find("how").hidden = !state.other;
    measurement.toggle(measurement.on);
    show(state.frame, true);
  };
  find("compare").hidden = names.length < 2;
  find("result").addEventListener("change", (event) => compare({ shown: event.target.value }));
  find("other").addEventListener("change", (event) => compare({ other: event.target.value }));
  find("how").addEventListener("change", (event) => compare({ how: event.target.value }));

  const measurement = new Measurement(scene, find("measured"));
  find("measure").addEventListener("click", () => {
    measurement.toggle(!measurement.on);
    find("measure").setAttribute("aria-pressed", measurement.on);
    draw();
  });
  const views = find("views");
  cameras.forEach((camera, c) => views.append(new Option(`through ${camera.name}`, c)));
  views.addEventListener("change", () => look(Number(views.value)));
  const setOpacity = (share) => { find("opacity").value = images.overlay.material.opacity = share; draw(); };
  const opacity = find("opacity").value; // by default
  find("opacity").addEventListener("input", (event) => { setOpacity(event.target.value); updateAddress(); });
  find("speed").addEventListener("change", (event) => (state.speed = Number(event.target.value)));
  find("loop").addEventListener("change", (event) => (state.loop = event.target.checked));
  const scrub = find("scrub");
  scrub.max = header.frames - 1;
  scrub.addEventListener("input", () => { pause(); show(Number(scrub.value)); });
  find("play").addEventListener("click", () => (state.playing ? pause() : play()));
  find("back").addEventListener("click", () => step(-1));
  find("forward").addEventListener("click", () => step(1));
  find("reset").addEventListener("click", () => { state.moved = false; look(-1); });
  const contact = contactFrames(header, arrays);
  paintMarks(find("marks"), header, contact);

  const play = () => {
    if (state.frame >= header.frames - 1) show(0);
    Object.assign(state, { playing: true, since: performance.now(), from: state.frame });
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
    let frame = state.from + Math.max(0, Math.floor(((now - state.since) / 1000) * header.fps * state.speed));
    if (frame >= header.frames && state.loop) {
      Object.assign(state, { since: now, from: 0 });
      frame = 0;
    } else if (frame >= header.frames) {
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
    const layer = [...layers.values()][event.key - 1];
    if (layer) layer.click();
    else if (keys[event.key] && !(event.key === " " && (typed === "BUTTON" || typed === "INPUT"))) keys[event.key]();
    else return;
    event.preventDefault();
  });

  /* The wheel and vertical strokes of a finger scroll the page until the user clicks the canvas; the wheel zooms
   * with Ctrl, and always on a page that does not scroll. */
  const canvas = find("canvas");
  let active = false, pressed = null;
  const activate = (on) => { active = on; canvas.style.touchAction = on ? "none" : "pan-y"; };
  activate(false);
  document.addEventListener("click", (event) => activate(event.target === canvas));
  canvas.addEventListener("wheel", (event) => {
    controls.enableZoom = active || event.ctrlKey || document.documentElement.scrollHeight <= window.innerHeight;
    find("hint").hidden = controls.enableZoom || !controls.enabled;
    clearTimeout(state.hint);
    state.hint = setTimeout(() => (find("hint").hidden = true), 1500);
  }, { capture: true, passive: true });
  canvas.addEventListener("pointerdown", (event) => {
    controls.enableZoom = true;
    pressed = { x: event.clientX, y: event.clientY, eye: eye.position.clone(), target: controls.target.clone() };
  }, { capture: true });
  canvas.addEventListener("pointercancel", () => { // the browser scrolls instead
    eye.position.copy(pressed.eye);
    controls.target.copy(pressed.target);
    controls.update();
  });
  canvas.addEventListener("click", (event) => {
    if (!measurement.on || Math.hypot(event.clientX - pressed.x, event.clientY - pressed.y) > 4) return;
    const [ray, { mesh, object }] = rayAt(event);
    measurement.click(ray, object?.mesh.visible ? [mesh, object.mesh] : [mesh], header.floor);
    draw();
  });
  canvas.addEventListener("dblclick", (event) => {
    const hit = rayAt(event)[0].intersectObjects(frusta.children)[0];
    if (hit && !measurement.on) look(frusta.children.indexOf(hit.object));
  });
  /* Names of the versions that are drawn next to each other. */
  const panes = () => (state.other && state.how === "split" ? [state.shown, state.other] : [state.shown]);
  /* The ray through a pixel, and the version that is drawn there. */
  const rayAt = (event) => {
    const box = canvas.getBoundingClientRect(), shown = panes(), wide = box.width / shown.length;
    const x = event.clientX - box.left, k = Math.min(shown.length - 1, Math.floor(x / wide));
    const ray = new THREE.Raycaster();
    ray.params.Line.threshold = 0.04;
    ray.setFromCamera(new THREE.Vector2((2 * (x - k * wide)) / wide - 1, 1 - (2 * (event.clientY - box.top)) / box.height), eye);
    return [ray, versions[shown[k]]];
  };

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
    for (const name of [state.shown, state.other].filter(Boolean)) {
      versions[name].pose(frame);
      versions[name].object?.pose(frame);
      paint(name, frame);
    }
    paintDifference(frame);
    measurement.update();
    const now = momentOf(frame);
    if (redraw || now !== moment) {
      moment = now;
      if (clouds.group.visible) clouds.show(now);
      for (const camera of cameras) {
        if (state.images || camera.index === through) images.show(camera, now);
        else images.hide(camera);
      }
    }
    scrub.value = frame;
    const why = reasons.get(frame);
    find("time").textContent = `${(frame / header.fps).toFixed(2)} s, frame ${frame}`;
    find("flag").textContent = why ? `not reliable here: ${why}` : "";
    root.dataset.frame = frame;
    if (!state.playing) updateAddress();
    draw();
  };
  /* Colour a version by contact, which is known of the first one. */
  const paint = (name, frame) => {
    const { mesh, object } = versions[name];
    paintContact(mesh, frame, header, arrays, COLOURS[name], state.contact && name === names[0]);
    if (!object) return;
    object.mesh.geometry.attributes.color.array.set(object.colours);
    object.mesh.geometry.attributes.color.needsUpdate = true;
  };
  /* Colour the shown version by the distance to the compared one; write the legend or the titles of both. */
  const paintDifference = (frame) => {
    const at = (key) => versions[key].storedAt?.(frame) ?? frame; // the truth is not stored in all frames
    const titles = panes().map((key) => `${header.versions[key]}${at(key) === frame ? "" : `, frame ${at(key)}`}`);
    find("titles").replaceChildren(...(titles.length > 1 || at(state.shown) !== frame ? titles : []).map((text) => {
      const title = document.createElement("span");
      title.textContent = text;
      return title;
    }));
    const colours = state.other && state.how === "distance", away = [state.shown, state.other].find((key) => colours && at(key) !== frame);
    find("legend").hidden = !colours;
    if (away) find("legend").textContent = `${header.versions[away]} is stored in frame ${at(away)}, not in frame ${frame}: no distances`;
    else if (colours) find("legend").textContent = `distance to ${header.versions[state.other]}, ${paintDistances(versions[state.shown], versions[state.other])}`;
  };
  const draw = () => {
    const { clientWidth: width, clientHeight: height } = canvas;
    if (!width || !height) return;
    const size = renderer.getSize(new THREE.Vector2());
    if (size.x !== width || size.y !== height) renderer.setSize(width, height, false);
    const shown = panes(), wide = width / shown.length;
    eye.aspect = wide / height;
    if (through >= 0) {
      const camera = cameras[through];
      const tall = (2 * Math.atan(camera.size[1] / 2 / camera.focal[1]) * 180) / Math.PI;
      const ratio = camera.size[0] / camera.size[1];
      // the whole image fits into the canvas
      eye.fov = eye.aspect >= ratio ? tall
        : (2 * Math.atan((Math.tan((tall * Math.PI) / 360) * ratio) / eye.aspect) * 180) / Math.PI;
    }
    eye.updateProjectionMatrix();
    sun.position.copy(eye.position).add(new THREE.Vector3(0.6, 0.3, 1.5));
    renderer.setScissorTest(true);
    shown.forEach((name, k) => {
      for (const [other, { group }] of Object.entries(versions)) group.visible = other === name;
      renderer.setViewport(k * wide, 0, wide, height);
      renderer.setScissor(k * wide, 0, wide, height);
      renderer.render(scene, eye);
    });
  };
  /* Look through camera c; -1 = free view. */
  const look = (c) => {
    if (through >= 0) cameras[through].place(0.28);
    through = c;
    views.value = c;
    controls.enabled = c < 0;
    find("image").hidden = c < 0 || !arrays["images/starts"];
    images.lookThrough(cameras[c]);
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
    const { clientWidth: width, clientHeight: height } = canvas;
    const far = Math.max(1, (1.1 * height) / Math.max(width, 1)); // a narrow canvas needs a larger distance
    eye.position.copy(middle).addScaledVector(ahead, 2.6 * far).addScaledVector(aside, 1.3 * far);
    eye.position.z += 0.7 * far;
    controls.update();
  };
  controls.addEventListener("change", () => draw());
  controls.addEventListener("end", () => { state.moved = true; updateAddress(); });
  new ResizeObserver(() => draw()).observe(canvas);

  // ------------------------------------------------------------------ state in the address: #t=3.2 (seconds)&...
  const updateAddress = () => {
    if (!state.ready) return;
    const shown = [...layers].filter(([, box]) => box.checked).map(([key]) => key).join();
    const link = {
      t: (state.frame / header.fps).toFixed(2),
      view: through >= 0 ? encodeURIComponent(cameras[through].name) : null,
      eye: state.moved && through < 0 ? [...eye.position, ...controls.target].map((v) => v.toFixed(2)).join() : null,
      layers: shown === defaults ? null : shown,
      result: state.shown === names[0] ? null : state.shown,
      other: state.other, how: state.other && state.how,
      opacity: find("opacity").value === opacity ? null : find("opacity").value,
    };
    history.replaceState(null, "", `#${Object.entries(link).filter(([, value]) => value !== null && value !== "").map((pair) => pair.join("=")).join("&")}`);
  };
  /* Show what the address names, if it names a time; the rest is as by default. */
  const followAddress = () => {
    const link = new URLSearchParams(location.hash.slice(1)), seconds = Number(link.get("t"));
    if (!link.has("t") || !Number.isFinite(seconds)) return;
    pause();
    state.frame = Math.round(seconds * header.fps);
    const on = (link.get("layers") ?? defaults).split(",");
    for (const [key, box] of layers) if (box.checked !== on.includes(key)) box.click();
    const [result, other] = ["result", "other"].map((key) => (names.includes(link.get(key)) ? link.get(key) : null));
    compare({ shown: result ?? names[0], other: other ?? "", how: link.get("how") === "distance" ? "distance" : "split" });
    setOpacity(link.get("opacity") ?? opacity);
    const view = cameras.findIndex(({ name }) => name === link.get("view")), at = link.get("eye")?.split(",").map(Number) ?? [];
    if (view !== through) look(view);
    if (view < 0 && at.length === 6 && at.every(Number.isFinite)) {
      eye.position.fromArray(at);
      controls.target.fromArray(at, 3);
      controls.update();
      state.moved = true;
    }
    show(seconds * header.fps);
  };
  window.addEventListener("hashchange", followAddress);

  compare({});
  show(Math.max(0, contact.indexOf(true)));
  overview();
  followAddress();
  if (!state.moved && through < 0) overview();
  draw();
  state.ready = true;
  say("");
  root.dataset.loadedMs = Math.round(performance.now());
  root.dataset.ready = "yes";

  // Interface for tests and the browser's console
  window.intercapViewer = { header, show, look, play, pause, state, versions, cameras, eye, draw, compare, measurement };
}
