/** Resizing with a Lanczos filter, antialiased as Pillow does it: two passes, with bytes between them. */

const RADIUS = 3; // of the filter, in pixels of the coarser image

/**
 * @typedef {object} Taps weights of the input's pixels in one pixel of the output
 * @property {number} first the first of these pixels
 * @property {Float64Array} weights
 */

/** @param {number} x */
function lanczos(x) {
  if (x === 0) {
    return 1;
  }
  if (Math.abs(x) >= RADIUS) {
    return 0;
  }
  const angle = Math.PI * x;
  return (RADIUS * Math.sin(angle) * Math.sin(angle / RADIUS)) / (angle * angle);
}

/**
 * Return the weights for each of `size` pixels made of `length` pixels.
 * @param {number} length
 * @param {number} size
 * @returns {Taps[]}
 */
export function tapsOf(length, size) {
  const scale = length / size;
  const stretch = Math.max(scale, 1);
  const reach = RADIUS * stretch;
  return Array.from({ length: size }, (_, i) => {
    const center = (i + 0.5) * scale;
    const first = Math.max(Math.trunc(center - reach + 0.5), 0);
    const end = Math.min(Math.trunc(center + reach + 0.5), length);
    const weights = new Float64Array(end - first);
    for (let j = 0; j < weights.length; j++) {
      weights[j] = lanczos((first + j - center + 0.5) / stretch);
    }
    const sum = weights.reduce((total, weight) => total + weight, 0);
    return { first, weights: weights.map((weight) => weight / sum) };
  });
}

/**
 * Resizes a square that continues the border of a part of it. The part's rows come one after the other.
 */
export class SquareResizer {
  /**
   * @param {number} size side of the result
   * @param {number} side side of the square
   * @param {{left: number, top: number, width: number, height: number}} part the pixels that are given, in the square
   */
  constructor(size, side, part) {
    this.size = size;
    this.part = part;
    this.taps = tapsOf(side, size);
    this.columns = this.taps.map((taps) => gathered(taps, part.left, part.width));
    this.narrow = new Uint8ClampedArray(part.height * size * 3);
  }

  /**
   * Take some rows of the part, in RGBA.
   * @param {Uint8ClampedArray} pixels
   * @param {number} firstRow
   */
  takeRows(pixels, firstRow) {
    const { width } = this.part;
    const rows = pixels.length / 4 / width;
    for (let row = 0; row < rows; row++) {
      let out = (firstRow + row) * this.size * 3;
      for (const { first, weights } of this.columns) {
        let [red, green, blue] = [0, 0, 0];
        let at = (row * width + first) * 4;
        for (let j = 0; j < weights.length; j++) {
          red += weights[j] * pixels[at];
          green += weights[j] * pixels[at + 1];
          blue += weights[j] * pixels[at + 2];
          at += 4;
        }
        this.narrow[out] = red;
        this.narrow[out + 1] = green;
        this.narrow[out + 2] = blue;
        out += 3;
      }
    }
  }

  /** @returns {Float32Array} the square [3, size, size], from 0 to 1 */
  finish() {
    const { size } = this;
    const plane = size * size;
    const image = new Float32Array(3 * plane);
    const bytes = new Uint8ClampedArray(3);
    this.taps.forEach((taps, row) => {
      const { first, weights } = gathered(taps, this.part.top, this.part.height);
      for (let column = 0; column < size; column++) {
        for (let channel = 0; channel < 3; channel++) {
          let sum = 0;
          for (let j = 0; j < weights.length; j++) {
            sum += weights[j] * this.narrow[((first + j) * size + column) * 3 + channel];
          }
          bytes[channel] = sum;
          image[channel * plane + row * size + column] = bytes[channel] / 255;
        }
      }
    });
    return image;
  }
}

/**
 * Return weights for pixels of a part, to whose border those of the pixels beyond are added.
 * @param {Taps} taps weights for pixels of the square
 * @param {number} start first pixel of the part
 * @param {number} length number of its pixels
 * @returns {Taps}
 */
function gathered(taps, start, length) {
  const place = (index) => Math.min(Math.max(taps.first + index - start, 0), length - 1);
  const first = place(0);
  const weights = new Float64Array(place(taps.weights.length - 1) - first + 1);
  taps.weights.forEach((weight, index) => {
    weights[place(index) - first] += weight;
  });
  return { first, weights };
}
