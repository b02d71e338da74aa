// The shader of 2014: its textures, and its uniforms.

const VARIANTS = { flss: 0, nmm: 1, pq: 2, gem: 3, nmm_pq: 4 };
const MAX_TERMS = 45;

const WINDOWS = ["flss", "nmm"];
const TILES = ["pq", "nmm_pq"];
const SERIES = [...WINDOWS, ...TILES];

// Their names, and the variants that have them.
const QUIRKS = {
  schlick: ["Schlick's Fresnel", SERIES],
  fixed_index: ["index 1.5 for every material", SERIES],
  complex_window_sum: ["complex sum over the window", WINDOWS],
  one_texel: ["window of one texel", WINDOWS],
  fixed_coherence: ["coherence length of 65 µm", SERIES],
  periodic_scan: ["scan as one period", WINDOWS],
  floor_anchor: ["window about floor(q T)", SERIES],
  no_jacobian: ["no dλ/dn", ["nmm", "nmm_pq"]],
  wrong_product: ["wrong imaginary part", TILES],
  relative: ["relative radiance (no 1/λ²)", SERIES],
  cie_rgb_matrix: ["CIE RGB shown as sRGB", SERIES],
  constant_blend: ["constant blend with the pigment", [...SERIES, "gem"]],
};
const PUBLISHED_TERMS = { flss: 37, nmm: 31, pq: 39, nmm_pq: 39, gem: 37 };
// Of the published program, and what one of it is of the colour.
const PUBLISHED_BRIGHTNESS = 1000;
const BRIGHTNESS_UNITS = { flss: 1, nmm: 1, pq: 0.5, nmm_pq: 0.5, gem: 1 / 4000 };
const allQuirks = (on) => Object.fromEntries(Object.keys(QUIRKS).map((name) => [name, on]));

const RGB_TO_XYZ = [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]];
const CIE_RGB = [[0.41847, -0.15866, -0.082835], [-0.091169, 0.25243, 0.015708], [0.0009209, -0.0025498, 0.1786]].map(
  (row) => row.map((value) => value / 0.17697));
const columns = (matrix) => [0, 1, 2].flatMap((i) => matrix.map((row) => row[i]));

// Discrete Fourier transform of complex numbers, e^(-2 pi i m x/N), for any N (Cooley and Tukey 1965).
function fourier(re, im) {
  const count = re.length;
  if (count === 1) return [re, im];
  let factor = 2;
  while (count % factor && factor * factor <= count) factor += 1;
  if (count % factor) factor = count;
  const rest = count / factor;
  const parts = [];
  for (let r = 0; r < factor; r++) {
    const take = (from) => Float64Array.from({ length: rest }, (_, i) => from[i * factor + r]);
    parts.push(rest === 1 ? [take(re), take(im)] : fourier(take(re), take(im)));
  }
  const [outRe, outIm] = [new Float64Array(count), new Float64Array(count)];
  const [cosines, sines] = circle(count);
  for (let m = 0; m < count; m++) {
    let [a, b] = [0, 0];
    for (let r = 0; r < factor; r++) {
      const k = (m * r) % count;
      const [x, y] = [parts[r][0][m % rest], parts[r][1][m % rest]];
      a += cosines[k] * x + sines[k] * y;
      b += cosines[k] * y - sines[k] * x;
    }
    outRe[m] = a;
    outIm[m] = b;
  }
  return [outRe, outIm];
}

const circles = new Map();
function circle(count) {
  if (!circles.has(count)) {
    const of = (f) => Float64Array.from({ length: count }, (_, k) => f((2 * Math.PI * k) / count));
    circles.set(count, [of(Math.cos), of(Math.sin)]);
  }
  return circles.get(count);
}

// The taper along one axis, and the coherence length 4 sigma of the window in return (taper.py of the package), from the
// sum of the squared windows at the pixels.
function taperOf(squares, pixel, length) {
  const count = squares.length;
  const total = squares.reduce((a, b) => a + b);
  const variance = squares.reduce((a, square, i) => a + square * ((i - (count - 1) / 2) * pixel) ** 2, 0) / total;
  const inverse = Math.max(16 / length ** 2 - 1 / (2 * variance), 1 / (count * pixel) ** 2);
  return { values: Float64Array.from(squares, (square) => Math.sqrt((square * count) / total)), length: 4 / Math.sqrt(inverse) };
}

async function tapersOf(heights) {
  const found = {};
  for (const [name, { length, squares }] of Object.entries(heights.windows)) {
    const axis = async (content, k) => {
      const { values } = await decoded(content);
      // An axis of one pixel.
      return values.length === 1 ? { values, length } : taperOf(values, heights.pixel_size[k], length);
    };
    found[name] = await Promise.all(squares.map(axis));
  }
  return found;
}

class Shader2014 {
  constructor(gl, heights, values, tapers, model) {
    Object.assign(this, { gl, heights, tapers, model });
    [this.rows, this.columns] = heights.shape;
    this.tile = [this.columns * heights.pixel_size[0], this.rows * heights.pixel_size[1]];
    this.values = Float64Array.from(values, (v) => (v / 65535) * heights.range);  // from the lowest point
    // Of the orders that light reaches, and those around them.
    this.order = [this.columns, this.rows].map((n, k) => Math.min(Math.floor(n / 2), Math.ceil((2 * this.tile[k]) / 0.38) + 8));
    this.textures = new Map();
    this.spacing = NaN;
  }

  get bytes() {
    return 8 * MAX_TERMS * (2 * this.order[0] + 1) * (2 * this.order[1] + 1);
  }

