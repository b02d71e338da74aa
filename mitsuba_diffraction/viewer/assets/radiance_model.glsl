// XYZ of the light that the model reflects: the mean over points of the light, with three wavelengths each for a continuum,
// and with all orders that reach the eye for a grating of resolved orders.
uniform highp sampler2D uMatching;  // x, y, z and the light at each nm from 360
uniform vec4 uSpectrum[48];         // of this frame: x, y, z times light times distance in nm, and lambda in nm
uniform vec2 uIndices[48];          // n + ik there
uniform vec3 uPigmentColour;        // XYZ of the pigment under the light
uniform highp sampler2D uNodes;     // of the table, to draw them: probability, alias, and weight (Vose 1991)
uniform int uNodeCount;

const float FIRST = 380.0, LAST = 740.0;  // nm
const int POINTS = KIND != RESOLVED ? 16 : LIGHT == 0 ? 1 : 4, EACH = 3;

mat3 lightAxes;  // along them: half the width, half the length, and the direction of the light
vec4 random;     // of this pixel and frame
int tilePlace = 0;  // of this pixel among those that share the points of a frame
const vec4 STEPS = vec4(0.8566748838545, 0.7338918566271, 0.6287067210378, 0.5385972572236);  // from point to point (Roberts 2018)
vec4 lightAt(int n);
vec4 lightTo(vec2 place);

vec3 matchingAt(float nanometres) {
  float at = nanometres - SHORTEST;
  int below = int(floor(at));
  vec4 low = texelFetch(uMatching, ivec2(below, 0), 0), high = texelFetch(uMatching, ivec2(below + 1, 0), 0);
  vec4 found = mix(low, high, at - float(below));
  return found.w * found.xyz;
}

// Of f over three of the wavelengths.
vec3 overWavelengths(vec3 wi, vec3 wo, int point) {
  vec2 tangent = -(wi.xy + wo.xy);
  float cosHalf = halfCosine(wi, wo), plane = MATERIAL == DIELECTRIC ? dielectric(cosHalf) : 1.0;
  bool steep = (KIND == SPLINES || KIND == WINDOW) && max(wi.z, wo.z) >= 0.4;
  float factor = steep ? steepFactor(wi, wo, tangent) * plane : plane, perFrequency = intervalsOf(wi, wo, 1.0);
  vec3 result = vec3(0.0);
  for (int k = 0; k < EACH; k++) {
    int j = (point + tilePlace) % POINTS + k * POINTS;  // in a tile, each point of the light meets all wavelengths
    vec4 weights = uSpectrum[j];
    float lambda = 1e-3 * weights.w, frequency = 1.0 / lambda, value;
    if (!steep) value = scatter(wi, wo, lambda);
    else if (KIND == SPLINES) value = splines(tangent * frequency, perFrequency * frequency);
    else value = overlapping(wi, wo, tangent * frequency, perFrequency * frequency, lambda);
    if (value == 0.0) continue;
    value *= factor * frequency * frequency;
    if (MATERIAL == CONDUCTOR) value *= conductor(cosHalf, uIndices[j]);
    result += value * weights.xyz;
  }
  return float(POINTS) * result;
}

