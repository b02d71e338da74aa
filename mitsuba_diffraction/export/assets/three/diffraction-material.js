// A material for three.js (WebGLRenderer) that shades by the colours of a diffracting surface, as `mitsuba-diffraction
// export` writes them (.bin), with the GLSL of shading.js.
import {
  DataArrayTexture, DataTexture, DataUtils, FloatType, HalfFloatType, LinearFilter, LinearMipmapLinearFilter,
  MeshStandardMaterial, NearestFilter, RGBAFormat, ShaderChunk, Vector2,
} from 'three';
import { MAX_U, SHADING, drawnOfTable } from './shading.js';

const VERSION = 3;
const SAMPLES = 256;  // of a sky, by a table
const [LOW, HIGH, WAVELENGTHS, MAX_ORDERS] = [1000 / 740, 1000 / 380, 12, 170];  // a texture has 2048 texels
const FROM_RADIUS = { radial: 0, tangential: 90 };

/** Colours of a surface: numbers of the header, and `uniforms` of shading.js. */
export class DiffractionData {
  /** Parse a file. Throws an Error if it is another file, of another version, or cut short. */
  constructor(buffer) {
    const view = new DataView(buffer);
    if (buffer.byteLength < 8 || view.getUint32(0) !== 0x4d444346) throw new Error('not a file of colours');
    let at = 8 + view.getUint32(4, true);
    if (at > buffer.byteLength) throw new Error('the file was cut short');
    const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 8, at - 8)));
    if (header.version !== VERSION) throw new Error(`version ${header.version}, wanted ${VERSION}`);
    const arrays = {};
    for (const { name, type, shape } of header.arrays) {
      const count = shape.reduce((product, n) => product * n, 1);
      if (at + 4 * count > buffer.byteLength) throw new Error('the file was cut short');
      arrays[name] = { shape, values: new (type === 'uint32' ? Uint32Array : Float32Array)(buffer, at, count) };
      at += 4 * count;
    }
    Object.assign(this, header);
    const own = this.kind === 'table' ? this.#table(arrays.values) : this.#orders(arrays);
    this.uniforms = {
      uCoat: this.coat, uEta: this.index, uMinCosine: this.min_cosine * (1 - 1e-6), ...own,
    };
  }

  #table({ values, shape: [layers, size] }) {
    const halves = new Uint16Array(4 * values.length), middle = size * size * (layers >> 1), sums = new Float64Array(size * size);
    values.forEach((p, k) => {
      const XYZ = [p & 511, p >>> 9 & 511, p >>> 18 & 511].map((x) => x * 2 ** ((p >>> 27) - 24));
      XYZ.forEach((x, c) => { halves[4 * k + c] = DataUtils.toHalfFloat(Math.min(x, 65504)); });
      if (k >= middle && k < middle + size * size) sums[k - middle] = XYZ[0] + XYZ[1] + XYZ[2];
    });
    const uColours = new DataArrayTexture(halves, size, size, layers);
    Object.assign(uColours, { format: RGBAFormat, type: HalfFloatType, magFilter: LinearFilter });
    Object.assign(uColours, { minFilter: LinearMipmapLinearFilter, generateMipmaps: true, needsUpdate: true });
    return { uColours, uRangeW: new Vector2(...this.range_w), uStretch: this.stretch, uEdge: Math.asinh(MAX_U / this.stretch), uDrawn: loaded(drawnOfTable(sums, size, this.stretch, SAMPLES), SAMPLES, 1) };
  }

  #orders({ frequencies, powers, light, reflectance }) {
    const T = this.tile_size, columns = powers.shape[1], orders = [];
    for (let k = 0; k < powers.shape[0]; k++) orders.push([0, 1].map((i) => Math.round(frequencies.values[2 * k + i] * T[i])));
    const [M, N] = [0, 1].map((i) => Math.max(...orders.map((m) => Math.abs(m[i]))));
    const rows = (2 * M + 1) * (2 * N + 1), all = new Float32Array(4 * columns * rows);
    orders.forEach(([m, n], k) => {
      const row = (n + N) * (2 * M + 1) + m + M;
      for (let i = 0; i < columns; i++) all[4 * (row * columns + i)] = powers.values[k * columns + i];
    });
    // Under a sky all orders count, at equidistant 1/λ.
    const count = WAVELENGTHS * Math.min(orders.length, MAX_ORDERS), step = (HIGH - LOW) / WAVELENGTHS;
    const sky = Float32Array.from({ length: 4 * count }, (_, k) => {
      const nu = LOW + step * (((k >> 2) % WAVELENGTHS) + 0.5);
      return [...orders[Math.floor((k >> 2) / WAVELENGTHS)], nu, (count * step) / nu ** 2][k & 3];
    });
    this.skyPoints = count;
    return {
      uPowers: loaded(all, columns, rows), uMaxKappa: this.max_kappa, uSigma: this.lobe_width,
      uPerPitch: new Vector2(...T), uMaxOrder: new Vector2(M, N), uDrawn: loaded(sky, count, 1),
      uGaussians: interpolated(light.values, light.shape[1], light.shape[0], 3),
      uRatios: interpolated(reflectance.values, reflectance.shape[1], reflectance.shape[0], 1),
    };
  }
}

