// Draws: positions and normals (geometry), the mean of frames of each side, the screen.

const R2 = [0.7548776662466927, 0.5698402909980532];  // steps of a two-dimensional sequence (Roberts 2018)
const fraction = (x) => x - Math.floor(x);

// Where on the lamp the light of a frame comes from, -1 to 1 along its axes.
function placeOf(state, frame) {
  const [x, y] = R2.map((step) => fraction(0.5 + frame * step));
  const [radius, phi] = [Math.sqrt(x), 2 * Math.PI * y];
  return lightSizeOf(state).uLightIsDisc ? [radius * Math.cos(phi), radius * Math.sin(phi)] : [2 * x - 1, 2 * y - 1];
}

// One of the two shaders: its program, its uniforms, and the mean of its frames. A frame is drawn in bands of rows, so
// that a slow shader blocks neither the page nor the device.
class Side {
  constructor(gl, text, constants, uniforms) {
    Object.assign(this, { gl, text, constants, uniforms });
    this.programs = new Map();
    this.means = [];
    this.milliseconds = NaN;
    this.band = 16;
  }

  programOf(state) {
    const constants = this.constants(state);
    if (!this.programs.has(constants)) {
      this.programs.set(constants, new Program(this.gl, SHADERS.circle_vertex, constants, this.text, SHADERS.shade));
    }
    return this.programs.get(constants);
  }

  resize(width, height) {
    for (const target of this.means) target.dispose();
    this.means = [new Target(this.gl, width, height), new Target(this.gl, width, height)];
    this.restart();
  }

  restart() {
    Object.assign(this, { frame: 0, row: 0, spent: 0 });
    for (const target of this.means) {
      target.bind();
      this.gl.clearBufferfv(this.gl.COLOR, 0, [0, 0, 0, 0]);
    }
  }

  // The mean that is shown: of all whole frames, or the first one as far as it is drawn.
  get mean() {
    return this.means[this.frame === 0 ? 1 : 0];
  }

  dispose() {
    for (const target of this.means) target.dispose();
    for (const { program } of this.programs.values()) this.gl.deleteProgram(program);
  }
}

// Scale and offset from pixels of the screen to those of a picture that fills the shorter side.
function pictureScale(picture, width, height) {
  const scale = Math.min(picture.width, picture.height) / Math.min(width, height);
  return [scale, scale, 0.5 * (picture.width - scale * width), 0.5 * (picture.height - scale * height)];
}

class Renderer {
  constructor(gl, data, tables) {
    this.gl = gl;
    this.data = data;
    this.spectrum = new Spectrum(gl, data.spectrum, tables.table, tables.metals);
    this.matching = numbers2D(gl, tables.light, 471, 1, 4);
    this.analytic = new Program(gl, SHADERS.circle_vertex, SHADERS.analytic);
    this.mesh = new Program(gl, SHADERS.mesh_vertex, SHADERS.scales, SHADERS.mesh);
    this.screen = new Program(gl, SHADERS.quad_vertex, SHADERS.ground, SHADERS.display);
    const constants = (state) => this.constants(state);
    this.model = new Side(gl, SHADING + SHADERS.model + SHADERS.radiance_model, constants, (state, frame) => this.modelUniforms(state, frame));
    this.programs = new Map();
    this.colours = new Colours(this);
    this.coil = tables.coil;
    this.noFootprint = numbers2D(gl, new Float32Array(1), 1, 1, 1);
    this.empty = gl.createVertexArray();
    this.shader = null;
    this.picture = tables.picture;
    this.normal = this.otherNormal = 1;
    this.scale = 1;
  }

  get sides() {
    return this.shader ? [this.model, this.shader] : [this.model];
  }

  // Puts the shader of 2014 on the other side; null for none.
  setShader(shader2014, variant) {
    if (this.shader) this.shader.dispose();
    this.shader = null;
    if (variant === null) return;
    const text = `#define VARIANT ${VARIANTS[variant]}\n${SHADING}${SHADERS.model}${SHADERS.shader_2014}`;
    this.shader = new Side(this.gl, text, (state) => this.constants(state), (state, frame) => ({
      ...shader2014.uniforms(state), uMatching: this.matching, uPlace: placeOf(state, frame),
    }));
    this.shader.resize(this.width, this.height);
  }