// Of f over the orders whose wavelengths by the grating equation are visible. 1/lambda is drawn from the lobe of each.
vec3 overOrders(vec3 wi, vec3 wo, vec2 u) {
  vec2 tangent = -(wi.xy + wo.xy), paths = abs(tangent) * uPerPitch;
  const float LOW = 1e3 / LAST, HIGH = 1e3 / FIRST;
  int axis = uMaxOrder.y == 0 || (uMaxOrder.x > 0 && paths.x >= paths.y) ? 0 : 1, across = 1 - axis;
  if (uMaxOrder[across] == 0 && abs(tangent[across]) * LOW > uHalfWidth[across]) return vec3(0.0);
  float span = length(tangent), spread = uSigma / max(span, 1e-9), cutoff = dot(uHalfWidth, uHalfWidth);
  vec2 ends = tangent[axis] * uPerPitch[axis] * vec2(LOW, HIGH);
  float margin = uHalfWidth[axis] * uPerPitch[axis];
  int first = max(int(ceil(min(ends.x, ends.y) - margin)), -uMaxOrder[axis]);
  int last = min(int(floor(max(ends.x, ends.y) + margin)), uMaxOrder[axis]);
  float cosHalf = halfCosine(wi, wo), perFrequency = intervalsOf(wi, wo, 1.0);
  bool narrow = spread < 0.15 * (HIGH - LOW);
  int samples = narrow ? 1 : 8;
  vec3 result = vec3(0.0);
  for (int n = first; n <= last; n++) {
    // Across the axis, the two nearest orders.
    float ratio = n == 0 ? 0.0 : float(n) * tangent[across] / tangent[axis] * uPerPitch[across] / uPerPitch[axis];
    int candidates = uMaxOrder[across] == 0 ? 1 : 2;
    for (int k = 0; k < candidates; k++) {
      ivec2 m;
      m[axis] = n;
      m[across] = uMaxOrder[across] == 0 ? 0 : int(floor(ratio)) + k;
      vec2 centre = vec2(m) / uPerPitch;
      float off = (centre.x * tangent.y - centre.y * tangent.x) / max(span, 1e-9);
      if (narrow && off * off > cutoff) continue;
      for (int s = 0; s < samples; s++) {
        float frequency, area;
        if (narrow) {
          float normal = sqrt(-2.0 * log(1.0 - u.x)) * cos(2.0 * PI * u.y);
          frequency = dot(centre, tangent) / (span * span) + spread * normal;
          area = 2.50662827 * spread * exp(0.5 * normal * normal);
        } else {
          frequency = mix(LOW, HIGH, (float(s) + u.x) / float(samples));
          area = (HIGH - LOW) / float(samples);
        }
        if (frequency <= LOW || frequency >= HIGH) continue;
        float lambda = 1.0 / frequency;
        float value = resolved(wi, wo, m, tangent * frequency, perFrequency * frequency, lambda);
        if (value == 0.0) continue;
        float nanometres = 1e3 * lambda;
        result += value * area * reflectance(cosHalf, nanometres) * matchingAt(nanometres);
      }
    }
  }
  return 1e3 * result;
}

// The n-th point of the light; of a strip over lines, where it may lie for some light to reach the eye.
vec4 lightFor(int n, vec3 wo) {
  int across = uMaxOrder.x == 0 ? 0 : 1;
  if (KIND != RESOLVED || LIGHT != 2 || uMaxOrder[across] != 0) return lightAt(n);
  vec2 u = fract(random.xy + float(n) * STEPS.xy);
  float x = 2.0 * u.x - 1.0, y = 0.0, slope;
  // v = 0 by Newton's method.
  for (int k = 0; k < 3; k++) {
    vec3 d = lightAxes * vec3(x, clamp(y, -1.0, 1.0), 1.0);
    float cosine = inversesqrt(dot(d, d)), sine = cosine * d[across];
    slope = cosine * (lightAxes[1][across] - sine * cosine * dot(d, lightAxes[1]));
    slope = (slope < 0.0 ? -1.0 : 1.0) * max(abs(slope), 1e-7);
    y = clamp(y, -1.0, 1.0) - (sine + wo[across]) / slope;
  }
  float radius = 1.15e-3 * LAST * uHalfWidth[across] / abs(slope);
  float low = clamp(y - radius, -1.0, 1.0), high = clamp(y + radius, -1.0, 1.0);
  vec4 light = lightTo(vec2(x, mix(low, high, u.y)));
  return vec4(light.xyz, light.w * 0.5 * (high - low));
}

// What the relief of scales leaves of light: that of Mitsuba's `normalmap` (Estevez et al. 2019).
float facing(vec3 wi) {
  float cosine = dot(wi, facet), alpha2 = min(0.125 * (1.0 / (facet.z * facet.z) - 1.0), 1.0);
  return cosine <= 0.0 ? 0.0 : 2.0 / (1.0 + sqrt(1.0 + alpha2 * (1.0 / (cosine * cosine) - 1.0)));
}

