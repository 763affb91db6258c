/** A rasterizer on the CPU, with the rules of `completesplat/rasterizers` (EWA splatting, front to back). */

const BLUR = 0.3; // px^2, added to the diagonal of a projected covariance
const NEAR = 0.01;
const MAX_ALPHA = 0.999;
const MIN_ALPHA = 1 / 255;
const MIN_TRANSMITTANCE = 1e-4;
const FRUSTUM_MARGIN = 0.3;

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
 * @property {Float32Array} depths of these
 * @property {Int32Array} starts of their entries, and the end of the last
 * @property {Int32Array} pixels of the entries
 * @property {Float32Array} weights of the entries
 * @property {Float32Array} open what is left of each pixel for the background
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
    focal: size / 2 / Math.tan((fovDegrees * Math.PI) / 360),
    principal: [size * axis[0], size * axis[1]],
    rotation: [1, 0, 0, 0, 1, 0, 0, 0, 1],
    translation: [0, 0, 0],
  };
}

/** Entries whose number is not known before. */
class Entries {
  constructor(capacity) {
    this.count = 0;
    this.pixels = new Int32Array(capacity);
    this.weights = new Float32Array(capacity);
  }

  push(pixel, weight) {
    if (this.count === this.pixels.length) {
      this.grow();
    }
    this.pixels[this.count] = pixel;
    this.weights[this.count] = weight;
    this.count += 1;
  }

  grow() {
    const { pixels, weights } = this;
    this.pixels = new Int32Array(2 * pixels.length);
    this.weights = new Float32Array(2 * weights.length);
    this.pixels.set(pixels);
    this.weights.set(weights);
  }
}

/**
 * Return what each Gaussian adds to each pixel of an image.
 * @param {import("./pipeline.js").Gaussians} gaussians
 * @param {Camera} camera
 * @returns {Contributions}
 */
export function contributions(gaussians, camera) {
  const { size } = camera;
  const { order, depths } = byDepth(gaussians, camera);
  const starts = new Int32Array(order.length + 1);
  const open = new Float32Array(size * size).fill(1);
  const stopped = new Uint8Array(size * size);
  const entries = new Entries(32 * order.length + 1);
  order.forEach((number, place) => {
    starts[place] = entries.count;
    const splat = projected(gaussians, camera, number);
    if (splat) {
      addEntries(splat, size, open, stopped, entries);
    }
  });
  starts[order.length] = entries.count;
  return {
    gaussians: order,
    depths: depths,
    starts,
    pixels: entries.pixels.subarray(0, entries.count),
    weights: entries.weights.subarray(0, entries.count),
    open,
  };
}

/** Return the numbers of the Gaussians in front of a camera, nearest first, and their depths. */
function byDepth({ means, opacities }, { rotation, translation }) {
  const all = new Float32Array(opacities.length);
  for (let i = 0; i < all.length; i++) {
    const [x, y, z] = means.subarray(3 * i, 3 * i + 3);
    all[i] = rotation[6] * x + rotation[7] * y + rotation[8] * z + translation[2];
  }
  const seen = [...all.keys()].filter((i) => all[i] > NEAR && opacities[i] >= MIN_ALPHA);
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
function unitMatrix(quaternions, number) {
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
      entries.push(pixel, open[pixel] * alpha);
      open[pixel] = behind;
    }
  }
}

/**
 * Return an image of values of the Gaussians, [pixel, channel], over a background.
 * @param {Contributions} seen
 * @param {(place: number, channel: number) => number} value of the Gaussian at a place in the order
 * @param {number} channels
 * @param {number} background
 * @returns {Float32Array}
 */
export function composited({ gaussians, starts, pixels, weights, open }, value, channels, background) {
  const image = new Float32Array(open.length * channels);
  for (let channel = 0; channel < channels; channel++) {
    for (let pixel = 0; pixel < open.length; pixel++) {
      image[pixel * channels + channel] = open[pixel] * background;
    }
    for (let place = 0; place < gaussians.length; place++) {
      const own = value(place, channel);
      for (let entry = starts[place]; entry < starts[place + 1]; entry++) {
        image[pixels[entry] * channels + channel] += weights[entry] * own;
      }
    }
  }
  return image;
}

/**
 * Return an image of Gaussians in bytes (RGBA), opaque over a background.
 * @param {import("./pipeline.js").Gaussians} gaussians
 * @param {Camera} camera
 * @param {number} background grey value
 * @returns {Uint8ClampedArray}
 */
export function drawn(gaussians, camera, background) {
  const seen = contributions(gaussians, camera);
  const { colors } = gaussians;
  const image = composited(seen, (place, channel) => colors[3 * seen.gaussians[place] + channel], 3, background);
  const bytes = new Uint8ClampedArray(4 * seen.open.length).fill(255);
  for (let pixel = 0; pixel < seen.open.length; pixel++) {
    for (let channel = 0; channel < 3; channel++) {
      bytes[4 * pixel + channel] = 255 * image[3 * pixel + channel];
    }
  }
  return bytes;
}
