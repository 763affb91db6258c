/** A rasterizer on the CPU, with the rules of `completesplat/rasterizers` (EWA splatting, front to back). */

export const BLUR = 0.3; // px^2, added to the diagonal of a projected covariance
export const NEAR = 0.01;
export const MAX_ALPHA = 0.999;
export const MIN_ALPHA = 1 / 255;
const MIN_TRANSMITTANCE = 1e-4;
export const FRUSTUM_MARGIN = 0.3;
const SMALLEST_KEPT = 6e-3; // weight of a Gaussian in a pixel

/**
 * @typedef {object} Camera
 * @property {number} size side of the image in pixels
 * @property {number} focal in pixels
 * @property {[number, number]} principal point, in pixels
 * @property {number[]} rotation from the world to the camera, 9 numbers by rows
 * @property {number[]} translation
 *
 * @typedef {object} Contributions what each Gaussian adds to each pixel, nearest Gaussians first
 * @property {Int32Array} gaussians numbers of the Gaussians that are seen
 * @property {Int32Array} starts of their entries, and the end of the last
 * @property {Int32Array} pixels of the entries
 * @property {Float32Array} weights of the entries
 * @property {Float32Array} image [pixel, 3], of all weights
 */

/**
 * Return the camera that took a photo, at the origin of the world.
 * @param {{fovDegrees: number, axis: [number, number]}} photo
 * @param {number} size
 * @returns {Camera}
 */
export function photoCamera({ fovDegrees, axis }, size) {
  return {
    size,
    focal: focalOf(fovDegrees, size),
    principal: [size * axis[0], size * axis[1]],
    rotation: [1, 0, 0, 0, 1, 0, 0, 0, 1],
    translation: [0, 0, 0],
  };
}

/** Return the focal length, in pixels, of a camera whose images have a side of this size. */
export function focalOf(fovDegrees, size) {
  return size / 2 / Math.tan((fovDegrees * Math.PI) / 360);
}

/** Numbers of pixels with weights, whose count is not known before. */
class Entries {
  constructor(capacity) {
    this.count = 0;
    this.pixels = new Int32Array(capacity);
    this.weights = new Float32Array(capacity);
  }

  /** Make room for as many entries more. */
  reserve(more) {
    const { pixels, weights } = this;
    if (this.count + more > pixels.length) {
      this.pixels = new Int32Array(2 * pixels.length + more);
      this.weights = new Float32Array(2 * pixels.length + more);
      this.pixels.set(pixels);
      this.weights.set(weights);
    }
  }

  /** Add those of other entries that are not tiny. */
  append(others) {
    this.reserve(others.count);
    for (let entry = 0; entry < others.count; entry++) {
      if (others.weights[entry] > SMALLEST_KEPT) {
        this.pixels[this.count] = others.pixels[entry];
        this.weights[this.count] = others.weights[entry];
        this.count += 1;
      }
    }
  }
}

/**
 * Call a function with what each Gaussian adds to the pixels of an image, nearest first.
 * @param {import("./pipeline.js").Gaussians} gaussians
 * @param {Camera} camera
 * @param {(number: number, depth: number, entries: Entries) => void} take it copies what it keeps of the entries
 * @returns {Float32Array} what is left of each pixel for the background
 */
export function eachSplat(gaussians, camera, take) {
  const { size } = camera;
  const { order, depths } = byDepth(gaussians, camera);
  const open = new Float32Array(size * size).fill(1);
  const stopped = new Uint8Array(size * size);
  const entries = new Entries(size * size);
  order.forEach((number, place) => {
    const splat = projected(gaussians, camera, number);
    entries.count = 0;
    if (splat) {
      addEntries(splat, size, open, stopped, entries);
    }
    if (entries.count > 0) {
      take(number, depths[place], entries);
    }
  });
  return open;
}

