// XYZ of pairs of directions under parallel light of irradiance one, in one frame.
uniform highp sampler2D uIncident;
uniform highp sampler2D uOutgoing;
uniform vec4 uRandom;
out vec4 oValue;

vec4 lightAt(int n) {
  return vec4(texelFetch(uIncident, ivec2(gl_FragCoord.xy), 0).xyz, 1.0);
}

vec4 lightTo(vec2 place) {
  return lightAt(0);
}

void main() {
  random = uRandom;
  oValue = vec4(radiance(texelFetch(uOutgoing, ivec2(gl_FragCoord.xy), 0).xyz), 1.0);
}
