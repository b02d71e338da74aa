// Position, normal and tangent of a mesh; the fourth components are those of the mesh's own normal along tangent and
// bitangent of the scales.
in vec3 vPosition;
in vec3 vNormal;
in vec3 vTangent;
in vec2 vUV;
uniform vec3 uEye;
layout(location = 0) out vec4 oPosition;
layout(location = 1) out vec4 oNormal;
layout(location = 2) out vec4 oTangent;

const float SILHOUETTE = 0.02;  // the smallest cosine between normal and eye

void main() {
  oPosition = vec4(vPosition, 1.0);
  // At silhouettes interpolated normals face away from the eye.
  vec3 normal = normalize(vNormal), eye = normalize(uEye - vPosition);
  normal = normalize(normal + max(SILHOUETTE - dot(normal, eye), 0.0) * eye);
  vec3 tangent = normalize(vTangent - normal * dot(normal, vTangent)), across = cross(normal, tangent), n = normal;
  if (uScales > 0) {
    vec3 scale = scaleAt(vUV);
    vec2 slope = scale.xy;
    // As Mitsuba's `normalmap` does with a normal that faces away from the eye.
    if (dot(normal - slope.x * tangent - slope.y * across, eye) <= 0.0) slope = -slope;
    n = normalize(normal - slope.x * tangent - slope.y * across);
    tangent = normalize(tangent - n * dot(n, tangent));
    tangent = cos(scale.z) * tangent + sin(scale.z) * cross(n, tangent);
  }
  oNormal = vec4(n, dot(normal, tangent));
  oTangent = vec4(tangent, dot(normal, cross(n, tangent)));
}