/**
 * Return an image of Gaussians, and what each of them adds to each pixel, without tiny weights.
 * @param {import("./pipeline.js").Gaussians} gaussians
 * @param {Camera} camera
 * @param {number} background grey value
 * @returns {Contributions}
 */
export function contributions(gaussians, camera, background) {
  const all = new Entries(64 * gaussians.opacities.length);
  const numbers = [];
  const starts = [0];
  const image = rendered(gaussians, camera, background, (number, entries) => {
    all.append(entries);
    numbers.push(number);
    starts.push(all.count);
  });
  return {
    gaussians: Int32Array.from(numbers),
    starts: Int32Array.from(starts),
    pixels: all.pixels,
    weights: all.weights,
    image,
  };
}

/** Return the numbers of the Gaussians in front of a camera, nearest first, and their depths. */
function byDepth({ means, opacities }, { rotation, translation }) {
  const all = new Float32Array(opacities.length);
  const seen = [];
  for (let i = 0; i < all.length; i++) {
    const at = 3 * i;
    const depth = rotation[6] * means[at] + rotation[7] * means[at + 1] + rotation[8] * means[at + 2] + translation[2];
    all[i] = depth;
    if (depth > NEAR && opacities[i] >= MIN_ALPHA) {
      seen.push(i);
    }
  }
  const order = Int32Array.from(seen).sort((i, j) => all[i] - all[j]);
  return { order, depths: Float32Array.from(order, (i) => all[i]) };
}

/**
 * Return a Gaussian in the image: centre, conic (inverse covariance), half height, and the exponent where it ends.
 */
function projected(gaussians, { size, focal, principal, rotation: r, translation: t }, number) {
  const { means, scales, quaternions, opacities } = gaussians;
  const [mx, my, mz] = [means[3 * number], means[3 * number + 1], means[3 * number + 2]];
  const x = r[0] * mx + r[1] * my + r[2] * mz + t[0];
  const y = r[3] * mx + r[4] * my + r[5] * mz + t[1];
  const z = r[6] * mx + r[7] * my + r[8] * mz + t[2];
  const slopeX = clampedSlope(x / z, focal, principal[0], size);
  const slopeY = clampedSlope(y / z, focal, principal[1], size);
  const q = unitMatrix(quaternions, number);
  let [aa, ab, bb] = [0, 0, 0];
  const rows = [];
  for (let axis = 0; axis < 3; axis++) {
    const scale = scales[3 * number + axis];
    const [u, v, w] = [q[axis] * scale, q[3 + axis] * scale, q[6 + axis] * scale];
    const depth = r[6] * u + r[7] * v + r[8] * w;
    const a = (focal / z) * (r[0] * u + r[1] * v + r[2] * w - slopeX * depth);
    const b = (focal / z) * (r[3] * u + r[4] * v + r[5] * w - slopeY * depth);
    rows.push([a, b]);
    aa += a * a;
    ab += a * b;
    bb += b * b;
  }
  const [[a0, b0], [a1, b1], [a2, b2]] = rows;
  const normal = (a1 * b2 - a2 * b1) ** 2 + (a2 * b0 - a0 * b2) ** 2 + (a0 * b1 - a1 * b0) ** 2;
  const determinant = normal + BLUR * (aa + bb) + BLUR * BLUR; // nothing cancels in thin ellipses
  const opacity = opacities[number];
  const end = Math.log(opacity / MIN_ALPHA);
  const splat = {
    x: (focal * x) / z + principal[0],
    y: (focal * y) / z + principal[1],
    xx: (bb + BLUR) / determinant,
    xy: -ab / determinant,
    yy: (aa + BLUR) / determinant,
    height: Math.sqrt(2 * end * (bb + BLUR)),
    end,
    opacity,
  };
  return Number.isFinite(splat.x + splat.y + splat.xx + splat.xy + splat.yy + splat.height) ? splat : null;
}

