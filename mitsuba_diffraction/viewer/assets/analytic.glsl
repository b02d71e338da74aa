// Position, normal and tangent of a sphere, a plate or a disc; they lie about the origin, with radius one.
uniform int uShape;
uniform vec3 uEye;
uniform mat3 uCamera;   // columns: right, up, back
uniform vec2 uTangentOfView;
uniform vec2 uJitter;
uniform vec2 uSize;
layout(location = 0) out vec4 oPosition;
layout(location = 1) out vec4 oNormal;
layout(location = 2) out vec4 oTangent;

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
    oTangent = vec4(r > 0.0 ? vec3(-p.y, p.x, 0.0) / r : vec3(1.0, 0.0, 0.0), 0.0);
    return;
  }
  float t = -uEye.z / ray.z;
  if (t < 0.0) return;
  vec3 p = uEye + t * ray;
  bool inside = uShape == 1 ? max(abs(p.x), abs(p.y)) <= 1.0 : dot(p.xy, p.xy) <= 1.0;
  if (!inside) return;
  oPosition = vec4(p, 1.0);
  oNormal = vec4(0.0, 0.0, 1.0, 0.0);
  oTangent = vec4(uShape == 1 ? vec3(1.0, 0.0, 0.0) : vec3(p.xy / max(length(p.xy), 1e-6), 0.0), 0.0);
}
