/** The page: what is shown when, and what the buttons do. */

import { listenForPhotos, showExamples } from "./choosing.js";
import { Comparison } from "./compare.js";
import { PageError, wordsFor } from "./errors.js";
import { plyOf, splatOf } from "./files.js";
import { SceneView } from "./scene.js";
import { Tiles } from "./tiles.js";

const parameters = new URLSearchParams(location.search);
const SAMPLES = Number(parameters.get("samples") ?? 4);
const FITS = parameters.get("fit") !== "0"; // ?fit=0: the networks' own scenes, not fitted to the photo

const byId = (id) => document.getElementById(id);

/** State of the page. `input` and `samples` are for tests, too. */
const page = { run: 0, settings: null, photo: null, input: null, samples: [], chosen: null, isDrawing: false };
window.tryPage = page;

const worker = new Worker("worker.js", { type: "module" });
const tiles = new Tiles(byId("tiles"), choose);
const comparison = new Comparison({
  overlay: byId("overlay"),
  divider: byId("divider"),
  slider: byId("slider"),
  frame: byId("frame"),
});
let view = null;

/** Say something to everybody, and show it. */
function say(words) {
  byId("status").textContent = words;
}

function fail(error) {
  const words = typeof error === "string" ? error : wordsFor(error);
  byId("error").textContent = words;
  byId("error").hidden = false;
}

function setDrawing(isDrawing) {
  page.isDrawing = isDrawing;
  byId("draw").hidden = isDrawing;
  byId("cancel").hidden = !isDrawing;
}

/** Wait over the stage with words, or do not wait. */
function wait(words) {
  byId("waiting").hidden = words === null;
  byId("waiting-words").textContent = words ?? "";
}

/** Begin with a photo. */
async function open(file) {
  byId("error").hidden = true;
  page.run += 1;
  page.photo = null;
  page.input = null;
  say("The photo is read.");
  worker.postMessage({ task: "open", file, run: page.run });
}

/** Show a photo that the worker has read, and draw its samples. */
function showPhoto({ preview, input, sizes, fovDegrees, fovIsRecorded, photoSize }) {
  page.photo = { fovDegrees, up: page.settings.up, fitSize: sizes[FITS ? sizes.length - 1 : 0] };
  page.input = input;
  byId("empty").hidden = true;
  byId("result").hidden = false;
  document.body.dataset.state = "result";
  const canvas = byId("photo");
  canvas.width = preview.width;
  canvas.height = preview.height;
  canvas.getContext("2d").drawImage(preview, 0, 0);
  comparison.setPhoto(preview);
  const source = fovIsRecorded ? "from the camera" : "assumed";
  byId("facts").textContent = `${photoSize[0]} × ${photoSize[1]}, ${fovDegrees.toFixed(0)}° wide (${source})`;
  window.scrollTo({ top: 0 });
  draw();
}

/** Draw samples of the open photo. */
function draw() {
  const seed = Math.min(Math.max(Math.trunc(Number(byId("seed").value)) || 0, 0), 2 ** 32 - 1);
  byId("seed").value = seed;
  page.run += 1;
  page.samples = [];
  page.chosen = null;
  const samples = page.settings.draws_samples ? SAMPLES : 1;
  tiles.reset(samples);
  setComparing(false);
  setEnabled(false);
  setDrawing(true);
  byId("frame").classList.add("waits");
  byId("frame").style.backgroundColor = "";
  wait(`Imagining ${samples === 1 ? "an answer" : `answer 1 of ${samples}`}`);
  say("Imagining the hidden sides.");
  worker.postMessage({ task: "draw", samples, seed, fits: FITS, run: page.run });
}

function setEnabled(isEnabled) {
  for (const id of ["turn", "compare", "ply", "splat"]) {
    byId(id).disabled = !isEnabled;
  }
}

/** Return the grey behind scenes, as in their fit. */
function behind() {
  const byte = Math.round(255 * (page.settings.background ?? 0.5));
  return `rgb(${byte} ${byte} ${byte})`;
}

/** Show a sample on the stage. */
function choose(number) {
  const isFirst = page.chosen === null;
  page.chosen = number;
  tiles.mark(number);
  setEnabled(true);
  byId("frame").classList.remove("waits");
  byId("frame").style.backgroundColor = behind();
  wait(null);
  try {
    view ??= new SceneView(byId("scene"), onTouch);
    view.show(page.samples[number], page.photo, isFirst);
    setTurnButton();
  } catch {
    byId("turn").disabled = true;
    fail(new PageError("This browser draws no WebGL 2, so scenes do not turn here; they can be saved all the same."));
  }
}

