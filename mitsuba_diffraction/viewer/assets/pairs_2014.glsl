// Linear RGB of pairs of directions.
uniform highp sampler2D uIncident;
uniform highp sampler2D uOutgoing;
out vec4 oValue;

void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  oValue = vec4(shaderRGB(texelFetch(uIncident, at, 0).xyz, texelFetch(uOutgoing, at, 0).xyz), 1.0);
}