// A texture of half floats, linear between the centres of its texels.
function interpolated(values, width, height, channels) {
  const texels = new Uint16Array(4 * width * height);
  for (let k = 0; k < width * height; k++) {
    for (let c = 0; c < channels; c++) texels[4 * k + c] = DataUtils.toHalfFloat(values[channels * k + c]);
  }
  const found = new DataTexture(texels, width, height, RGBAFormat, HalfFloatType);
  return Object.assign(found, { magFilter: LinearFilter, minFilter: LinearFilter, needsUpdate: true });
}

function loaded(values, width, height) {
  const found = new DataTexture(values, width, height, RGBAFormat, FloatType);
  return Object.assign(found, { magFilter: NearestFilter, minFilter: NearestFilter, needsUpdate: true });
}

/** Load a file of colours; null, and one message in the console, if it cannot be read. */
export async function loadDiffraction(url) {
  try {
    const response = await fetch(url);
    if (!response.ok) throw new Error(`HTTP status ${response.status}`);
    return new DiffractionData(await response.arrayBuffer());
  } catch (error) {
    console.error(`DiffractionMaterial: ${url}: ${error.message}; shown in grey`);
    return null;
  }
}

/** GLSL of f for the data of a surface, see shading.js: ofLamp(c, a, b, isDisc, wo) is XYZ. */
export const shadingOf = (data) => `${data.kind === 'orders' ? '#define ORDERS\n' : ''}const bool HAS_COAT = ${data.coat > 1}, HAS_BASE = true;
${SHADING}
vec3 toRGB(vec3 XYZ) { return mat3(3.2406, -0.9689, 0.0557, -1.5372, 1.8758, -0.2040, -0.4986, 0.0415, 1.0570) * XYZ; }
#ifdef ORDERS
uniform highp sampler2D uPowers;
uniform float uMaxKappa;
float orderPower(ivec2 m, float kappa) {
  if (any(greaterThan(abs(m), uMaxOrder))) return 0.0;
  int row = (m.y + uMaxOrder.y) * (2 * uMaxOrder.x + 1) + m.x + uMaxOrder.x, last = textureSize(uPowers, 0).x - 1;
  float x = clamp(kappa / uMaxKappa, 0.0, 1.0) * float(last);
  int below = min(int(x), last - 1);
  return mix(texelFetch(uPowers, ivec2(below, row), 0).x, texelFetch(uPowers, ivec2(below + 1, row), 0).x, x - float(below));
}
#endif
`;

