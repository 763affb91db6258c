/** A photo as the network's square input, with its field of view. The rules are those of `completesplat/photo/`. */

import { PageError } from "./errors.js";
import { readHeader, recordedFov } from "./header.js";
import { SquareResizer } from "./lanczos.js";

const MOST_PIXELS = 64_000_000;
const MOST_BYTES = 2 ** 28;
const SMALLEST_SIDE = 8; // pixels
const MOST_ASPECT = 3; // longer side over shorter side of a photo that is kept whole
const OBJECT_SHARE = 0.9; // of the side that an object fills, for weights of objects on a background
const BAND = 256; // rows that are read at a time, so that a large photo is in memory once
const PREVIEW = 640; // pixels
const OPAQUE_KINDS = ["image/jpeg"];

/**
 * @typedef {object} Box a rectangle of a photo, in pixels; it may extend beyond the photo
 * @property {number} left
 * @property {number} top
 * @property {number} width
 * @property {number} height
 *
 * @typedef {object} Photo
 * @property {Map<number, Float32Array>} images the square in sRGB [3, size, size], by size
 * @property {number} fovDegrees across a side of the square
 * @property {boolean} fovIsRecorded whether it is from EXIF
 * @property {[number, number]} axis where the optical axis meets the square, in shares of its side
 * @property {[number, number, number, number]} part left, top, right and bottom of the photo's part of the square,
 *   around which its border is continued, in shares
 * @property {[number, number]} photoSize width and height, upright
 * @property {number} side of the square, in the photo's pixels
 * @property {ImageBitmap} preview the photo's part of the square, for people
 */

/**
 * Read a photo.
 * @param {Blob} file
 * @param {object} settings `pipeline.json`
 * @param {number} size of the network's image
 * @param {number} detail size of a second image, if the photo has so many pixels
 * @returns {Promise<Photo>}
 */
export async function readPhoto(file, settings, size, detail) {
  const header = await checkedHeader(file);
  const bitmap = await decoded(file);
  try {
    checkSize(bitmap.width, bitmap.height);
    const background = settings.background ?? 1;
    const object = OPAQUE_KINDS.includes(file.type) ? null : opaqueBox(bitmap);
    const window = object ? objectWindow(bitmap, object, settings) : wholeWindow(bitmap);
    const part = object ? window : within(window, bitmap);
    const sizes = new Set([size, Math.max(size, Math.min(detail, window.width))]);
    return {
      images: resized(bitmap, window, part, background, [...sizes]),
      ...fieldOfView(header, bitmap, window, object, settings),
      part: shares(part, window),
      photoSize: [bitmap.width, bitmap.height],
      side: window.width,
      preview: preview(bitmap, window, part, background, object !== null),
    };
  } finally {
    bitmap.close();
  }
}

/**
 * Return 1 where pixels of a square of a size are the photo's own, and 0 where its border is continued.
 * @param {Photo["part"]} part
 * @param {number} size
 * @returns {Float32Array}
 */
export function ownAt(part, size) {
  const [left, top, right, bottom] = part;
  return Float32Array.from({ length: size * size }, (_, index) => {
    const x = ((index % size) + 0.5) / size;
    const y = (Math.floor(index / size) + 0.5) / size;
    return x > left && x < right && y > top && y < bottom ? 1 : 0;
  });
}

/** @param {Blob} file */
async function checkedHeader(file) {
  if (file.size === 0) {
    throw new PageError("The file is empty. Choose another photo.");
  }
  if (file.size > MOST_BYTES) {
    throw new PageError("The file has more than 256 MB. Make the photo smaller first.");
  }
  const header = readHeader(new DataView(await file.slice(0, 2 ** 20).arrayBuffer()));
  if (header.width) {
    checkSize(header.width, header.height);
  }
  return header;
}

/** @param {Blob} file */
async function decoded(file) {
  try {
    return await createImageBitmap(file, { imageOrientation: "from-image" });
  } catch {
    if (/hei[cf]/i.test(`${file.type} ${file.name ?? ""}`)) {
      throw new PageError("This browser cannot read HEIC photos. Safari can; or save the photo as a JPEG first.");
    }
    throw new PageError("This file is not an image that the browser can read. Choose a JPEG, PNG or WebP photo.");
  }
}

/**
 * @param {number} width
 * @param {number} height
 */
function checkSize(width, height) {
  if (width * height > MOST_PIXELS) {
    const millions = Math.round((width * height) / 1e6);
    throw new PageError(`The photo has ${millions} million pixels, and 64 are the most. Make it smaller first.`);
  }
  if (Math.min(width, height) < SMALLEST_SIDE) {
    throw new PageError(`The image has ${width} x ${height} pixels; at least ${SMALLEST_SIDE} a side are needed.`);
  }
}

/**
 * Return the box around all that is not transparent, or null if all pixels are opaque.
 * @param {ImageBitmap} bitmap
 * @returns {Box | null}
 */
function opaqueBox(bitmap) {
  let isOpaque = true;
  let [left, top, right, bottom] = [Infinity, Infinity, -Infinity, -Infinity];
  eachBand(bitmap, { left: 0, top: 0, width: bitmap.width, height: bitmap.height }, null, (pixels, firstRow) => {
    for (let i = 0; i < pixels.length / 4; i++) {
      const alpha = pixels[4 * i + 3];
      isOpaque &&= alpha === 255;
      if (alpha > 0) {
        const x = i % bitmap.width;
        const y = firstRow + Math.floor(i / bitmap.width);
        left = Math.min(left, x);
        right = Math.max(right, x + 1);
        top = Math.min(top, y);
        bottom = Math.max(bottom, y + 1);
      }
    }
  });
  if (isOpaque) {
    return null;
  }
  if (right < 0) {
    throw new PageError("The image is nothing but transparency. Choose another.");
  }
  return { left, top, width: right - left, height: bottom - top };
}

