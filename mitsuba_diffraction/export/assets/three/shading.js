// Shades by the colours of a diffracting surface: GLSL (WebGL2) and what its textures need, for the material for three.js
// and for the live page. Symbols are those of colour_table.py: u = −(ω_i + ω_o)_∥ and w = n (cos θ_i + cos θ_o) next to
// the relief, f = K G T_i T_o C(u, w) + (1 − R_i)(1 − R_o) base/π. Directions are unit vectors along the axes of the
// pattern, z the normal, both away from the surface and outside of a coat, which keeps their tangential components.
// HAS_COAT and HAS_BASE are constants of the program, as some renderers execute both branches of a condition.
// Lengths are in µm, colours XYZ under D65. C is a table, or with ORDERS a sum over separate orders.

export const SHADING = /* glsl */ `
uniform float uCoat;       // index of a clear layer over the relief; one without
uniform float uEta;        // index of the material relative to the layer
uniform float uMinCosine;  // next to the relief
uniform float uHeightScale;
uniform vec2 uPerPitch;    // T of orders
uniform ivec2 uMaxOrder;
uniform float uSigma;      // sigma_q
uniform highp sampler2D uDrawn;  // for the sky: u and its density, or m, nu and what a sample weighs

#ifndef PI
#define PI 3.14159265358979
#endif
const float LOW = 1e3 / 740.0, HIGH = 1e3 / 380.0;  // nu = 1/lambda of visible light, 1/um
const float MAX_U = 2.0;

vec3 baseColour = vec3(0.0);

// A condition as a loop: some renderers execute both branches of an if, but no loop that no pixel enters.
#define LOOP_IF(condition) for (int once = int(condition); once > 0; once--)

// k_z next to the relief, from the cosine outside.
float inner(float cosine) {
  return sqrt(max(cosine * cosine + (uCoat * uCoat - 1.0), 1e-12));
}

float dielectricOf(float cosine, float eta) {
  float square = eta * eta, inside = sqrt(max(square - 1.0 + cosine * cosine, 0.0));  // k_z; without cancellation
  float s = (cosine - inside) / max(cosine + inside, 1e-12);
  float p = (square * cosine - inside) / max(square * cosine + inside, 1e-12);
  return 0.5 * (s * s + p * p);
}

// The face of the coat, at the cosine outside.
float face(float cosine) {
  return HAS_COAT ? dielectricOf(cosine, uCoat) : 0.0;
}

// What enters a dielectric, through its coat.
float transmittance(float cosine) {
  return (1.0 - face(cosine)) * (1.0 - dielectricOf(min(inner(cosine) / uCoat, 1.0), uEta));
}

// K G from k_z of both directions and |lambda q|^2.
float kGOf(vec2 k, float tangentSquare) {
  float vz = k.x + k.y, a = tangentSquare + vz * vz;
  return a / (vz * max(k.x, k.y)) * min(a / (4.0 * vz * min(k.x, k.y)), 1.0);
}

// The same from cos^2.
float kG(vec2 squares, float tangentSquare) {
  return kGOf(sqrt(max(squares + (uCoat * uCoat - 1.0), 1e-12)), tangentSquare);
}

// Of the lobe of an order near its Rayleigh anomaly (optics/geometry.py of the package).
float horizonGain(float x) {
  float t = max(1.0 - 0.25 * x, 0.0);
  float p = 3.5662365;
  p = p * t - 9.23048089;
  p = p * t + 10.57318562;
  p = p * t - 5.03522703;
  p = p * t + 0.81494507;
  p = p * t - 0.04034151;
  return 1.0 + t * t * p;
}

// cos^2 of both directions of an order at lambda q = change, and in z the gain of its lobe. The edge at its Rayleigh
// anomaly is a ramp, as wide as nu times that number.
vec3 squaresAndGain(vec3 wi, vec3 wo, vec2 change, float perWidth, float ramp) {
  float squareI = wi.z * wi.z, squareO = wo.z * wo.z;
  float orderO = squareI - dot(change, 2.0 * wi.xy + change);
  float orderI = squareO - dot(change, 2.0 * wo.xy + change);
  float smaller = min(orderI, orderO), gain = float(smaller > 0.0);
  if (ramp > 0.0) {
    float slope = 2.0 * dot(change, (orderI < orderO ? wo.xy : wi.xy) + change);  // of that over log nu
    gain = clamp(0.5 + smaller / max(abs(slope) * ramp, 1e-6), 0.0, 1.0);
    orderI = max(orderI, 0.0);
    orderO = max(orderO, 0.0);
  }
  if (gain > 0.0) {
    gain *= horizonGain(0.5 * perWidth * min(squareI, orderO)) * horizonGain(0.5 * perWidth * min(squareO, orderI));
  }
  return vec3(0.5 * (squareI + orderI), 0.5 * (squareO + orderO), gain);
}

float orderFactor(vec3 wi, vec3 wo, vec2 tangent, float perWidth, float ramp) {
  vec3 found = squaresAndGain(wi, wo, tangent, perWidth, ramp);
  return found.z > 0.0 ? kG(found.xy, dot(tangent, tangent)) * found.z : 0.0;
}

// Whether the table has the angles of both directions.
bool covered(vec3 wi, vec3 wo) {
  float cosine = min(wi.z, wo.z);
  return cosine > 0.0 && inner(cosine) >= uMinCosine * uCoat;
}

// T_i T_o.
float throughCoat(vec3 wi, vec3 wo) {
  return covered(wi, wo) ? (1.0 - face(wi.z)) * (1.0 - face(wo.z)) : 0.0;
}

#ifdef ORDERS

uniform highp sampler2D uGaussians;     // of a Gaussian of light, over its middle c and its width s, in 1/um
uniform highp sampler2D uRatios;  // R relative to that at normal incidence, over nu and cos theta_h
const float MAX_CENTRE = 4.0, CUTOFF = 4.0;  // of lobes, and of their products with nodes, in standard deviations
// Nodes of factors that vary within a lobe: see colour_table.py.
const float NODES = 8.0, SPACING = (HIGH - LOW) / (NODES - 2.0), PER_SPACING = 1.0 / 1.7, MAX_SINGLE = 0.06;
const float NARROW = 3e-3, WIDE = SPACING * PER_SPACING;  // s in uGaussians

float orderPower(ivec2 m, float kappa);  // eta, of the program

// Interpolated at coordinates from 0 to 1.
vec3 look(highp sampler2D map, float x, float y) {
  vec2 size = vec2(textureSize(map, 0));
  return textureLod(map, (clamp(vec2(x, y), 0.0, 1.0) * (size - 1.0) + 0.5) / size, 0.0).rgb;
}

float relative(vec2 u, float w, float nu) {
  return look(uRatios, (nu - LOW) / (HIGH - LOW), min(0.5 * length(vec3(u, w)) / uCoat, 1.0)).r;
}

// p C^-1 q for a matrix (A, B; B, C), times its determinant.
float product(vec3 matrix, vec2 p, vec2 q) {
  return p.x * q.x * matrix.z - (p.x * q.y + p.y * q.x) * matrix.y + p.y * q.y * matrix.x;
}

// Of order m, its lobe Gaussian in nu: see OrderColours; nu in the covariance as at its middle. A wide lobe has several
// parts, each about a node.
vec3 colourOfOrder(ivec2 m, vec3 wi, vec3 wo, vec2 u, float w, vec3 spread) {
  vec2 q = vec2(m) / uPerPitch;
  float nu = m == ivec2(0) ? 1.8 : clamp(dot(u, q) / max(dot(u, u), 1e-12), LOW, HIGH);
  vec3 matrix = nu * nu * spread + vec3(uSigma * uSigma, 0.0, uSigma * uSigma);
  float det = matrix.x * matrix.z - matrix.y * matrix.y;
  float inverse = max(product(matrix, u, u) / det, 1e-12), centre = product(matrix, u, q) / (det * inverse);
  vec2 rest = q - u * centre;  // |q|^2 - c^2 |u|^2 would lose its digits
  float exponent = -0.5 * product(matrix, rest, rest) / det;
  float s = inversesqrt(inverse), both = sqrt(1.0 / inverse + WIDE * WIDE), first = 0.0, last = 0.0;
  bool isWide = s > MAX_SINGLE;
  if (isWide) {
    float place = (centre - LOW) / SPACING + 0.5, reach = CUTOFF * both / SPACING;
    first = max(ceil(place - reach), 0.0);
    last = min(floor(place + reach), NODES - 1.0);
  } else if (centre <= 0.0 || centre >= MAX_CENTRE) last = -1.0;
  if (exponent < -0.5 * CUTOFF * CUTOFF) last = -1.0;
  vec3 result = vec3(0.0), lightBefore = vec3(0.0);
  float factorBefore = 0.0, correction = isWide ? 0.5 * PER_SPACING * PER_SPACING : 0.0;
  for (float k = first; k <= last; k++) {
    float nu = centre, middle = centre, width = s, weight = 1.0;
    if (isWide) {
      nu = LOW + (k - 0.5) * SPACING;
      middle = mix(nu, centre, WIDE * WIDE / (both * both));
      width = s * WIDE / both;
      weight = exp(-0.5 * (centre - nu) * (centre - nu) / (both * both)) / (sqrt(2.0 * PI) * PER_SPACING);
    }
    float visible = clamp(nu, LOW, HIGH), factor = orderPower(m, 2.0 * PI * w * visible * uHeightScale);
    factor *= relative(u, w, visible) * orderFactor(wi, wo, q / visible, visible / uSigma, isWide ? SPACING / visible : 0.0);
    vec3 light = look(uGaussians, middle / MAX_CENTRE, log(width / NARROW) / log(WIDE / NARROW)) * (width * weight);
    result += (1.0 + 2.0 * correction) * factor * light - correction * (factorBefore * light + factor * lightBefore);
    factorBefore = factor;
    lightBefore = light;
  }
  return result * exp(exponent) / (2.0 * PI * sqrt(det));
}

// K G C, the mean over a part of a lamp: u has the covariance (a, b; b, c), and the lobe stays a Gaussian.
vec3 coloursOf(vec3 wi, vec3 wo, vec3 spread) {
  vec2 u = -(wi.xy + wo.xy);
  float w = inner(wi.z) + inner(wo.z);
  vec3 total = vec3(0.0);
  vec2 widths = CUTOFF * sqrt(uSigma * uSigma + HIGH * HIGH * spread.xz) * uPerPitch, path = u * uPerPitch;
  int axis = uMaxOrder.y == 0 || (uMaxOrder.x > 0 && abs(path.x) >= abs(path.y)) ? 0 : 1, across = 1 - axis;
  float along = path[axis], slope = abs(along) > 1e-6 ? path[across] / along : 0.0;
  int first = max(int(ceil(min(along * LOW, along * HIGH) - widths[axis])), -uMaxOrder[axis]);
  int last = min(int(floor(max(along * LOW, along * HIGH) + widths[axis])), uMaxOrder[axis]);
  float reach = widths[across] + abs(slope) * widths[axis];
  if (uMaxOrder[across] == 0 && abs(path[across]) * LOW > widths[across]) last = first - 1;
  for (int n = first; n <= last; n++) {
    // Across, the orders next to the line of all wavelengths.
    float middle = slope * float(n);
    int from = max(int(ceil(middle - reach)), -uMaxOrder[across]), to = min(int(floor(middle + reach)), uMaxOrder[across]);
    for (int k = from; k <= to; k++) {
      total += colourOfOrder(axis == 0 ? ivec2(n, k) : ivec2(k, n), wi, wo, u, w, spread);
    }
  }
  return total;
}

const float MAX_DISC_PARTS = 7.0;

// How many parts of a lamp are taken along half of a length.
float partsOf(float size, vec2 u) {
  return min(ceil(size * 1.8 / uSigma), 6.0);
}

#else

uniform highp sampler2DArray uColours;  // C; u = a sinh(x), layers over w
uniform vec2 uRangeW;                   // of the first and the last layer
uniform float uStretch;                 // a
uniform float uEdge;                    // x where u is MAX_U

// Of the distances between nodes at u.
vec2 squareOfSpacing(vec2 u) {
  float perNode = 2.0 * uEdge / float(textureSize(uColours, 0).x - 1);
  return (u * u + uStretch * uStretch) * (perNode * perNode);
}

// K G C, the mean over a part of a lamp: u has the covariance (a, b; b, c), about that of a texel of a lower level.
vec3 coloursOf(vec3 wi, vec3 wo, vec3 spread) {
  vec2 u = -(wi.xy + wo.xy);
  vec2 k = vec2(inner(wi.z), inner(wo.z));
  float w = k.x + k.y;
  vec3 size = vec3(textureSize(uColours, 0));
  vec2 x = abs(u) / uStretch, warped = sign(u) * log(x + sqrt(x * x + 1.0)) / (2.0 * uEdge) + 0.5;
  vec2 at = (clamp(warped, 0.0, 1.0) * (size.xy - 1.0) + 0.5) / size.xy;
  float layer = clamp((w - uRangeW.x) / (uRangeW.y - uRangeW.x), 0.0, 1.0) * (size.z - 1.0), below = min(floor(layer), size.z - 2.0);
  vec2 texels = spread.xz / squareOfSpacing(u);
  float level = 0.5 * log2(max(4.0 * min(texels.x, texels.y), 1.0));
  vec3 low = textureLod(uColours, vec3(at, below), level).rgb, high = textureLod(uColours, vec3(at, below + 1.0), level).rgb;
  return mix(low, high, layer - below) * kGOf(k, dot(u, u));
}

const float MAX_DISC_PARTS = 19.0;

float partsOf(float size, vec2 u) {
  vec2 squares = squareOfSpacing(u);
  return min(ceil(size * inversesqrt(min(squares.x, squares.y))), 6.0);
}

#endif

// f cos theta_i of a part of a lamp about wi, with standard deviations p and q, and of the base.
vec3 ofPart(vec3 wi, vec3 wo, vec3 p, vec3 q, float throughBase) {
  float factor = throughCoat(wi, wo);
  vec3 total = vec3(0.0);
  if (HAS_BASE && throughBase > 0.0 && wi.z > 0.0) total = throughBase * transmittance(wi.z) / PI * baseColour;
  vec3 spread = vec3(p.x * p.x + q.x * q.x, p.x * p.y + q.x * q.y, p.y * p.y + q.y * q.y);
  if (factor > 0.0) total += factor * coloursOf(wi, wo, spread);
  return max(wi.z, 0.0) * total;
}

// The light of a lamp that shines from c + s a + t b, s and t from -1 to 1 or in a disc, relative to its irradiance on
// a plane that faces c: a disc is a Gaussian, or 4, 7 or 19 of them, a rectangle has them in rows, half of their
// distance wide, all with the variance of the lamp.
vec3 ofLamp(vec3 c, vec3 a, vec3 b, bool isDisc, vec3 wo) {
  float perDistance = inversesqrt(dot(c, c)), throughBase = !HAS_BASE || baseColour == vec3(0.0) ? 0.0 : transmittance(max(wo.z, 0.0));
  vec3 total = vec3(0.0), middle = c * perDistance, n = cross(a, b);
  vec2 u = -(middle.xy + wo.xy), sizes = vec2(length(a), length(b)) * perDistance;
  vec2 counts = max(max(vec2(partsOf(sizes.x, u), partsOf(sizes.y, u)), ceil(12.0 * sizes)), 1.0);
  if (isDisc) counts = vec2(counts.x == 1.0 ? 1.0 : counts.x == 2.0 ? 4.0 : counts.x == 3.0 ? 7.0 : MAX_DISC_PARTS, 1.0);
  vec2 squares = counts * counts, shrink = sqrt(max(squares - 3.0, 0.0) / max(squares - 1.0, 1.0));
  vec2 width = mix(1.0 / counts, vec2(0.577), equal(counts, vec2(1.0)));
  if (isDisc) width = vec2(counts.x == 1.0 ? 0.5 : counts.x == 4.0 ? 0.3 : counts.x == 7.0 ? 0.3035 : 0.18);
  float facing = abs(dot(n, middle));
  // In rings of 4, or of 1, 6 and 12: 60 degrees between 6, then 30 from 15 on.
  bool isRing = counts.x == 4.0;
  float radius = isRing ? 0.566 : counts.x == 7.0 ? 0.607 : 0.38;
  vec2 ray = vec2(1.0, 0.0), between = isRing ? vec2(0.0, 1.0) : vec2(0.5, 0.8660254);
  for (int j = 0; j < int(counts.y); j++) {
    for (int i = 0; i < int(counts.x); i++) {
      vec2 place = ((2.0 * vec2(i, j) + 1.0) / counts - 1.0) * shrink;
      vec2 step = i < 7 ? between : i == 7 ? vec2(0.9659258, 0.2588190) : vec2(0.8660254, 0.5);
      ray = mat2(step.x, step.y, -step.y, step.x) * ray;
      if (isDisc) place = (i == 0 && !isRing ? 0.0 : i > 6 ? 0.76 : radius) * ray;
      vec3 d = c + place.x * a + place.y * b;
      float perLength = inversesqrt(dot(d, d)), ratio = perLength / perDistance;
      vec3 wi = d * perLength, part = ofPart(wi, wo, width.x * perLength * a, width.y * perLength * b, throughBase);
      total += part * (facing > 0.0 ? ratio * ratio * abs(dot(n, wi)) : 1.0);
    }
  }
  return total / (counts.x * counts.y * (facing > 0.0 ? facing : 1.0));
}

vec3 underSky(vec3 XYZ, vec3 wi, float solidAngle);  // XYZ times the radiance of the sky about wi, of the program

// The light of the sky by some of the samples in uDrawn.
vec3 ofSky(vec3 wo, int first, int count) {
  vec3 total = vec3(0.0);
  int all = textureSize(uDrawn, 0).x;
  for (int k = 0; k < count; k++) {
    vec4 drawn = texelFetch(uDrawn, ivec2((first + k) % all, 0), 0);
#ifdef ORDERS
    float nu = drawn.z, area = 1e-3, place = float(first + k), turn = 2.0 * PI * fract(0.56984029 * place);
    // A point of its lobe.
    vec2 offset = uSigma * sqrt(-2.0 * log(1.0 - fract(0.5 + 0.75487767 * place))) * vec2(cos(turn), sin(turn));
    vec2 centre = drawn.xy / (uPerPitch * nu), u = centre + offset / nu;
#else
    float area = 1.0 / (drawn.z * float(count));
    vec2 u = drawn.xy;
#endif
    vec2 incident = -wo.xy - u;
    float square = 1.0 - dot(incident, incident);
    vec3 wi = vec3(incident, sqrt(max(square, 1e-6)));
    float w = inner(wi.z) + inner(wo.z), factor = throughCoat(wi, wo);
    if (factor > 0.0 && square > 1e-6) {
#ifdef ORDERS
      ivec2 m = ivec2(round(drawn.xy));
      float power = orderPower(m, 2.0 * PI * w * nu * uHeightScale) * relative(u, w, nu) * drawn.w / float(count);
      power *= orderFactor(wi, wo, centre, nu / uSigma, 0.0) / sqrt(2.0 * PI);
      vec3 XYZ = look(uGaussians, nu / MAX_CENTRE, 0.0) * power;  // the narrowest row is the light at nu
#else
      vec3 XYZ = coloursOf(wi, wo, vec3(0.0)) * area;
#endif
      total += underSky(XYZ * factor, wi, area / wi.z);
    }
  }
  return total;
}
`;

