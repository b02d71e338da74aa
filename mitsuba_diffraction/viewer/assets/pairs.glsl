// f cos of pairs of directions: omega_i and lambda (nm), omega_o.
uniform highp sampler2D uIncident;
uniform highp sampler2D uOutgoing;
out vec4 oValue;

void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  vec4 incident = texelFetch(uIncident, at, 0);
  vec3 outgoing = texelFetch(uOutgoing, at, 0).xyz;
  oValue = vec4(brdf(incident.xyz, outgoing, incident.w) * outgoing.z, 0.0, 0.0, 1.0);
}
