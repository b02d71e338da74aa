// Position, normal and tangent of a sphere, a plate or a disc; they lie about the origin, with radius one. A wall has those
// of the plate that faces it from above, whose back hides a part of it. The fourth
// component of a position is the coverage: of the grating one, of clear plastic beside it CLEAR.
uniform int uShape;
uniform vec3 uEye;
uniform mat3 uCamera;   // columns: right, up, back
uniform vec2 uTangentOfView;
uniform vec2 uJitter;
uniform vec2 uSize;
uniform bool uFromRadius;  // whether the tangent points away from the centre, on a sphere from its north pole
uniform vec4 uWall;        // height of the plate above the wall, half the sides of both, and zero
uniform vec3 uRings;       // of a disc, between the radii of its hole, and of the inner and outer edge of its grating
layout(location = 0) out vec4 oPosition;
layout(location = 1) out vec4 oNormal;
layout(location = 2) out vec4 oTangent;

const float CLEAR = 0.25;

vec4 tangentOf(vec3 along, vec3 radius) {
  vec3 tangent = uFromRadius ? radius : along;
  float size = length(tangent);
  return vec4(size > 0.0 ? tangent / size : vec3(1.0, 0.0, 0.0), 0.0);
}

void main() {
  vec2 ndc = 2.0 * (gl_FragCoord.xy + uJitter) / uSize - 1.0;
  vec3 ray = normalize(uCamera * vec3(ndc * uTangentOfView, -1.0));
  oPosition = oNormal = oTangent = vec4(0.0);
  if (uShape == 0) {
    float b = dot(uEye, ray), d = b * b - dot(uEye, uEye) + 1.0;
    if (d < 0.0) return;
    float t = -b - sqrt(d);
    if (t < 0.0) return;
    vec3 p = normalize(uEye + t * ray);
    oPosition = vec4(p, 1.0);
    oNormal = vec4(p, 0.0);
    float r = length(p.xy);
    vec2 outward = r > 0.0 ? p.xy / r : vec2(1.0, 0.0);
    oTangent = tangentOf(vec3(-p.y, p.x, 0.0), vec3(p.z * outward, -r));
    return;
  }
  if (uShape == 3) {
    oNormal = vec4(0.0, 0.0, -1.0, 0.0);
    oTangent = vec4(-1.0, 0.0, 0.0, 0.0);
    for (int k = 0; k < 2; k++) {
      float distance = ((k == 0 ? uWall.x : 0.0) - uEye.z) / ray.z;
      vec3 p = uEye + distance * ray;
      if (distance > 0.0 && max(abs(p.x), abs(p.y)) <= (k == 0 ? uWall.y : uWall.z)) {
        oPosition = vec4(p, 1.0);
        return;
      }
    }
    return;
  }
  float t = -uEye.z / ray.z;
  if (t < 0.0) return;
  vec3 p = uEye + t * ray;
  float r = length(p.xy);
  bool inside = uShape == 1 ? max(abs(p.x), abs(p.y)) <= 1.0 : r >= uRings.x && r <= 1.0;
  if (!inside) return;
  oPosition = vec4(p, uShape == 1 || (r >= uRings.y && r <= uRings.z) ? 1.0 : CLEAR);
  oNormal = vec4(0.0, 0.0, 1.0, 0.0);
  if (uShape == 1) {
    oTangent = tangentOf(vec3(1.0, 0.0, 0.0), vec3(p.xy, 0.0));
  } else {
    // Mitsuba's disk has polar UVs, so that its tangent points outwards.
    oTangent = vec4(p.xy / max(r, 1e-6), 0.0, 0.0);
  }
}
