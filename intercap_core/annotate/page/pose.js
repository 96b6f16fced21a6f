/* The object's pose at a frame: dragged and turned in a view or in 3D, by numbers, or fitted to the
 * images from where it is. The only place that knows how poses are written into the annotation. */
import { post } from "./api.js";
import { button, make } from "./dom.js";
import { IDENTITY, apply, invert, rigid, rotationVector, rows, turnOnly, turnedAbout } from "./geometry.js";

const TURN = 0.008; // radians a pixel
const NEARER = 0.01; // of the distance, a notch of the wheel

/* --- how the annotation has them: a list of poses, one a frame; a file may have a single one instead - */
const posesOf = (draft) => {
  const single = draft.get("object_pose");
  return [...(draft.get("object_poses") ?? []), ...(single ? [single] : [])]
    .map((one) => ({ ...one, frame: one.frame ?? 0 })).sort((a, b) => a.frame - b.frame);
};

export function poseAt(draft, frame) {
  const told = posesOf(draft).find((one) => one.frame === frame);
  return told ? rigid(told.rotation_vector, told.translation) : null;
}

export function putPose(draft, frame, pose, says) {
  const all = posesOf(draft), old = all.find((one) => one.frame === frame);
  put(draft, [...all.filter((one) => one !== old), {
    ...old, // how well it is known stays
    frame,
    rotation_vector: rotationVector(pose).map((v) => Number(v.toFixed(6))),
    translation: pose.map((row) => Number(row[3].toFixed(5))),
  }], says);
}

export const takePose = (draft, frame) => put(draft, posesOf(draft).filter((one) => one.frame !== frame), "object pose removed");

export const posedFrames = (draft) => posesOf(draft).map((one) => one.frame);

/* Both sections together are an error: a single one stays as the file has it as long as it is alone. */
function put(draft, poses, says) {
  const single = draft.get("object_pose"), alone = single && poses.length === 1 && poses[0].frame === (single.frame ?? 0);
  poses.sort((a, b) => a.frame - b.frame);
  draft.put({ object_pose: alone ? poses[0] : null, object_poses: alone ? null : poses }, says);
}

/* Where a result has the object at a frame: the joint fit, else the track; null = nowhere. */
export function objectPose(arrays, frame) {
  for (const poses of [arrays["poses/joint"], arrays["poses/object_track"]]) {
    if (!poses || poses.length < 12 * (frame + 1)) continue;
    const own = poses.subarray(12 * frame, 12 * frame + 12);
    if (Number.isFinite(own[0])) return rows(own);
  }
  return null;
}

/* --- the object as the page has it ------------------------------------------------------------- */
export class PoseEditor {
  constructor(app, object) {
    this.app = app;
    this.object = object;
    this.centre = object.arrays.centre;
    this.editing = false;
    this.pose = null;
    this.report = "";
  }

  /* Where the result has the object; null = nowhere. */
  found(frame) { return objectPose(this.object.arrays, frame); }

  at(frame) {
    if (this.editing) return this.pose;
    return poseAt(this.app.draft, frame) ?? this.found(frame);
  }

  start() {
    const { app } = this;
    this.pose = poseAt(app.draft, app.frame) ?? this.found(app.frame) ?? this.#ahead();
    this.editing = true;
    this.report = "";
    app.setMode(this);
  }

