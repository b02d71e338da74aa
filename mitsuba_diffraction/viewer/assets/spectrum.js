// The spectrum S(q; kappa) and the material as uniforms of model.glsl.

const KINDS = { resolved: 0, lines: 1, window: 2, splines: 3 };
const MAX_DRAWN_LOBE_WIDTH = 0.03;  // cycles/um, of a line grating, as in bsdf/orders.py
const MAX_LOBES = 8;                // along one axis

// Error function (Abramowitz and Stegun 1964, 7.1.26), to 1.5e-7.
function erf(x) {
  const t = 1 / (1 + 0.3275911 * Math.abs(x));
  const p = ((((1.061405429 * t - 1.453152027) * t + 1.421413741) * t - 0.284496736) * t + 0.254829592) * t;
  return Math.sign(x) * (1 - p * Math.exp(-x * x));
}

function lobeWidth(coherenceLength) {
  return 1 / (2 * Math.SQRT2 * Math.PI * (coherenceLength / 4));
}

// The truncation of lobes along both axes, as OrderGrid.lobes.
function lobesOf(spectrum, sigma) {
  return spectrum.tile_size.map((size, axis) => {
    const maxOrder = spectrum.max_order[axis];
    let count = Math.max(1, Math.ceil(2 * spectrum.cutoff_sigmas * sigma * size * (1 - 1e-9)));
    let halfWidth = count > 1 ? count / (2 * size) : spectrum.cutoff_sigmas * sigma;
    const readsAll = count > 2 * maxOrder + 1;
    if (readsAll) [count, halfWidth] = [2 * maxOrder + 1, Infinity];
    const inside = readsAll ? 1 : erf(halfWidth / (Math.SQRT2 * sigma));
    return { count, halfWidth: Math.min(halfWidth, 1e30), readsAll, peak: 1 / (Math.sqrt(2 * Math.PI) * sigma * inside) };
  });
}

// The coherence lengths that the table covers: (shortest, longest) in um.
function coherenceLengths(spectrum) {
  const own = spectrum.coherence_length;
  if (spectrum.kind === "splines") return [own, own];
  // A mean over random patches has a comb of orders, which shorter coherence lengths blur.
  const longest = spectrum.patches > 1 ? own : Math.max(own, 130);
  let shortest = own;
  const few = (length) =>
    lobesOf(spectrum, lobeWidth(length)).every((lobe, axis) => lobe.readsAll || lobe.count <= MAX_LOBES ||
      2 * spectrum.max_order[axis] + 1 <= MAX_LOBES);
  while (shortest > 2 && few(shortest / 1.1)) shortest /= 1.1;
  return [shortest, longest];
}

const MARGIN = 3;  // nodes that are zero around the table, as in model.glsl

// (layers, terms, rows, columns) as (layers, rows, columns, terms), with the margin.
function interleaved(values, [layers, terms, rows, columns]) {
  const [height, width] = [rows + 2 * MARGIN, columns + 2 * MARGIN];
  const result = new values.constructor(layers * height * width * terms);
  let from = 0;
  for (let layer = 0; layer < layers; layer++) {
    for (let p = 0; p < terms; p++) {
      for (let j = 0; j < rows; j++) {
        const start = ((layer * height + j + MARGIN) * width + MARGIN) * terms + p;
        for (let i = 0; i < columns; i++) result[start + i * terms] = values[from++];
      }
    }
  }
  return result;
}

// Numbers of a table in half or single precision.
function floatsOf({ values, type }) {
  if (type !== "float16") return values;
  const halves = Float32Array.from({ length: 65536 }, (_, bits) => {
    const [exponent, fraction] = [(bits >> 10) & 31, bits & 1023];
    const size = exponent === 0 ? fraction * 2 ** -24 : (1024 + fraction) * 2 ** (exponent - 25);
    return bits & 32768 ? -size : size;
  });
  return Float32Array.from(values, (bits) => halves[bits]);
}

class Spectrum {
  constructor(gl, spectrum, table, materials) {
    Object.assign(this, { gl, spectrum, materials });
    const [layers, terms, rows, columns] = table.shape;
    this.table = { values: floatsOf(table), layers, terms, nodes: rows * columns };
    const padded = interleaved(table.values, table.shape);
    this.texture = numbers3D(gl, padded, columns + 2 * MARGIN, rows + 2 * MARGIN, layers, terms);
    this.bytes = padded.byteLength;
    Object.assign(this, { layers, terms });
    this.noIndex = numbers2D(gl, new Float32Array(2), 1, 1, 2);
  }

