// XYZ to the screen, as optics/color.py of the package: into the gamut, exposure, roll-off, transfer function of sRGB.
uniform highp sampler2D uMean;
uniform float uExposure;
uniform vec3 uBackground;  // encoded
uniform highp sampler2D uOther;  // the other side: a mean, or linear sRGB of a picture
uniform bool uOtherIsPicture;
uniform vec4 uOtherScale;  // scale and offset of its pixels
uniform float uOtherExposure;
uniform float uDivider;    // pixels from the left
uniform bool uDifference;
uniform float uScale;           // of the drawn part of the mean
uniform bool uHasGround;
uniform vec2 uScreen;           // its size in pixels
out vec4 oColour;

vec3 toLinear(vec3 xyz) {
  return vec3(dot(vec3(3.2406, -1.5372, -0.4986), xyz), dot(vec3(-0.9689, 1.8758, 0.0415), xyz),
              dot(vec3(0.0557, -0.2040, 1.0570), xyz));
}

// Columns of linear sRGB to LMS of Oklab, and back.
const mat3 TO_LMS = mat3(0.4122214708, 0.2119034982, 0.0883024619, 0.5363325363, 0.6806995451, 0.2817188376,
                         0.0514459929, 0.1073969566, 0.6299787005);
const mat3 FROM_LMS = mat3(4.0767416621, -1.2684380046, -0.0041960863, -3.3077115913, 2.6097574011, -0.7034186147,
                           0.2309699292, -0.3413193965, 1.7076147010);
const vec3 LUMINANCE = vec3(0.2126, 0.7152, 0.0722);
const float SHOULDER_START = 0.8, ROUNDNESS = 0.3, WHITENING = 0.15;

float greyOf(vec3 root) {
  return dot(vec3(0.2104542553, 0.7936177850, -0.0040720468), root);
}

// Linear sRGB with a chroma multiplied by a factor, from the cube roots of LMS.
vec3 withChroma(vec3 root, float factor) {
  vec3 mixed = greyOf(root) + factor * (root - greyOf(root));
  return FROM_LMS * (mixed * mixed * mixed);
}

vec3 rootOf(vec3 rgb) {
  vec3 lms = TO_LMS * rgb;
  return sign(lms) * pow(abs(lms), vec3(1.0 / 3.0));
}

bool isInside(vec3 rgb) {
  float limit = ROUNDNESS * (rgb.r + rgb.g + rgb.b) / 3.0;
  return min(min(rgb.r, rgb.g), rgb.b) >= 0.0 && rgb.r * rgb.g * rgb.b >= limit * limit * limit;
}

float shoulder(float x) {
  float d = 1.0 - SHOULDER_START;
  return x <= SHOULDER_START ? x : 1.0 - d * d / (x - SHOULDER_START + d);
}

vec3 intoGamut(vec3 rgb) {
  float luminance = dot(LUMINANCE, rgb);
  if (!(luminance > 0.0)) return vec3(0.0);
  vec3 root = rootOf(rgb / luminance);
  float inside = 0.0, outside = 1.0 / SHOULDER_START;
  if (isInside(withChroma(root, outside))) return rgb;
  for (int i = 0; i < 20; i++) {
    float middle = 0.5 * (inside + outside);
    if (isInside(withChroma(root, middle))) inside = middle;
    else outside = middle;
  }
  vec3 mapped = max(withChroma(root, outside * shoulder(1.0 / outside)), 0.0);
  float found = dot(LUMINANCE, mapped);
  return luminance * (found > 0.0 ? mapped / found : vec3(1.0));
}

// A smooth norm, about the brightest channel.
float sizeOf(vec3 rgb) {
  float mean = (rgb.r + rgb.g + rgb.b) / 3.0;
  vec3 more = max(rgb - mean, 0.0);
  return mean + pow(dot(more * more, more), 1.0 / 3.0);
}

vec3 rollOff(vec3 rgb) {
  float size = sizeOf(rgb);
  if (size <= SHOULDER_START) return rgb;
  float shown = shoulder(size);
  vec3 whiter = max(withChroma(rootOf(rgb), 1.0 / (WHITENING * (size - shown) + 1.0)), 0.0);
  return whiter * shown / sizeOf(whiter);
}

vec3 encode(vec3 rgb) {
  rgb = clamp(rgb, 0.0, 1.0);
  return mix(1.055 * pow(rgb, vec3(1.0 / 2.4)) - 0.055, 12.92 * rgb, lessThanEqual(rgb, vec3(0.0031308)));
}

// Linear sRGB that the screen emits.
vec3 shown(vec3 rgb, float exposure) {
  return clamp(rollOff(exposure * intoGamut(rgb)), 0.0, 1.0);
}

vec3 ofMean(vec4 mean) {
  return mean.a > 0.0 ? toLinear(mean.xyz / mean.a) : vec3(0.0);
}