  // The constants of all shaders: of the model, and whether the light is parallel, a disc or a strip.
  constants(state) {
    const { uLightIsDisc, uLightSize } = lightSizeOf(state);
    const light = Math.max(...uLightSize) === 0 ? 0 : uLightIsDisc ? 1 : 2;
    return `${this.colours.constants(state)}${this.spectrum.constants(state)}const int LIGHT = ${light};\n`;
  }

  // A program of model.glsl and other text, which are kept.
  programOf(state, ...text) {
    const whole = [this.constants(state), SHADING, SHADERS.model, ...text].join("\n");
    if (!this.programs.has(whole)) this.programs.set(whole, new Program(this.gl, SHADERS.quad_vertex, whole));
    return this.programs.get(whole);
  }

  modelUniforms(state, frame) {
    return {
      ...this.spectrum.uniforms(state),
      ...this.colours.uniforms(),
      uSky: state.sky / Math.PI,
      uFirst: frame,
      uBase: state.hasBase && state.material === "dielectric" ? colourOfPigment(state.pigment) : [0, 0, 0],
    };
  }

  resize(width, height) {
    if (this.width === width && this.height === height) return;
    Object.assign(this, { width, height });
    if (this.geometry) this.geometry.dispose();
    this.geometry = new Target(this.gl, width, height, 3, true);
    this.geometryFrame = -1;
    for (const side of this.sides) side.resize(width, height);
  }

  restart() {
    this.geometryFrame = -1;
    for (const side of this.sides) side.restart();
  }

  // The size that is drawn: smaller while a slow device is busy.
  get drawn() {
    return [Math.ceil(this.width * this.scale), Math.ceil(this.height * this.scale)];
  }

  quad() {
    const { gl } = this;
    gl.bindVertexArray(this.empty);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  // Draws where the shape is seen: in a circle about the middle, as some renderers shade what is beside it as well.
  shape(state, camera) {
    const { gl } = this;
    const [width, height] = this.drawn;
    const radius = RADII[state.shape] ?? Infinity, whole = Math.hypot(width, height) / 2;
    const seen = radius < state.distance ? radius / Math.sqrt(state.distance ** 2 - radius ** 2) / camera.tangents[0] : Infinity;
    const half = Math.ceil(Math.min((seen * width) / 2, whole)) + 1;  // a pixel for the jitter
    gl.viewport(Math.round(width / 2) - half, Math.round(height / 2) - half, 2 * half, 2 * half);
    gl.bindVertexArray(this.empty);
    gl.drawArrays(gl.TRIANGLE_FAN, 0, 16);
  }

  // Positions and normals of a frame, where they are not there already.
  drawGeometry(state, camera, frame) {
    if (frame === this.geometryFrame) return;
    this.geometryFrame = frame;
    const { gl } = this;
    const [width, height] = this.drawn;
    const jitter = frame === 0 ? [0, 0] : R2.map((step) => fraction(0.5 + frame * step) - 0.5);
    this.geometry.bind(width, height);
    for (let i = 0; i < 3; i++) gl.clearBufferfv(gl.COLOR, i, [0, 0, 0, 0]);
    if (state.shape in ANALYTIC) {
      gl.disable(gl.DEPTH_TEST);
      this.analytic.use({
        uShape: ANALYTIC[state.shape],
        uEye: camera.eye,
        uCamera: [...camera.right, ...camera.up, ...camera.back],
        uTangentOfView: camera.tangents,
        uJitter: jitter,
        uSize: [width, height],
        uFromRadius: Number(state.fromRadius),
        uWall: [PLATE.height, PLATE.side, PLATE.wall, 0],
        uRings: this.data.rings || [0, 0, 1],
      });
      this.shape(state, camera);
      return;
    }
    gl.clearBufferfi(gl.DEPTH_STENCIL, 0, 1, 0);
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.CULL_FACE);
    this.mesh.use({ uProjection: projectionOf(camera, jitter, width, height), uEye: camera.eye, uScales: SCALES[state.scales] });
    this.coil.mesh.draw();
    gl.disable(gl.CULL_FACE);
    gl.disable(gl.DEPTH_TEST);
  }

