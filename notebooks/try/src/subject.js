/** The object that a photo is of: the middle that a scene turns around (the rules of `export/subject.py`). */

import { eachSplat, photoCamera } from "./raster.js";

const SIDE = 48; // pixels of the image in which an object is sought
const WIDTH = 0.25; // standard deviation of the kernel, in halves of the image's width at its place
const REACH = 4; // standard deviations of the kernel within which what is seen may be the object's
const NEARNESS = 2; // exponent of 1 / depth in the weights
const STANDING_OUT = 6; // exponent of the median depth of a pixel's row over its own
const ROUNDS = 10; // of the mean shift
const ALMOST_ALL = 0.98; // share of an object's pixels that its radius holds
const HIDDEN_DEPTH = 0.5; // of the half size of an object's front: how far its middle lies behind the front

/**
 * @typedef {object} Subject
 * @property {number[]} center in the photo's camera's frame
 * @property {number} radius of a ball around it that holds the object
 *
 * @typedef {object} Seen a pixel that is more than half opaque
 * @property {number[]} ray
 * @property {number[]} point
 * @property {number} weight
 */

/**
 * @param {import("./pipeline.js").Gaussians} gaussians
 * @param {import("./photo.js").Photo} photo
 * @returns {Subject}
 */
export function subjectOf(gaussians, photo) {
  const camera = photoCamera(photo, SIDE);
  const front = frontOf(gaussians, camera, photo.part);
  if (front.length === 0) {
    const depths = Array.from({ length: gaussians.opacities.length }, (_, i) => gaussians.means[3 * i + 2]);
    return { center: [0, 0, quantile(depths, 0.5)], radius: 0 };
  }
  const inside = aroundMode(front, SIDE / (2 * camera.focal));
  const depth = quantile(inside.map(({ point }) => point[2]), 0.5);
  const [low, high] = [Math.min, Math.max].map((end) => {
    return [0, 1].map((axis) => inside.reduce((value, { ray }) => end(value, ray[axis]), inside[0].ray[axis]));
  });
  const halfSize = (Math.max(high[0] - low[0], high[1] - low[1]) / 2) * depth;
  const middle = [(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, 1];
  const center = middle.map((value) => value * (depth + HIDDEN_DEPTH * halfSize));
  // At the outline of the object, depths are partly of what lies behind it.
  const distances = inside.map(({ ray, point }) => {
    const bounded = Math.min(Math.max(point[2], depth - halfSize), depth + halfSize);
    return distance(ray.map((value) => value * bounded), center);
  });
  return { center, radius: Math.max(halfSize, quantile(distances, ALMOST_ALL)) };
}

/** @returns {Seen[]} */
function frontOf(gaussians, camera, [left, top, right, bottom]) {
  const sums = new Float32Array(SIDE * SIDE);
  const open = eachSplat(gaussians, camera, (_, depth, { count, pixels, weights }) => {
    for (let entry = 0; entry < count; entry++) {
      sums[pixels[entry]] += weights[entry] * depth;
    }
  });
  const surface = sums.map((sum, pixel) => (open[pixel] < 0.5 ? sum / (1 - open[pixel]) : 0));
  const pixels = [];
  for (let row = 0; row < SIDE; row++) {
    const depths = surface.subarray(row * SIDE, (row + 1) * SIDE);
    const typical = quantile([...depths].filter((depth) => depth > 0), 0.5);
    depths.forEach((depth, column) => {
      const [x, y] = [column + 0.5, row + 0.5];
      const isOwn = x > left * SIDE && x < right * SIDE && y > top * SIDE && y < bottom * SIDE;
      if (depth > 0 && isOwn) {
        const ray = [(x - camera.principal[0]) / camera.focal, (y - camera.principal[1]) / camera.focal, 1];
        const alpha = 1 - open[row * SIDE + column];
        const weight = alpha * (typical / depth) ** STANDING_OUT * depth ** -NEARNESS;
        pixels.push({ ray, point: ray.map((value) => value * depth), weight });
      }
    });
  }
  return pixels;
}

/**
 * Return which pixels show what lies around the mode, which is found by mean shift from the densest pixel.
 * @param {Seen[]} front
 * @param {number} halfWidth of the image, at a depth of 1
 * @returns {Seen[]}
 */
function aroundMode(front, halfWidth) {
  const kernel = (from, to, width) => Math.exp(-((distance(from, to) / width) ** 2) / 2);
  const densities = front.map(({ point }) => {
    const width = WIDTH * halfWidth * point[2];
    return front.reduce((sum, other) => sum + other.weight * kernel(point, other.point, width), 0);
  });
  const best = densities.indexOf(densities.reduce((most, density) => Math.max(most, density)));
  const width = WIDTH * halfWidth * front[best].point[2];
  let mode = front[best].point;
  for (let round = 0; round < ROUNDS; round++) {
    const near = front.map(({ point, weight }) => weight * kernel(point, mode, width));
    const total = near.reduce((sum, value) => sum + value, 0);
    mode = [0, 1, 2].map((axis) => near.reduce((sum, value, i) => sum + value * front[i].point[axis], 0) / total);
  }
  const gap = gapOf(front.map(({ point }) => point[2]));
  const close = front.filter(({ point }) => distance(point, mode) < REACH * width);
  const alike = close.filter(({ point }) => point[2] < gap === mode[2] < gap);
  return alike.length ? alike : close;
}

/** Return the depth that parts near from far: the one with the largest variance of 1 / depth between both (Otsu). */
function gapOf(depths) {
  const ordered = depths.map((depth) => 1 / depth).sort((a, b) => a - b);
  const total = ordered.reduce((sum, value) => sum + value, 0);
  let [gap, most, sum] = [Infinity, -1, 0];
  for (let below = 1; below < ordered.length; below++) {
    sum += ordered[below - 1];
    const apart = sum / below - (total - sum) / (ordered.length - below);
    const variance = below * (ordered.length - below) * apart * apart;
    if (variance > most) {
      most = variance;
      gap = 2 / (ordered[below - 1] + ordered[below]);
    }
  }
  return gap;
}

/** Return the value below which a share of the values lies. */
function quantile(values, share) {
  const ordered = Float64Array.from(values).sort();
  return ordered[Math.floor(share * (ordered.length - 1))];
}

function distance(a, b) {
  return Math.sqrt((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2); // hypot is slow
}
