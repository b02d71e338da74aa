// XYZ of pairs of directions under parallel light of irradiance one.
uniform highp sampler2D uIncident;
uniform highp sampler2D uOutgoing;
out vec4 oValue;

void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  lightAxes = mat3(vec3(0.0), vec3(0.0), texelFetch(uIncident, at, 0).xyz);
  oValue = vec4(radiance(texelFetch(uOutgoing, at, 0).xyz), 1.0);
}
