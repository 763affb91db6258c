/** Tiles of the samples: steps while a sample forms, then small images of it turning. */

const FRAME_MS = 190;

/** One tile. */
class Tile {
  /**
   * @param {number} number
   * @param {() => void} onChoose
   */
  constructor(number, onChoose) {
    this.number = number;
    this.frames = [];
    this.button = document.createElement("button");
    this.button.type = "button";
    this.button.className = "tile";
    this.button.disabled = true;
    this.button.setAttribute("aria-pressed", "false");
    this.button.setAttribute("aria-label", `Answer ${number + 1}, not drawn yet`);
    this.canvas = document.createElement("canvas");
    this.progress = document.createElement("progress");
    this.progress.max = 1;
    this.progress.value = 0;
    this.progress.setAttribute("aria-hidden", "true");
    const label = document.createElement("span");
    label.textContent = number + 1;
    this.button.append(this.canvas, this.progress, label);
    this.button.addEventListener("click", onChoose);
    this.item = document.createElement("li");
    this.item.append(this.button);
  }

  /** @param {number} share of the sample's steps */
  setProgress(share) {
    this.progress.value = share;
    this.button.classList.add("forming");
  }

  /** Let the sample be chosen. */
  finish() {
    this.button.disabled = false;
    this.button.classList.remove("forming");
    this.button.classList.add("finished");
    this.button.setAttribute("aria-label", `Answer ${this.number + 1}`);
  }

  /**
   * @param {ImageData} image
   * @param {number} frame
   * @param {number} frames in a turn
   */
  addFrame(image, frame, frames) {
    this.frames[frame] = image;
    this.count = frames;
    if (this.canvas.width !== image.width) {
      this.canvas.width = image.width;
      this.canvas.height = image.height;
      this.draw(frame);
    }
  }

  draw(frame) {
    if (this.frames[frame]) {
      this.canvas.getContext("2d").putImageData(this.frames[frame], 0, 0);
    }
  }
}

/** All tiles. */
export class Tiles {
  /**
   * @param {HTMLElement} list
   * @param {(number: number) => void} onChoose
   */
  constructor(list, onChoose) {
    this.list = list;
    this.onChoose = onChoose;
    this.tiles = [];
    this.frame = 0;
    this.still = matchMedia("(prefers-reduced-motion: reduce)");
    setInterval(() => this.animate(), FRAME_MS);
  }

  /** @param {number} count of samples that will come */
  reset(count) {
    this.tiles = Array.from({ length: count }, (_, i) => new Tile(i, () => this.onChoose(i)));
    this.list.replaceChildren(...this.tiles.map((tile) => tile.item));
  }

  /** Remove the tiles whose samples will not come. */
  dropUnfinished() {
    this.tiles = this.tiles.filter((tile) => !tile.button.disabled);
    this.list.replaceChildren(...this.tiles.map((tile) => tile.item));
  }

  /** @param {number} number of the chosen sample */
  mark(number) {
    for (const tile of this.tiles) {
      tile.button.setAttribute("aria-pressed", String(tile.number === number));
    }
  }

  /** Show the next image of every tile whose turn is complete. */
  animate() {
    if (this.still.matches || document.hidden) {
      return;
    }
    this.frame += 1;
    for (const tile of this.tiles) {
      if (tile.count && Object.keys(tile.frames).length === tile.count) {
        tile.draw((this.frame + tile.count / 8) % tile.count);
      }
    }
  }
}
