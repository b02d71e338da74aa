// The shader of 2014 (shader_2014 of the package): colour of a tile by Taylor textures, wavelength by
// wavelength. VARIANT is that of VARIANTS in shader_2014.js; a quirk is a departure of the published code that can be
// switched off.
#define OF_ORDERS (VARIANT == 1 || VARIANT == 4)
#define OF_TILES (VARIANT == 2 || VARIANT == 4)

uniform highp sampler2DArray uTexels;  // F{t^n}(m), t = h/H: columns m_x, rows m_y, layers n
uniform ivec2 uTexelOrder;             // largest |m| of the texture
uniform ivec2 uPixels;                 // of the tile
uniform vec2 uTile;                    // um
uniform float uHeight;                 // H in um
uniform int uTerms;
uniform float uWindowSigma;            // sigma_f in cycles/um
uniform vec2 uWindowSigmas;            // along both axes, less for a tapered scan
uniform ivec2 uRadius;                 // texels of the window on each side
uniform ivec2 uTiles;                  // of PQ
uniform float uSpacing;                // of GEM, um
uniform highp sampler2D uMatching;     // x, y, z and the light at each nm from 360
uniform mat3 uToRGB;                   // from XYZ
uniform mat3 uFromRGB;                 // linear sRGB to XYZ
uniform bool uSchlick, uFixedIndex, uComplexSum, uFloor, uNoJacobian, uWrongProduct, uRelative;
uniform bool uConstantBlend;
uniform float uBrightness;             // of the diffraction alone; one for radiance

const float FIRST = 380.0, LAST = 780.0, STEP = 5.0;  // nm
const int COUNT = 81;

uniform vec2 uPlace;                   // of the lamp in this frame, -1 to 1 along its axes

struct Pair {
  vec3 uvw;
  float cosHalf;
  float factor;
};

// X, Y, Z per nm, and R at normal incidence.
vec4 weightsAt(float nanometres, float peak) {
  if (nanometres < FIRST - 1e-3 || nanometres > LAST + 1e-3) return vec4(0.0);
  float at = nanometres - SHORTEST;
  int below = int(floor(at));
  vec4 low = texelFetch(uMatching, ivec2(below, 0), 0), high = texelFetch(uMatching, ivec2(below + 1, 0), 0);
  float r = uFixedIndex ? 0.04 : reflectance(1.0, nanometres);
  vec3 xyz = mix(low.xyz * low.w, high.xyz * high.w, at - float(below));
  if (!uRelative) xyz *= r * peak / (nanometres * nanometres * 1e-6);
  return vec4(xyz, r);
}

float fresnelRatio(float r, float cosHalf) {
  float x = 1.0 - cosHalf;
  if (uSchlick || MATERIAL != DIELECTRIC) return (r + (1.0 - r) * x * x * x * x * x) / r;
  return dielectricOf(cosHalf, (1.0 + sqrt(r)) / (1.0 - sqrt(r))) / r;
}

// sum_n (i x)^n/n! F{t^n}, zero outside of the texture.
vec2 amplitude(ivec2 m, float x) {
  if (any(greaterThan(abs(m), uTexelOrder))) return vec2(0.0);
  vec2 c = vec2(1.0, 0.0), result = vec2(0.0);
  for (int n = 0; n < uTerms; n++) {
    vec2 term = texelFetch(uTexels, ivec3(m + uTexelOrder, n), 0).xy;
    result += vec2(c.x * term.x - c.y * term.y, c.x * term.y + c.y * term.x);
    float step = x / float(n + 1);
    c = vec2(-step * c.y, step * c.x);
  }
  return result;
}

float phi(ivec2 m, vec2 at, vec2 stretch) {
  vec2 d = (vec2(m) - at) / (1.41421356 * uWindowSigmas * uTile) * stretch;
  float height = uWindowSigma * inversesqrt(uWindowSigmas.x * uWindowSigmas.y);
  return height * exp(-dot(d, d));
}

