/** Detail of a photo in a scene's front: Gaussians are split where the photo shows more than they can. */

import { BLUR, unitMatrix } from "./raster.js";

const APART = 0.7; // of the parts from the whole's centre along each of two axes, in its standard deviations
const SMALLER = Math.sqrt(1 - APART ** 2); // scale of the parts, which together have the variance of the whole
const PLACES = [[-APART, -APART], [-APART, APART], [APART, -APART], [APART, APART]];
const SMALLEST_SPLIT = 0.5; // standard deviation in pixels, below which nothing is split
const SMALLEST_ERROR = 1e-3; // squared error of a Gaussian's pixels, in all, below which it is not split
const ENTRIES = 256; // of the table of opacities

/**
 * Return Gaussians that look in the photo's camera's large image as the given ones look in its small one.
 *
 * The rasterizer adds a blur of pixels to each Gaussian, which is less of the scene in a larger image.
 * @param {import("./pipeline.js").Gaussians} gaussians
 * @param {import("./raster.js").Camera} small
 * @param {import("./raster.js").Camera} large
 * @returns {import("./pipeline.js").Gaussians}
 */
export function seenLarger(gaussians, small, large) {
  const variance = BLUR * (1 / small.focal ** 2 - 1 / large.focal ** 2);
  const scales = gaussians.scales.map((scale, index) => {
    const depth = gaussians.means[3 * Math.floor(index / 3) + 2];
    return Math.sqrt(scale ** 2 + variance * depth ** 2);
  });
  return { ...gaussians, scales };
}

/**
 * Return which Gaussians to split: those larger than pixels that show most of the image's error.
 * @param {import("./pipeline.js").Gaussians} gaussians
 * @param {import("./raster.js").Camera} camera the photo's
 * @param {Float32Array} errors squared, of the image, for each Gaussian
 * @param {number} most
 * @returns {number[]}
 */
export function worthSplitting(gaussians, camera, errors, most) {
  const chosen = [...errors.keys()].filter((number) => {
    const depth = gaussians.means[3 * number + 2];
    const isLarge = () => (lengthsAcross(gaussians, number)[1] * camera.focal) / depth > SMALLEST_SPLIT;
    return errors[number] > SMALLEST_ERROR && depth > 0 && isLarge();
  });
  return chosen.sort((a, b) => errors[b] - errors[a]).slice(0, most);
}

/** Return the axes of a Gaussian as they look from the photo's camera, the longest first. */
function axesAcross({ means, quaternions, scales }, number) {
  const rotation = unitMatrix(quaternions, number);
  const mean = means.subarray(3 * number, 3 * number + 3);
  const distance = Math.sqrt(mean[0] ** 2 + mean[1] ** 2 + mean[2] ** 2);
  const ray = Array.from(mean, (value) => value / distance);
  const axes = [0, 1, 2].map((index) => {
    const scale = scales[3 * number + index];
    const vector = [rotation[index] * scale, rotation[3 + index] * scale, rotation[6 + index] * scale];
    const along = vector[0] * ray[0] + vector[1] * ray[1] + vector[2] * ray[2];
    return { index, scale, vector, across: Math.sqrt(Math.max(scale ** 2 - along ** 2, 0)) };
  });
  return axes.sort((a, b) => b.across - a.across);
}

function lengthsAcross(gaussians, number) {
  return axesAcross(gaussians, number).map(({ across }) => across);
}

/**
 * Split Gaussians into four each, along the two axes that look longest from the photo's camera.
 *
 * The four look nearly like the whole. Along their third axis they are no longer than along the first, lest they are
 * spikes from the side. They come after all others; the first of them is in the place of the whole.
 * @param {import("./pipeline.js").Gaussians} gaussians
 * @param {number[]} chosen
 * @returns {import("./pipeline.js").Gaussians}
 */
export function split(gaussians, chosen) {
  const count = gaussians.opacities.length + (PLACES.length - 1) * chosen.length;
  const result = {};
  for (const [name, values] of Object.entries(gaussians)) {
    result[name] = new Float32Array((values.length / gaussians.opacities.length) * count);
    result[name].set(values);
  }
  const opacityOf = opacitiesOfParts();
  let free = gaussians.opacities.length;
  for (const number of chosen) {
    const [first, second, third] = axesAcross(gaussians, number);
    const scales = [0, 0, 0];
    scales[first.index] = SMALLER * first.scale;
    scales[second.index] = SMALLER * second.scale;
    scales[third.index] = Math.min(third.scale, SMALLER * first.scale);
    PLACES.forEach(([u, v], part) => {
      const place = part === 0 ? number : free + part - 1;
      for (let axis = 0; axis < 3; axis++) {
        const moved = u * first.vector[axis] + v * second.vector[axis];
        result.means[3 * place + axis] = gaussians.means[3 * number + axis] + moved;
        result.scales[3 * place + axis] = scales[axis];
        result.colors[3 * place + axis] = gaussians.colors[3 * number + axis];
      }
      result.quaternions.set(gaussians.quaternions.subarray(4 * number, 4 * number + 4), 4 * place);
      result.opacities[place] = opacityOf(gaussians.opacities[number]);
    });
    free += PLACES.length - 1;
  }
  return result;
}

/**
 * Return a function from a Gaussian's opacity to that of its parts, which cover as much of the image together.
 *
 * The integral of 1 - (1 - a g1) ... (1 - a g4), where the g are the parts' Gaussians, is a sum of integrals of products
 * of Gaussians. It grows with a, so a table of it is inverted.
 */
function opacitiesOfParts() {
  const factors = Array(PLACES.length + 1).fill(0); // of the powers of a
  for (let subset = 1; subset < 2 ** PLACES.length; subset++) {
    const members = PLACES.filter((_, index) => (subset >> index) & 1);
    const mean = [0, 1].map((axis) => members.reduce((sum, place) => sum + place[axis], 0) / members.length);
    const spread = members.reduce((sum, [u, v]) => sum + (u - mean[0]) ** 2 + (v - mean[1]) ** 2, 0);
    const integral = (SMALLER ** 2 / members.length) * Math.exp(-spread / (2 * SMALLER ** 2)); // over the whole's
    factors[members.length] -= (-1) ** members.length * integral;
  }
  const covered = Array.from({ length: ENTRIES + 1 }, (_, entry) => {
    return factors.reduce((sum, factor, power) => sum + factor * (entry / ENTRIES) ** power, 0);
  });
  return (opacity) => {
    const found = covered.findIndex((value) => value >= opacity);
    const above = found === -1 ? ENTRIES : Math.max(found, 1);
    const share = (opacity - covered[above - 1]) / (covered[above] - covered[above - 1]);
    return (above - 1 + Math.min(Math.max(share, 0), 1)) / ENTRIES;
  };
}