export const MAX_U = 2;
export const SAMPLES = 1024;  // of a sky, of many frames
const [LOW, HIGH, STEPS] = [1000 / 740, 1000 / 380, 48];

// Items drawn by their weights in equal steps of their sum; the first ones, too, are spread out.
function drawn(weights, itemOf, count = SAMPLES) {
  const found = new Float32Array(4 * count), total = weights.reduce((a, b) => a + b, 0);
  for (let n = 0, k = 0, sum = weights[0]; n < count; n++) {
    while (k < weights.length - 1 && sum < ((n + 0.5) / count) * total) sum += weights[++k];
    found.set(itemOf(k, weights[k] / total), 4 * ((n * 101) % count));
  }
  return found;
}

/** uDrawn of a table, from X + Y + Z of its middle layer. */
export function drawnOfTable(sums, size, stretch, count) {
  const edge = Math.asinh(MAX_U / stretch), x = (k) => edge * ((2 * k) / (size - 1) - 1);
  const node = (k) => stretch * Math.sinh(x(k)), width = (k) => (stretch * Math.cosh(x(k)) * edge * 2) / (size - 1);
  const at = (k) => [k % size, Math.floor(k / size)];
  // Along a Z-order curve, equal steps of the sum are compact regions.
  const spread = (i) => Array.from({ length: 8 }, (_, bit) => ((i >> bit) & 1) * 4 ** bit).reduce((a, b) => a + b, 0);
  const codes = Array.from(sums, (_, k) => spread(at(k)[0]) + 2 * spread(at(k)[1]));
  const order = [...codes.keys()].sort((a, b) => codes[a] - codes[b]);
  const weights = Float64Array.from(order, (k) => {
    const [i, j] = at(k);
    return node(i) ** 2 + node(j) ** 2 > MAX_U ** 2 ? 0 : sums[k] * width(i) * width(j);
  });
  return drawn(weights, (k, part) => {
    const [i, j] = at(order[k]);
    return [node(i), node(j), part / (width(i) * width(j)), 0];
  }, count);
}

/** uDrawn of orders, from their powers (row, nu) for a common pair of directions, rows over m_y. */
export function drawnOfOrders(powerAt, [M, N]) {
  const count = (2 * M + 1) * (2 * N + 1), step = (HIGH - LOW) / STEPS, nu = (k) => LOW + step * ((k % STEPS) + 0.5);
  const powers = Float64Array.from({ length: count * STEPS }, (_, k) => Math.max(powerAt(Math.floor(k / STEPS), nu(k)), 0));
  // For other directions an order has its power at other wavelengths.
  const weights = powers.map((power, k) => {
    const from = k - (k % STEPS), mean = powers.subarray(from, from + STEPS).reduce((a, b) => a + b, 0) / STEPS;
    return (power + 0.3 * mean) * (Math.exp(-(((nu(k) - 1.8) / 0.3) ** 2)) + Math.exp(-(((nu(k) - 2.2) / 0.15) ** 2)) + 0.1);
  });
  return drawn(weights, (k, part) => {
    const order = Math.floor(k / STEPS), m = (order % (2 * M + 1)) - M, n = Math.floor(order / (2 * M + 1)) - N;
    return [m, n, nu(k), step / nu(k) ** 2 / part];
  });
}
