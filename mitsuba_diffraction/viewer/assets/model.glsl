// f = T_i T_o R K G S(q; kappa)/lambda^2 + (1 - R_i)(1 - R_o) base/pi, in 1/sr: bsdf/orders.py, bsdf/continuum.py,
// bsdf/directions.py, bsdf/coat.py and optics/geometry.py of the package, for reflected light. E is one. It follows
// shading.js. KIND, MATERIAL, CUBIC, HAS_BASE and HAS_COAT are constants of the program (spectrum.js), since some
// renderers execute both branches of a condition.

uniform highp sampler2DArray uTable;  // a_p of c = sum_p a_p t^p: columns m_x, rows m_y, layers intervals of kappa
uniform float uUnit;                  // factor of the table
uniform float uIntervalsPerKappa;
uniform ivec2 uCount;                 // of the lobes that contribute at one q; uPerPitch of splines is 1/spacing
uniform bvec2 uReadsAll;              // whether all orders contribute
uniform vec2 uHalfWidth;              // of a lobe
uniform vec2 uPeak;                   // of a lobe along one axis
uniform vec2 uLimit;                  // |q| at which splines end

uniform highp sampler2D uIndex;       // n + ik at each nm from 360
uniform vec3 uPigment;                // coefficients of the reflectance of the base

uniform float uSky;                   // radiance of the sky relative to the irradiance of the light

const int DIELECTRIC = 0, CONDUCTOR = 1, MIRROR = 2;
const int RESOLVED = 0, LINES = 1, WINDOW = 2, SPLINES = 3;
const int MARGIN = 3;  // of the table, in nodes
const float SHORTEST = 360.0, LONGEST = 830.0;
const vec3 D65 = vec3(0.9505, 1.0, 1.089);
const float GROUND = 0.5, ZENITH = 5.0;  // radiance of the sky below the horizon and at the zenith, relative to uSky

mat3 frame;  // columns: the pattern's axes and the normal
vec3 facet = vec3(0.0, 0.0, 1.0);  // the normal of the mesh, along them
mat3 lightAxes;  // along them: half the width, half the length, and the direction of the light

float continuumFactor(vec3 wi, vec3 wo, vec2 tangent, float perWidth) {
  vec2 squares = vec2(wi.z * wi.z, wo.z * wo.z);
  float square = dot(tangent, tangent);
  float mirror = clamp((25.0 - square * perWidth * perWidth) / 9.0, 0.0, 1.0);
  mirror *= clamp(2.0 - 5.0 * sqrt(max(max(squares.x, squares.y), 1e-12)), 0.0, 1.0);  // zero unless both are grazing
  float gain = mirror > 0.0 ? squaresAndGain(wi, wo, vec2(0.0), perWidth, 0.0).z : 0.0;
  return mix(kG(squares, square), gain, mirror);
}

// The table has a margin of zeros.
vec4 node(ivec2 m, int interval) {
  return texelFetch(uTable, ivec3(clamp(m, -uMaxOrder - 1, uMaxOrder + 1) + uMaxOrder + MARGIN, interval), 0);
}

vec2 lobe(vec2 m, vec2 q) {
  vec2 offset = q - m / uPerPitch;
  vec2 value = uPeak * exp(-0.5 * offset * offset / (uSigma * uSigma));
  return mix(value, vec2(0.0), greaterThan(abs(offset), uHalfWidth));
}

// kappa in intervals of the table.
float intervalsOf(vec3 wi, vec3 wo, float frequency) {
  return (inner(wi.z) + inner(wo.z)) * 2.0 * PI * frequency * uHeightScale * uIntervalsPerKappa;
}

// The interval, and the powers of t in it.
vec4 powersAt(float x, out int interval) {
  interval = min(int(x), textureSize(uTable, 0).z - 1);
  float t = 2.0 * (x - float(interval)) - 1.0;
  return vec4(1.0, t, t * t, CUBIC ? t * t * t : 0.0) * uUnit;
}

