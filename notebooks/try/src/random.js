/** Random numbers as torch draws them on a CPU, so that a seed gives the scenes that Python's `predict` gives. */

const STATE = 624;
const SHIFT = 397;

/** Mersenne Twister of 32 bits (MT19937, Matsumoto and Nishimura 1998). */
export class MersenneTwister {
  /** @param {number} seed its lower 32 bits count */
  constructor(seed) {
    this.state = new Uint32Array(STATE);
    this.state[0] = seed;
    for (let i = 1; i < STATE; i++) {
      const previous = this.state[i - 1] ^ (this.state[i - 1] >>> 30);
      this.state[i] = Math.imul(1812433253, previous) + i;
    }
    this.index = STATE;
  }

  /** @returns {number} the next 32 bits */
  next() {
    if (this.index === STATE) {
      this.twist();
    }
    let bits = this.state[this.index];
    this.index += 1;
    bits ^= bits >>> 11;
    bits ^= (bits << 7) & 0x9d2c5680;
    bits ^= (bits << 15) & 0xefc60000;
    return (bits ^ (bits >>> 18)) >>> 0;
  }

  twist() {
    const { state } = this;
    for (let i = 0; i < STATE; i++) {
      const mixed = (state[i] & 0x80000000) | (state[(i + 1) % STATE] & 0x7fffffff);
      const odd = mixed & 1 ? 0x9908b0df : 0;
      state[i] = state[(i + SHIFT) % STATE] ^ (mixed >>> 1) ^ odd;
    }
    this.index = 0;
  }
}

/** Normal numbers of a seed. Those of several samples follow each other, so that sample k is block k. */
export class Normals {
  /** @param {number} seed */
  constructor(seed) {
    this.twister = new MersenneTwister(seed);
  }

  /**
   * Return the next normal numbers: blocks of 16 by Box and Muller, from the 24 lower bits of each draw.
   * @param {number} count a multiple of 16
   * @returns {Float32Array}
   */
  draw(count) {
    const values = new Float32Array(count);
    for (let i = 0; i < count; i++) {
      values[i] = (this.twister.next() & 0xffffff) / 2 ** 24;
    }
    for (let block = 0; block < count; block += 16) {
      for (let i = block; i < block + 8; i++) {
        const radius = Math.fround(Math.sqrt(-2 * Math.log(1 - values[i])));
        const angle = Math.fround(Math.fround(2 * Math.PI) * values[i + 8]);
        values[i] = radius * Math.cos(angle);
        values[i + 8] = radius * Math.sin(angle);
      }
    }
    return values;
  }
}