/**
 * Return the square of a side in the middle of a box.
 * @param {Box} box
 * @param {number} side
 * @returns {Box}
 */
function centralWindow(box, side) {
  const left = box.left + Math.floor((box.width - side) / 2);
  const top = box.top + Math.floor((box.height - side) / 2);
  return { left, top, width: side, height: side };
}

/**
 * Return the square around a photo, or around its middle if it is very long.
 * @param {ImageBitmap} bitmap
 */
function wholeWindow({ width, height }) {
  const side = Math.min(Math.max(width, height), MOST_ASPECT * Math.min(width, height));
  return centralWindow({ left: 0, top: 0, width, height }, side);
}

/**
 * Return the square of a photo that is transparent around an object.
 * @param {ImageBitmap} bitmap
 * @param {Box} object
 * @param {object} settings
 */
function objectWindow({ width, height }, object, settings) {
  if (settings.background !== null) {
    const share = settings.object_share ?? OBJECT_SHARE;
    return centralWindow(object, Math.round(Math.max(object.width, object.height) / share));
  }
  const reach = Math.max(
    width - 2 * object.left,
    2 * (object.left + object.width) - width,
    height - 2 * object.top,
    2 * (object.top + object.height) - height,
  );
  return centralWindow({ left: 0, top: 0, width, height }, Math.max(reach, Math.min(width, height)));
}

/**
 * Return the part of a window that lies within a photo.
 * @param {Box} window
 * @param {ImageBitmap} bitmap
 * @returns {Box}
 */
function within(window, bitmap) {
  const left = Math.max(window.left, 0);
  const top = Math.max(window.top, 0);
  const width = Math.min(window.left + window.width, bitmap.width) - left;
  const height = Math.min(window.top + window.height, bitmap.height) - top;
  return { left, top, width, height };
}

/**
 * Call a function with the pixels of a box (RGBA), some rows at a time.
 * @param {ImageBitmap} bitmap
 * @param {Box} box
 * @param {number | null} background grey value behind the photo; null: transparent
 * @param {(pixels: Uint8ClampedArray, firstRow: number) => void} take
 */
function eachBand(bitmap, box, background, take) {
  const canvas = new OffscreenCanvas(box.width, Math.min(BAND, box.height));
  const context = canvas.getContext("2d", { willReadFrequently: true });
  for (let row = 0; row < box.height; row += BAND) {
    const rows = Math.min(BAND, box.height - row);
    context.clearRect(0, 0, box.width, BAND);
    if (background !== null) {
      context.fillStyle = grey(background);
      context.fillRect(0, 0, box.width, BAND);
    }
    context.drawImage(bitmap, -box.left, -box.top - row);
    take(context.getImageData(0, 0, box.width, rows).data, row);
  }
}

/** @param {number} value from 0 to 1 */
function grey(value) {
  const byte = Math.round(255 * value);
  return `rgb(${byte} ${byte} ${byte})`;
}

/**
 * @param {ImageBitmap} bitmap
 * @param {Box} window
 * @param {Box} part
 * @param {number} background
 * @param {number[]} sizes
 */
function resized(bitmap, window, part, background, sizes) {
  const placed = { ...part, left: part.left - window.left, top: part.top - window.top };
  const resizers = sizes.map((size) => new SquareResizer(size, window.width, placed));
  eachBand(bitmap, part, background, (pixels, firstRow) => {
    for (const resizer of resizers) {
      resizer.takeRows(pixels, firstRow);
    }
  });
  return new Map(resizers.map((resizer) => [resizer.size, resizer.finish()]));
}

/** Return the field of view across the square, and where the optical axis meets it. */
function fieldOfView(header, bitmap, window, object, settings) {
  const { width, height } = bitmap;
  const recorded = settings.reads_exif ? recordedFov(header.exif, Math.max(width, height)) : null;
  if (recorded === null || (object && settings.background !== null)) {
    return { fovDegrees: settings.fov_degrees, fovIsRecorded: false, axis: [0.5, 0.5] };
  }
  const share = window.width / Math.max(width, height);
  const tangent = share * Math.tan((recorded * Math.PI) / 360);
  const axis = [(width / 2 - window.left) / window.width, (height / 2 - window.top) / window.width];
  return { fovDegrees: (Math.atan(tangent) * 360) / Math.PI, fovIsRecorded: true, axis };
}

/** @returns {Photo["part"]} */
function shares(part, window) {
  const left = (part.left - window.left) / window.width;
  const top = (part.top - window.top) / window.width;
  return [left, top, left + part.width / window.width, top + part.height / window.width];
}

/** Return a small image of the photo's part of the square, transparent around it. */
function preview(bitmap, window, part, background, isCutOut) {
  const canvas = new OffscreenCanvas(PREVIEW, PREVIEW);
  const context = canvas.getContext("2d");
  const scale = PREVIEW / window.width;
  context.imageSmoothingQuality = "high";
  if (isCutOut) {
    context.fillStyle = grey(background);
    context.fillRect(0, 0, PREVIEW, PREVIEW);
  }
  context.scale(scale, scale);
  context.drawImage(bitmap, -window.left, -window.top);
  return canvas.transferToImageBitmap();
}
