/** The order in which Gaussians are drawn: the farthest first. */

const KEYS = 65536; // depths that are told apart
const SAME_DIRECTION = 1 - 1e-6; // cosine of the angle up to which an order stays

/** Order of a scene's Gaussians by depth, kept while the view's direction stays. */
export class DepthOrder {
  /**
   * @param {Float32Array} means [n, 3]
   * @param {number} length of `numbers`, at least n
   */
  constructor(means, length) {
    const count = means.length / 3;
    this.count = count;
    this.means = means;
    this.depths = new Float32Array(count);
    this.keys = new Uint16Array(count);
    this.numbers = new Uint32Array(length);
    this.direction = null;
  }

  /**
   * Sort `numbers` for a direction of view, and return whether they have changed.
   * @param {number[]} direction of length 1
   */
  sort(direction) {
    if (this.direction && dot(this.direction, direction) > SAME_DIRECTION) {
      return false;
    }
    this.direction = direction;
    this.setKeys();
    const ends = new Uint32Array(KEYS);
    for (const key of this.keys) {
      ends[key] += 1;
    }
    for (let key = 1; key < KEYS; key++) {
      ends[key] += ends[key - 1];
    }
    for (let number = this.keys.length - 1; number >= 0; number--) {
      const key = this.keys[number];
      ends[key] -= 1;
      this.numbers[ends[key]] = number;
    }
    return true;
  }

  /** Set the keys: 0 for the farthest. */
  setKeys() {
    const { means, depths, keys } = this;
    const [x, y, z] = this.direction;
    let [nearest, farthest] = [Infinity, -Infinity];
    for (let number = 0; number < depths.length; number++) {
      const depth = x * means[3 * number] + y * means[3 * number + 1] + z * means[3 * number + 2];
      depths[number] = depth;
      nearest = Math.min(nearest, depth);
      farthest = Math.max(farthest, depth);
    }
    const scale = (KEYS - 1) / Math.max(farthest - nearest, 1e-9);
    for (let number = 0; number < depths.length; number++) {
      keys[number] = (farthest - depths[number]) * scale;
    }
  }
}

function dot(a, b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}
