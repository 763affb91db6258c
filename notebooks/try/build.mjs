/**
 * Build the page into a folder: `node build.mjs FOLDER`.
 *
 * FOLDER/weights holds what `completesplat export weights=general precision=float16 out=FOLDER/weights` wrote, and the
 * weights' LICENSE.txt; FOLDER/examples holds what `examples.py` wrote.
 */

import { createHash } from "node:crypto";
import { copyFile, mkdir, readdir, readFile, writeFile } from "node:fs/promises";
import path from "node:path";
import { fileURLToPath } from "node:url";

import { build } from "esbuild";

const SOURCES = path.dirname(fileURLToPath(import.meta.url));
const MODULES = path.join(SOURCES, "node_modules");
const PACKAGES = ["onnxruntime-web"];
const RUNTIME = "ort-wasm-simd-threaded";
const COPIED = ["index.html", "style.css", "icon.svg"];
const KNOWN_LICENCES = /CC0|CC BY(-[A-Z]{2})* \d\.\d|Apache License|MIT License/;
const folder = process.argv[2];

/** Leaves onnxruntime's module as a file of its own, because its threads load it again. */
const separateRuntime = {
  name: "separate-runtime",
  setup({ onResolve }) {
    onResolve({ filter: /^onnxruntime-web\/wasm$/ }, () => ({ path: "./ort/ort.wasm.min.mjs", external: true }));
  },
};

if (!folder) {
  console.error("build.mjs: no folder is given; run node build.mjs FOLDER");
  process.exit(2);
}
await mkdir(path.join(folder, "ort"), { recursive: true });
for (const name of COPIED) {
  await copyFile(path.join(SOURCES, name), path.join(folder, name));
}
for (const name of ["ort.wasm.min.mjs", `${RUNTIME}.mjs`, `${RUNTIME}.wasm`]) {
  await copyFile(path.join(MODULES, "onnxruntime-web", "dist", name), path.join(folder, "ort", name));
}
await writeFile(path.join(folder, "licences.txt"), await licences());
await bundle(["main.js", "worker.js"], {});
const heavy = await listed(["weights", "ort"], /\.(onnx|json|wasm)$/);
const examples = await listed(["examples"], /\.jpg$/);
const [licence] = (await text("weights/LICENSE.txt")).match(KNOWN_LICENCES) ?? [""];
await writeFile(path.join(folder, "files.json"), JSON.stringify({ heavy, examples, licence }, null, 1));
const shell = [
  ...["./", "files.json", "licences.txt", "main.js", "worker.js", "icon.svg", "style.css", "weights/LICENSE.txt"],
  ...["ort/ort.wasm.min.mjs", `ort/${RUNTIME}.mjs`, ...examples.map((file) => file.path)],
];
const version = (await Promise.all(shell.slice(1).map((name) => hashOf(name)))).concat(await hashOf("index.html"));
await bundle(["service_worker.js"], {
  FILES: JSON.stringify(shell),
  VERSION: JSON.stringify(digest(version.join())),
});
const megabytes = (heavy.reduce((sum, { bytes }) => sum + bytes, 0) / 1e6).toFixed(1);
console.log(`${folder}: built; visitors load ${megabytes} MB of networks and runtime once`);

/** Bundle modules of src/ into files of the same names. */
async function bundle(names, define) {
  await build({
    entryPoints: names.map((name) => path.join(SOURCES, "src", name)),
    outdir: folder,
    bundle: true,
    format: "esm",
    minify: true,
    target: "es2022",
    legalComments: "none", // all licences are in licences.txt
    logLevel: "warning",
    plugins: [separateRuntime],
    define,
  });
}

/** Return path, size and hash of files in folders. */
async function listed(folders, pattern) {
  const files = [];
  for (const name of folders) {
    const names = (await readdir(path.join(folder, name))).filter((file) => pattern.test(file)).sort();
    for (const file of names) {
      const place = `${name}/${file}`;
      const { length } = await readFile(path.join(folder, place));
      files.push({ path: place, bytes: length, hash: await hashOf(place) });
    }
  }
  return files;
}

async function hashOf(name) {
  return digest(await readFile(path.join(folder, name)));
}

function digest(content) {
  return createHash("sha256").update(content).digest("hex").slice(0, 12);
}

function text(name) {
  return readFile(path.join(folder, name), "utf8");
}

/** Return the licences of the bundled packages. */
async function licences() {
  const parts = [];
  for (const name of PACKAGES) {
    const { version, license, homepage } = JSON.parse(await readFile(path.join(MODULES, name, "package.json"), "utf8"));
    const files = (await readdir(path.join(MODULES, name))).filter((file) => /^licen[cs]e/i.test(file));
    const words = files.length ? await readFile(path.join(MODULES, name, files[0]), "utf8") : "";
    parts.push(`${name} ${version}: ${license} (${homepage})\n\n${words}`);
  }
  return parts.join(`\n${"-".repeat(80)}\n`);
}
