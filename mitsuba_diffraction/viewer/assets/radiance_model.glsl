// XYZ of the light that the model reflects.
uniform highp sampler2D uMatching;  // x, y, z and the light at each nm from 360
uniform int uWavelengths;
uniform float uOffset;              // of the wavelengths, 0 to 1
uniform float uSky;                 // radiance of the sky relative to the irradiance of the light
uniform float uEntered;             // fraction of diffuse light that enters the surface

const float FIRST = 380.0, LAST = 740.0;  // nm

vec4 matchingAt(float nanometres) {
  float at = nanometres - SHORTEST;
  int below = int(floor(at));
  return mix(texelFetch(uMatching, ivec2(below, 0), 0), texelFetch(uMatching, ivec2(below + 1, 0), 0), at - float(below));
}

mat3 frame;   // columns: the pattern's axes and the normal
vec2 random;  // of this pixel and frame
vec4 lightAt(int n);

vec3 radiance(vec3 wo) {
  vec3 result = vec3(0.0);
  float step = (LAST - FIRST) / float(uWavelengths);
  for (int j = 0; j < uWavelengths; j++) {
    float nanometres = FIRST + step * (float(j) + uOffset);
    vec4 weights = matchingAt(nanometres);
    vec4 light = lightAt(j);  // other points of the light for other wavelengths
    float value = brdf(light.xyz, wo, nanometres) * max(light.z, 0.0) * light.w;
    if (uSky > 0.0 && wo.z > 0.0) {
      // All orders together reflect a uniform sky as a plane does.
      float reflected = reflectance(wo.z, nanometres);
      if (uHasBase && uMaterial == 0) reflected += (1.0 - reflected) * uEntered * pigment(nanometres);
      value += uSky * reflected;
    }
    result += value * weights.w * weights.xyz;
  }
  return result * step;
}
