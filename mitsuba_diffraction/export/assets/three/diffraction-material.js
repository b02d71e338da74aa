// A material for three.js that shades by the colours of a diffracting surface, as `mitsuba-diffraction export` writes
// them (.bin). Symbols are those of colour_table.py: u = −(ω_i + ω_o)_∥ and w = n (cos θ_i + cos θ_o) next to the relief,
// f = K G T_i T_o C(u, w) + (1 − R_i)(1 − R_o) base/π. Colours are XYZ under D65 until they are added up.
import {
  ClampToEdgeWrapping, Data3DTexture, DataTexture, DataUtils, HalfFloatType, LinearFilter, NearestFilter, RGBAFormat,
  RGBFormat, UnsignedInt5999Type, FloatType,
} from 'three';
import { LightingModel, LightingNode, MeshStandardNodeMaterial } from 'three/webgpu';
import {
  If, Loop, cameraWorldMatrix, diffuseColor, float, ivec2, lightViewPosition, normalView, pmremTexture, positionView,
  positionViewDirection, select, texture, texture3D, textureLoad, uniform, uv, vec2, vec3,
} from 'three/tsl';

const VERSION = 1;
const MAX_U = 2; // of a table
const [LOW, HIGH] = [1000 / 740, 1000 / 380]; // ν = 1/λ of visible light, 1/µm
const MAX_CENTRE = 4, NARROW = 3e-3, WIDE = 30; // 1/µm, of the table of light
const MAX_MIRROR = 6 * 0.74; // |u|/σ_q, µm
const LAMP_POINTS = 16;
const WAVELENGTHS = 12; // of an order under a sky
const FROM_RADIUS = { radial: 0, tangential: 90 };

const square = (x) => x.mul(x);
const toRGB = (XYZ) => vec3(
  XYZ.dot(vec3(3.2406, -1.5372, -0.4986)), XYZ.dot(vec3(-0.9689, 1.8758, 0.0415)), XYZ.dot(vec3(0.0557, -0.2040, 1.0570)),
);

/** Colours of a surface: numbers of the header and textures. */
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
    if (this.kind === 'table') this.#table(arrays.values);
    else this.#orders(arrays);
  }

  #table({ values, shape: [layers, size] }) {
    this.table = new Data3DTexture(values, size, size, layers);
    Object.assign(this.table, { format: RGBFormat, type: UnsignedInt5999Type, magFilter: LinearFilter });
    Object.assign(this.table, { minFilter: LinearFilter, unpackAlignment: 4, needsUpdate: true });
    Object.assign(this, { size, layers });
    // Under a sky: points of u, drawn by X + Y + Z on the middle layer in equal steps of their sum.
    const middle = values.subarray(size * size * (layers >> 1), size * size * ((layers >> 1) + 1));
    const a = this.stretch, edge = Math.asinh(MAX_U / a), x = (k) => edge * (2 * k / (size - 1) - 1);
    const node = (k) => a * Math.sinh(x(k)), width = (k) => a * Math.cosh(x(k)) * edge * 2 / (size - 1);
    const sums = new Float64Array(size * size + 1);
    for (let k = 0; k < size * size; k++) {
      const i = k % size, j = (k - i) / size, p = middle[k], outside = node(i) ** 2 + node(j) ** 2 > 4;
      const XYZ = ((p & 511) + (p >>> 9 & 511) + (p >>> 18 & 511)) * 2 ** ((p >>> 27) - 24);
      sums[k + 1] = sums[k] + (outside ? 0 : XYZ * width(i) * width(j));
    }
    const drawn = new Float32Array(4 * 256);
    for (let n = 0, k = 0; n < 256; n++) {
      const order = (n * 101) % 256; // so that the first points, too, are spread out
      while (k < size * size - 1 && sums[k + 1] < (n + 0.5) / 256 * sums[size * size]) k++;
      const i = k % size, j = (k - i) / size;
      drawn.set([node(i), node(j), (sums[k + 1] - sums[k]) / sums[size * size] / (width(i) * width(j))], 4 * order);
    }
    this.drawn = loaded(drawn, 256);
  }

  #orders({ frequencies, powers, light, reflectance, mirror }) {
    const count = frequencies.shape[0];
    this.count = count;
    const q = new Float32Array(4 * Math.max(count, 1));
    for (let k = 0; k < count; k++) q.set(frequencies.values.subarray(2 * k, 2 * k + 2), 4 * k);
    this.frequencies = loaded(q, Math.max(count, 1));
    this.powers = interpolated(powers.values, powers.shape[1], Math.max(count, 1), 1);
    this.light = interpolated(light.values, light.shape[1], light.shape[0], 3);
    this.reflectance = interpolated(reflectance.values, reflectance.shape[1], reflectance.shape[0], 1);
    const [rows, columns] = mirror.shape, scaled = mirror.values.map((x) => x * 2 * Math.PI * this.lobe_width ** 2);
    this.mirror = interpolated(scaled, columns, rows, 3);
    // ∫ C du of order 0.
    const sums = new Float32Array(3 * rows), step = MAX_MIRROR / (columns - 1);
    for (let k = 0; k < rows * columns; k++) {
      for (let c = 0; c < 3; c++) sums[3 * Math.floor(k / columns) + c] += scaled[3 * k + c] * (k % columns) * step ** 2;
    }
    this.mirrorSum = interpolated(sums, rows, 1, 3);
  }
}