float power(ivec2 m, float x) {
  int interval;
  vec4 powers = powersAt(x, interval);
  return dot(node(m, interval), powers);
}

float orderPower(ivec2 m, float kappa) {
  return max(power(m, kappa * uIntervalsPerKappa), 0.0);
}

// S of splines.
float splines(vec2 q, float x) {
  int interval;
  vec4 powers = powersAt(x, interval);
  vec2 at = q * uPerPitch, nearest = round(at), d = at - nearest;
  ivec3 m = ivec3(clamp(ivec2(nearest), -uMaxOrder - 2, uMaxOrder + 2) + uMaxOrder + MARGIN, interval);
  vec2 before = 0.5 * (0.5 - d) * (0.5 - d), here = 0.75 - d * d, after = 0.5 * (0.5 + d) * (0.5 + d);
  const ivec3 X = ivec3(1, 0, 0), Y = ivec3(0, 1, 0);
  vec4 low = before.x * texelFetch(uTable, m - X - Y, 0) + here.x * texelFetch(uTable, m - Y, 0) + after.x * texelFetch(uTable, m + X - Y, 0);
  vec4 middle = before.x * texelFetch(uTable, m - X, 0) + here.x * texelFetch(uTable, m, 0) + after.x * texelFetch(uTable, m + X, 0);
  vec4 high = before.x * texelFetch(uTable, m - X + Y, 0) + here.x * texelFetch(uTable, m + Y, 0) + after.x * texelFetch(uTable, m + X + Y, 0);
  float result = max(dot(before.y * low + here.y * middle + after.y * high, powers) * uPerPitch.x * uPerPitch.y, 0.0);
  return all(lessThanEqual(abs(q), uLimit)) ? result : 0.0;
}

// S of orders whose lobes overlap; of lines, K G S.
float overlapping(vec3 wi, vec3 wo, vec2 q, float x, float lambda) {
  vec2 at = q * uPerPitch;
  ivec2 first = ivec2(ceil(at - 0.5 * vec2(uCount)));
  if (uReadsAll.x) first.x = -uMaxOrder.x;
  if (uReadsAll.y) first.y = -uMaxOrder.y;
  int interval;
  vec4 powers = powersAt(x, interval), sum = vec4(0.0);
  for (int j = 0; j < uCount.y; j++) {
    for (int i = 0; i < uCount.x; i++) {
      ivec2 m = first + ivec2(i, j);
      vec2 lobes = lobe(vec2(m), q);
      float weight = lobes.x * lobes.y;
      if (weight == 0.0) continue;
      if (KIND == LINES) weight *= orderFactor(wi, wo, vec2(m) / uPerPitch * lambda, 1.0 / (lambda * uSigma), 0.0);
      sum += weight * node(m, interval);
    }
  }
  return max(dot(sum, powers), 0.0);
}

// K G S of one order.
float resolved(vec3 wi, vec3 wo, ivec2 m, vec2 q, float x, float lambda) {
  if (any(greaterThan(abs(m), uMaxOrder))) return 0.0;
  vec2 lobes = lobe(vec2(m), q);
  if (lobes.x * lobes.y == 0.0) return 0.0;
  float factor = orderFactor(wi, wo, vec2(m) / uPerPitch * lambda, 1.0 / (lambda * uSigma), 0.0);
  return factor == 0.0 ? 0.0 : max(lobes.x * lobes.y * factor * power(m, x), 0.0);
}

// K G S in um^2, lambda in um.
float scatter(vec3 wi, vec3 wo, float lambda) {
  vec2 tangent = -(wi.xy + wo.xy), q = tangent / lambda;
  float x = intervalsOf(wi, wo, 1.0 / lambda);
  if (KIND == RESOLVED) return resolved(wi, wo, ivec2(ceil(q * uPerPitch - 0.5)), q, x, lambda);
  if (KIND == LINES) return overlapping(wi, wo, q, x, lambda);
  float density = KIND == SPLINES ? splines(q, x) : overlapping(wi, wo, q, x, lambda);
  return density == 0.0 ? 0.0 : density * continuumFactor(wi, wo, tangent, 1.0 / (lambda * uSigma));
}