// |sum phi F|^2 or sum phi^2 |F|^2 about `at`, in texels; with an axis, only of the `order` along it.
float windowed(vec2 at, vec2 middle, float x, ivec2 radius, vec2 stretch, int axis, int order) {
  ivec2 first = ivec2(clamp(uFloor ? floor(middle) : roundEven(middle), -1e6, 1e6)) - radius;
  vec2 total = vec2(0.0);
  float powers = 0.0;
  for (int j = 0; j <= 2 * radius.y; j++) {
    for (int i = 0; i <= 2 * radius.x; i++) {
      ivec2 m = first + ivec2(i, j);
      if (axis >= 0 && m[axis] != order) continue;
      float weight = phi(m, at, stretch);
      vec2 f = weight * amplitude(m, x);
      total += f;
      powers += dot(f, f);
    }
  }
  return uComplexSum ? dot(total, total) : powers;
}

#if OF_TILES
// sin(pi x); that of GLSL is precise in absolute terms only, and not always then.
float sinPi(float x) {
  float k = roundEven(x), r = x - k, s = r * r;
  float p = r * (3.14159265 + s * (-5.16771278 + s * (2.55016404 + s * (-0.59926453 + s * (0.08214589 - 0.00737043 * s)))));
  return (int(abs(k)) & 1) == 0 ? p : -p;
}

const float AT_INTEGER = 8.6316745750310983e-05;

// sin(pi N x)/sin(pi x), stable at whole x.
float tileFactor(float x, int count) {
  float n = float(count), k = roundEven(x), r = x - k;
  float product = n * r;
  float whole = roundEven(product), part = product - whole;
  bool atInteger = abs(product) < AT_INTEGER;
  float quotient = atInteger ? n : sinPi(part) / sinPi(r);
  int parity = int(abs(k)) * ((count - 1) % 2) + (atInteger ? 0 : int(abs(whole)));
  return (parity & 1) == 0 ? quotient : -quotient;
}

vec2 tileSum(float x, int count) {
  float k = roundEven(x), r = x - k;
  int parity = int(abs(k)) * ((count - 1) % 2);
  float size = tileFactor(x, count) * ((parity & 1) == 0 ? 1.0 : -1.0), angle = float(count - 1) * r;
  return vec2(size * sinPi(angle + 0.5), -size * sinPi(angle));
}

float tilingPower(vec2 at) {
  float power;
  if (uWrongProduct) {
    vec2 a = tileSum(at.x, uTiles.x), b = tileSum(at.y, uTiles.y);
    float p = a.x * b.x - a.y * b.y, q = a.x * b.x + a.y * b.y;
    power = p * p + q * q;
  } else {
    power = tileFactor(at.x, uTiles.x) * tileFactor(at.y, uTiles.y);
    power *= power;
  }
  return power / pow(float(uTiles.x * uTiles.y), 2.0);
}

float kernel(float t, int count) {
  return tileFactor(t / float(count), count) / float(count);
}
#endif

#if VARIANT == 4
// The integral of sinc^2(N t) sinc^2(M (rho t + delta)) over t, for N tiles and M across.
float lineArea(float tiles, float across, float rho, float delta) {
  bool wide = across * rho <= tiles;
  float ratio = wide ? across * rho / tiles : tiles / max(across * rho, 1e-6);
  float turns = abs(delta * (wide ? across : tiles / max(rho, 1e-6))), c = 6.28318531 * turns;
  float first = 0.5 - c * c / 24.0, second = c * c / 30.0 - 1.0 / 3.0;
  if (c >= 0.1) {
    float halfSine = sinPi(turns), below = 2.0 * halfSine * halfSine;
    first = below / (c * c);
    second = (1.0 - below - sinPi(2.0 * turns) / c) / (c * c);
  }
  return max(2.0 * ((1.0 + ratio) * first + 2.0 * ratio * second), 0.0) / (wide ? tiles : across * rho);
}