// Of the sky, by orders or splines drawn in proportion to their mean power, each at one wavelength.
vec3 ofSky(vec3 wo, float transmitted) {
  const int SAMPLES = 8;
  int width = textureSize(uNodes, 0).x, columns = 2 * uMaxOrder.x + 1;
  vec3 result = vec3(0.0);
  for (int k = 0; k < SAMPLES; k++) {
    vec4 u = fract(random + 0.5 + float(k) * STEPS);
    if (HAS_BASE) {
      vec3 diffuse = vec3(sqrt(u.z) * vec2(cos(2.0 * PI * u.w), sin(2.0 * PI * u.w)), sqrt(1.0 - u.z));
      result += facing(diffuse) * skyIn(diffuse) * transmitted * transmittance(diffuse.z) * uPigmentColour;
    }
    float at = u.x * float(uNodeCount);
    int index = min(int(at), uNodeCount - 1);
    vec4 drawn = texelFetch(uNodes, ivec2(index % width, index / width), 0);
    if (at - float(index) > drawn.x) {
      index = int(drawn.y);
      drawn = texelFetch(uNodes, ivec2(index % width, index / width), 0);
    }
    ivec2 m = ivec2(index % columns, index / columns) - uMaxOrder;
    vec4 weights = uSpectrum[6 * k + int(5.999 * u.y)];
    float lambda = 1e-3 * weights.w, perWidth = 1.0 / (lambda * uSigma);
    vec2 offset = uSigma * sqrt(-2.0 * log(1.0 - u.z)) * vec2(cos(2.0 * PI * u.w), sin(2.0 * PI * u.w));
    if (KIND == SPLINES) {
      // The sum of three uniform numbers has the density of a quadratic B-spline.
      vec2 v = u.zw;
      offset = (v + fract(199.0 * v) + fract(39601.0 * v) - 1.5) / uPerPitch;
    }
    vec2 centre = vec2(m) / uPerPitch, tangent = lambda * (centre + offset), incident = -wo.xy - tangent;
    float square = 1.0 - dot(incident, incident);
    if (square <= 0.0) continue;
    vec3 wi = vec3(incident, sqrt(square));
    if (covered(wi, wo)) {
      float value = KIND == RESOLVED || KIND == LINES ? orderFactor(wi, wo, centre * lambda, perWidth)
                                                      : continuumFactor(wi, wo, tangent, perWidth);
      value *= power(m, intervalsOf(wi, wo, 1.0 / lambda)) / drawn.z * reflectance(halfCosine(wi, wo), weights.w);
      result += 48.0 * facing(wi) * skyIn(wi) * value * (1.0 - face(wi.z)) * (1.0 - face(wo.z)) * weights.xyz;
    }
  }
  return result / float(SAMPLES);
}

vec3 radiance(vec3 wo) {
  vec3 result = vec3(0.0);
  if (wo.z <= 0.0) return result;
  float transmitted = HAS_BASE ? transmittance(wo.z) : 0.0;
  for (int n = 0; n < POINTS; n++) {
    vec4 light = lightFor(n, wo);  // other points of the light for other wavelengths
    vec3 wi = light.xyz;
    if (wi.z <= 0.0 || light.w <= 0.0) continue;
    vec3 value = vec3(0.0);
    if (covered(wi, wo)) {
      value = KIND == RESOLVED ? overOrders(wi, wo, fract(random.zw + float(n) * STEPS.zw))
                                : overWavelengths(wi, wo, n);
      value *= (1.0 - face(wi.z)) * (1.0 - face(wo.z));
    }
    if (HAS_BASE) value += transmitted * transmittance(wi.z) / PI * uPigmentColour;
    result += facing(wi) * wi.z * light.w * value;
  }
  result /= float(POINTS);
  if (uSky > 0.0) result += uSky * ofSky(wo, transmitted);
  return result;
}
