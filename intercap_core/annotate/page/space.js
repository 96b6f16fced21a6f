/* The 4D viewer. The overlay takes the body's vertices and colours from it, and the parts in contact. The
 * result before the last run is loaded here as well. */
import { fetchArrays } from "./api.js";
import { find, make } from "./dom.js";
import { apply, compose, invert } from "./geometry.js";
import { posedFrames } from "./pose.js";

export const GREY = [0.62, 0.62, 0.64]; // colour of the body while left and right are coloured
const BODY = [0.42, 0.66, 0.92];
export const BEFORE = [0.72, 0.5, 0.95];

export class Space {
  constructor(app) {
    this.app = app;
    this.viewer = null;
    this.before = null;
  }

  async load() {
    const { app } = this;
    find("space").replaceChildren(make("p", { class: "dim" }, "Loading the body and the 4D viewer (some MB)… Images and marks can already be used."));
    try {
      const data = await fetchArrays(`${app.path}/viewer?v=${app.info.result}`), { header, arrays } = data;
      find("space").replaceChildren(viewerElement());
      await window.showInterCap(data);
      this.viewer = window.intercapViewer;
      if (!this.viewer) throw new Error("this browser cannot draw in 3D");
      this.main = Object.keys(header.versions)[0];
      app.overlay?.mesh("body", arrays.faces, BODY, arrays[`${this.main}/rest`]);
      this.data = data;
      this.centresFrame = -1;
      this.master_from_zup = invert(app.info.zup_from_master);
    } catch (error) {
      this.viewer = null;
      find("space").replaceChildren(make("p", { class: "fault" }, error.message));
      return;
    }
    const root = document.querySelector(".viewer");
    new MutationObserver(() => { // the viewer's own controls change the frame as well
      const frame = Number(root.dataset.frame);
      if (frame !== app.frame && !this.follows) app.show(frame);
    }).observe(root, { attributes: true, attributeFilter: ["data-frame"] });
    app.pose?.watch(root.querySelector("canvas"));
    app.redraw();
  }

  /* Show why there is no viewer. */
  showReason(reason) {
    this.viewer = null;
    find("space").replaceChildren(make("p", { class: "dim" }, reason));
  }

  /* Load the result before the last run. */
  async loadBefore() {
    const { app } = this, before = {};
    for (const name of ["object", "viewer"]) {
      try { before[name] = await fetchArrays(`${app.path}/${name}?version=before&v=${app.info.result}`); } catch { /* the old result did not have it */ }
    }
    const { viewer } = before;
    if (viewer && app.overlay) {
      const name = Object.keys(viewer.header.versions)[0];
      before.body = window.skinnedBody(name, viewer.header, viewer.arrays);
      // the old result has its own z-up frame, given by the pose of the master camera
      before.master_from_zup = invert(viewer.header.cameras.find(({ name: camera }) => camera === app.info.master).pose);
      app.overlay.mesh("before", viewer.arrays.faces, BEFORE, viewer.arrays[`${name}/rest`]);
    }
    this.before = before;
  }

  /* Bodies to draw over the images in a frame. */
  bodies(frame, layers) {
    const { overlay } = this.app, bodies = [];
    if (!layers.body) return bodies;
    if (layers.before && this.before?.body) {
      this.before.body.pose(frame);
      overlay.move("before", this.before.body.mesh.geometry.attributes.position.array);
      bodies.push({ name: "before", pose: this.before.master_from_zup });
    }
    if (this.viewer) {
      const body = this.viewer.versions[this.main], { position, color } = body.mesh.geometry.attributes;
      body.pose(frame);
      window.paintContact(body.mesh, frame, this.data.header, this.data.arrays, layers.sides ? GREY : BODY, layers.contact && !layers.sides);
      overlay.move("body", position.array, color.array); // the viewer paints its own colours before it draws
      bodies.push({ name: "body", pose: this.master_from_zup });
    }
    return bodies;
  }

  setLayers({ contact, body, object }) {
    if (!this.viewer) return;
    this.viewer.state.contact = contact;
    const version = this.viewer.versions[this.main];
    version.group.children[0].visible = body;
    if (version.object) version.object.shown = object;
  }

  /* Update the 3D viewer in the next animation frame, after the images. */
  follow() {
    if (!this.viewer || this.follows) return;
    this.follows = true;
    requestAnimationFrame(() => {
      this.follows = false;
      this.viewer?.show(this.app.frame);
      this.#showEdited();
    });
  }

