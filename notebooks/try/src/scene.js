/** The chosen scene, drawn by Spark: it turns slowly until it is touched. */

import { PackedSplats, SparkRenderer, SplatMesh } from "@sparkjsdev/spark";
import { Color, PerspectiveCamera, Quaternion, Scene, Vector3, WebGLRenderer } from "three";

import { mix, PHOTO_VIEW, viewOf } from "./orbit.js";

const BLUR = 0.3; // px^2 that the rasterizer of the fit adds to projected covariances
const SPEED = (12 * Math.PI) / 180; // a second
const REST = 1.2; // seconds in which a new scene is seen from the front
const GLIDE = 1.2; // seconds from the photo's view to the orbit's
const SLOW = 0.2; // seconds for an image, from which on moving images have fewer pixels, as without a graphics card
const STEP = Math.PI / 24; // of an arrow key
const MOST_PITCH = 1.2;
const ZOOMS = [0.35, 2.5];
const MOST_PIXEL_RATIO = 2;
const LEAST_SCALE = 0.125;
const LONGEST_STEP = 0.1; // seconds by which a scene turns between two images

/** View of one scene in a canvas. */
export class SceneView {
  /**
   * @param {HTMLCanvasElement} canvas
   * @param {() => void} onTouch called when somebody touches the scene
   */
  constructor(canvas, onTouch) {
    this.canvas = canvas;
    this.onTouch = onTouch;
    const options = { canvas, antialias: false, alpha: true, premultipliedAlpha: true };
    this.renderer = new WebGLRenderer(options); // throws where there is no WebGL 2
    this.scene = new Scene();
    this.spark = new SparkRenderer({
      renderer: this.renderer,
      onDirty: () => this.request(),
      // As the rasterizer of the fit.
      preBlurAmount: BLUR,
      blurAmount: 0,
      maxStdDev: Math.sqrt(2 * Math.log(255)),
      maxPixelRadius: 4096,
      sortRadial: false,
    });
    this.scene.add(this.spark);
    this.camera = new PerspectiveCamera();
    this.camera.matrixAutoUpdate = false;
    this.mesh = null;
    this.turn = { ...PHOTO_VIEW };
    this.goal = null; // of a glide
    this.isTurning = false;
    this.isRequested = false;
    this.scale = 1; // of the resolution while the scene moves
    this.fence = null; // until the graphics card has drawn the last image
    this.pointers = new Map();
    this.listen();
    new ResizeObserver(() => this.request()).observe(canvas);
  }

  /**
   * Show a scene from the photo's view; later ones of the same photo from where the last was seen.
   * @param {{gaussians: import("./pipeline.js").Gaussians, subject: import("./subject.js").Subject}} sample
   * @param {{fovDegrees: number, up: number[], fitSize: number}} photo
   * @param {boolean} isNew whether it is of another photo
   */
  show({ gaussians, subject }, photo, isNew) {
    const mesh = new SplatMesh({ packedSplats: this.packed(gaussians, photo) });
    this.scene.add(mesh);
    if (this.mesh) {
      this.scene.remove(this.mesh);
      this.mesh.dispose();
    }
    this.mesh = mesh;
    this.photo = photo;
    this.subject = subject;
    if (isNew) {
      this.turn = { ...PHOTO_VIEW };
      this.goal = null;
      this.isTurning = !matchMedia("(prefers-reduced-motion: reduce)").matches;
      this.rest = REST;
    }
    mesh.initialized.then(() => this.request());
  }

  /** Remove the scene. */
  clear() {
    if (this.mesh) {
      this.scene.remove(this.mesh);
      this.mesh.dispose();
      this.mesh = null;
      this.request();
    }
  }

  /** Glide to the photo's view, and stay. */
  toPhoto() {
    this.isTurning = false;
    this.turn.yaw = nearestToZero(this.turn.yaw);
    this.glideTo(PHOTO_VIEW);
  }

  /** Turn, or stand still. */
  setTurning(isTurning) {
    this.isTurning = isTurning;
    this.rest = 0;
    this.goal = null;
    this.request();
  }

