/** Cameras around a scene, in the photo's camera's frame: +x right, +y down, +z forward. */

import { focalOf } from "./raster.js";

const MARGIN = 1.05; // of the distance at which an object just fits into the frame

/** @typedef {[number, number, number]} Vector */

/**
 * @typedef {object} View a camera's place
 * @property {Vector} eye
 * @property {Vector} right
 * @property {Vector} down
 * @property {Vector} forward
 *
 * @typedef {object} Turn
 * @property {number} yaw radians to the right, around the scene's axis
 * @property {number} pitch radians up
 * @property {number} zoom share of the distance
 * @property {number} look 0: the photo's own view; 1: from where the object stays in the frame all around
 */

export const PHOTO_VIEW = { yaw: 0, pitch: 0, zoom: 1, look: 0 };

/**
 * Return the camera's place after a turn around an object.
 * @param {Turn} turn
 * @param {import("./subject.js").Subject} subject
 * @param {Vector} up
 * @param {number} fovDegrees
 * @returns {View}
 */
export function viewOf({ yaw, pitch, zoom, look }, { center, radius }, up, fovDegrees) {
  const arm = center.map((value) => -value);
  const needed = (MARGIN * radius) / Math.sin((fovDegrees * Math.PI) / 360);
  const back = mix(1, Math.max(1, needed / Math.max(norm(arm), 1e-9)), look) * zoom;
  const axis = unit(up);
  const aside = unit(cross(axis, arm));
  const tilted = rotated(arm, aside, -pitch);
  const eye = rotated(tilted, axis, yaw).map((value, i) => center[i] + back * value);
  // The photo's view need not have the object's middle in its own.
  const toCenter = unit(center.map((value, i) => value - eye[i]));
  const forward = unit([0, 0, 1].map((value, i) => mix(value, toCenter[i], look)));
  const above = [0, -1, 0].map((value, i) => mix(value, axis[i], look));
  const right = unit(cross(forward, above));
  return { eye, right, down: cross(forward, right), forward };
}

/**
 * Return a view as a camera of the rasterizer, with the principal point in the middle.
 * @param {View} view
 * @param {number} fovDegrees
 * @param {number} size
 * @returns {import("./raster.js").Camera}
 */
export function cameraAt({ eye, right, down, forward }, fovDegrees, size) {
  return {
    size,
    focal: focalOf(fovDegrees, size),
    principal: [size / 2, size / 2],
    rotation: [...right, ...down, ...forward],
    translation: [right, down, forward].map((row) => -dot(row, eye)),
  };
}

export function mix(from, to, share) {
  return from + (to - from) * share;
}

function dot(a, b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

function norm(a) {
  return Math.hypot(...a);
}

function unit(a) {
  const length = norm(a);
  return a.map((value) => value / length);
}

function cross(a, b) {
  return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}

/** Rotate a vector about a unit axis (Rodrigues). */
function rotated(vector, axis, angle) {
  const [cos, sin] = [Math.cos(angle), Math.sin(angle)];
  const aside = cross(axis, vector);
  const along = dot(axis, vector) * (1 - cos);
  return vector.map((value, i) => value * cos + aside[i] * sin + axis[i] * along);
}
