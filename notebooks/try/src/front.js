/** The front of a scene as the photo shows it: its colours, and where they do not suffice, smaller Gaussians. */

import { seenLarger, split, worthSplitting } from "./detail.js";
import { contributions } from "./raster.js";

const ENOUGH = 1e-3; // mean squared error (30 dB) at which fitting ends: more of it makes the sides of a scene worse
const ROUNDS = 4;
const DAMPING = 0.02; // squared weights that hold a colour where it was
const PARTS_PER_PIXEL = 0.5; // Gaussians that splits may add for each new pixel of the photo

/**
 * @typedef {object} Target an image that a front is fitted to
 * @property {import("./raster.js").Camera} camera
 * @property {Float32Array} image [3, size, size]
 * @property {Float32Array} own 1 where the image is to be fitted, else 0
 */

/**
 * Fit a scene's front to a photo's images, the smallest of which is of the network's size.
 * @param {import("./pipeline.js").Gaussians} gaussians
 * @param {Target[]} targets
 * @param {number} background grey value behind the scene
 * @returns {import("./pipeline.js").Gaussians}
 */
export function fitFront(gaussians, [first, ...larger], background) {
  let scene = new Fit(gaussians, first, background).run();
  let last = first;
  for (const target of larger) {
    const before = new Fit(seenLarger(scene, last.camera, target.camera), target, background);
    const pixels = target.camera.size ** 2 - last.camera.size ** 2;
    const most = Math.floor((PARTS_PER_PIXEL * pixels) / 3);
    const chosen = before.isEnough() ? [] : worthSplitting(before.given, target.camera, before.errors(), most);
    const after = chosen.length ? new Fit(split(before.given, chosen), target, background) : before;
    scene = after.run();
    last = target;
  }
  return scene;
}

/**
 * Least squares of colours by rounds over all Gaussians, each of which sets its colour to what is best while the others
 * stay (Gauss and Seidel). No colour becomes brighter than white, because it would show from the side.
 */
class Fit {
  /**
   * @param {import("./pipeline.js").Gaussians} gaussians
   * @param {Target} target
   * @param {number} background
   */
  constructor(gaussians, { camera, image, own }, background) {
    this.given = gaussians;
    this.colors = gaussians.colors.slice();
    this.own = own;
    this.seen = contributions(gaussians, camera, background);
    this.count = 3 * own.reduce((sum, value) => sum + value, 0);
    this.residuals = this.seen.image.map((value, index) => {
      const pixel = Math.floor(index / 3);
      return own[pixel] * (image[(index % 3) * own.length + pixel] - value);
    });
  }

  isEnough() {
    const squares = this.residuals.reduce((sum, value) => sum + value * value, 0);
    return squares <= ENOUGH * this.count;
  }

  /** @returns {import("./pipeline.js").Gaussians} with other colours */
  run() {
    for (let round = 0; round < ROUNDS && !this.isEnough(); round++) {
      this.seen.gaussians.forEach((number, place) => this.settle(number, place));
    }
    return { ...this.given, colors: this.colors };
  }

  /** Set the colour of one Gaussian, and take the change from the residuals. */
  settle(number, place) {
    const { starts, pixels, weights } = this.seen;
    const { residuals, own } = this;
    const [start, end] = [starts[place], starts[place + 1]];
    let square = DAMPING;
    let [red, green, blue] = [0, 0, 0];
    for (let entry = start; entry < end; entry++) {
      const at = 3 * pixels[entry];
      const weight = weights[entry] * own[pixels[entry]];
      square += weight * weight;
      red += weight * residuals[at];
      green += weight * residuals[at + 1];
      blue += weight * residuals[at + 2];
    }
    red = this.change(3 * number, red, square);
    green = this.change(3 * number + 1, green, square);
    blue = this.change(3 * number + 2, blue, square);
    for (let entry = start; entry < end; entry++) {
      const at = 3 * pixels[entry];
      const weight = weights[entry] * own[pixels[entry]];
      residuals[at] -= weight * red;
      residuals[at + 1] -= weight * green;
      residuals[at + 2] -= weight * blue;
    }
  }

  /** Change one number of the colours, and return by how much. */
  change(index, product, square) {
    const given = this.given.colors[index];
    const color = this.colors[index];
    const wanted = color + (product + DAMPING * (given - color)) / square;
    this.colors[index] = Math.min(Math.max(wanted, Math.min(given, 0)), Math.max(given, 1));
    return this.colors[index] - color;
  }

  /** Return the image's squared errors for each Gaussian, weighted by its share of each pixel. */
  errors() {
    const { gaussians, starts, pixels, weights } = this.seen;
    const { residuals } = this;
    const errors = new Float32Array(this.given.opacities.length);
    gaussians.forEach((number, place) => {
      for (let entry = starts[place]; entry < starts[place + 1]; entry++) {
        const at = 3 * pixels[entry];
        const error = residuals[at] ** 2 + residuals[at + 1] ** 2 + residuals[at + 2] ** 2;
        errors[number] += weights[entry] * error;
      }
    });
    return errors;
  }
}
