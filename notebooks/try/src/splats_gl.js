/** A rasterizer on the graphics card, with the rules of `raster.js`: one quad for each Gaussian, the farthest first. */

import { DepthOrder } from "./order.js";
import { BLUR, FRUSTUM_MARGIN, MAX_ALPHA, MIN_ALPHA, NEAR } from "./raster.js";

const TEXELS = 4; // of a Gaussian: mean and opacity, scales, quaternion, colour
const ROW = 512; // Gaussians in a row of the textures, which then are as wide as every WebGL 2 allows
const QUAD = [0, 1, 2, 2, 1, 3]; // corners of two triangles

const VERTEX = `#version 300 es
precision highp float;
precision highp int;
uniform highp sampler2D gaussians;
uniform highp usampler2D order;
uniform vec2 size;
uniform float focal;
uniform vec2 principal;
uniform mat3 rotation;
uniform vec3 translation;
uniform float variance;
flat out vec4 color;
out vec2 deviations;

mat3 unitMatrix(vec4 quaternion) {
  float size = length(quaternion);
  vec4 q = size > 1e-12 ? quaternion / size : vec4(1, 0, 0, 0);
  float w = q.x, x = q.y, y = q.z, z = q.w;
  return mat3(
    1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
    2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
    2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)
  );
}

void main() {
  int place = gl_VertexID / 4;
  int number = int(texelFetch(order, ivec2(place % ${ROW}, place / ${ROW}), 0).r);
  ivec2 texel = ivec2(${TEXELS} * (number % ${ROW}), number / ${ROW});
  vec4 mean = texelFetch(gaussians, texel, 0);
  vec4 scales = texelFetch(gaussians, texel + ivec2(1, 0), 0);
  vec4 quaternion = texelFetch(gaussians, texel + ivec2(2, 0), 0);
  color = vec4(texelFetch(gaussians, texel + ivec2(3, 0), 0).rgb, mean.w);
  vec3 at = rotation * mean.xyz + translation;
  float end = log(mean.w / float(${MIN_ALPHA}));
  gl_Position = vec4(2, 2, 2, 1); // not in the image
  if (at.z <= float(${NEAR}) || end <= 0.0) {
    return;
  }
  vec2 beyond = float(${FRUSTUM_MARGIN}) * 0.5 * size;
  vec2 slope = clamp(at.xy / at.z, (-principal - beyond) / focal, (size - principal + beyond) / focal);
  mat3 axes = rotation * unitMatrix(quaternion);
  vec3 x, y;
  for (int axis = 0; axis < 3; axis++) {
    vec3 arm = axes[axis] * sqrt(scales[axis] * scales[axis] + variance * mean.z * mean.z);
    vec2 seen = (focal / at.z) * (arm.xy - slope * arm.z);
    x[axis] = seen.x;
    y[axis] = seen.y;
  }
  vec3 normal = cross(x, y);
  float blur = float(${BLUR});
  float determinant = dot(normal, normal) + blur * (dot(x, x) + dot(y, y)) + blur * blur; // nothing cancels
  // The covariance's Cholesky factor makes the ellipse of a circle, and its quad of a square.
  float first = sqrt(dot(x, x) + blur);
  float both = dot(x, y) / first;
  float second = sqrt(determinant) / first;
  deviations = sqrt(2.0 * end) * vec2(gl_VertexID % 2 * 2 - 1, gl_VertexID / 2 % 2 * 2 - 1);
  vec2 offset = vec2(first * deviations.x, both * deviations.x + second * deviations.y);
  vec2 pixel = focal * at.xy / at.z + principal + offset;
  gl_Position = vec4(2.0 * pixel.x / size.x - 1.0, 1.0 - 2.0 * pixel.y / size.y, 0, 1);
}`;

const FRAGMENT = `#version 300 es
precision highp float;
flat in vec4 color;
in vec2 deviations;
out vec4 result;

void main() {
  float alpha = min(color.a * exp(-0.5 * dot(deviations, deviations)), float(${MAX_ALPHA}));
  if (alpha < float(${MIN_ALPHA})) {
    discard;
  }
  result = vec4(color.rgb * alpha, alpha);
}`;