// sum_m |F_nm|^2 I_m over the three orders m about `at` across the axis.
float linePower(vec2 at, float x, int axis) {
  int across = 1 - axis;
  float order = roundEven(at[axis]), rho = abs(at[across] / order);
  ivec2 m = ivec2(clamp(roundEven(at), -1e6, 1e6));
  float total = 0.0;
  m[across] -= 1;
  for (int k = 0; k < 3; k++) {
    vec2 f = amplitude(m, x);
    total += dot(f, f) * lineArea(float(uTiles[axis]), float(uTiles[across]), rho, at[across] - float(m[across]));
    m[across] += 1;
  }
  return total;
}
#endif

// |P(q; kappa)|^2, one for a flat mirror at q = 0.
float powerAt(Pair pair, float lambda) {
  vec2 at = pair.uvw.xy * uTile / lambda;
  float x = -6.28318531 * pair.uvw.z / lambda * uHeightScale * uHeight;
#if OF_TILES
  if (any(greaterThan(abs(at), 0.5 * vec2(uPixels)))) return 0.0;
  ivec2 first = ivec2(uFloor ? floor(at) : roundEven(at)) - 1;
  vec2 total = vec2(0.0);
  for (int j = 0; j < 3; j++) {
    for (int i = 0; i < 3; i++) {
      ivec2 m = first + ivec2(i, j);
      vec2 turn = vec2(m * (uPixels - 1)) / vec2(uPixels);
      float angle = turn.x + turn.y;
      vec2 phase = vec2(sinPi(angle + 0.5), sinPi(angle)), f = amplitude(m, x);
      vec2 offset = at - vec2(m);
      total += kernel(offset.x, uPixels.x) * kernel(offset.y, uPixels.y) *
               vec2(f.x * phase.x - f.y * phase.y, f.x * phase.y + f.y * phase.x);
    }
  }
  return dot(total, total) * tilingPower(at);
#else
  return windowed(at, at, x, uRadius, vec2(1.0), -1, 0);
#endif
}

// XYZ without the gain: the trapezoidal rule over 81 wavelengths.
vec3 overWavelengths(Pair pair, float peak) {
  vec3 result = vec3(0.0);
  for (int j = 0; j < COUNT; j++) {
    float nanometres = FIRST + STEP * float(j);
    vec4 weights = weightsAt(nanometres, peak);
    float width = (j == 0 || j == COUNT - 1 ? 0.5 * STEP : STEP) * fresnelRatio(weights.w, pair.cosHalf);
#if VARIANT == 4
    // Order zero of the axis along which the others are.
    width *= max(abs(pair.uvw.x) * uTile.x, abs(pair.uvw.y) * uTile.y) < 0.5e-3 * nanometres ? powerAt(pair, 1e-3 * nanometres) : 0.0;
#elif VARIANT == 1
    // Order zero alone.
    float lambda = 1e-3 * nanometres, x = -6.28318531 * pair.uvw.z / lambda * uHeightScale * uHeight;
    width *= windowed(pair.uvw.xy * uTile / lambda, vec2(0.0), x, ivec2(0), vec2(1.0), -1, 0);
#else
    width *= powerAt(pair, 1e-3 * nanometres);
#endif
    result += width * weights.xyz;
  }
  return result;
}