vec3 toLab(vec3 rgb) {
  vec3 xyz = vec3(dot(vec3(0.4124, 0.3576, 0.1805), rgb), dot(vec3(0.2126, 0.7152, 0.0722), rgb),
                  dot(vec3(0.0193, 0.1192, 0.9505), rgb)) / vec3(0.9505, 1.0, 1.089);
  vec3 f = mix(pow(max(xyz, 1e-9), vec3(1.0 / 3.0)), 7.787037 * xyz + 16.0 / 116.0, lessThan(xyz, vec3(0.008856)));
  return vec3(116.0 * f.y - 16.0, 500.0 * (f.x - f.y), 200.0 * (f.y - f.z));
}

// CIEDE2000 (CIE 142).
float deltaE(vec3 a, vec3 b) {
  const float PI = 3.14159265, SEVENTH = 6103515625.0;
  float mean7 = pow(0.5 * (length(a.yz) + length(b.yz)), 7.0);
  float g = 1.5 - 0.5 * sqrt(mean7 / (mean7 + SEVENTH));
  vec2 p = vec2(a.y * g, a.z), q = vec2(b.y * g, b.z);
  float c1 = length(p), c2 = length(q);
  float h1 = c1 > 0.0 ? atan(p.y, p.x) : 0.0, h2 = c2 > 0.0 ? atan(q.y, q.x) : 0.0;
  if (h1 < 0.0) h1 += 2.0 * PI;
  if (h2 < 0.0) h2 += 2.0 * PI;
  float dh = c1 * c2 > 0.0 ? h2 - h1 : 0.0;
  if (dh > PI) dh -= 2.0 * PI;
  if (dh < -PI) dh += 2.0 * PI;
  float dL = b.x - a.x, dC = c2 - c1, dH = 2.0 * sqrt(c1 * c2) * sin(0.5 * dh);
  float L = 0.5 * (a.x + b.x), C = 0.5 * (c1 + c2), h = h1 + h2;
  if (c1 * c2 > 0.0) {
    if (abs(h1 - h2) > PI) h += h < 2.0 * PI ? 2.0 * PI : -2.0 * PI;
    h *= 0.5;
  }
  float T = 1.0 - 0.17 * cos(h - PI / 6.0) + 0.24 * cos(2.0 * h) + 0.32 * cos(3.0 * h + PI / 30.0) -
            0.2 * cos(4.0 * h - 63.0 * PI / 180.0);
  float turn = (h * 180.0 / PI - 275.0) / 25.0, C7 = pow(C, 7.0), L50 = (L - 50.0) * (L - 50.0);
  float RT = -2.0 * sqrt(C7 / (C7 + SEVENTH)) * sin(PI / 3.0 * exp(-turn * turn));
  vec3 d = vec3(dL / (1.0 + 0.015 * L50 / sqrt(20.0 + L50)), dC / (1.0 + 0.045 * C), dH / (1.0 + 0.015 * C * T));
  return sqrt(max(dot(d, d) + RT * d.y * d.z, 0.0));
}

// Black, purple, orange, pale yellow, for 0 to 1.
vec3 heat(float x) {
  vec3 c = mix(vec3(0.0, 0.0, 0.02), vec3(0.45, 0.11, 0.5), clamp(3.0 * x, 0.0, 1.0));
  c = mix(c, vec3(0.97, 0.45, 0.36), clamp(3.0 * x - 1.0, 0.0, 1.0));
  return mix(c, vec3(0.99, 0.99, 0.75), clamp(3.0 * x - 2.0, 0.0, 1.0));
}

const float MAX_DELTA_E = 30.0;

vec3 toLinearChannels(vec3 encoded) {
  return mix(pow((encoded + 0.055) / 1.055, vec3(2.4)), encoded / 12.92, lessThanEqual(encoded, vec3(0.04045)));
}

void main() {
  vec4 mean = texelFetch(uMean, ivec2(gl_FragCoord.xy * uScale), 0);
  vec3 ours = shown(ofMean(mean), uExposure);
  vec4 found = vec4(0.0);
  vec2 at = gl_FragCoord.xy * uOtherScale.xy + uOtherScale.zw;
  if (all(greaterThanEqual(at, vec2(0.0))) && all(lessThan(ivec2(at), textureSize(uOther, 0)))) {
    found = texelFetch(uOther, ivec2(at), 0);
  }
  vec3 theirs = shown(uOtherIsPicture ? found.rgb : ofMean(found), uOtherExposure);
  float cover = uOtherIsPicture ? 1.0 : found.a;
  vec3 background = uBackground;
  if (min(mean.a, cover) < 1.0 && uHasGround) {
    background = encode(withGround(toLinearChannels(uBackground), 2.0 * gl_FragCoord.xy / uScreen - 1.0));
  }
  vec3 colour = mix(background, encode(ours), mean.a);
  if (uDifference) {
    colour = mix(uBackground, heat(deltaE(toLab(ours), toLab(theirs)) / MAX_DELTA_E), min(mean.a, cover));
  } else if (gl_FragCoord.x > uDivider) {
    colour = mix(background, encode(theirs), cover);
  }
  if (abs(gl_FragCoord.x - uDivider) < 1.0 && !uDifference) colour = vec3(0.5);
  oColour = vec4(colour, 1.0);
}
