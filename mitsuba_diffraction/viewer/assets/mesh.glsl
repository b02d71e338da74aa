in vec3 vPosition;
in vec3 vNormal;
in vec3 vTangent;
layout(location = 0) out vec4 oPosition;
layout(location = 1) out vec4 oNormal;
layout(location = 2) out vec4 oTangent;

void main() {
  oPosition = vec4(vPosition, 1.0);
  oNormal = vec4(vNormal, 0.0);
  oTangent = vec4(vTangent, 0.0);
}