  // Continues the frame of a side for about `budget` ms, in the columns from first to end (0 to 1).
  draw(side, state, [first, end], budget) {
    const { gl } = this;
    const [width, height] = this.drawn;
    const camera = cameraOf(state, width, height);
    const { frame } = side;
    this.drawGeometry(state, camera, frame);
    const turn = radians(state.orientation);
    const [uPosition, uNormal, uTangent] = this.geometry.textures;
    const [before, after] = side.means;
    const [left, right] = [Math.floor(first * width), Math.ceil(end * width)];
    after.bind(width, height);
    side.programOf(state).use({
      ...side.uniforms(state, frame),
      uPosition, uNormal, uTangent,
      uBefore: before.textures[0],
      uWeight: 1 / (frame + 1),
      uEye: camera.eye,
      uLight: towardsLight(state),
      uPlate: plateOf(state),
      uLightSize: lightSizeOf(state).uLightSize,
      uSin: Math.sin(turn),
      uCos: Math.cos(turn),
    });
    gl.enable(gl.SCISSOR_TEST);
    after.read(0, 0, 1, 1);  // The time of what was drawn before is not that of the rows.
    const start = performance.now();
    let now = start;
    while (side.row < height && now - start < budget) {
      const rows = Math.min(side.band, height - side.row);
      gl.scissor(left, side.row, Math.max(right - left, 1), rows);
      after.bind(width, height);
      this.shape(state, camera);
      after.read(left, side.row, 1, 1);  // waits until it is drawn
      side.row += rows;
      const spent = performance.now() - now;
      now += spent;
      side.spent += spent;
      side.band = Math.min(Math.max(Math.round((side.band * budget) / (3 * Math.max(spent, 0.5))), 1), 4 * side.band);
    }
    gl.disable(gl.SCISSOR_TEST);
    if (side.row >= height) {
      side.means = [after, before];
      side.milliseconds = side.spent;
      Object.assign(side, { frame: frame + 1, row: 0, spent: 0 });
    }
  }

  // The ground as it is seen, for display.glsl.
  groundUniforms(state) {
    const camera = cameraOf(state, this.width, this.height);
    const isCoil = state.shape === "coil";
    return {
      uHasGround: Number(!state.difference || state.right === "none"),
      uShape: isCoil ? Object.keys(ANALYTIC).length : ANALYTIC[state.shape],
      uEye: camera.eye,
      uCamera: [...camera.right, ...camera.up, ...camera.back],
      uTangentOfView: camera.tangents,
      uGround: isCoil ? this.coil.lowest : GROUND_HEIGHTS[state.shape] || 0,
      uLight: lightOf(state),
      uHalfWidth: lightSizeOf(state).uLightSize[0],
      uRings: this.data.rings || [0, 0, 1],
      uFootprint: isCoil ? this.coil.footprint : this.noFootprint,
    };
  }