  /* Show the edited pose in 3D. */
  #showEdited() {
    const { app } = this, object = this.viewer?.versions[this.main]?.object, pose = app.pose?.at(app.frame);
    if (!object || !pose || !(app.pose.editing || posedFrames(app.draft).length)) return;
    const [a, b, c] = compose(app.info.zup_from_master, pose);
    object.mesh.visible = app.layers.object;
    object.mesh.matrix.set(...a, ...b, ...c, 0, 0, 0, 1);
    object.mesh.matrixWorldNeedsUpdate = true;
    this.viewer.draw();
  }

  /* The viewer's virtual camera: camera_from_master, and the size of a pixel in metres at a depth. */
  eye() {
    const { eye } = this.viewer, canvas = document.querySelector(".viewer canvas");
    eye.updateMatrixWorld();
    const m = eye.matrixWorld.elements; // column-major, looks along -z with y up
    const zup_from_eye = [0, 1, 2].map((k) => [m[k], -m[4 + k], -m[8 + k], m[12 + k]]);
    const camera_from_master = compose(invert(zup_from_eye), this.app.info.zup_from_master);
    const tall = 2 * Math.tan((eye.fov * Math.PI) / 360);
    return { camera_from_master, metres: (depth) => (depth * tall) / canvas.clientHeight };
  }

  /* Mark parts in contact by a dot at their centre, even if they are occluded. */
  markContact(view, brush) {
    const { app } = this;
    if (!this.viewer || !app.info.object) return;
    if (this.centresFrame !== app.frame) {
      this.centresFrame = app.frame;
      this.centres = this.#centres();
    }
    for (const [k, { part, share, point }] of this.centres.entries()) {
      const at = app.views.place(view, point);
      if (!at) continue;
      brush.globalAlpha = Math.max(0.35, share);
      brush.fillStyle = "#ff3b47";
      brush.strokeStyle = "#ffffff";
      brush.lineWidth = 1.5;
      brush.beginPath();
      brush.arc(...at, view.width > 400 ? 5 : 3, 0, 7);
      brush.fill();
      brush.stroke();
      if (view.width > 400) {
        brush.font = "600 12px system-ui";
        brush.lineWidth = 3;
        brush.strokeStyle = "rgba(0, 0, 0, 0.7)";
        const text = `${part.replaceAll("_", " ")} ${Math.round(100 * share)} %`;
        const below = at[1] - 3 + 15 * k; // avoids overlapping labels
        brush.strokeText(text, at[0] + 9, below);
        brush.fillStyle = "#ffffff";
        brush.fillText(text, at[0] + 9, below);
      }
      brush.globalAlpha = 1;
    }
  }

  /* Centres of the body parts whose probability of contact is at least 0.25, master frame. */
  #centres() {
    const { app } = this, { regions } = app.contact, region = this.data.arrays["contact/region"], vertices = this.viewer.versions[this.main].mesh.geometry.attributes.position.array;
    if (!region) return [];
    const sums = regions.map((part) => ({ part, share: app.contact.probabilityAt(part, app.frame) ?? 0, count: 0, sum: [0, 0, 0] }));
    for (let v = 0; v < region.length; v += 1) {
      const total = sums[region[v]];
      if (!total || total.share < 0.25) continue;
      total.count += 1;
      for (let k = 0; k < 3; k += 1) total.sum[k] += vertices[3 * v + k];
    }
    return sums.filter(({ count }) => count).map(({ part, share, count, sum }) =>
      ({ part, share, point: apply(this.master_from_zup, sum.map((v) => v / count)) }));
  }
}

function viewerElement() {
  const part = (tag, name, more = {}, ...children) => make(tag, { ...more, data: { part: name } }, ...children);
  return make("div", { class: "viewer", tabIndex: 0, role: "group", "aria-label": "Sequence in 3D over time" },
    make("div", { class: "stage" }, part("canvas", "canvas", { role: "img", "aria-label": "Body and object in 3D" }), part("div", "message", { role: "status" })),
    make("details", {}, make("summary", {}, "3D view"), part("div", "layers", { role: "group", "aria-label": "Shown in 3D" }),
      make("label", {}, "view ", part("select", "views", {}, new Option("free", "-1"))), part("button", "reset", { type: "button" }, "Overview")));
}