function onTouch() {
  setTurnButton();
  if (comparison.isOn) {
    setComparing(false);
  }
}

function setTurnButton() {
  byId("turn").setAttribute("aria-pressed", String(Boolean(view?.isTurning)));
}

function setComparing(isOn) {
  byId("compare").setAttribute("aria-pressed", String(isOn));
  comparison.set(isOn);
  if (isOn) {
    view?.toPhoto();
    setTurnButton();
  }
}

/** Save the chosen sample. */
function save(suffix, contentOf) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(contentOf(page.samples[page.chosen].gaussians));
  link.download = `scene_${byId("seed").value}_${page.chosen + 1}.${suffix}`;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
  say(`Saved as ${link.download}.`);
}

/** What the worker says. */
const answers = {
  loading({ loaded, total }) {
    byId("progress").value = loaded / total;
    byId("size").textContent = `Networks: ${(loaded / 1e6).toFixed(1)} of ${(total / 1e6).toFixed(1)} MB`;
  },
  async downloaded({ stored }) {
    byId("networks").classList.add("loaded");
    byId("size").textContent = `Networks: ${page.megabytes} MB, loaded`;
    const registration = await navigator.serviceWorker?.ready;
    byId("offline").hidden = !(stored && registration?.active);
  },
  loaded({ settings }) {
    page.settings = settings;
    document.body.dataset.networks = "loaded";
  },
  opened: showPhoto,
  step({ sample, step, steps }) {
    tiles.tiles[sample].setProgress(step / steps);
    if (sample === 0) {
      byId("waiting-words").textContent = `Imagining answer 1 of ${tiles.tiles.length}`;
    }
  },
  sample({ sample, ...made }) {
    page.samples[sample] = made;
    tiles.tiles[sample].finish();
    say(`Answer ${sample + 1} of ${tiles.tiles.length} is ready.`);
    if (page.chosen === null) {
      choose(sample);
    }
  },
  frame({ sample, image, frame, frames }) {
    tiles.tiles[sample].addFrame(image, frame, frames);
  },
  drawn() {
    setDrawing(false);
    say("All answers are ready.");
  },
  failed({ task, words }) {
    fail(words);
    if (task === "load") {
      byId("size").textContent = "The networks are not loaded";
    }
    if (task === "draw") {
      cancel();
    }
  },
};

worker.onmessage = ({ data }) => {
  if (data.run === undefined || data.run === page.run) {
    answers[data.kind](data);
  }
};
worker.onerror = (event) => fail(new PageError(`This browser cannot run the page: ${event.message}`));

/** Stop drawing; samples that are there stay. */
function cancel() {
  page.run += 1;
  worker.postMessage({ task: "cancel", run: page.run });
  setDrawing(false);
  tiles.dropUnfinished();
  wait(null);
  byId("frame").classList.remove("waits");
  say("Cancelled.");
}

/** Load the list of files, and the networks. */
async function begin() {
  const response = await fetch("files.json").catch(() => null);
  if (!response?.ok) {
    fail(new PageError("The page is not complete on the server, or the connection is lost. Load it again."));
    return;
  }
  const { heavy, examples, licence } = await response.json();
  page.megabytes = (heavy.reduce((sum, { bytes }) => sum + bytes, 0) / 1e6).toFixed(1);
  byId("licence").textContent = licence ? `${licence}, ` : "";
  showExamples(examples, open, fail);
  worker.postMessage({ task: "load", files: heavy });
}

listenForPhotos(open, fail);
byId("draw").addEventListener("click", () => {
  byId("seed").value = Number(byId("seed").value) + 1;
  draw();
});
byId("seed").addEventListener("change", draw);
byId("cancel").addEventListener("click", cancel);
byId("compare").addEventListener("click", () => setComparing(!comparison.isOn));
byId("turn").addEventListener("click", () => {
  setComparing(false);
  view.setTurning(!view.isTurning);
  setTurnButton();
});
byId("ply").addEventListener("click", () => save("ply", plyOf));
byId("splat").addEventListener("click", () => save("splat", splatOf));
navigator.serviceWorker?.register("service_worker.js").catch(() => {}); // such as in private windows
begin();
