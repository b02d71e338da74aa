// The ground under the surface, with the shadow of the lamp and that of contact. It is no part of the mean, of the
// exposure, or of the saved scene.
uniform int uShape;        // as in analytic.glsl; COIL for the mesh
uniform vec3 uEye;
uniform mat3 uCamera;      // columns: right, up, back
uniform vec2 uTangentOfView;
uniform float uGround;     // height of the ground
uniform vec3 uLight;       // to the light
uniform float uHalfWidth;  // of the light, at distance one
uniform vec3 uRings;
uniform highp sampler2D uFootprint;  // of the coil from above, blurred

const int DISC = 2, WALL = 3, COIL = 4;
const float FOOTPRINT_EDGE = 1.6, SHADOW = 0.65, AMBIENT = 0.3, BRIGHT = 0.055, EXTENT = 2.6, CONTACT = 0.12;

float footprintAt(vec2 p) {
  ivec2 size = textureSize(uFootprint, 0);
  vec2 at = (0.5 + 0.5 * p / FOOTPRINT_EDGE) * vec2(size) - 0.5, part = fract(at);
  ivec2 low = ivec2(floor(at));
  float sum = 0.0;
  for (int k = 0; k < 4; k++) {
    ivec2 step = ivec2(k & 1, k >> 1), texel = low + step;
    if (any(lessThan(texel, ivec2(0))) || any(greaterThanEqual(texel, size))) continue;
    vec2 weight = mix(1.0 - part, part, vec2(step));
    sum += weight.x * weight.y * texelFetch(uFootprint, texel, 0).x;
  }
  return sum;
}

// The distance from the edge of a plate or a disc with a hole, negative inside.
float outside(vec2 p) {
  return uShape == DISC ? max(length(p) - 1.0, uRings.x - length(p)) : max(abs(p.x), abs(p.y)) - 1.0;
}

// The fractions of the lamp and of the sky that are hidden from a point of the ground.
vec2 hiddenAt(vec3 p) {
  float along = -uGround / max(uLight.z, 0.05);
  if (uShape == COIL) return vec2(footprintAt(p.xy + along * uLight.xy), footprintAt(p.xy));
  if (uShape == 0) {
    float t = dot(-p, uLight), width = max(uHalfWidth * t, 0.02), r = length(p);
    float lamp = t > 0.0 ? 1.0 - smoothstep(1.0 - width, 1.0 + width, length(p + t * uLight)) : 0.0;
    return vec2(lamp, -p.z / (r * r * r));  // of a sphere of radius one
  }
  float width = max(uHalfWidth * along, 0.01);
  return vec2(1.0 - smoothstep(-width, width, outside(p.xy + along * uLight.xy)),
              1.0 - smoothstep(-CONTACT, CONTACT, outside(p.xy)));
}

// Linear, from the colour of the stage, which the ground takes far away.
vec3 withGround(vec3 stage, vec2 ndc) {
  vec3 ray = uCamera * vec3(ndc * uTangentOfView, -1.0);
  float t = (uGround - uEye.z) / ray.z;
  if (uShape == WALL || uEye.z <= uGround || t <= 0.0) return stage;
  vec3 p = uEye + t * ray;
  vec2 hidden = clamp(hiddenAt(p), 0.0, 1.0);
  float lit = uLight.z > 0.0 ? 1.0 - SHADOW * hidden.x - AMBIENT * hidden.y : 1.0 - AMBIENT * hidden.y;
  return mix(stage, vec3(BRIGHT) * lit, exp(-dot(p.xy, p.xy) / (EXTENT * EXTENT)));
}
