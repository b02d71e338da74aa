// XYZ of a surface under a uniform sky of radiance one, by its cosine: all orders together reflect it as a plane does.
// The face of a coat is left out.
uniform highp sampler2D uMatching;
uniform float uEntered;  // fraction of diffuse light that enters the surface
uniform float uLastTexel;
out vec4 oValue;

void main() {
  float cosine = (gl_FragCoord.x - 0.5) / uLastTexel;
  float front = face(cosine), inside = min(inner(cosine) / uCoat, 1.0);
  vec3 sum = vec3(0.0);
  for (int nanometres = 380; nanometres <= 740; nanometres += 2) {
    vec4 weights = texelFetch(uMatching, ivec2(float(nanometres) - SHORTEST, 0), 0);
    float reflected = (1.0 - front) * (1.0 - front) * reflectance(inside, float(nanometres));
    if (HAS_BASE) reflected += transmittance(cosine) * uEntered * pigment(float(nanometres));
    sum += (nanometres == 380 || nanometres == 740 ? 1.0 : 2.0) * reflected * weights.w * weights.xyz;
  }
  oValue = vec4(sum, 1.0);
}
