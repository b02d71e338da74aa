// XYZ to the screen, as color.py of the package: into the gamut, exposure, roll-off, transfer function of sRGB.
uniform highp sampler2D uMean;
uniform float uExposure;
uniform vec3 uBackground;  // encoded
uniform float uScale;      // of the drawn part of the mean
out vec4 oColour;

vec3 toLinear(vec3 xyz) {
  return vec3(dot(vec3(3.2406, -1.5372, -0.4986), xyz), dot(vec3(-0.9689, 1.8758, 0.0415), xyz),
              dot(vec3(0.0557, -0.2040, 1.0570), xyz));
}

vec3 intoGamut(vec3 rgb, float luminance) {
  luminance = max(luminance, 0.0);
  float lowest = min(min(min(rgb.r, rgb.g), rgb.b), 0.0);
  float span = luminance - lowest;
  return max(luminance + (span > 0.0 ? luminance / span : 0.0) * (rgb - luminance), 0.0);
}

vec3 rollOff(vec3 rgb) {
  float peak = max(max(rgb.r, rgb.g), rgb.b);
  if (peak <= 0.8) return rgb;
  float shown = 1.0 - 0.04 / (peak - 0.8 + 0.2);
  float white = 1.0 - 1.0 / (0.15 * (peak - shown) + 1.0);
  vec3 scaled = rgb * shown / peak;
  return scaled + white * (shown - scaled);
}

vec3 encode(vec3 rgb) {
  rgb = clamp(rgb, 0.0, 1.0);
  return mix(1.055 * pow(rgb, vec3(1.0 / 2.4)) - 0.055, 12.92 * rgb, lessThanEqual(rgb, vec3(0.0031308)));
}

void main() {
  vec4 mean = texelFetch(uMean, ivec2(gl_FragCoord.xy * uScale), 0);
  vec3 xyz = mean.a > 0.0 ? mean.xyz / mean.a : vec3(0.0);
  vec3 rgb = intoGamut(toLinear(xyz), dot(vec3(0.2126, 0.7152, 0.0722), toLinear(xyz)));
  oColour = vec4(mix(uBackground, encode(rollOff(uExposure * rgb)), mean.a), 1.0);
}
