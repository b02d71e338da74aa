// Adds a frame to the mean of those before: XYZ, and the coverage of the pixel.
uniform highp sampler2D uPosition;  // w: the coverage, one of the grating
uniform highp sampler2D uNormal;
uniform highp sampler2D uTangent;
uniform highp sampler2D uBefore;
uniform float uWeight;              // of this frame
uniform vec3 uEye;
uniform vec3 uLight;                // to the light
uniform float uPlate;               // height of the plate above the wall that is seen; zero where the surface is seen
uniform vec2 uLightSize;            // of LIGHT, parallel (0), a disc (1) or a strip (2): half its width and half its length at distance one
uniform float uSin;                 // of the angle from the tangent to the pattern's x axis
uniform float uCos;
out vec4 oMean;

// XYZ of what the face of the coat mirrors: the light and the sky.
vec3 mirrored(vec3 wo) {
  vec3 direction = vec3(-wo.xy, wo.z);
  float radiance = uSky * skyIn(direction);
  if (LIGHT != 0) {
    vec2 at = vec2(dot(direction, lightAxes[0]), dot(direction, lightAxes[1])) / (uLightSize * uLightSize);
    at /= max(dot(direction, lightAxes[2]), 1e-9);
    bool seen = LIGHT == 1 ? dot(at, at) <= 1.0 : max(abs(at.x), abs(at.y)) <= 1.0;
    if (seen) radiance += 1.0 / ((LIGHT == 1 ? PI : 4.0) * uLightSize.x * uLightSize.y);
  }
  return face(wo.z) * radiance * D65;
}

void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  vec4 position = texelFetch(uPosition, at, 0);
  vec4 value = vec4(0.0);
  if (position.w > 0.0) {
    vec4 normal = texelFetch(uNormal, at, 0), along = texelFetch(uTangent, at, 0);
    vec3 n = normalize(normal.xyz), tangent = along.xyz;
    vec3 s = normalize(tangent - n * dot(n, tangent));
    vec3 t = cross(n, s);
    frame = mat3(uCos * s + uSin * t, uCos * t - uSin * s, n);
    facet = vec3(uCos * normal.w + uSin * along.w, uCos * along.w - uSin * normal.w, 0.0);
    facet.z = sqrt(1.0 - dot(facet, facet));
    vec3 width = normalize(cross(vec3(0.0, 0.0, 1.0), uLight));
    lightAxes = mat3(uLightSize.x * (width * frame), uLightSize.y * (cross(uLight, width) * frame), uLight * frame);
    vec3 wo = normalize(uPlate > 0.0 ? position.xyz - vec3(0.0, 0.0, uPlate) : uEye - position.xyz) * frame;
    vec3 xyz = vec3(0.0);
    if (wo.z > 0.0 && uCoat > 1.0) xyz = mirrored(wo);
    if (position.w == 1.0) xyz += radiance(wo);
    // A white wall receives cos^2/r^2, r the plate's height over the cosine; the back of the plate is black.
    if (uPlate > 0.0) xyz *= position.z > 0.5 * uPlate ? 0.0 : wo.z * wo.z * wo.z * wo.z;
    value = position.w * vec4(xyz, 1.0);
  }
  vec4 before = texelFetch(uBefore, at, 0);
  oMean = uWeight >= 1.0 ? value : mix(before, value, uWeight);
}
