/** The ways in which a photo comes to the page: a file, the camera, dropping, pasting, an example. */

import { PageError } from "./errors.js";

const byId = (id) => document.getElementById(id);

/**
 * Call a function with each photo that somebody gives.
 * @param {(file: Blob) => void} onPhoto
 * @param {(error: unknown) => void} onError
 */
export function listenForPhotos(onPhoto, onError) {
  const take = (file) => (file ? onPhoto(file) : onError(new PageError("There is no photo in it. Choose a photo.")));
  for (const [button, input] of [["choose", "file"], ["take", "camera"], ["other", "file"]]) {
    byId(button).addEventListener("click", () => byId(input).click());
  }
  for (const id of ["file", "camera"]) {
    byId(id).addEventListener("change", ({ target }) => {
      if (target.files[0]) {
        take(target.files[0]);
      }
      target.value = ""; // the same file may be chosen again
    });
  }
  document.addEventListener("paste", ({ clipboardData }) => {
    if (clipboardData.files.length) {
      take(clipboardData.files[0]);
    }
  });
  listenForDrops(take);
}

function listenForDrops(take) {
  let depth = 0;
  const mark = () => document.body.classList.toggle("dropping", depth > 0);
  document.addEventListener("dragenter", () => {
    depth += 1;
    mark();
  });
  document.addEventListener("dragleave", () => {
    depth -= 1;
    mark();
  });
  document.addEventListener("dragover", (event) => event.preventDefault());
  document.addEventListener("drop", (event) => {
    event.preventDefault();
    depth = 0;
    mark();
    take(event.dataTransfer.files[0]);
  });
}

/**
 * Show the examples.
 * @param {import("./weights.js").Listed[]} files
 * @param {(file: Blob) => void} onPhoto
 * @param {(error: unknown) => void} onError
 */
export function showExamples(files, onPhoto, onError) {
  const items = files.map(({ path }) => {
    const name = path.match(/\d_(\w+)\.jpg$/)[1];
    const button = document.createElement("button");
    button.type = "button";
    const image = new Image();
    image.src = path;
    image.alt = `Example photo: ${name}`;
    button.append(image);
    button.addEventListener("click", async () => {
      try {
        onPhoto(await (await fetch(path)).blob());
      } catch {
        onError(new PageError("The example cannot be loaded: the connection is lost. Choose a photo of your own."));
      }
    });
    const item = document.createElement("li");
    item.append(button);
    return item;
  });
  byId("examples").replaceChildren(...items);
}
