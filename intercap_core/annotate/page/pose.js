/* The object's pose in a frame: moved and rotated by dragging in a view or in 3D, by numbers, or by a
 * fit to the images. No other module knows how the annotation stores poses. */
import { post } from "./api.js";
import { button, followPointer, make } from "./dom.js";
import { same } from "./draft.js";
import { IDENTITY, apply, invert, rigid, rotationVector, rows, rotate, rotateAbout } from "./geometry.js";

const ROTATION_PER_PX = 0.008; // radians per pixel of a drag
const WHEEL_STEP = 0.01; // share by which the distance changes per notch of the wheel

/* --- poses in the annotation: a list with at most one per frame, or a single pose --------------- */
const posesOf = (draft) => {
  const single = draft.get("object_pose");
  return [...(draft.get("object_poses") ?? []), ...(single ? [single] : [])]
    .map((entry) => ({ ...entry, frame: entry.frame ?? 0 })).sort((a, b) => a.frame - b.frame);
};

/* The annotated pose of a frame, master_from_object; null if there is none. */
export function poseAt(draft, frame) {
  const stored = posesOf(draft).find((entry) => entry.frame === frame);
  return stored ? rigid(stored.rotation_vector, stored.translation) : null;
}

export function putPose(draft, frame, pose, label) {
  const all = posesOf(draft), old = all.find((entry) => entry.frame === frame);
  put(draft, [...all.filter((entry) => entry !== old), {
    ...old, // keeps the stated deviations
    frame,
    rotation_vector: rotationVector(pose).map((v) => Number(v.toFixed(6))),
    translation: pose.map((row) => Number(row[3].toFixed(5))),
  }], label);
}

export const removePose = (draft, frame) => put(draft, posesOf(draft).filter((entry) => entry.frame !== frame), "object pose removed");

export const posedFrames = (draft) => posesOf(draft).map((entry) => entry.frame);

/* A file may not have both sections. A single pose keeps its section while it is the only pose. */
function put(draft, poses, label) {
  const single = draft.get("object_pose"), alone = single && poses.length === 1 && poses[0].frame === (single.frame ?? 0);
  poses.sort((a, b) => a.frame - b.frame);
  draft.put({ object_pose: alone ? poses[0] : null, object_poses: alone ? null : poses }, label);
}

/* Pose of a result in a frame, from the joint fit or else the track; null if there is none. */
export function objectPose(arrays, frame) {
  for (const poses of [arrays["poses/joint"], arrays["poses/object_track"]]) {
    if (!poses || poses.length < 12 * (frame + 1)) continue;
    const pose = poses.subarray(12 * frame, 12 * frame + 12);
    if (Number.isFinite(pose[0])) return rows(pose);
  }
  return null;
}

/* --- editing ------------------------------------------------------------------------------------ */
export class PoseEditor {
  constructor(app, object) {
    this.app = app;
    this.object = object;
    this.centre = object.arrays.centre;
    this.editing = false;
    this.pose = null;
    this.report = "";
    this.fits = app.pose?.fits ?? new Map(); // promises of the fits in progress by frame
  }

  /* Pose of the result in a frame; null if there is none. */
  resultAt(frame) { return objectPose(this.object.arrays, frame); }

  /* The edited, else the annotated, else the result's pose of a frame. */
  at(frame) {
    if (this.editing) return this.pose;
    return poseAt(this.app.draft, frame) ?? this.resultAt(frame);
  }

  start() {
    const { app } = this;
    this.pose = poseAt(app.draft, app.frame) ?? this.resultAt(app.frame) ?? this.#initialPose();
    this.editing = true;
    this.report = "";
    app.setMode(this);
  }

