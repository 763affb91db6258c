/** The chosen scene: it turns slowly until it is touched. */

import { cameraAt, mix, PHOTO_VIEW, viewOf } from "./orbit.js";
import { focalOf } from "./raster.js";
import { SplatRenderer } from "./splats_gl.js";

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
    this.renderer = new SplatRenderer(canvas); // throws where there is no WebGL 2
    this.gaussians = null;
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
    this.gaussians = gaussians;
    this.photo = photo;
    this.subject = subject;
    if (isNew) {
      this.turn = { ...PHOTO_VIEW };
      this.goal = null;
      this.isTurning = !matchMedia("(prefers-reduced-motion: reduce)").matches;
      this.rest = REST;
    }
    this.upload();
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

  /** Give the scene to the renderer. */
  upload() {
    const { fovDegrees, fitSize } = this.photo;
    this.renderer.setScene(this.gaussians, focalOf(fovDegrees, fitSize));
    this.request();
  }

  /** Begin again with a new context, such as after a phone's sleep. */
  restore() {
    this.renderer = new SplatRenderer(this.canvas);
    this.fence = null;
    if (this.gaussians) {
      this.upload();
    }
  }

  pixelRatio() {
    return Math.min(devicePixelRatio, MOST_PIXEL_RATIO) * (this.isMoving() ? this.scale : 1);
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
    if (!this.gaussians) {
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
    this.draw();
    const { gl } = this.renderer;
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
    const { gl } = this.renderer;
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

  /** Draw the scene from where the camera is; the photo's field of view is that of the shorter side. */
  draw() {
    const { fovDegrees, up } = this.photo;
    const ratio = this.pixelRatio();
    const { clientWidth, clientHeight } = this.canvas;
    const size = [clientWidth, clientHeight].map((length) => Math.max(Math.floor(length * ratio), 1));
    const camera = cameraAt(viewOf(this.turn, this.subject, up, fovDegrees), fovDegrees, Math.min(...size));
    this.renderer.draw({ ...camera, principal: size.map((length) => length / 2) }, size);
  }

  /** Stop turning, and let the scene be moved from where it is. */
  touch() {
    this.isTurning = false;
    this.goal = null;
    this.onTouch();
  }

  /** Turn and zoom by what a person did. */
  move(yaw, pitch, zoom) {
    if (!this.gaussians) {
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
    canvas.addEventListener("webglcontextlost", (event) => event.preventDefault()); // it may come back
    canvas.addEventListener("webglcontextrestored", () => this.restore());
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
