in vec3 vPosition;
in vec3 vNormal;
in vec3 vTangent;
uniform vec3 uEye;
layout(location = 0) out vec4 oPosition;
layout(location = 1) out vec4 oNormal;
layout(location = 2) out vec4 oTangent;

const float SILHOUETTE = 0.02;  // the smallest cosine between normal and eye

void main() {
  oPosition = vec4(vPosition, 1.0);
  // At silhouettes interpolated normals face away from the eye.
  vec3 normal = normalize(vNormal), eye = normalize(uEye - vPosition);
  oNormal = vec4(normalize(normal + max(SILHOUETTE - dot(normal, eye), 0.0) * eye), 0.0);
  oTangent = vec4(vTangent, 0.0);
}
