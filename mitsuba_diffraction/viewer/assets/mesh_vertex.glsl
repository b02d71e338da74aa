layout(location = 0) in vec3 aPosition;
layout(location = 1) in vec3 aNormal;
layout(location = 2) in vec3 aTangent;
layout(location = 3) in vec2 aUV;
uniform mat4 uProjection;
out vec3 vPosition;
out vec3 vNormal;
out vec3 vTangent;
out vec2 vUV;

void main() {
  vPosition = aPosition;
  vNormal = aNormal;
  vTangent = aTangent;
  vUV = aUV;
  gl_Position = uProjection * vec4(aPosition, 1.0);
}