  // The taper of the heights: of the coherence length of the spectrum or of 65 um, or none.
  taperOf({ quirks, right }) {
    if (quirks.periodic_scan || !WINDOWS.includes(right)) return "none";
    const name = quirks.fixed_coherence ? "sun" : "own";
    return name in this.tapers ? name : "none";
  }

  // Which textures a state needs.
  kindOf(state) {
    return this.taperOf(state);
  }

  // Makes the textures of w t^n, t = h/H, with heights from the middle, and a taper w.
  async prepare(state, progress) {
    const kind = this.kindOf(state);
    if (this.textures.has(kind)) return;
    const { gl, rows, columns, order } = this;
    const taper = this.tapers[this.taperOf(state)];
    const range = this.heights.range;
    const height = range / 2;
    const t = this.values.map((v) => (range === 0 ? 0 : (v - height) / height));
    const [width, depth] = order.map((m) => 2 * m + 1);
    const made = texture(gl, gl.TEXTURE_2D_ARRAY);
    gl.texStorage3D(gl.TEXTURE_2D_ARRAY, 1, gl.RG32F, width, depth, MAX_TERMS);
    const taperAt = (i) => taper[0].values[i % columns] * taper[1].values[Math.floor(i / columns)];
    const powers = Float64Array.from(t, (_, i) => (taper ? taperAt(i) : 1));
    const none = new Float64Array(columns);
    for (let n = 0; n < MAX_TERMS; n++) {
      const lines = Array.from({ length: rows }, (_, j) => fourier(powers.subarray(j * columns, (j + 1) * columns), none));
      const layer = new Float32Array(2 * width * depth);
      for (let i = 0; i < width; i++) {
        const m = i - order[0];
        // The Nyquist order of an even number of pixels is negative.
        if (2 * m === columns) continue;
        const at = ((m % columns) + columns) % columns;
        const [re, im] = fourier(Float64Array.from(lines, (line) => line[0][at]), Float64Array.from(lines, (line) => line[1][at]));
        for (let j = 0; j < depth; j++) {
          const l = j - order[1];
          if (2 * l === rows && rows > 1) continue;
          const from = ((l % rows) + rows) % rows;
          layer[2 * (j * width + i)] = re[from] / (rows * columns);
          layer[2 * (j * width + i) + 1] = im[from] / (rows * columns);
        }
      }
      if (n === 1 && !taper) this.spacing = this.strongestPeriod(layer, width, depth);
      gl.bindTexture(gl.TEXTURE_2D_ARRAY, made.texture);
      gl.texSubImage3D(gl.TEXTURE_2D_ARRAY, 0, 0, 0, n, width, depth, 1, gl.RG, gl.FLOAT, layer);
      for (let i = 0; i < t.length; i++) powers[i] *= t[i];
      if (t.length > 20000) {
        progress(n / MAX_TERMS);
        await new Promise((done) => setTimeout(done));
      }
    }
    progress(1);
    this.textures.set(kind, { texels: made, height });
  }

  strongestPeriod(layer, width, depth) {
    const [M] = this.order;
    let [best, strongest] = [0, 0];
    for (let m = 1; m <= M; m++) {
      let power = 0;
      for (let j = 0; j < depth; j++) {
        const k = 2 * (j * width + M + m);
        power += layer[k] ** 2 + layer[k + 1] ** 2;
      }
      if (power > strongest * (1 + 1e-6)) [best, strongest] = [m, power];
    }
    return this.tile[0] / (best || 1);
  }

  uniforms(state) {
    const { quirks } = state;
    const { texels, height } = this.textures.get(this.kindOf(state));
    const length = quirks.fixed_coherence ? 65 : state.coherenceLength;
    const sigma = Math.SQRT2 * lobeWidth(length);
    const taper = this.tapers[this.taperOf(state)];
    const sigmas = [0, 1].map((axis) => (taper ? (sigma * length) / taper[axis].length : sigma));
    const matrix = quirks.cie_rgb_matrix ? CIE_RGB : XYZ_TO_RGB;
    const hasFreeScale = state.right === "gem" || quirks.relative;
    const radius = (size, k) => (quirks.one_texel ? 1 : Math.min(Math.max(Math.ceil(2 * sigmas[k] * size - 0.5), 1), 16));
    return {
      ...this.model.uniforms({ ...state, coat: 1 }),
      uSky: 0,
      uTexels: texels,
      uTexelOrder: this.order,
      uPixels: [this.columns, this.rows],
      uTile: this.tile,
      uHeight: height,
      uTerms: state.terms,
      uWindowSigma: sigma,
      uWindowSigmas: sigmas,
      uRadius: this.tile.map(radius),
      uTiles: this.tile.map((size) => Math.max(1, Math.round(length / size))),
      uSpacing: this.spacing,
      uToRGB: columns(matrix),
      uBrightness: hasFreeScale ? state.brightness * BRIGHTNESS_UNITS[state.right] : 1,
      uFromRGB: columns(RGB_TO_XYZ),
      uSchlick: Number(quirks.schlick),
      uFixedIndex: Number(quirks.fixed_index),
      uComplexSum: Number(quirks.complex_window_sum),
      uFloor: Number(quirks.floor_anchor),
      uNoJacobian: Number(quirks.no_jacobian),
      uWrongProduct: Number(quirks.wrong_product),
      uRelative: Number(quirks.relative),
      uConstantBlend: Number(quirks.constant_blend),
    };
  }
}
