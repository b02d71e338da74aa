// What shading.js looks up: C at the nodes of a layer of w, or for separate orders (PART 1 and 2) the colours of Gaussians
// of light, and R relative to that at normal incidence. Light is x, y, z times E over nm.
uniform highp sampler2D uMatching;    // x, y, z and the light at each nm from 360
uniform vec4 uSpectrum[WAVELENGTHS];  // x, y, z times light times distance in nm, and lambda in nm
uniform vec2 uIndices[WAVELENGTHS];   // n + ik there
uniform vec2 uSize;
uniform float uW;                     // of the layer
uniform float uMaxU;                  // of pairs of directions next to this layer
uniform float uStretchOfNodes;
out vec4 oColour;

vec3 lightAt(float nanometres) {
  vec4 found = texelFetch(uMatching, ivec2(int(nanometres - SHORTEST), 0), 0);
  return found.w * found.xyz;
}

float reflected(float cosine, int j) {
  return MATERIAL == CONDUCTOR ? conductor(cosine, uIndices[j]) : reflectance(cosine, uSpectrum[j].w);
}

void main() {
  vec2 place = (gl_FragCoord.xy - 0.5) / (uSize - 1.0);
  vec3 total = vec3(0.0);
#if PART == 0
  float edge = asinh(MAX_U / uStretchOfNodes);
  vec2 u = uStretchOfNodes * sinh(edge * (2.0 * place - 1.0));
  vec2 spacing = sqrt(u * u + uStretchOfNodes * uStretchOfNodes) * 2.0 * edge / (uSize - 1.0);
  oColour = vec4(0.0);
  if (length(u) > uMaxU + 2.0 * length(spacing)) return;
  float cosine = min(0.5 * length(vec3(u, uW)) / uCoat, 1.0), perFrequency = 2.0 * PI * uW * uHeightScale * uIntervalsPerKappa;
  for (int j = 0; j < WAVELENGTHS; j++) {
    float frequency = 1e3 / uSpectrum[j].w, x = perFrequency * frequency;
    vec2 q = u * frequency;
    float density = KIND == SPLINES ? splines(q, x) : overlapping(vec3(0.0), vec3(0.0), q, x, 1.0 / frequency);
    if (density > 0.0) total += density * reflected(cosine, j) * frequency * frequency * uSpectrum[j].xyz;
  }
#elif PART == 1
  float c = MAX_CENTRE * place.x, s = NARROW * pow(WIDE / NARROW, place.y);
  float low = max(LOW, c - 5.0 * s), high = min(HIGH, c + 5.0 * s), step = (high - low) / 100.0;
  for (int j = 0; j < 100 && high > low; j++) {
    float nu = low + step * (float(j) + 0.5), d = (nu - c) / s;
    total += exp(-0.5 * d * d) * reflectance(1.0, 1e3 / nu) * lightAt(1e3 / nu);
  }
  total *= 1e3 * step / s;
#else
  float nm = 1e3 / mix(LOW, HIGH, place.x);
  total = vec3(reflectance(max(place.y, 1e-3), nm) / reflectance(1.0, nm));
#endif
  oColour = vec4(max(total, 0.0), 1.0);
}
