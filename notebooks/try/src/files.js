/** Files of scenes: `.ply` in the layout of 3D Gaussian Splatting, and `.splat` (antimatter15's, 32 bytes a splat). */

const SH_C0 = 0.28209479177387814; // spherical harmonic of degree 0, by which 3DGS files divide colours
const SMALLEST_ALPHA = 1e-6;
const AXES = "coordinates as given, none turned; camera frames have +x right, +y down, +z forward (OpenCV)";
const PROPERTIES = [
  ...["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"],
  ...["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"],
];
const SPLAT_BYTES = 32;

/**
 * Return the content of a `.ply` file.
 * @param {import("./pipeline.js").Gaussians} gaussians
 * @returns {Blob}
 */
export function plyOf(gaussians) {
  const count = gaussians.opacities.length;
  const width = PROPERTIES.length;
  const table = new DataView(new ArrayBuffer(4 * width * count));
  for (let i = 0; i < count; i++) {
    const alpha = Math.min(Math.max(gaussians.opacities[i], SMALLEST_ALPHA), 1 - SMALLEST_ALPHA);
    const row = [
      ...gaussians.means.subarray(3 * i, 3 * i + 3),
      ...[0, 0, 0],
      ...Array.from(gaussians.colors.subarray(3 * i, 3 * i + 3), (color) => (color - 0.5) / SH_C0),
      Math.log(alpha / (1 - alpha)),
      ...Array.from(gaussians.scales.subarray(3 * i, 3 * i + 3), Math.log),
      ...gaussians.quaternions.subarray(4 * i, 4 * i + 4),
    ];
    row.forEach((value, column) => table.setFloat32(4 * (width * i + column), value, true));
  }
  const properties = PROPERTIES.map((name) => `property float ${name}\n`).join("");
  const start = `ply\nformat binary_little_endian 1.0\ncomment ${AXES}\nelement vertex ${count}\n`;
  return new Blob([`${start}${properties}end_header\n`, table.buffer], { type: "application/octet-stream" });
}

/**
 * Return the content of a `.splat` file.
 * @param {import("./pipeline.js").Gaussians} gaussians
 * @returns {Blob}
 */
export function splatOf(gaussians) {
  const count = gaussians.opacities.length;
  const buffer = new ArrayBuffer(SPLAT_BYTES * count);
  const floats = new Float32Array(buffer);
  const bytes = new Uint8ClampedArray(buffer); // it rounds and clamps
  for (let i = 0; i < count; i++) {
    floats.set(gaussians.means.subarray(3 * i, 3 * i + 3), 8 * i);
    floats.set(gaussians.scales.subarray(3 * i, 3 * i + 3), 8 * i + 3);
    const quaternion = gaussians.quaternions.subarray(4 * i, 4 * i + 4);
    const length = Math.hypot(...quaternion) || 1;
    for (let j = 0; j < 3; j++) {
      bytes[SPLAT_BYTES * i + 24 + j] = 255 * gaussians.colors[3 * i + j];
    }
    bytes[SPLAT_BYTES * i + 27] = 255 * gaussians.opacities[i];
    for (let j = 0; j < 4; j++) {
      bytes[SPLAT_BYTES * i + 28 + j] = (128 * quaternion[j]) / length + 128;
    }
  }
  return new Blob([buffer], { type: "application/octet-stream" });
}