  kindOf(lobes, sigma) {
    const isLine = this.spectrum.max_order.includes(0);
    const single = lobes.every((lobe) => lobe.count === 1);
    if (single && !(isLine && sigma > MAX_DRAWN_LOBE_WIDTH)) return KINDS.resolved;
    return isLine ? KINDS.lines : KINDS.window;
  }

  kindAt(state) {
    const sigma = lobeWidth(state.coherenceLength);
    return this.spectrum.kind === "splines" ? KINDS.splines : this.kindOf(lobesOf(this.spectrum, sigma), sigma);
  }

  // The power of a node at kappa.
  powerAt(node, kappa) {
    const { values, layers, terms, nodes } = this.table;
    const x = Math.min((kappa * layers) / this.spectrum.max_kappa, layers);
    const layer = Math.min(Math.floor(x), layers - 1), t = 2 * (x - layer) - 1;
    return Array.from({ length: terms }, (_, p) => values[(layer * terms + p) * nodes + node] * t ** p).reduce((a, b) => a + b);
  }

  // The constants of model.glsl.
  constants(state) {
    const metal = state.material in this.materials;
    const dielectric = state.material === "dielectric";
    return `const int KIND = ${this.kindAt(state)};
const int MATERIAL = ${dielectric ? 0 : metal ? 1 : 2};
const bool CUBIC = ${this.terms === 4}, HAS_BASE = ${state.hasBase && dielectric}, HAS_COAT = ${state.coat > state.air};
`;
  }

  uniforms(state) {
    const { spectrum } = this;
    const splines = spectrum.kind === "splines";
    const sigma = lobeWidth(splines ? spectrum.coherence_length : state.coherenceLength);
    const lobes = splines ? null : lobesOf(spectrum, sigma);
    const both = (of) => (splines ? [0, 0] : lobes.map(of));
    const metal = this.materials[state.material];
    return {
      uTable: this.texture,
      uUnit: spectrum.unit,
      uIntervalsPerKappa: this.layers / spectrum.max_kappa,
      uMaxOrder: spectrum.max_order,
      uPerPitch: splines ? spectrum.spacing.map((d) => 1 / d) : spectrum.tile_size,
      uCount: both((lobe) => lobe.count),
      uReadsAll: both((lobe) => Number(lobe.readsAll)),
      uHalfWidth: both((lobe) => lobe.halfWidth),
      uPeak: both((lobe) => lobe.peak),
      uSigma: sigma,
      uLimit: splines ? spectrum.limit : [0, 0],
      uHeightScale: state.heightScale,
      uMinCosine: Math.cos((spectrum.largest_angle * Math.PI) / 180) * (1 - 1e-6),
      uCoat: Math.max(state.coat / state.air, 1),
      uEta: state.index / state.coat,
      uIndex: metal ? metal.texture : this.noIndex,
      uPigment: state.hasBase ? pigmentOf(state.pigment) : [0, 0, 0],
    };
  }
}

const [FIRST, LAST] = [380, 740];  // nm

// A table of `components` numbers at each nm from 360.
function at(table, components, nm, k) {
  const below = Math.floor(nm - 360);
  const low = table[components * below + k];
  return low + (nm - 360 - below) * (table[components * (below + 1) + k] - low);
}

// Wavelengths of the visible spectrum, equidistant, as uniforms of table.glsl.
function wavelengthsOf(state, metal, count) {
  const step = (LAST - FIRST) / count;
  const [spectrum, indices] = [[], []];
  for (let j = 0; j < count; j++) {
    const nm = FIRST + step * (j + 0.5);
    spectrum.push(...[0, 1, 2].map((k) => step * at(matching, 4, nm, 3) * at(matching, 4, nm, k)), nm);
    indices.push(...(metal ? [0, 1].map((k) => at(metal.values, 2, nm, k) / state.coat) : [1, 0]));
  }
  return { uSpectrum: spectrum, uIndices: indices };
}

// XYZ of the pigment under the light.
function colourOfPigment(hex) {
  const [a, b, c] = pigmentOf(hex), sum = [0, 0, 0];
  for (let nm = FIRST; nm < LAST; nm++) {
    const x = (a * nm + b) * nm + c, part = matching[4 * (nm - 360) + 3] * (0.5 + (0.5 * x) / Math.sqrt(1 + x * x));
    for (let k = 0; k < 3; k++) sum[k] += part * matching[4 * (nm - 360) + k];
  }
  return sum;
}