// Of the fragment shader of MeshStandardMaterial, for whose lights these functions are called.
const LIGHTING = /* glsl */ `
uniform float uOrientation;
uniform bool uIsRadial;
uniform int uSkyPoints;
#if NUM_DIR_LIGHTS > 0
uniform float uDirectionalRadii[NUM_DIR_LIGHTS];
#endif
#if NUM_POINT_LIGHTS > 0
uniform float uPointRadii[NUM_POINT_LIGHTS];
#endif
#if NUM_SPOT_LIGHTS > 0
uniform float uSpotRadii[NUM_SPOT_LIGHTS];
#endif
mat3 pattern;  // its axes
vec3 patternOut;
vec3 below;    // linear sRGB of the base
float lampTangent = 0.0;

float tangentOf(float sine) { return min(sine, 0.99) * inversesqrt(1.0 - min(sine * sine, 0.98)); }

void startPattern(vec3 position, vec3 n, vec3 toEye, vec2 st, vec3 base) {
  vec3 px = dFdx(position), py = dFdy(position);
  vec2 sx = dFdx(st), sy = dFdy(st);
  float turn = sign(sx.x * sy.y - sx.y * sy.x);
  vec3 U = (px * sy.y - py * sx.y) * turn, V = (py * sx.x - px * sy.x) * turn;
  vec3 along = uIsRadial ? U * (st.x - 0.5) + V * (st.y - 0.5) : U;
  vec3 s = normalize(along - n * dot(n, along)), t = cross(n, s);
  pattern = mat3(cos(uOrientation) * s + sin(uOrientation) * t, cos(uOrientation) * t - sin(uOrientation) * s, n);
  patternOut = toEye * pattern;
  below = base;
  baseColour = mat3(0.4124, 0.2126, 0.0193, 0.3576, 0.7152, 0.1192, 0.1805, 0.0722, 0.9505) * base;
}

void RE_Direct_Diffraction(const in IncidentLight light, const in vec3 position, const in vec3 n, const in vec3 toEye,
    const in vec3 clearcoatNormal, const in PhysicalMaterial material, inout ReflectedLight reflectedLight) {
  vec3 c = light.direction * pattern, a = normalize(cross(abs(c.z) < 0.99 ? vec3(0.0, 0.0, 1.0) : vec3(1.0, 0.0, 0.0), c));
  vec3 XYZ = ofLamp(c, lampTangent * a, lampTangent * cross(c, a), true, patternOut);
  reflectedLight.directSpecular += toRGB(XYZ) * light.color;
}

#if NUM_RECT_AREA_LIGHTS > 0
void RE_Direct_RectArea_Diffraction(const in RectAreaLight light, const in vec3 position, const in vec3 n, const in vec3 toEye,
    const in vec3 clearcoatNormal, const in PhysicalMaterial material, inout ReflectedLight reflectedLight) {
  vec3 c = (light.position - position) * pattern, a = light.halfWidth * pattern, b = light.halfHeight * pattern;
  float towards = dot(cross(a, b), c), square = dot(c, c);
  if (towards > 0.0) {
    vec3 irradiance = 4.0 * towards * inversesqrt(square) / square * light.color;
    reflectedLight.directSpecular += toRGB(ofLamp(c, a, b, false, patternOut)) * irradiance;
  }
}
#endif

// In linear sRGB; the roughness of a mirror whose lobe fills about this solid angle.
vec3 underSky(vec3 XYZ, vec3 wi, float solidAngle) {
#ifdef USE_ENVMAP
  vec3 direction = pattern * wi;
  return toRGB(XYZ) * getIBLRadiance(direction, direction, clamp(sqrt(sqrt(solidAngle / (4.0 * PI))), 0.0, 1.0));
#else
  return vec3(0.0);
#endif
}

void RE_IndirectDiffuse_Diffraction(const in vec3 irradiance, const in vec3 position, const in vec3 n, const in vec3 toEye,
    const in vec3 clearcoatNormal, const in PhysicalMaterial material, inout ReflectedLight reflectedLight) {
  // The transmittance of diffuse light is about that at 57 degrees.
  reflectedLight.indirectDiffuse += irradiance / PI * transmittance(0.55) * transmittance(max(patternOut.z, 0.0)) * below;
}

void RE_IndirectSpecular_Diffraction(const in vec3 radiance, const in vec3 irradiance, const in vec3 clearcoatRadiance,
    const in vec3 position, const in vec3 n, const in vec3 toEye, const in vec3 clearcoatNormal,
    const in PhysicalMaterial material, inout ReflectedLight reflectedLight) {
#ifdef USE_ENVMAP
  vec3 mirrored = vec3(-patternOut.xy, patternOut.z), white = vec3(0.9505, 1.0, 1.089);
  reflectedLight.indirectSpecular += ofSky(patternOut, 0, uSkyPoints) + underSky(face(max(patternOut.z, 0.0)) * white, mirrored, 0.0);
  reflectedLight.indirectDiffuse += irradiance / PI * transmittance(0.55) * transmittance(max(patternOut.z, 0.0)) * below;
#endif
}
#undef RE_Direct
#define RE_Direct RE_Direct_Diffraction
#undef RE_Direct_RectArea
#define RE_Direct_RectArea RE_Direct_RectArea_Diffraction
#undef RE_IndirectDiffuse
#define RE_IndirectDiffuse RE_IndirectDiffuse_Diffraction
#undef RE_IndirectSpecular
#define RE_IndirectSpecular RE_IndirectSpecular_Diffraction
`;