// A texture of half floats, linear between the centres of its texels.
function interpolated(values, width, height, channels) {
  const texels = new Uint16Array(4 * width * height);
  for (let k = 0; k < width * height; k++) {
    for (let c = 0; c < channels; c++) texels[4 * k + c] = DataUtils.toHalfFloat(values[channels * k + c]);
  }
  const found = new DataTexture(texels, width, height, RGBAFormat, HalfFloatType);
  Object.assign(found, { magFilter: LinearFilter, minFilter: LinearFilter, needsUpdate: true });
  Object.assign(found, { wrapS: ClampToEdgeWrapping, wrapT: ClampToEdgeWrapping });
  return found;
}

function loaded(values, width) {
  const found = new DataTexture(values, width, 1, RGBAFormat, FloatType);
  Object.assign(found, { magFilter: NearestFilter, minFilter: NearestFilter, needsUpdate: true });
  return found;
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

/** f as nodes, of directions in the frame of the pattern. */
export class DiffractionBRDF {
  constructor(data) { this.data = data; }

  // Next to the relief, from the cosine outside.
  inner(cosine) { return square(cosine).add(this.data.coat ** 2 - 1).max(1e-12).sqrt(); }

  // Fresnel's reflectance of a dielectric of index n, unpolarised.
  fresnel(cosine, n) {
    const inside = square(cosine).add(n * n - 1).max(0).sqrt();
    const s = cosine.sub(inside).div(cosine.add(inside)), p = cosine.mul(n * n).sub(inside).div(cosine.mul(n * n).add(inside));
    return square(s).add(square(p)).mul(0.5);
  }

  // T of the face of the coat.
  face(cosine) { return this.data.coat === 1 ? float(1) : this.fresnel(cosine, this.data.coat).oneMinus(); }

  // 1 − R of the relief and of the coat over it.
  entering(cosine) {
    return this.fresnel(this.inner(cosine).div(this.data.coat), this.data.index).oneMinus().mul(this.face(cosine));
  }

  kG(ki, ko, u) {
    const w = ki.add(ko), square_v = u.dot(u).add(square(w));
    const ai = square_v.div(ki.mul(2)), ao = square_v.div(ko.mul(2));
    return ai.mul(ao).div(square(w)).min(ai.min(ao).mul(2).div(w));
  }

  // What multiplies C.
  factor(wi, wo, u) {
    const ki = this.inner(wi.z), ko = this.inner(wo.z), least = this.data.min_cosine * this.data.coat;
    const seen = wi.z.min(wo.z).greaterThan(0).and(ki.min(ko).greaterThanEqual(least * (1 - 1e-6)));
    return select(seen, this.kG(ki, ko, u).mul(this.face(wi.z)).mul(this.face(wo.z)), float(0));
  }

  at(w) { return w.sub(this.data.range_w[0]).div(this.data.range_w[1] - this.data.range_w[0]); }

  // Interpolated at coordinates from 0 to 1.
  look(map, x, y) {
    const { width, height } = map.image, texel = (t, n) => t.clamp(0, 1).mul(n - 1).add(0.5).div(n);
    return texture(map, vec2(texel(x, width), texel(y, height))).level(float(0));
  }

  // C of overlapping orders and continua.
  table(u, w) {
    const { stretch, size, layers, table } = this.data, x = u.abs().div(stretch);
    const warped = u.sign().mul(x.add(square(x).add(1).sqrt()).log()).div(2 * Math.asinh(MAX_U / stretch)).add(0.5);
    const across = warped.clamp(0, 1).mul(size - 1).add(0.5).div(size);
    const along = this.at(w).clamp(0, 1).mul(layers - 1).add(0.5).div(layers);
    return texture3D(table, vec3(across, along)).level(float(0)).rgb;
  }

  relative(cosine, nu) { return this.look(this.data.reflectance, nu.sub(LOW).div(HIGH - LOW), cosine).r; }

  power(order, kappa) {
    return this.look(this.data.powers, kappa.div(this.data.max_kappa), float(order).div(Math.max(this.data.count - 1, 1))).r;
  }

  // C of separate orders, the mean over a lamp whose tangents have the covariance (a, b; b, c): in closed form, as the
  // lobe, of variance σ_q² + ν² times it, stays a Gaussian; ν within a lobe as at its centre.
  orders(u, w, [a, b, c]) {
    const { lobe_width: sigma, coat, count } = this.data, variance = sigma * sigma;
    const cosine = u.dot(u).add(square(w)).sqrt().div(2 * coat).min(1).toVar();
    const total = vec3(0).toVar();
    const length = u.length().max(1e-6).toVar();
    const mean = 1.8, spread = a.add(c).mul(mean * mean / 2).add(variance).toVar();
    const ratio = float(variance).div(spread), x = length.mul(ratio.sqrt()).div(sigma * MAX_MIRROR);
    const mirror = this.look(this.data.mirror, x, this.at(w)).rgb.div(spread.mul(2 * Math.PI));
    total.addAssign(select(x.lessThanEqual(1), mirror, vec3(0)));
    Loop({ start: 0, end: count, type: 'int', condition: '<', name: 'order' }, ({ order }) => {
      const q = textureLoad(this.data.frequencies, ivec2(order, 0)).xy.toVar();
      const nu = u.dot(q).div(square(length)).clamp(LOW, HIGH).toVar(), square_nu = square(nu);
      const A = square_nu.mul(a).add(variance).toVar(), B = square_nu.mul(b).toVar(), C = square_nu.mul(c).add(variance).toVar();
      const det = A.mul(C).sub(square(B)).toVar();
      const product = (p, r) => p.x.mul(r.x).mul(C).sub(p.x.mul(r.y).add(p.y.mul(r.x)).mul(B)).add(p.y.mul(r.y).mul(A)).div(det);
      const inverse = product(u, u).max(1e-12).toVar();
      const centre = product(u, q).div(inverse).toVar();
      const rest = q.sub(u.mul(centre)).toVar(); // |q|² − c² |u|² would lose its digits
      const exponent = product(rest, rest).div(-2).toVar();
      If(exponent.greaterThan(-40).and(centre.greaterThan(0)).and(centre.lessThan(MAX_CENTRE)), () => {
        const s = inverse.inverseSqrt(), visible = centre.clamp(LOW, HIGH);
        const power = this.power(order, w.mul(visible).mul(2 * Math.PI)).mul(this.relative(cosine, visible));
        const row = s.div(NARROW).log().div(Math.log(WIDE / NARROW));
        const light = this.look(this.data.light, centre.div(MAX_CENTRE), row).rgb.mul(s.min(1));
        total.addAssign(light.mul(power).mul(exponent.exp()).div(det.sqrt().mul(2 * Math.PI)));
      });
    });
    return total;
  }

  // K G T_i T_o C, (X, Y, Z), the mean over a round lamp of an angular radius (a node, radians; null of none).
  evaluate(wi, wo, radius = null) {
    const result = vec3(0).toVar();
    if (this.data.kind === 'orders') {
      const u = wi.xy.add(wo.xy).negate().toVar(), w = this.inner(wi.z).add(this.inner(wo.z)).toVar();
      const variance = radius === null ? float(0) : square(radius.sin()).div(4).toVar();
      const spread = [square(wi.x).oneMinus(), wi.x.mul(wi.y).negate(), square(wi.y).oneMinus()].map((x) => x.mul(variance));
      result.assign(this.orders(u, w, spread).mul(this.factor(wi, wo, u)).mul(wi.z.max(0)));
      return result;
    }
    const add = (direction, part) => {
      const u = direction.xy.add(wo.xy).negate().toVar(), w = this.inner(direction.z).add(this.inner(wo.z));
      result.addAssign(this.table(u, w).mul(this.factor(direction, wo, u)).mul(direction.z.max(0)).mul(part));
    };
    if (radius === null) {
      add(wi, 1);
    } else {
      const a = select(wi.z.abs().lessThan(0.99), vec3(0, 0, 1), vec3(1, 0, 0)).cross(wi).normalize().toVar();
      const b = wi.cross(a).toVar();
      Loop({ start: 0, end: LAMP_POINTS, type: 'int', condition: '<', name: 'point' }, ({ point }) => {
        const sine = float(point).add(0.5).div(LAMP_POINTS).sqrt().mul(radius.sin()), phi = float(point).mul(2.39996323);
        const across = a.mul(phi.cos()).add(b.mul(phi.sin())).mul(sine);
        add(wi.mul(square(sine).oneMinus().sqrt()).add(across).toVar(), 1 / LAMP_POINTS);
      });
    }
    return result;
  }

  // Light of a sky, radiance(ω_i, solid angle) in linear sRGB: linear sRGB.
  underSky(wo, radiance, points) {
    const { data } = this, total = vec3(0).toVar();
    const add = (u, C) => {
      const incident = wo.xy.add(u).negate().toVar(), z2 = incident.dot(incident).oneMinus().toVar();
      If(z2.greaterThan(1e-6), () => {
        const wi = vec3(incident, z2.sqrt()).toVar(), w = this.inner(wi.z).add(this.inner(wo.z)).toVar();
        const { XYZ, area } = C(w);
        total.addAssign(toRGB(XYZ.mul(this.factor(wi, wo, u))).mul(radiance(wi, area.div(wi.z))));
      });
    };
    if (data.kind === 'table') {
      Loop({ start: 0, end: points, type: 'int', condition: '<', name: 'point' }, ({ point }) => {
        const drawn = textureLoad(data.drawn, ivec2(point, 0)).toVar(), area = drawn.z.mul(points).reciprocal().toVar();
        add(drawn.xy, (w) => ({ XYZ: this.table(drawn.xy, w).mul(area), area }));
      });
      return total;
    }
    const step = (HIGH - LOW) / WAVELENGTHS;
    add(vec2(0).toVar(), (w) => ({ XYZ: this.look(data.mirrorSum, this.at(w), float(0)).rgb, area: float((data.lobe_width * 0.55) ** 2 * 6) }));
    Loop({ start: 0, end: data.count * WAVELENGTHS, type: 'int', condition: '<', name: 'order' }, ({ order }) => {
      const m = order.div(WAVELENGTHS).toVar(), nu = float(order.mod(WAVELENGTHS)).add(0.5).mul(step).add(LOW).toVar();
      const u = textureLoad(data.frequencies, ivec2(m, 0)).xy.div(nu).toVar();
      add(u, (w) => {
        const cosine = u.dot(u).add(square(w)).sqrt().div(2 * data.coat).min(1);
        const power = this.power(m, w.mul(nu).mul(2 * Math.PI)).mul(this.relative(cosine, nu));
        // The narrowest row: the light at ν, times √2π.
        const light = this.look(data.light, nu.div(MAX_CENTRE), float(0)).rgb.div(Math.sqrt(2 * Math.PI));
        return { XYZ: light.mul(power).mul(step).div(square(nu)), area: square(u.length().mul(step).div(nu)) };
      });
    });
    return total;
  }
}

class SkyNode extends LightingNode {
  constructor(environment) {
    super();
    this.environment = environment;
  }

  setup(builder) { builder.context.lightingModel.sky(this.environment, builder); }
}

class DiffractionLighting extends LightingModel {
  constructor(material) {
    super();
    this.material = material;
    this.brdf = new DiffractionBRDF(material.diffraction);
  }

  start(builder) {
    const { orientation, isRadial } = this.material, N = normalView.toVar();
    const px = positionView.dFdx(), py = positionView.dFdy(), st = uv(), sx = st.dFdx(), sy = st.dFdy();
    const turn = sx.x.mul(sy.y).sub(sx.y.mul(sy.x)).sign();
    const U = px.mul(sy.y).sub(py.mul(sx.y)).mul(turn), V = py.mul(sx.x).sub(px.mul(sy.x)).mul(turn);
    const centred = st.sub(0.5), along = isRadial ? U.mul(centred.x).add(V.mul(centred.y)) : U;
    const S = along.sub(N.mul(N.dot(along))).normalize().toVar(), B = N.cross(S).toVar();
    const [cos, sin] = [orientation.cos(), orientation.sin()];
    this.axes = [S.mul(cos).add(B.mul(sin)).toVar(), B.mul(cos).sub(S.mul(sin)).toVar(), N];
    this.wo = this.local(positionViewDirection).toVar();
    super.start(builder);
  }

  local(v) { return vec3(...this.axes.map((axis) => v.dot(axis))); }

  global(v) { return this.axes[0].mul(v.x).add(this.axes[1].mul(v.y)).add(this.axes[2].mul(v.z)); }

  // Light that reaches the base and leaves it, divided by the color, the area and the cosine.
  below(cosine) { return this.brdf.entering(cosine.max(1e-3)).mul(this.brdf.entering(this.wo.z.max(1e-3))); }

  direct({ lightDirection, lightColor, lightNode, reflectedLight }) {
    const wi = this.local(lightDirection).toVar(), { light } = lightNode, { angularRadius = 0, radius = 0 } = light.userData;
    let angle = null;
    if (light.isDirectionalLight && angularRadius > 0) {
      angle = float(angularRadius);
    } else if (!light.isDirectionalLight && radius > 0) {
      angle = float(radius).div(lightViewPosition(light).sub(positionView).length()).min(1).asin();
    }
    const XYZ = this.brdf.evaluate(wi, this.wo, angle);
    reflectedLight.directSpecular.addAssign(toRGB(XYZ).mul(lightColor));
    const diffuse = diffuseColor.rgb.mul(wi.z.max(0)).mul(this.below(wi.z)).mul(1 / Math.PI);
    reflectedLight.directDiffuse.addAssign(diffuse.mul(lightColor));
  }

  sky(environment, builder) {
    const { reflectedLight } = builder.context, { brdf, wo } = this;
    const from = (direction, roughness) => pmremTexture(environment, direction.transformDirection(cameraWorldMatrix), roughness);
    // α of the lobe of a rough mirror that fills about this solid angle; roughness is its root.
    const radiance = (wi, area) => from(this.global(wi), area.div(4 * Math.PI).sqrt().sqrt().clamp(0, 1));
    reflectedLight.indirectSpecular.addAssign(brdf.underSky(wo, radiance, this.material.skyPoints));
    if (brdf.data.coat > 1) {
      const mirrored = vec3(wo.xy.negate(), wo.z).toVar();
      reflectedLight.indirectSpecular.addAssign(from(this.global(mirrored), float(0)).mul(brdf.face(wo.z).oneMinus()));
    }
    // Fresnel's transmittance of diffuse light is about that at 57°.
    reflectedLight.indirectDiffuse.addAssign(diffuseColor.rgb.mul(this.below(float(0.55))).mul(from(this.axes[2], float(1))));
  }

  // Colours outside of the gamut are mixed with grey of their luminance.
  finish({ context }) {
    const rgb = context.outgoingLight, Y = rgb.dot(vec3(0.2126, 0.7152, 0.0722)).max(0).toVar();
    const least = rgb.x.min(rgb.y).min(rgb.z), kept = Y.div(Y.sub(least).max(1e-9)).min(1);
    rgb.assign(vec3(Y).add(rgb.sub(Y).mul(kept)));
  }
}

/** A mesh with a diffracting surface; of null it is grey. */
export class DiffractionMaterial extends MeshStandardNodeMaterial {
  static get type() { return 'DiffractionMaterial'; }

  constructor(data, { orientation, radial, skyPoints = 64, ...parameters } = {}) {
    super({ color: data === null ? 0x808080 : data.base, ...parameters });
    this.diffraction = data;
    this.skyPoints = skyPoints;
    const stated = orientation ?? data?.orientation ?? 0, isNamed = stated in FROM_RADIUS;
    this.isRadial = radial ?? isNamed;
    this.orientation = uniform((isNamed ? FROM_RADIUS[stated] : stated) * Math.PI / 180);
  }

  setupLightingModel(builder) {
    return this.diffraction === null ? super.setupLightingModel(builder) : new DiffractionLighting(this);
  }

  setupEnvironment(builder) {
    if (this.diffraction === null) return super.setupEnvironment(builder);
    const environment = this.envMap ?? builder.environmentNode?.value;
    return environment?.isTexture ? new SkyNode(environment) : null;
  }
}