  /**
   * Return splats for Spark. They look at the canvas's size as they look at that of the fit, whose pixels blur more.
   */
  packed({ means, quaternions, scales, opacities, colors }, { fovDegrees, fitSize }) {
    const rgbMax = colors.reduce((most, value) => Math.max(most, value), 1);
    const splats = new PackedSplats({ maxSplats: opacities.length, splatEncoding: { rgbMin: 0, rgbMax } });
    const tangent = Math.tan((fovDegrees * Math.PI) / 360);
    const variance = BLUR * (((2 * tangent) / fitSize) ** 2 - ((2 * tangent) / this.side()) ** 2);
    const [center, scale, quaternion, color] = [new Vector3(), new Vector3(), new Quaternion(), new Color()];
    for (let i = 0; i < opacities.length; i++) {
      center.fromArray(means, 3 * i);
      const added = Math.max(variance, 0) * center.z ** 2;
      const [a, b, c] = [0, 1, 2].map((axis) => Math.sqrt(scales[3 * i + axis] ** 2 + added));
      scale.set(a, b, c);
      const [w, x, y, z] = quaternions.subarray(4 * i, 4 * i + 4);
      quaternion.set(x, y, z, w).normalize();
      color.setRGB(...[0, 1, 2].map((channel) => Math.max(colors[3 * i + channel], 0)));
      splats.pushSplat(center, scale, quaternion, opacities[i], color);
    }
    return splats;
  }

  pixelRatio() {
    return Math.min(devicePixelRatio, MOST_PIXEL_RATIO) * (this.isMoving() ? this.scale : 1);
  }

  /** Side of the square in which the photo's view appears, in pixels. */
  side() {
    const ratio = Math.min(devicePixelRatio, MOST_PIXEL_RATIO);
    return Math.max(Math.min(this.canvas.clientWidth, this.canvas.clientHeight) * ratio, 1);
  }

  /** Draw when the browser next does. */
  request() {
    if (!this.isRequested) {
      this.isRequested = true;
      requestAnimationFrame((now) => this.animate(now));
    }
  }

