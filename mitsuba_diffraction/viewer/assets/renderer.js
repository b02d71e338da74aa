// Draws: positions and normals (geometry), the mean of frames of each side, the screen.

const GOLDEN = 0.6180339887498949;
const R2 = [0.7548776662466927, 0.5698402909980532];  // steps of a two-dimensional sequence (Roberts 2018)
const fraction = (x) => x - Math.floor(x);

// One of the two shaders: its program, its uniforms, and the mean of its frames.
class Side {
  constructor(gl, text, uniforms) {
    this.gl = gl;
    this.program = new Program(gl, SHADERS.quad_vertex, text, SHADERS.shade);
    this.uniforms = uniforms;
    this.means = [];
    this.milliseconds = NaN;
  }

  resize(width, height) {
    for (const target of this.means) target.dispose();
    this.means = [new Target(this.gl, width, height), new Target(this.gl, width, height)];
  }

  get mean() {
    return this.means[0];
  }
}

class Renderer {
  constructor(gl, data, tables) {
    this.gl = gl;
    this.data = data;
    this.spectrum = new Spectrum(gl, data.spectrum, tables.table, tables.metals);
    this.matching = numbers2D(gl, tables.light, 471, 1, 4);
    this.analytic = new Program(gl, SHADERS.quad_vertex, SHADERS.analytic);
    this.mesh = new Program(gl, SHADERS.mesh_vertex, SHADERS.mesh);
    this.screen = new Program(gl, SHADERS.quad_vertex, SHADERS.display);
    this.model = new Side(gl, SHADERS.model + SHADERS.radiance_model, (state) => this.modelUniforms(state));
    this.coil = tables.coil;
    this.empty = gl.createVertexArray();
    this.frame = 0;
    this.scale = 1;
  }

  get sides() {
    return [this.model];
  }

  modelUniforms(state) {
    return {
      ...this.spectrum.uniforms(state),
      uMatching: this.matching,
      uWavelengths: state.wavelengths,
      uSky: state.sky / Math.PI,
    };
  }

  resize(width, height) {
    if (this.width === width && this.height === height) return;
    Object.assign(this, { width, height });
    if (this.geometry) this.geometry.dispose();
    this.geometry = new Target(this.gl, width, height, 3, true);
    for (const side of this.sides) side.resize(width, height);
    this.restart();
  }

  restart() {
    this.frame = 0;
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

  drawGeometry(state, camera, jitter) {
    const { gl } = this;
    const [width, height] = this.drawn;
    this.geometry.bind(width, height);
    if (state.shape in ANALYTIC) {
      gl.disable(gl.DEPTH_TEST);
      this.analytic.use({
        uShape: ANALYTIC[state.shape],
        uEye: camera.eye,
        uCamera: [...camera.right, ...camera.up, ...camera.back],
        uTangentOfView: camera.tangents,
        uJitter: jitter,
        uSize: [width, height],
      });
      this.quad();
      return;
    }
    for (let i = 0; i < 3; i++) gl.clearBufferfv(gl.COLOR, i, [0, 0, 0, 0]);
    gl.clearBufferfi(gl.DEPTH_STENCIL, 0, 1, 0);
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.CULL_FACE);
    this.mesh.use({ uProjection: projectionOf(camera, jitter, width, height) });
    this.coil.mesh.draw();
    gl.disable(gl.CULL_FACE);
    gl.disable(gl.DEPTH_TEST);
  }

  // Adds a frame to the mean of each side; `regions` has the columns that each needs, (first, end) from 0 to 1.
  drawFrame(state, regions) {
    const { gl, frame } = this;
    const [width, height] = this.drawn;
    const camera = cameraOf(state, width, height);
    const jitter = frame === 0 ? [0, 0] : R2.map((step) => fraction(0.5 + frame * step) - 0.5);
    this.drawGeometry(state, camera, jitter);
    const turn = radians(state.orientation);
    const [uPosition, uNormal, uTangent] = this.geometry.textures;
    gl.enable(gl.SCISSOR_TEST);
    for (const side of this.sides) {
      const [first, end] = regions(side).map((x) => Math.round(x * width));
      if (first >= end) continue;
      const start = performance.now();
      const [before, after] = side.means;
      after.bind(width, height);
      gl.scissor(first, 0, end - first, height);
      side.program.use({
        ...side.uniforms(state),
        uPosition, uNormal, uTangent,
        uBefore: before.textures[0],
        uWeight: 1 / (frame + 1),
        uEye: camera.eye,
        uLight: lightOf(state),
        ...lightSizeOf(state),
        uRandom: R2.map((step) => fraction(0.5 + frame * step)),
        uOffset: fraction(0.5 + frame * GOLDEN),
        uSin: Math.sin(turn),
        uCos: Math.cos(turn),
      });
      this.quad();
      side.means = [after, before];
      after.read(first, 0, 1, 1);  // waits until it is drawn
      side.milliseconds = performance.now() - start;
    }
    gl.disable(gl.SCISSOR_TEST);
    this.frame += 1;
  }

  drawScreen(state, background) {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, gl.drawingBufferWidth, gl.drawingBufferHeight);
    this.screen.use({
      uMean: this.model.mean.textures[0],
      uExposure: 2 ** state.exposure * this.normal,
      uBackground: background,
      uScale: this.scale,
    });
    this.quad();
  }

  // XYZ and coverage of the mean of a side, from the lowest row up: (height, width, 4).
  readMean(side = this.model) {
    const [width, height] = this.drawn;
    return { width, height, values: side.mean.read(0, 0, width, height) };
  }

  // The exposure that shows the picture well: color.auto_exposure of the package.
  autoExposure() {
    const { values } = this.readMean();
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

  // f cos theta_o of pairs, (n, 7): omega_i, omega_o along the pattern's axes, lambda in nm.
  evaluatePairs(state, pairs) {
    const { gl } = this;
    this.pairs ??= new Program(gl, SHADERS.quad_vertex, SHADERS.model, SHADERS.pairs);
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
    this.pairs.use({
      ...this.spectrum.uniforms(state),
      uIncident: numbers2D(gl, incident, width, height, 4),
      uOutgoing: numbers2D(gl, outgoing, width, height, 4),
    });
    this.quad();
    const values = target.read(0, 0, width, height);
    target.dispose();
    return Float32Array.from({ length: count }, (_, i) => values[4 * i]);
  }
}