float dielectric(float cosine) {
  return dielectricOf(cosine, uEta);
}

// Radiance of the sky in a direction along the pattern's axes, relative to uSky.
float skyIn(vec3 direction) {
  float up = max((frame * direction).z, 0.0);
  return GROUND + (ZENITH - GROUND) * up * up;
}

// What the relief of scales leaves of light: that of Mitsuba's `normalmap` (Estevez et al. 2019).
float facing(vec3 wi) {
  float cosine = dot(wi, facet), alpha2 = min(0.125 * (1.0 / (facet.z * facet.z) - 1.0), 1.0);
  return cosine <= 0.0 ? 0.0 : 2.0 / (1.0 + sqrt(1.0 + alpha2 * (1.0 / (cosine * cosine) - 1.0)));
}

vec3 underSky(vec3 XYZ, vec3 wi, float solidAngle) {
  return XYZ * uSky * skyIn(wi) * facing(wi);
}

// cos of the angle between both directions and their half vector, next to the relief.
float halfCosine(vec3 wi, vec3 wo) {
  return min(0.5 * length(vec3(wi.xy + wo.xy, inner(wi.z) + inner(wo.z))) / uCoat, 1.0);
}

float conductor(float cosine, vec2 index) {
  float c2 = cosine * cosine, s2 = 1.0 - c2;
  float n2 = index.x * index.x, k2 = index.y * index.y;
  float difference = n2 - k2 - s2;
  float both = sqrt(max(difference * difference + 4.0 * n2 * k2, 0.0));
  float a = sqrt(max(0.5 * (both + difference), 0.0));
  float s = (both + c2 - 2.0 * a * cosine) / (both + c2 + 2.0 * a * cosine);
  float p = s * (c2 * both + s2 * s2 - 2.0 * a * cosine * s2) / (c2 * both + s2 * s2 + 2.0 * a * cosine * s2);
  return 0.5 * (s + p);
}

// n + ik of a conductor relative to the coat.
vec2 indexAt(float nanometres) {
  float at = clamp(nanometres - SHORTEST, 0.0, LONGEST - SHORTEST);
  int below = int(min(floor(at), LONGEST - SHORTEST - 1.0));
  vec2 low = texelFetch(uIndex, ivec2(below, 0), 0).xy, high = texelFetch(uIndex, ivec2(below + 1, 0), 0).xy;
  return mix(low, high, at - float(below)) / uCoat;
}

// R of a plane at a cosine next to it; lambda in nm.
float reflectance(float cosine, float nanometres) {
  if (MATERIAL == MIRROR) return 1.0;
  return MATERIAL == DIELECTRIC ? dielectric(cosine) : conductor(cosine, indexAt(nanometres));
}

float pigment(float nanometres) {
  float x = (uPigment.x * nanometres + uPigment.y) * nanometres + uPigment.z;
  return 0.5 + 0.5 * x * inversesqrt(1.0 + x * x);
}

float brdf(vec3 wi, vec3 wo, float nanometres) {
  if (wi.z <= 0.0 || wo.z <= 0.0) return 0.0;
  float result = 0.0;
  if (covered(wi, wo)) {
    float lambda = 1e-3 * nanometres;
    float power = scatter(wi, wo, lambda);
    if (power > 0.0) {
      result = power * reflectance(halfCosine(wi, wo), nanometres) / (lambda * lambda);
      result *= (1.0 - face(wi.z)) * (1.0 - face(wo.z));
    }
  }
  if (HAS_BASE) {
    result += transmittance(wi.z) * transmittance(wo.z) * pigment(nanometres) / PI;
  }
  return result;
}