// Sets lampTangent before the light of each lamp.
const LIGHTS = [
  ['pointLight = pointLights[ i ];', 'lampTangent = tangentOf(uPointRadii[ i ] / length(pointLight.position - geometryPosition));'],
  ['spotLight = spotLights[ i ];', 'lampTangent = tangentOf(uSpotRadii[ i ] / length(spotLight.position - geometryPosition));'],
  ['directionalLight = directionalLights[ i ];', 'lampTangent = uDirectionalRadii[ i ];'],
].reduce((text, [line, added]) => text.replace(line, `${line}\n${added}`), ShaderChunk.lights_fragment_begin);

// Colours outside of the gamut are mixed with grey of their luminance.
const GAMUT = /* glsl */ `{
  float Y = max(dot(outgoingLight, vec3(0.2126, 0.7152, 0.0722)), 0.0);
  float least = min(min(outgoingLight.r, outgoingLight.g), outgoingLight.b);
  outgoingLight = vec3(Y) + (outgoingLight - Y) * min(Y / max(Y - least, 1e-9), 1.0);
}`;

/** A mesh with a diffracting surface; of null it is grey. */
export class DiffractionMaterial extends MeshStandardMaterial {
  constructor(data, { orientation, radial, skyPoints = 64, heightScale = 1, ...parameters } = {}) {
    super({ color: data === null ? 0x808080 : data.base, ...parameters });
    this.diffraction = data;
    if (data === null) return;
    const canScale = heightScale === 1 || (data.kind === 'orders' && heightScale >= 0 && heightScale < 1);
    if (!canScale) {
      const wanted = data.kind === 'orders' ? '0 to 1' : '1, as orders overlap';
      console.error(`DiffractionMaterial: heightScale: got ${heightScale}, wanted ${wanted}; export with height_scale, shown with 1`);
    }
    const stated = orientation ?? data.orientation ?? 0, isNamed = stated in FROM_RADIUS;
    this.defines = { ...this.defines, USE_UV: '' };
    this.shading = {
      uOrientation: { value: (isNamed ? FROM_RADIUS[stated] : stated) * Math.PI / 180 }, uIsRadial: { value: radial ?? isNamed },
      uSkyPoints: { value: data.skyPoints ?? skyPoints }, uHeightScale: { value: canScale ? heightScale : 1 },
      uDirectionalRadii: { value: [] }, uPointRadii: { value: [] }, uSpotRadii: { value: [] },
      ...Object.fromEntries(Object.entries(data.uniforms).map(([name, value]) => [name, { value }])),
    };
  }

  onBeforeCompile(shader) {
    if (this.diffraction === null) return;
    Object.assign(shader.uniforms, this.shading);
    const toEye = 'isOrthographic ? vec3(0.0, 0.0, 1.0) : normalize(vViewPosition)';
    shader.fragmentShader = shader.fragmentShader
      .replace('#include <lights_physical_pars_fragment>', `$&\n${shadingOf(this.diffraction)}${LIGHTING}`)
      .replace('#include <lights_fragment_begin>', `startPattern(-vViewPosition, normal, ${toEye}, vUv, diffuseColor.rgb);\n${LIGHTS}`)
      .replace('#include <opaque_fragment>', `${GAMUT}\n$&`);
  }

  customProgramCacheKey() { return `diffraction ${this.diffraction?.kind} ${this.diffraction?.coat > 1}`; }

  // The sizes of the lamps, in the order in which three.js has them.
  onBeforeRender(renderer, scene) {
    if (this.diffraction === null) return;
    const lights = [], rank = (light) => (light.castShadow ? 2 : 0) + (light.map ? 1 : 0);
    scene.traverseVisible((object) => { if (object.isLight) lights.push(object); });
    lights.sort((a, b) => rank(b) - rank(a));
    const of = (kind, size) => lights.filter((light) => light[kind]).map(size);
    this.shading.uDirectionalRadii.value = of('isDirectionalLight', ({ userData }) => Math.tan(userData.angularRadius ?? 0));
    this.shading.uPointRadii.value = of('isPointLight', ({ userData }) => userData.radius ?? 0);
    this.shading.uSpotRadii.value = of('isSpotLight', ({ userData }) => userData.radius ?? 0);
  }
}
