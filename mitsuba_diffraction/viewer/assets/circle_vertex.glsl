// A polygon of 16 sides around the circle in the viewport.
void main() {
  float phi = (float(gl_VertexID) + 0.5) * 0.39269908;
  gl_Position = vec4(vec2(cos(phi), sin(phi)) / 0.98078528, 0.0, 1.0);
}
