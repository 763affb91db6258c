/** All heavy work: networks, photo, fitting, and the small images of turning scenes. */

import { PageError, wordsFor } from "./errors.js";
import { fitFront } from "./front.js";
import { cameraAt, viewOf } from "./orbit.js";
import { ownAt, readPhoto } from "./photo.js";
import { Pipeline } from "./pipeline.js";
import { bytesOf, photoCamera, rendered } from "./raster.js";
import { subjectOf } from "./subject.js";
import { Downloads } from "./weights.js";

const BEHIND = 0.5; // grey value behind scenes, unless the weights have a background
const DETAIL = 256; // pixels of the image that fronts are fitted to, if the photo has as many
const FRAMES = 16; // small images of a scene in one turn
const FRAME_SIZE = 96; // pixels

/** @type {Promise<Pipeline> | null} */
let loading = null;
/** @type {import("./photo.js").Photo | null} */
let photo = null;
let run = 0; // number of the work that is wanted; other work ends

/** An end of work that nobody wants any more. */
class Cancelled extends Error {}

const tasks = { load, open, draw, cancel };

self.onmessage = async ({ data }) => {
  try {
    await tasks[data.task](data);
  } catch (error) {
    if (!(error instanceof Cancelled)) {
      self.postMessage({ kind: "failed", task: data.task, run: data.run, words: wordsFor(error) });
    }
  }
};

/**
 * Load the networks.
 * @param {{files: import("./weights.js").Listed[]}} request
 */
async function load({ files }) {
  loading ??= loadedPipeline(files);
  try {
    const { settings } = await loading;
    self.postMessage({ kind: "loaded", settings });
  } catch (error) {
    loading = null;
    throw error;
  }
}

async function loadedPipeline(files) {
  const onProgress = (loaded, total) => self.postMessage({ kind: "loading", loaded, total });
  const downloads = new Downloads(files, onProgress);
  const contents = await downloads.load();
  self.postMessage({ kind: "downloaded", stored: downloads.areStored });
  const settings = JSON.parse(new TextDecoder().decode(contents.get("weights/pipeline.json")));
  const graphs = {};
  for (const [name, { file }] of Object.entries(settings.graphs)) {
    graphs[name] = contents.get(`weights/${file}`);
  }
  const runtime = [...contents].find(([path]) => path.endsWith(".wasm"))[1];
  return Pipeline.create(settings, graphs, runtime.buffer);
}

/** Read a photo. */
async function open({ file, run: number }) {
  run = number;
  photo = null;
  const { settings } = await wantedPipeline();
  photo = await readPhoto(file, settings, settings.image_size, DETAIL);
  await checkWanted(number);
  const { images, preview, fovDegrees, fovIsRecorded, photoSize } = photo;
  const input = images.get(settings.image_size).slice();
  const sizes = [...images.keys()];
  const answer = { kind: "opened", run: number, input, sizes, preview, fovDegrees, fovIsRecorded, photoSize };
  self.postMessage(answer, [preview]);
}

/** Draw samples of the open photo, each with a full turn of small images. */
async function draw({ samples, seed, fits, run: number }) {
  run = number;
  const pipeline = await wantedPipeline();
  const turning = [];
  let sample = 0;
  let begun = performance.now();
  for await (const made of pipeline.scenes(photo, samples, seed)) {
    await checkWanted(number);
    if (!made.scene) {
      self.postMessage({ kind: "step", run: number, sample, ...made });
      continue;
    }
    const gaussians = fits ? fitted(made.scene, pipeline.settings) : made.scene;
    const subject = subjectOf(gaussians, photo);
    const seconds = (performance.now() - begun) / 1000;
    turning.push({ sample, gaussians, subject });
    self.postMessage({ kind: "sample", run: number, sample, seconds, subject, gaussians });
    postFrame(turning[sample], FRAMES / 8, number, pipeline.settings);
    sample += 1;
    begun = performance.now();
  }
  self.postMessage({ kind: "drawn", run: number });
  for (let frame = 0; frame < FRAMES; frame++) {
    for (const scene of turning) {
      await checkWanted(number);
      postFrame(scene, frame, number, pipeline.settings);
    }
  }
}

function cancel({ run: number }) {
  run = number;
}

function fitted(gaussians, settings) {
  const targets = [...photo.images].map(([size, image]) => {
    return { camera: photoCamera(photo, size), image, own: ownAt(photo.part, size) };
  });
  return fitFront(gaussians, targets, settings.background ?? BEHIND);
}

/** Post a small image of a scene that turns. */
function postFrame({ sample, gaussians, subject }, frame, number, settings) {
  const turn = { yaw: (2 * Math.PI * frame) / FRAMES, pitch: 0, zoom: 1, look: 1 };
  const view = viewOf(turn, subject, settings.up, photo.fovDegrees);
  const camera = cameraAt(view, photo.fovDegrees, FRAME_SIZE);
  const image = new ImageData(bytesOf(rendered(gaussians, camera, settings.background ?? BEHIND)), FRAME_SIZE);
  self.postMessage({ kind: "frame", run: number, sample, frame, frames: FRAMES, image });
}

async function wantedPipeline() {
  if (!loading) {
    throw new PageError("The networks are not loaded. Load the page again.");
  }
  return loading;
}

/** Let messages in; end work that they have replaced. */
async function checkWanted(number) {
  await new Promise((resolve) => setTimeout(resolve));
  if (run !== number) {
    throw new Cancelled();
  }
}