#if OF_ORDERS
// Only the wavelengths of the orders, lambda = d u/n.
vec3 overOrders(Pair pair, float peak) {
  vec2 paths = abs(pair.uvw.xy) * uTile, inSigmas = pair.uvw.xy / uWindowSigmas;
  int axis = paths.x >= paths.y ? 0 : 1;
  float path = 1e3 * paths[axis];
  int first = max(int(ceil(path / LAST)), 1), last = int(floor(path / FIRST));
  vec3 result = vec3(0.0);
  for (int n = first; n <= last; n++) {
    float nanometres = path / float(n), lambda = 1e-3 * nanometres;
    vec2 at = pair.uvw.xy * uTile / lambda;
    float x = -6.28318531 * pair.uvw.z / lambda * uHeightScale * uHeight, width = STEP, power;
    if (uNoJacobian) {
      power = powerAt(pair, lambda);
    } else {
#if VARIANT == 4
      power = linePower(at, x, axis);
      width = nanometres * nanometres / path;
#else
      // In units of sigma, in which the window is round.
      float slope = length(inSigmas), tilt = abs(inSigmas[axis]) / slope;
      vec2 stretch = axis == 0 ? vec2(0.0, tilt) : vec2(tilt, 0.0);
      power = windowed(at, at, x, uRadius, stretch, axis, int(roundEven(at[axis])));
      width = 1.77245385 * nanometres * nanometres * 1e-3 / slope;
#endif
    }
    vec4 weights = weightsAt(nanometres, peak);
    result += power * width * fresnelRatio(weights.w, pair.cosHalf) * weights.xyz;
  }
  return result;
}
#endif

vec3 gem(vec3 wi, vec3 wo) {
  float path = abs(wi.x + wo.x) * uSpacing;
  float rough = 5.0 * path / max(wi.z + wo.z, 1e-6);
  vec3 result = vec3(exp(-rough * rough));
  for (int n = 1; n <= 7; n++) {
    vec3 d = 4.0 * ((path / float(n) - 0.38) / 0.4 - vec3(0.75, 0.5, 0.25));
    result += max(1.0 - d * d, 0.0);
  }
  return result;
}

// Linear RGB, as the shader shows it.
vec3 shaderRGB(vec3 wi, vec3 wo) {
  if (wi.z <= 0.0 || wo.z <= 0.0) return vec3(0.0);
#if VARIANT == 3
  return uBrightness * gem(wi, wo);
#else
  Pair pair;
  pair.uvw = -wi - wo;
  float square = dot(pair.uvw.xy, pair.uvw.xy), cosines = max(wi.z, 1e-7);
  pair.cosHalf = 0.5 * length(pair.uvw);
  pair.factor = kG(vec2(cosines * cosines, wo.z * wo.z), square) * cosines;
#if OF_TILES
  float peak = uTile.x * uTile.y * float(uTiles.x * uTiles.y);
#else
  float peak = 1.0 / (3.14159265 * uWindowSigma * uWindowSigma);
#endif
#if VARIANT == 1
  vec3 xyz = overOrders(pair, peak);
  if (length(pair.uvw.xy / uWindowSigmas) * 1e3 / LAST < 4.0) xyz += overWavelengths(pair, peak);
#elif VARIANT == 4
  vec3 xyz = overOrders(pair, peak) + overWavelengths(pair, peak);
#else
  vec3 xyz = overWavelengths(pair, peak);
#endif
  return uToRGB * (uBrightness * pair.factor * xyz);
#endif
}

// XYZ of what an sRGB screen shows.
vec3 radiance(vec3 wo) {
  vec3 d = lightAxes * vec3(uPlace, 1.0);
  float cosine = inversesqrt(dot(d, d));
  vec4 light = vec4(d * cosine, cosine * cosine * cosine);  // and the solid angle there relative to the middle
  vec3 rgb = light.w * shaderRGB(light.xyz, wo);
  vec3 below = vec3(0.0);
  if (HAS_BASE && light.z > 0.0 && wo.z > 0.0) {
    for (int j = 0; j < COUNT; j++) {
      float nanometres = FIRST + STEP * float(j);
      vec4 weights = texelFetch(uMatching, ivec2(int(nanometres - SHORTEST), 0), 0);
      below += STEP * pigment(nanometres) * weights.w * weights.xyz;
    }
    below *= light.w * light.z / PI;
    below *= uConstantBlend ? 0.5 : transmittance(light.z) * transmittance(wo.z);
    if (uConstantBlend) rgb *= 0.5;
  }
  return uFromRGB * max(rgb, 0.0) + below;
}
