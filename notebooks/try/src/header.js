/** What the header of an image file says before it is decoded: the size in pixels, and EXIF's field of view. */

const FULL_FRAME_WIDTH = 36; // mm
const MILLIMETRES = { 2: 25.4, 3: 10, 4: 1, 5: 0.001 }; // by FocalPlaneResolutionUnit
const TAGS = {
  exif: 0x8769,
  focalLength: 0x920a,
  width: 0xa002,
  height: 0xa003,
  planeResolution: 0xa20e,
  planeUnit: 0xa210,
  equivalent: 0xa405, // FocalLengthIn35mmFilm
};

/**
 * @typedef {object} Header
 * @property {number} [width] as it is stored, if the format is one of those that are looked into
 * @property {number} [height]
 * @property {Map<number, number>} exif numbers of the record's tags
 */

/**
 * Read the header of a JPEG or PNG; that of others is empty.
 * @param {DataView} view the file
 * @returns {Header}
 */
export function readHeader(view) {
  try {
    if (view.getUint32(0) === 0x89504e47) {
      return readPng(view);
    }
    if (view.getUint16(0) === 0xffd8) {
      return readJpeg(view);
    }
  } catch (error) {
    if (!(error instanceof RangeError)) {
      throw error;
    }
  }
  return { exif: new Map() };
}

/** @param {DataView} view */
function readPng(view) {
  const header = { width: view.getUint32(16), height: view.getUint32(20), exif: new Map() };
  let at = 8;
  while (at + 8 < view.byteLength) {
    const length = view.getUint32(at);
    const kind = view.getUint32(at + 4);
    if (kind === 0x65584966) { // eXIf
      header.exif = readExif(view, at + 8, length);
    }
    if (kind === 0x49444154) { // IDAT
      break;
    }
    at += 12 + length;
  }
  return header;
}

/** @param {DataView} view */
function readJpeg(view) {
  const header = { exif: new Map() };
  let at = 2;
  while (at + 4 < view.byteLength && view.getUint8(at) === 0xff) {
    const marker = view.getUint8(at + 1);
    const length = view.getUint16(at + 2);
    const isSize = marker >= 0xc0 && marker <= 0xcf && ![0xc4, 0xc8, 0xcc].includes(marker);
    if (isSize) {
      header.height = view.getUint16(at + 5);
      header.width = view.getUint16(at + 7);
      break;
    }
    if (marker === 0xe1 && view.getUint32(at + 4) === 0x45786966) { // "Exif"
      header.exif = readExif(view, at + 10, length - 8);
    }
    at += 2 + length;
  }
  return header;
}

/**
 * Return the numbers of an EXIF record; what is damaged is left out.
 * @param {DataView} file
 * @param {number} start
 * @param {number} length
 * @returns {Map<number, number>}
 */
function readExif(file, start, length) {
  const values = new Map();
  try {
    const view = new DataView(file.buffer, file.byteOffset + start, length);
    const little = view.getUint16(0) === 0x4949;
    readDirectory(view, view.getUint32(4, little), little, values);
    if (values.has(TAGS.exif)) {
      readDirectory(view, values.get(TAGS.exif), little, values);
    }
  } catch (error) {
    if (!(error instanceof RangeError)) {
      throw error;
    }
  }
  return values;
}

/**
 * @param {DataView} view
 * @param {number} start
 * @param {boolean} little
 * @param {Map<number, number>} values
 */
function readDirectory(view, start, little, values) {
  const count = view.getUint16(start, little);
  for (let i = 0; i < count; i++) {
    const at = start + 2 + 12 * i;
    const kind = view.getUint16(at + 2, little);
    const tag = view.getUint16(at, little);
    if (kind === 3) {
      values.set(tag, view.getUint16(at + 8, little));
    } else if (kind === 4) {
      values.set(tag, view.getUint32(at + 8, little));
    } else if (kind === 5) {
      const place = view.getUint32(at + 8, little);
      values.set(tag, view.getUint32(place, little) / view.getUint32(place + 4, little));
    }
  }
}

/**
 * Return the field of view in degrees across the longer side of a photo, or null if it is not recorded.
 * @param {Map<number, number>} exif
 * @param {number} longerSide in pixels
 * @returns {number | null}
 */
export function recordedFov(exif, longerSide) {
  const number = (tag) => (Number.isFinite(exif.get(tag)) && exif.get(tag) > 0 ? exif.get(tag) : null);
  const equivalent = number(TAGS.equivalent);
  const focal = equivalent ? (equivalent / FULL_FRAME_WIDTH) * longerSide : focalFromSensor(exif, number, longerSide);
  if (focal === null) {
    return null;
  }
  const degrees = (2 * Math.atan(longerSide / (2 * focal)) * 180) / Math.PI;
  return degrees > 1 && degrees < 170 ? degrees : null;
}

/** Return the focal length in pixels from the sensor's resolution, or null if it is not recorded. */
function focalFromSensor(exif, number, longerSide) {
  const focal = number(TAGS.focalLength);
  const resolution = number(TAGS.planeResolution);
  const unit = exif.get(TAGS.planeUnit) ?? 2;
  if (focal === null || resolution === null || !(unit in MILLIMETRES)) {
    return null;
  }
  const sides = [number(TAGS.width), number(TAGS.height)];
  const scale = sides.includes(null) ? 1 : longerSide / Math.max(...sides);
  return ((focal * resolution) / MILLIMETRES[unit]) * scale;
}
