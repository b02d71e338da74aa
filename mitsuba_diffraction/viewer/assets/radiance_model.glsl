// XYZ of the light that the model reflects, by shading.js: of the lamp, and of samples of the sky, in each frame others.
uniform vec3 uBase;     // XYZ of the pigment under the light
uniform int uFirst;     // sample of the sky

const int SKY_SAMPLES = 16, BASE_SAMPLES = 4;

vec3 radiance(vec3 wo) {
  baseColour = uBase;
  float shown = facing(lightAxes[2]);
  vec3 result = vec3(0.0);
  if (LIGHT == 0) {
    result = shown * ofPart(lightAxes[2], wo, vec3(0.0), vec3(0.0), HAS_BASE ? transmittance(max(wo.z, 0.0)) : 0.0);
  } else {
    if (shown > 0.0 && wo.z > 0.0) result = shown * ofLamp(lightAxes[2], lightAxes[0], lightAxes[1], LIGHT == 1, wo);
  }
  LOOP_IF(uSky > 0.0 && wo.z > 0.0) {
    result += ofSky(wo, uFirst * SKY_SAMPLES, SKY_SAMPLES);
    for (int k = 0; k < BASE_SAMPLES && HAS_BASE; k++) {
      float square = (float(k) + fract(0.5 + 0.618034 * float(uFirst))) / float(BASE_SAMPLES), phi = 2.39996 * float(4 * uFirst + k);
      vec3 wi = vec3(sqrt(square) * vec2(cos(phi), sin(phi)), sqrt(1.0 - square));
      result += underSky(uBase * transmittance(wo.z) * transmittance(wi.z), wi, 0.0) / float(BASE_SAMPLES);
    }
  }
  return result;
}