  /* Of an object that is nowhere: where the nearest frame has it, else amid the cameras. */
  #ahead() {
    for (let k = 1; k < this.app.told.frames; k += 1) {
      for (const t of [this.app.frame - k, this.app.frame + k]) {
        const near = t >= 0 && t < this.app.told.frames ? this.found(t) : null;
        if (near) return near;
      }
    }
    const middles = this.app.told.cameras.filter((one) => one.pose).map((one) => apply(invert(one.pose), [0, 0, 2]));
    return IDENTITY.map((row, i) => [row[0], row[1], row[2],
      middles.reduce((sum, m) => sum + m[i], 0) / Math.max(1, middles.length)]);
  }

  leave() {
    this.settle();
    this.editing = false;
  }

  get hint() {
    return "Drag the object to move it, Shift+drag to turn it, Alt+drag to roll it, wheel for nearer and farther (Ctrl+wheel zooms). S fits it to the images, Esc ends.";
  }

  middle() { return apply(this.pose, this.centre); }

  /* The pose as it is now goes to the draft, as one step that can be undone. */
  put(says) { putPose(this.app.draft, this.app.frame, this.pose, says); }

  changed() { this.app.redraw(); this.panel(); }

  press(view, event) {
    if (event.button === 1 || !view.camera.pose) return null;
    return this.drag(event, {
      camera_from_master: view.camera.pose,
      metres: (depth) => (depth * view.crop[2]) / view.canvas.clientWidth / view.camera.lens[0],
    });
  }

  /* A drag seen by a camera; metres(depth) = of the room for a pixel of the screen. */
  drag(event, { camera_from_master, metres }) {
    const from = [event.clientX, event.clientY], start = this.pose;
    const master_from_camera = invert(camera_from_master);
    const turns = event.shiftKey || event.button === 2, rolls = event.altKey;
    return {
      move: (next) => {
        const [dx, dy] = [next.clientX - from[0], next.clientY - from[1]];
        this.pose = start;
        const middle = this.middle();
        if (turns || rolls) {
          const vector = rolls ? [0, 0, TURN * dx] : [-TURN * dy, TURN * dx, 0];
          this.pose = turnedAbout(start, turnOnly(master_from_camera, vector), middle);
        } else {
          const scale = metres(apply(camera_from_master, middle)[2]);
          const by = turnOnly(master_from_camera, [dx * scale, dy * scale, 0]);
          this.pose = start.map((row, i) => [row[0], row[1], row[2], row[3] + by[i]]);
        }
        this.report = "";
        this.changed();
      },
      end: () => { if (this.pose !== start) this.put(turns || rolls ? "object turned" : "object moved"); },
    };
  }

  wheel(view, event) {
    if (event.ctrlKey || !view.camera.pose) return false;
    const master_from_camera = invert(view.camera.pose), middle = this.middle();
    const origin = master_from_camera.map((row) => row[3]);
    const by = middle.map((v, i) => (v - origin[i]) * NEARER * Math.sign(event.deltaY));
    this.pose = this.pose.map((row, i) => [row[0], row[1], row[2], row[3] + by[i]]);
    this.changed();
    clearTimeout(this.late);
    this.late = setTimeout(() => this.settle(), 250);
    return true;
  }

  /* Turns of the wheel are one step, once it rests or something else is done. */
  settle() {
    if (!this.late) return;
    clearTimeout(this.late);
    this.late = null;
    this.put("object nearer or farther");
  }

  /* A drag on the object in the 3D viewer, which else turns the view. */
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
      const up = () => {
        window.removeEventListener("pointermove", drag.move);
        window.removeEventListener("pointerup", up);
        drag.end();
      };
      window.addEventListener("pointermove", drag.move);
      window.addEventListener("pointerup", up);
    }, { capture: true });
  }

  async snap() {
    if (!this.editing) this.start();
    const { app } = this, frame = app.frame;
    this.report = "fitting…";
    this.panel();
    try {
      const found = await post(`sequences/${app.told.sequence}/snap`, {
        frame, rotation_vector: rotationVector(this.pose), translation: this.pose.map((row) => row[3]),
      });
      if (app.frame !== frame || !this.editing) return;
      if (found.seen) {
        this.pose = rigid(found.rotation_vector, found.translation);
        this.report = `fitted: overlap ${found.overlap.toFixed(2)} in ${found.views} views, moved ${(1000 * found.moved_m).toFixed(0)} mm and ${((found.turned_rad * 180) / Math.PI).toFixed(0)}°`;
        this.put("object fitted to the images");
      } else this.report = "the images bear out no pose near this one; drag it nearer, or leave it as you see it";
    } catch (error) { this.report = error.message; }
    this.changed();
  }

  remove() {
    takePose(this.app.draft, this.app.frame);
    this.app.setMode(null);
  }

  undone() { // the draft went back: the pose follows
    this.pose = poseAt(this.app.draft, this.app.frame) ?? this.found(this.app.frame) ?? this.pose;
  }

  panel() {
    const box = this.box ??= make("div", { class: "pose" });
    const { app } = this, stated = posedFrames(app.draft);
    const where = stated.length ? `The annotation has a pose at frame${stated.length > 1 ? "s" : ""} ${stated.join(", ")}.` : "The annotation has no pose of the object.";
    if (!this.editing) {
      box.replaceChildren(make("p", {}, where),
        button("Place the object at this frame", () => this.start(), { class: "main", title: "O" }),
        ...stated.map((frame) => button(`Go to frame ${frame}`, () => app.show(frame))),
        ...(stated.includes(app.frame) ? [button("Remove the pose", () => this.remove())] : []));
      return box;
    }
    const numbers = [
      ...["x", "y", "z"].map((axis, i) => [`${axis}, m`, () => this.pose[i][3], (v) => { this.pose = this.pose.map((row, k) => (k === i ? [row[0], row[1], row[2], v] : row)); }, 0.005]),
      ...["x", "y", "z"].map((axis, i) => [`turn ${axis}, rad`, () => rotationVector(this.pose)[i], (v) => {
        const next = [...rotationVector(this.pose)]; next[i] = v;
        this.pose = rigid(next, this.pose.map((row) => row[3]));
      }, 0.02]),
    ];
    if (box.contains(document.activeElement) && document.activeElement.tagName === "INPUT") { // while it is typed
      box.querySelector(".report").textContent = this.report;
      return box;
    }
    box.replaceChildren(
      make("p", {}, `Object at frame ${app.frame}: master camera's frame, x right, y down, z forward.`),
      make("div", { class: "numbers" }, numbers.map(([name, value, set, step]) => make("label", {}, name,
        make("input", { type: "number", step: String(step), value: value().toFixed(4), oninput: (event) => {
          const number = event.target.valueAsNumber;
          event.target.setAttribute("aria-invalid", String(!Number.isFinite(number)));
          if (!Number.isFinite(number)) return;
          set(number);
          app.redraw();
        }, onchange: (event) => {
          if (Number.isFinite(event.target.valueAsNumber)) { this.put("object by numbers"); return; }
          event.target.value = value().toFixed(4); // no number: as it was
          event.target.removeAttribute("aria-invalid");
        } })))),
      make("p", { class: "report", role: "status" }, this.report),
      button("Fit to the images", () => this.snap(), { class: "main", title: "S" }),
      button("As the result has it", () => { const found = this.found(app.frame); if (found) { this.pose = found; this.put("object as found"); this.changed(); } }),
      button("Remove the pose", () => this.remove()),
      button("Done", () => app.setMode(null), { title: "Esc" }));
    return box;
  }

  mark(view, brush) {
    const at = this.app.views.place(view, this.middle());
    if (!at) return;
    const axes = [[1, 0, 0], [0, 1, 0], [0, 0, 1]].map((axis) =>
      this.middle().map((v, i) => v + 0.6 * this.object.header.diameter * turnOnly(this.pose, axis)[i]));
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