  animate(now) {
    this.isRequested = false;
    if (!this.mesh) {
      this.renderer.clear();
      return;
    }
    if (this.isBusy(now)) {
      this.request();
      return;
    }
    const seconds = Math.min((now - (this.last ?? now)) / 1000, LONGEST_STEP);
    this.last = this.isMoving() ? now : undefined;
    this.advance(seconds);
    this.fitToCanvas();
    this.place();
    this.renderer.render(this.scene, this.camera);
    const gl = this.renderer.getContext();
    this.fence = { sync: gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0), begun: now };
    gl.flush();
    if (this.goal || this.isTurning) {
      this.request();
    }
  }

  isMoving() {
    return Boolean(this.goal || this.isTurning || this.pointers.size);
  }

  /** Return whether the last image is still being drawn; moving images become smaller where that takes long. */
  isBusy(now) {
    if (!this.fence) {
      return false;
    }
    const gl = this.renderer.getContext();
    if (gl.getSyncParameter(this.fence.sync, gl.SYNC_STATUS) !== gl.SIGNALED) {
      return true;
    }
    gl.deleteSync(this.fence.sync);
    if ((now - this.fence.begun) / 1000 > SLOW) {
      this.scale = Math.max(this.scale / 2, LEAST_SCALE);
    }
    this.fence = null;
    return false;
  }

  /** Move the camera on. */
  advance(seconds) {
    if (this.goal) {
      this.goal.share = Math.min(this.goal.share + seconds / GLIDE, 1);
      const eased = this.goal.share ** 2 * (3 - 2 * this.goal.share);
      for (const name of Object.keys(this.turn)) {
        this.turn[name] = mix(this.goal.from[name], this.goal.to[name], eased);
      }
      this.goal = this.goal.share < 1 ? this.goal : null;
    } else if (this.isTurning) {
      this.rest = Math.max(this.rest - seconds, 0);
      if (this.rest === 0) {
        this.turn.look = Math.min(this.turn.look + seconds / GLIDE, 1);
        this.turn.yaw += SPEED * seconds;
      }
    }
  }

  glideTo(turn) {
    this.goal = { from: { ...this.turn }, to: { ...turn }, share: 0 };
    if (matchMedia("(prefers-reduced-motion: reduce)").matches) {
      this.goal.share = 1;
    }
    this.last = undefined;
    this.request();
  }

  fitToCanvas() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const ratio = this.pixelRatio();
    if (this.canvas.width !== Math.floor(width * ratio) || this.canvas.height !== Math.floor(height * ratio)) {
      this.renderer.setPixelRatio(ratio);
      this.renderer.setSize(width, height, false);
    }
    const tangent = Math.tan((this.photo.fovDegrees * Math.PI) / 360) * Math.max(height / width, 1);
    this.camera.fov = (2 * Math.atan(tangent) * 180) / Math.PI;
    this.camera.aspect = width / height;
    this.camera.near = 0.01;
    this.camera.updateProjectionMatrix();
  }

  /** Put the camera in its place; three.js has y up and looks along -z. */
  place() {
    const { eye, right, down, forward } = viewOf(this.turn, this.subject, this.photo.up, this.photo.fovDegrees);
    const rows = [0, 1, 2].map((i) => [right[i], -down[i], -forward[i], eye[i]]);
    this.camera.matrix.set(...rows.flat(), 0, 0, 0, 1);
    this.camera.updateMatrixWorld(true);
  }

  /** Stop turning, and let the scene be moved from where it is. */
  touch() {
    this.isTurning = false;
    this.goal = null;
    this.onTouch();
  }

  /** Turn and zoom by what a person did. */
  move(yaw, pitch, zoom) {
    if (!this.mesh) {
      return;
    }
    this.touch();
    this.turn.look = Math.min(this.turn.look + (Math.abs(yaw) + Math.abs(pitch)) * 1.5, 1);
    this.turn.yaw += yaw;
    this.turn.pitch = Math.min(Math.max(this.turn.pitch + pitch, -MOST_PITCH), MOST_PITCH);
    this.turn.zoom = Math.min(Math.max(this.turn.zoom * zoom, ZOOMS[0]), ZOOMS[1]);
    this.request();
  }

  listen() {
    const { canvas } = this;
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      this.pointers.set(event.pointerId, [event.clientX, event.clientY]);
      this.touch();
    });
    canvas.addEventListener("pointermove", (event) => this.drag(event));
    for (const kind of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(kind, (event) => {
        this.pointers.delete(event.pointerId);
        this.request(); // with all pixels
      });
    }
    const onWheel = (event) => {
      event.preventDefault();
      this.move(0, 0, Math.exp(event.deltaY * 0.001));
    };
    canvas.addEventListener("wheel", onWheel, { passive: false });
    canvas.addEventListener("keydown", (event) => this.press(event));
    canvas.addEventListener("dblclick", () => this.toPhoto());
  }

  /** One pointer turns, two zoom. */
  drag(event) {
    const last = this.pointers.get(event.pointerId);
    if (!last) {
      return;
    }
    const before = this.spread();
    this.pointers.set(event.pointerId, [event.clientX, event.clientY]);
    if (this.pointers.size === 2) {
      this.move(0, 0, before / this.spread());
      return;
    }
    const angle = Math.PI / Math.min(this.canvas.clientWidth, this.canvas.clientHeight);
    this.move((last[0] - event.clientX) * angle, (event.clientY - last[1]) * angle, 1);
  }

  /** Distance between two pointers. */
  spread() {
    const [a, b] = [...this.pointers.values()];
    return b ? Math.max(Math.hypot(a[0] - b[0], a[1] - b[1]), 1) : 1;
  }

  press(event) {
    const moves = {
      ArrowLeft: [-STEP, 0, 1],
      ArrowRight: [STEP, 0, 1],
      ArrowUp: [0, STEP, 1],
      ArrowDown: [0, -STEP, 1],
      "+": [0, 0, 0.9],
      "=": [0, 0, 0.9],
      "-": [0, 0, 1 / 0.9],
    };
    if (event.key in moves) {
      event.preventDefault();
      this.move(...moves[event.key]);
    }
    if (event.key === "Home") {
      event.preventDefault();
      this.toPhoto();
      this.onTouch();
    }
  }
}

/** Return the same direction, by less than half a turn from the front. */
function nearestToZero(angle) {
  return angle - 2 * Math.PI * Math.round(angle / (2 * Math.PI));
}