  drawScreen(state, background) {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, gl.drawingBufferWidth, gl.drawingBufferHeight);
    const { width, height, picture } = this;
    const isPicture = state.right === "picture";
    const other = isPicture ? picture.texture : (this.shader || this.model).mean.textures[0];
    const exposure = 2 ** state.exposure;
    this.screen.use({
      ...this.groundUniforms(state),
      uScreen: [gl.drawingBufferWidth, gl.drawingBufferHeight],
      uMean: this.model.mean.textures[0],
      uOther: other,
      uScale: this.scale,
      uOtherScale: isPicture ? pictureScale(picture, width, height) : [this.scale, this.scale, 0, 0],
      uOtherIsPicture: Number(isPicture),
      uExposure: exposure * this.normal,
      uOtherExposure: exposure * (isPicture ? this.normal : this.otherNormal),
      uDivider: state.right === "none" ? 1e6 : state.divider * gl.drawingBufferWidth,
      uDifference: Number(state.difference && state.right !== "none"),
      uBackground: background,
    });
    this.quad();
  }

  // Encoded sRGB of XYZ as it is shown where its brightest channel is at the shoulder, 0 to 1.
  displayed(xyz, state) {
    const { gl } = this;
    const target = new Target(gl, 1, 1);
    target.bind();
    const uMean = numbers2D(gl, Float32Array.from([...xyz, 1]), 1, 1, 4);
    this.screen.use({
      ...this.groundUniforms(state), uHasGround: 0, uScreen: [1, 1],
      uMean, uOther: uMean, uScale: 1, uOtherScale: [1, 1, 0, 0], uOtherIsPicture: 0,
      uExposure: 0.8 / Math.max(...toRGB(xyz), 1e-30), uOtherExposure: 1, uDivider: 1e6, uDifference: 0, uBackground: [0, 0, 0],
    });
    this.quad();
    const values = target.read(0, 0, 1, 1);
    target.dispose();
    return [...values.slice(0, 3)];
  }

  // XYZ and coverage of the mean of a side, from the lowest row up: (height, width, 4).
  readMean(side = this.model) {
    const [width, height] = this.drawn;
    return { width, height, values: side.mean.read(0, 0, width, height) };
  }

  // The exposure that shows the picture well: color.auto_exposure of the package.
  autoExposure(side = this.model) {
    const { values } = this.readMean(side);
    const peaks = [];
    for (let i = 0; i < values.length; i += 4) {
      if (values[i + 3] > 0) {
        const peak = Math.max(...toRGB([values[i], values[i + 1], values[i + 2]])) / values[i + 3];
        if (peak > 0) peaks.push(peak);
      }
    }
    const at = (sorted, p) => sorted[Math.min(Math.floor(p * sorted.length), sorted.length - 1)];
    peaks.sort((a, b) => a - b);
    if (peaks.length === 0) return 1;
    const floor = 1e-3 * at(peaks, 0.99);
    return 1 / at(peaks.filter((peak) => peak > floor), 0.97);
  }

  // The same for the model; where the light is not seen, its sky stays dim.
  exposureOf(state) {
    return Math.min(this.autoExposure(), state.sky > 0 ? (0.4 * Math.PI) / state.sky : Infinity);
  }

  // f cos theta_o of pairs, (n, 7): omega_i, omega_o along the pattern's axes, lambda in nm.
  evaluatePairs(state, pairs) {
    const values = this.evaluate(this.programOf(state, SHADERS.pairs), this.spectrum.uniforms(state), pairs);
    return Float32Array.from({ length: pairs.length / 7 }, (_, i) => values[4 * i]);
  }

  // XYZ under parallel light for pairs, as above without lambda in use: (n, 4).
  evaluateColours(state, pairs) {
    while (!this.colours.isReady) this.colours.prepare(state, Infinity);
    const parallel = { ...state, lightWidth: 0, lightLength: 0, sky: 0 };
    return this.evaluate(this.programOf(parallel, SHADERS.radiance_model, SHADERS.pairs_model), this.modelUniforms(parallel, 0), pairs);
  }

  // Linear RGB of the shader of 2014 for pairs, as above: (n, 4).
  evaluateShader(shader2014, state, pairs) {
    const program = this.programOf(state, `#define VARIANT ${VARIANTS[state.right]}`, SHADERS.shader_2014, SHADERS.pairs_2014);
    return this.evaluate(program, { ...shader2014.uniforms(state), uMatching: this.matching, uPlace: [0, 0] }, pairs);
  }

  evaluate(program, uniforms, pairs) {
    const { gl } = this;
    const count = pairs.length / 7;
    const width = Math.min(count, 1024);
    const height = Math.ceil(count / width);
    const [incident, outgoing] = [new Float32Array(4 * width * height), new Float32Array(4 * width * height)];
    for (let i = 0; i < count; i++) {
      incident.set([pairs[7 * i], pairs[7 * i + 1], pairs[7 * i + 2], pairs[7 * i + 6]], 4 * i);
      outgoing.set([pairs[7 * i + 3], pairs[7 * i + 4], pairs[7 * i + 5]], 4 * i);
    }
    const target = new Target(gl, width, height);
    target.bind();
    program.use({
      ...uniforms,
      uIncident: numbers2D(gl, incident, width, height, 4),
      uOutgoing: numbers2D(gl, outgoing, width, height, 4),
    });
    this.quad();
    const values = target.read(0, 0, width, height);
    target.dispose();
    return values;
  }
}