  /* Initial pose of an object without one: from the nearest frame, or else in the middle of the room. */
  #initialPose() {
    for (let k = 1; k < this.app.info.frames; k += 1) {
      for (const t of [this.app.frame - k, this.app.frame + k]) {
        const near = t >= 0 && t < this.app.info.frames ? this.resultAt(t) : null;
        if (near) return near;
      }
    }
    const middle = this.app.roomCentre();
    return IDENTITY.map((row, i) => [row[0], row[1], row[2], middle[i]]);
  }

  leave() {
    this.finishWheel();
    this.editing = false;
  }

  get hint() {
    return "Drag moves the object, Shift+drag rotates it, Alt+drag rolls it, the wheel changes its distance (Ctrl+wheel zooms). S fits it to the images, Esc ends.";
  }

  middle() { return apply(this.pose, this.centre); }

  /* Store the current pose in the draft, as one undo step. */
  put(label) { putPose(this.app.draft, this.app.frame, this.pose, label); }

  changed() { this.app.redraw(); this.panel(); }

  press(view, event) {
    if (event.button === 1 || !view.camera.pose) return null;
    return this.drag(event, {
      camera_from_master: view.camera.pose,
      metres: (depth) => (depth * view.crop[2]) / view.canvas.clientWidth / view.camera.lens[0],
    });
  }

  /* Drag the object as a camera sees it; metres(depth) is the size of a screen pixel at that depth. */
  drag(event, { camera_from_master, metres }) {
    const from = [event.clientX, event.clientY], start = this.pose;
    const master_from_camera = invert(camera_from_master);
    const rotates = event.shiftKey || event.button === 2, rolls = event.altKey;
    return {
      move: (next) => {
        const [dx, dy] = [next.clientX - from[0], next.clientY - from[1]];
        this.pose = start;
        const middle = this.middle();
        if (rotates || rolls) {
          const vector = rolls ? [0, 0, ROTATION_PER_PX * dx] : [-ROTATION_PER_PX * dy, ROTATION_PER_PX * dx, 0];
          this.pose = rotateAbout(start, rotate(master_from_camera, vector), middle);
        } else {
          const scale = metres(apply(camera_from_master, middle)[2]);
          const by = rotate(master_from_camera, [dx * scale, dy * scale, 0]);
          this.pose = start.map((row, i) => [row[0], row[1], row[2], row[3] + by[i]]);
        }
        this.report = "";
        this.changed();
      },
      end: () => { if (this.pose !== start) this.put(rotates || rolls ? "object rotated" : "object moved"); },
    };
  }

  wheel(view, event) {
    if (event.ctrlKey || !view.camera.pose) return false;
    const master_from_camera = invert(view.camera.pose), middle = this.middle();
    const origin = master_from_camera.map((row) => row[3]);
    const by = middle.map((v, i) => (v - origin[i]) * WHEEL_STEP * Math.sign(event.deltaY));
    this.pose = this.pose.map((row, i) => [row[0], row[1], row[2], row[3] + by[i]]);
    this.changed();
    clearTimeout(this.wheelTimer);
    this.wheelTimer = setTimeout(() => this.finishWheel(), 250);
    return true;
  }

  /* Store the wheel's movement as one undo step. */
  finishWheel() {
    if (!this.wheelTimer) return;
    clearTimeout(this.wheelTimer);
    this.wheelTimer = null;
    this.put("object distance changed");
  }

  /* Let drags that start on the object in the 3D viewer move the object instead of the view. */
  watch(canvas) {
    canvas.addEventListener("pointerdown", (event) => {
      if (!this.editing || !this.app.space.viewer) return;
      const camera = this.app.space.eye();
      const at = apply(camera.camera_from_master, this.middle());
      const box = canvas.getBoundingClientRect();
      const x = box.left + box.width / 2 + at[0] / camera.metres(at[2]);
      const y = box.top + box.height / 2 + at[1] / camera.metres(at[2]);
      const reach = Math.max(18, (0.55 * this.object.header.diameter) / camera.metres(at[2]));
      if (at[2] < 0.05 || Math.hypot(event.clientX - x, event.clientY - y) > reach) return;
      event.stopImmediatePropagation();
      event.preventDefault();
      const drag = this.drag(event, camera);
      followPointer(drag.move, drag.end);
    }, { capture: true });
  }

  /* Fit the pose to the images on the server. A pose that is edited or removed during the fit is kept. */
  snap() {
    if (!this.editing) this.start();
    const { frame } = this.app;
    if (this.fits.has(frame)) return;
    this.report = "fitting…";
    const fit = this.#fit(frame).finally(() => {
      if (this.fits.get(frame) === fit) this.fits.delete(frame);
      this.changed();
    });
    this.fits.set(frame, fit);
    this.panel();
  }

  async #fit(frame) {
    const { app, pose } = this, stored = poseAt(app.draft, frame);
    const edited = () => this.editing && app.frame === frame ? !same(this.pose, pose) : !same(poseAt(app.draft, frame), stored);
    const report = (text) => {
      if (this.editing && app.frame === frame) this.report = text;
      else app.say(`frame ${frame}: ${text}`);
    };
    try {
      const fit = await post(`${app.path}/snap`, {
        frame, rotation_vector: rotationVector(pose), translation: pose.map((row) => row[3]),
      });
      if (!this.fits.has(frame)) return; // the pose was removed
      if (edited()) report("the fit is discarded, because the pose was edited meanwhile");
      else if (fit.seen) {
        const fitted = rigid(fit.rotation_vector, fit.translation);
        if (this.editing && app.frame === frame) this.pose = fitted;
        report(`fitted: overlap ${fit.overlap.toFixed(2)} in ${fit.views} views, moved by ${(1000 * fit.moved_m).toFixed(0)} mm and rotated by ${((fit.turned_rad * 180) / Math.PI).toFixed(0)}°`);
        putPose(app.draft, frame, fitted, "object fitted to the images");
      } else report("the images support no pose near this one: drag the object closer to its true pose, or keep yours");
    } catch (error) { report(error.message); }
  }

  /* Wait until all edits are in the draft: fits in progress, and the wheel's last step. */
  async settle() {
    while (this.fits.size) {
      this.app.say(`waiting for the fit of frame ${[...this.fits.keys()].join(", ")}`);
      await Promise.all(this.fits.values());
    }
    this.finishWheel();
  }

  remove() {
    this.fits.delete(this.app.frame);
    removePose(this.app.draft, this.app.frame);
    this.app.setMode(null);
  }

  followDraft() { // after undo or redo
    this.pose = poseAt(this.app.draft, this.app.frame) ?? this.resultAt(this.app.frame) ?? this.pose;
  }

  panel() {
    const box = this.box ??= make("div", { class: "pose" });
    const { app } = this, frames = posedFrames(app.draft);
    const where = frames.length ? `The annotation has poses in frame${frames.length > 1 ? "s" : ""} ${frames.join(", ")}.` : "The annotation has no pose of the object.";
    if (!this.editing) {
      box.replaceChildren(make("p", {}, where),
        button("Place the object in this frame", () => this.start(), { class: "main", title: "O" }),
        ...frames.map((frame) => button(`Go to frame ${frame}`, () => app.show(frame))),
        ...(frames.includes(app.frame) ? [button("Remove the pose", () => this.remove())] : []));
      return box;
    }
    const numbers = [
      ...["x", "y", "z"].map((axis, i) => [`${axis}, m`, () => this.pose[i][3], (v) => { this.pose = this.pose.map((row, k) => (k === i ? [row[0], row[1], row[2], v] : row)); }, 0.005]),
      ...["x", "y", "z"].map((axis, i) => [`rotation vector ${axis}, rad`, () => rotationVector(this.pose)[i], (v) => {
        const next = [...rotationVector(this.pose)]; next[i] = v;
        this.pose = rigid(next, this.pose.map((row) => row[3]));
      }, 0.02]),
    ];
    if (box.contains(document.activeElement) && document.activeElement.tagName === "INPUT") { // while the user types
      box.querySelector(".report").textContent = this.report;
      box.querySelectorAll(".numbers input").forEach((input, k) => { // a typed number equals its value
        const value = numbers[k][1]();
        if (Math.abs(input.valueAsNumber - value) > 1e-4) input.value = value.toFixed(4);
      });
      return box;
    }
    box.replaceChildren(
      make("p", {}, `Object in frame ${app.frame}; coordinates of reference camera ${app.info.master}: x right, y down, z forward.`),
      make("div", { class: "numbers" }, numbers.map(([name, value, set, step]) => make("label", {}, name,
        make("input", { type: "number", step: String(step), value: value().toFixed(4), oninput: (event) => {
          const number = event.target.valueAsNumber;
          event.target.setAttribute("aria-invalid", String(!Number.isFinite(number)));
          if (!Number.isFinite(number)) return;
          set(number);
          app.redraw();
        }, onchange: (event) => {
          if (Number.isFinite(event.target.valueAsNumber)) { this.put("object placed by numbers"); return; }
          event.target.value = value().toFixed(4); // not a number: restore the value
          event.target.removeAttribute("aria-invalid");
        } })))),
      make("p", { class: "report", role: "status" }, this.report),
      button("Fit to the images", () => this.snap(), { class: "main", title: "S" }),
      button("Use the result's pose", () => { const pose = this.resultAt(app.frame); if (pose) { this.pose = pose; this.put("object as in the result"); this.changed(); } }),
      button("Remove the pose", () => this.remove()),
      button("Done", () => app.setMode(null), { title: "Esc" }));
    return box;
  }

  mark(view, brush) {
    const at = this.app.views.place(view, this.middle());
    if (!at) return;
    const axes = [[1, 0, 0], [0, 1, 0], [0, 0, 1]].map((axis) =>
      this.middle().map((v, i) => v + 0.6 * this.object.header.diameter * rotate(this.pose, axis)[i]));
    ["#e5484d", "#30a46c", "#3b82f6"].forEach((colour, k) => {
      const tip = this.app.views.place(view, axes[k]);
      if (!tip) return;
      brush.strokeStyle = colour;
      brush.lineWidth = 2;
      brush.beginPath();
      brush.moveTo(...at);
      brush.lineTo(...tip);
      brush.stroke();
    });
  }
}

