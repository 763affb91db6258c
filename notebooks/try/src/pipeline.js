/** The networks: ONNX graphs of a folder, run as `pipeline.json` says (the pattern is notebooks/onnx_predict.py). */

import * as ort from "onnxruntime-web/wasm";

import { Normals } from "./random.js";

const MOST_THREADS = 4;

/**
 * @typedef {object} Gaussians in the camera's frame: +x right, +y down, +z forward
 * @property {Float32Array} means [n, 3]
 * @property {Float32Array} quaternions [n, 4], w first
 * @property {Float32Array} scales [n, 3], standard deviations
 * @property {Float32Array} opacities [n]
 * @property {Float32Array} colors [n, 3], sRGB
 */

/** Networks of a folder, ready to run. */
export class Pipeline {
  /**
   * @param {object} settings `pipeline.json`
   * @param {Record<string, ort.InferenceSession>} sessions
   */
  constructor(settings, sessions) {
    this.settings = settings;
    this.sessions = sessions;
  }

  /**
   * @param {object} settings `pipeline.json`
   * @param {Record<string, Uint8Array>} graphs content of the graphs' files, by name
   * @param {ArrayBuffer} runtime content of onnxruntime's WebAssembly
   */
  static async create(settings, graphs, runtime) {
    ort.env.wasm.wasmBinary = runtime;
    ort.env.wasm.wasmPaths = new URL("ort/", self.location.href).href;
    ort.env.wasm.numThreads = self.crossOriginIsolated ? Math.min(MOST_THREADS, navigator.hardwareConcurrency) : 1;
    ort.env.logLevel = "error";
    const sessions = {};
    for (const [name, content] of Object.entries(graphs)) {
      sessions[name] = await ort.InferenceSession.create(content, { executionProviders: ["wasm"] });
    }
    return new Pipeline(settings, sessions);
  }

  /**
   * Run a graph.
   * @param {string} name
   * @param {Record<string, ort.Tensor>} inputs
   */
  run(name, inputs) {
    return this.sessions[name].run(inputs);
  }

  /**
   * Return the camera's inputs of a graph. The intrinsics have their principal point at the optical axis.
   * @param {{fovDegrees: number, axis: [number, number]}} photo
   */
  cameraInputs({ fovDegrees, axis }) {
    const { image_size: size, depth_before: before, smallest_depth: smallest, fov_degrees: trained } = this.settings;
    const tangent = (degrees) => Math.tan((degrees * Math.PI) / 360);
    const focal = size / 2 / tangent(fovDegrees);
    let depths = this.settings.depth_range;
    if (before !== null) { // the object stays as large in the photo as in training
      const moved = (depths[0] + before) * (tangent(trained) / tangent(fovDegrees) - 1);
      depths = depths.map((depth) => Math.max(depth + moved, smallest));
    }
    const intrinsics = [focal, 0, size * axis[0], 0, focal, size * axis[1], 0, 0, 1];
    return {
      intrinsics: new ort.Tensor("float32", Float32Array.from(intrinsics), [1, 3, 3]),
      depth_range: new ort.Tensor("float32", Float32Array.from(depths), [1, 2]),
    };
  }

  /**
   * Yield the scenes of a photo one after the other, and before each of them its steps.
   * @param {import("./photo.js").Photo} photo
   * @param {number} samples
   * @param {number} seed
   * @returns {AsyncGenerator<{step: number, steps: number} | {scene: Gaussians}>}
   */
  async *scenes(photo, samples, seed) {
    const { image_size: size, draws_samples: draws } = this.settings;
    const image = new ort.Tensor("float32", photo.images.get(size), [1, 3, size, size]);
    const camera = this.cameraInputs(photo);
    if (!draws) {
      yield { scene: gaussiansOf(await this.run("scene", { image, ...camera })) };
      return;
    }
    const { conditioning, ...skips } = await this.run("image", { image });
    const { calls, latent: last } = this.settings.steps;
    const shape = this.settings.noise_shape;
    const count = shape.reduce((product, length) => product * length, 1);
    const normals = new Normals(seed);
    for (let sample = 0; sample < samples; sample++) {
      const terms = [normals.draw(count)];
      for (const [step, call] of calls.entries()) {
        yield { step, steps: calls.length };
        const latent = new ort.Tensor("float32", weighted(call.input, terms), [1, ...shape]);
        const timestep = new ort.Tensor("int64", BigInt64Array.of(BigInt(call.timestep)), [1]);
        const { prediction } = await this.run("step", { latent, timestep, conditioning });
        terms.push(prediction.data);
      }
      yield { step: calls.length, steps: calls.length };
      const latent = new ort.Tensor("float32", weighted(last, terms), [1, ...shape]);
      const weight = new ort.Tensor("float32", Float32Array.of(1), [1]);
      const values = await this.run("decode", { latent, skip_weight: weight, ...camera, ...skips });
      yield { scene: gaussiansOf(values) };
    }
  }
}

/**
 * Return a weighted sum: each latent is one of the noise and of the predictions so far.
 * @param {number[]} weights
 * @param {Float32Array[]} terms
 */
function weighted(weights, terms) {
  return terms[0].map((_, index) => {
    let sum = 0;
    for (let i = 0; i < terms.length; i++) {
      sum += weights[i] * terms[i][index];
    }
    return sum;
  });
}

/** @returns {Gaussians} */
function gaussiansOf({ means, quaternions, scales, opacities, colors }) {
  return {
    means: means.data,
    quaternions: quaternions.data,
    scales: scales.data,
    opacities: opacities.data,
    colors: colors.data,
  };
}
