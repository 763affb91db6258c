/** The front of a scene in the photo's colours. */

import { contributions } from "./raster.js";

const ENOUGH = 1e-3; // mean squared error (30 dB) at which fitting ends: more of it makes the sides of a scene worse
const DAMPING = 0.02; // squared weights that hold a colour where it was

/**
 * Fit the colours of Gaussians to a photo, as far as they are seen in it: least squares by rounds over all Gaussians,
 * each of which sets its colour to what is best while the others stay (Gauss and Seidel).
 *
 * No colour becomes brighter than white or darker than black, because it would show from the side.
 *
 * @param {import("./pipeline.js").Gaussians} gaussians
 * @param {import("./raster.js").Camera} camera
 * @param {Float32Array} image [3, size, size]
 * @param {Float32Array} own 1 where the image is to be fitted, else 0
 * @param {number} rounds
 * @param {number} background grey value behind the scene
 * @returns {{gaussians: import("./pipeline.js").Gaussians, before: number, after: number}} with mean squared errors
 */
export function fitColors(gaussians, camera, image, own, rounds, background) {
  const seen = contributions(gaussians, camera);
  const colors = gaussians.colors.slice();
  const residuals = missing(seen, colors, image, own, background);
  const count = 3 * own.reduce((sum, value) => sum + value, 0);
  const before = squares(residuals) / count;
  let after = before;
  for (let round = 0; round < rounds && after > ENOUGH; round++) {
    for (let place = 0; place < seen.gaussians.length; place++) {
      settle(seen, place, gaussians.colors, colors, residuals, own);
    }
    after = squares(residuals) / count;
  }
  return { gaussians: { ...gaussians, colors }, before, after };
}

/** Return what an image lacks, [pixel, channel], and 0 where it is not to be fitted. */
function missing({ gaussians, starts, pixels, weights, open }, colors, image, own, background) {
  const residuals = new Float32Array(3 * open.length);
  for (let index = 0; index < residuals.length; index++) {
    const pixel = Math.floor(index / 3);
    residuals[index] = image[(index % 3) * open.length + pixel] - open[pixel] * background;
  }
  gaussians.forEach((number, place) => {
    for (let entry = starts[place]; entry < starts[place + 1]; entry++) {
      for (let channel = 0; channel < 3; channel++) {
        residuals[3 * pixels[entry] + channel] -= weights[entry] * colors[3 * number + channel];
      }
    }
  });
  return residuals.map((value, index) => value * own[Math.floor(index / 3)]);
}

/** Set the colour of one Gaussian, and take the change from the residuals. */
function settle({ gaussians, starts, pixels, weights }, place, given, colors, residuals, own) {
  const number = gaussians[place];
  let square = DAMPING;
  let [red, green, blue] = [0, 0, 0];
  for (let entry = starts[place]; entry < starts[place + 1]; entry++) {
    const pixel = pixels[entry];
    const weight = weights[entry] * own[pixel];
    square += weight * weight;
    red += weight * residuals[3 * pixel];
    green += weight * residuals[3 * pixel + 1];
    blue += weight * residuals[3 * pixel + 2];
  }
  const wanted = [red, green, blue];
  for (let channel = 0; channel < 3; channel++) {
    const index = 3 * number + channel;
    const pull = DAMPING * (given[index] - colors[index]);
    const color = colors[index] + (wanted[channel] + pull) / square;
    const clamped = Math.min(Math.max(color, Math.min(given[index], 0)), Math.max(given[index], 1));
    wanted[channel] = Math.fround(clamped) - colors[index];
    colors[index] = clamped;
  }
  for (let entry = starts[place]; entry < starts[place + 1]; entry++) {
    const pixel = pixels[entry];
    const weight = weights[entry] * own[pixel];
    residuals[3 * pixel] -= weight * wanted[0];
    residuals[3 * pixel + 1] -= weight * wanted[1];
    residuals[3 * pixel + 2] -= weight * wanted[2];
  }
}

function squares(residuals) {
  return residuals.reduce((sum, value) => sum + value * value, 0);
}
