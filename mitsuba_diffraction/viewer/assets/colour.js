// Colours: spectra of pigments, XYZ to sRGB.

const XYZ_TO_RGB = [[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.204, 1.057]];
const times = (matrix, v) => matrix.map((row) => row[0] * v[0] + row[1] * v[1] + row[2] * v[2]);
const toRGB = (xyz) => times(XYZ_TO_RGB, xyz);

const encodeSRGB = (c) => (c <= 0.0031308 ? 12.92 * c : 1.055 * c ** (1 / 2.4) - 0.055);
const decodeSRGB = (c) => (c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4);

// Linear sRGB of #rrggbb.
function linearOf(hex) {
  return [1, 3, 5].map((i) => decodeSRGB(parseInt(hex.slice(i, i + 2), 16) / 255));
}

let matching = null;  // x, y, z and the light at each nm from 360; set by main.js
const pigments = new Map();

// Coefficients (a, b, c) of a reflectance with the linear sRGB of `hex` under D65, by Gauss-Newton:
// 1/2 + x/(2 sqrt(1 + x^2)), x = a l^2 + b l + c, l in nm (Jakob and Hanika 2019), the form that Mitsuba uses.
function pigmentOf(hex) {
  if (!pigments.has(hex)) pigments.set(hex, fitted(linearOf(hex).map((c) => Math.min(Math.max(c, 1e-3), 0.999))));
  return pigments.get(hex);
}

function fitted(wanted) {
  // l is mapped to 0...1 for the fit.
  let coefficients = [0, 0, 0];
  const colourOf = ([a, b, c]) => {
    const sum = [0, 0, 0];
    for (let i = 0; i < 471; i += 5) {
      const t = i / 470;
      const x = (a * t + b) * t + c;
      const weight = 5 * matching[4 * i + 3] * (0.5 + (0.5 * x) / Math.sqrt(1 + x * x));
      for (let k = 0; k < 3; k++) sum[k] += weight * matching[4 * i + k];
    }
    return toRGB(sum);
  };
  const white = colourOf([0, 0, 1e9]);
  const residual = (found) => colourOf(found).map((c, k) => c / white[k] - wanted[k]);
  const size = (v) => Math.hypot(...v);
  for (let step = 0; step < 40; step++) {
    const r = residual(coefficients);
    if (size(r) < 1e-6) break;
    const columns = coefficients.map((value, k) => {
      const moved = [...coefficients];
      moved[k] += 1e-4;
      return residual(moved).map((m, i) => (m - r[i]) / 1e-4);
    });
    const change = solved(columns, r);
    let factor = 1;
    const moved = () => coefficients.map((value, k) => value - factor * change[k]);
    while (factor > 1e-4 && !(size(residual(moved())) < size(r))) factor /= 2;
    coefficients = moved();
  }
  const [a, b, c] = coefficients;
  // From t = (l - 360)/470 to l.
  return [a / 470 ** 2, b / 470 - (2 * 360 * a) / 470 ** 2, c - (360 * b) / 470 + a * (360 / 470) ** 2];
}

// Solves M x = r for a matrix given by its columns (Cramer).
function solved([u, v, w], r) {
  const det = (a, b, c) =>
    a[0] * (b[1] * c[2] - b[2] * c[1]) - b[0] * (a[1] * c[2] - a[2] * c[1]) + c[0] * (a[1] * b[2] - a[2] * b[1]);
  const d = det(u, v, w) || 1e-30;
  return [det(r, v, w) / d, det(u, r, w) / d, det(u, v, r) / d];
}