/** Limit a slope to the frustum with a margin, because the projection's derivative explodes far outside. */
function clampedSlope(slope, focal, principal, size) {
  const beyond = (FRUSTUM_MARGIN * 0.5 * size) / focal;
  return Math.min(Math.max(slope, -principal / focal - beyond), (size - principal) / focal + beyond);
}

/** Return the rotation matrix, by rows, of a quaternion of any length. */
export function unitMatrix(quaternions, number) {
  const [w0, x0, y0, z0] = quaternions.subarray(4 * number, 4 * number + 4);
  const length = Math.hypot(w0, x0, y0, z0);
  const [w, x, y, z] = length > 1e-12 ? [w0 / length, x0 / length, y0 / length, z0 / length] : [1, 0, 0, 0];
  return [
    ...[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
    ...[2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
    ...[2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
  ];
}

/** Add a Gaussian's entries, and take them from what is left of the pixels. */
function addEntries({ x, y, xx, xy, yy, height, end, opacity }, size, open, stopped, entries) {
  const firstRow = Math.max(Math.ceil(y - height - 0.5), 0);
  const lastRow = Math.min(Math.floor(y + height - 0.5), size - 1);
  for (let row = firstRow; row <= lastRow; row++) {
    const dy = row + 0.5 - y;
    const root = xy * xy * dy * dy - xx * (yy * dy * dy - 2 * end);
    if (root < 0) {
      continue;
    }
    const half = Math.sqrt(root) / xx;
    const middle = x - (xy * dy) / xx - 0.5;
    const first = Math.max(Math.ceil(middle - half), 0);
    const last = Math.min(Math.floor(middle + half), size - 1);
    for (let column = first; column <= last; column++) {
      const pixel = row * size + column;
      if (stopped[pixel]) {
        continue;
      }
      const dx = column + 0.5 - x;
      const sigma = 0.5 * (xx * dx * dx + yy * dy * dy) + xy * dx * dy;
      const alpha = Math.min(opacity * Math.exp(-sigma), MAX_ALPHA);
      if (alpha < MIN_ALPHA) {
        continue;
      }
      const behind = open[pixel] * (1 - alpha);
      if (behind <= MIN_TRANSMITTANCE) {
        stopped[pixel] = 1;
        continue;
      }
      entries.pixels[entries.count] = pixel;
      entries.weights[entries.count] = open[pixel] * alpha;
      entries.count += 1;
      open[pixel] = behind;
    }
  }
}

/**
 * Return an image of Gaussians, [pixel, 3].
 * @param {import("./pipeline.js").Gaussians} gaussians
 * @param {Camera} camera
 * @param {number} background grey value
 * @param {(number: number, entries: Entries) => void} [take] called with the entries of each
 * @returns {Float32Array}
 */
export function rendered(gaussians, camera, background, take = () => {}) {
  const { colors } = gaussians;
  const image = new Float32Array(3 * camera.size * camera.size);
  const open = eachSplat(gaussians, camera, (number, _, entries) => {
    const { count, pixels, weights } = entries;
    const [red, green, blue] = [colors[3 * number], colors[3 * number + 1], colors[3 * number + 2]];
    for (let entry = 0; entry < count; entry++) {
      const at = 3 * pixels[entry];
      image[at] += weights[entry] * red;
      image[at + 1] += weights[entry] * green;
      image[at + 2] += weights[entry] * blue;
    }
    take(number, entries);
  });
  return image.map((value, index) => value + open[Math.floor(index / 3)] * background);
}

/**
 * Return an image of numbers from 0 to 1 as opaque bytes (RGBA).
 * @param {Float32Array} image [pixel, 3]
 * @returns {Uint8ClampedArray}
 */
export function bytesOf(image) {
  const bytes = new Uint8ClampedArray((4 * image.length) / 3).fill(255);
  for (let index = 0; index < image.length; index++) {
    bytes[index + Math.floor(index / 3)] = 255 * image[index];
  }
  return bytes;
}