/** Rasterizer of one scene into a canvas, which is transparent where nothing is. */
export class SplatRenderer {
  /**
   * @param {HTMLCanvasElement} canvas
   * @throws {Error} where there is no WebGL 2
   */
  constructor(canvas) {
    const gl = canvas.getContext("webgl2", { antialias: false, depth: false });
    if (!gl) {
      throw new Error("WebGL 2: the browser has none");
    }
    this.canvas = canvas;
    this.gl = gl;
    this.program = linked(gl);
    this.places = {};
    for (const name of ["size", "focal", "principal", "rotation", "translation", "variance"]) {
      this.places[name] = gl.getUniformLocation(this.program, name);
    }
    // Sums of 8 bits would show steps, and lose colours that are brighter than white.
    const isFine = gl.getExtension("EXT_color_buffer_float") ?? gl.getExtension("EXT_color_buffer_half_float");
    this.format = isFine ? gl.RGBA16F : gl.RGBA8;
    this.image = gl.createRenderbuffer();
    this.framebuffer = gl.createFramebuffer();
    this.imageSize = [0, 0];
    this.order = null;
    gl.useProgram(this.program);
    for (const [unit, name] of ["gaussians", "order"].entries()) {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
      gl.uniform1i(gl.getUniformLocation(this.program, name), unit);
    }
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
  }

  /**
   * Take a scene.
   * @param {import("./pipeline.js").Gaussians} gaussians
   * @param {number} fitFocal focal length, in pixels, of the photo's camera in the fit: larger images, whose pixels
   *   blur less, look as those of the fit
   */
  setScene({ means, quaternions, scales, opacities, colors }, fitFocal) {
    const { gl } = this;
    const count = opacities.length;
    const rows = Math.ceil(count / ROW);
    const texels = new Float32Array(4 * TEXELS * ROW * rows);
    for (let number = 0; number < count; number++) {
      const at = 4 * TEXELS * number;
      texels.set(means.subarray(3 * number, 3 * number + 3), at);
      texels[at + 3] = opacities[number];
      texels.set(scales.subarray(3 * number, 3 * number + 3), at + 4);
      texels.set(quaternions.subarray(4 * number, 4 * number + 4), at + 8);
      texels.set(colors.subarray(3 * number, 3 * number + 3), at + 12);
    }
    gl.activeTexture(gl.TEXTURE0);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, TEXELS * ROW, rows, 0, gl.RGBA, gl.FLOAT, texels);
    // One draw of all quads: some drivers are slow with many instances of a quad.
    const corners = new Uint32Array(QUAD.length * count);
    for (let number = 0; number < count; number++) {
      corners.set(QUAD.map((corner) => 4 * number + corner), QUAD.length * number);
    }
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, corners, gl.STATIC_DRAW);
    this.order = new DepthOrder(means, ROW * rows);
    this.fitFocal = fitFocal;
  }

  /**
   * Draw the scene into the whole canvas.
   * @param {import("./raster.js").Camera} camera
   * @param {[number, number]} size width and height of the image in pixels
   */
  draw({ focal, principal, rotation, translation }, size) {
    const { gl, places, order } = this;
    this.resize(size);
    if (order.sort(rotation.slice(6))) {
      const rows = order.numbers.length / ROW;
      gl.activeTexture(gl.TEXTURE1);
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.R32UI, ROW, rows, 0, gl.RED_INTEGER, gl.UNSIGNED_INT, order.numbers);
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.framebuffer);
    gl.viewport(0, 0, ...size);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.uniform2f(places.size, ...size);
    gl.uniform1f(places.focal, focal);
    gl.uniform2f(places.principal, ...principal);
    gl.uniformMatrix3fv(places.rotation, true, rotation);
    gl.uniform3f(places.translation, ...translation);
    gl.uniform1f(places.variance, BLUR * Math.max(this.fitFocal ** -2 - focal ** -2, 0));
    gl.drawElements(gl.TRIANGLES, QUAD.length * order.count, gl.UNSIGNED_INT, 0);
    gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, null);
    gl.blitFramebuffer(0, 0, ...size, 0, 0, ...size, gl.COLOR_BUFFER_BIT, gl.NEAREST);
  }

  /** Make the canvas empty. */
  clear() {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.clear(gl.COLOR_BUFFER_BIT);
  }

  /** Give the canvas and the image behind it a size. */
  resize([width, height]) {
    const { gl, canvas } = this;
    if (this.imageSize[0] === width && this.imageSize[1] === height) {
      return;
    }
    this.imageSize = [width, height];
    canvas.width = width;
    canvas.height = height;
    gl.bindRenderbuffer(gl.RENDERBUFFER, this.image);
    gl.renderbufferStorage(gl.RENDERBUFFER, this.format, width, height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.framebuffer);
    gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.RENDERBUFFER, this.image);
  }
}

/** Return the program of both shaders. */
function linked(gl) {
  const program = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
    throw new Error(`WebGL 2: the shaders do not link: ${gl.getProgramInfoLog(program)}`);
  }
  return program;
}
