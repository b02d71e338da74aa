// What shading.js looks up, made by the device from the spectrum: again when the heights, the coherence length or the
// material change, in bands of rows, so that the page stays responsive. Lengths in um.

// Of a table: nodes along u and w, and wavelengths. Until the last is made, those before are shown.
const TABLES = [{ size: 64, layers: 6, wavelengths: 20 }, { size: 128, layers: 13, wavelengths: 30 }];
const STRETCH = 0.15;  // a
const MIN_W = 0.15;
const CENTRES = 512, WIDTHS = 12, COSINES = 16;  // of the colours of separate orders
const MAX_ORDER_WIDTH = 0.014;  // cycles/um, of overlapping lobes that are added up, as a table would be too coarse

class Colours {
  constructor(renderer) {
    Object.assign(this, { renderer, gl: renderer.gl, spectrum: renderer.spectrum, of: null, shown: null });
    this.framebuffer = this.gl.createFramebuffer();
  }

  // Whether colours are sums over orders: where few overlap, or lobes are too narrow for a table.
  areOrders(state) {
    return this.spectrum.spectrum.kind === "orders" && (this.spectrum.kindAt(state) !== KINDS.window || lobeWidth(state.coherenceLength) < MAX_ORDER_WIDTH);
  }

  // Constants of shading.js.
  constants(state) {
    return this.areOrders(state) ? "#define ORDERS\n" : "";
  }

  // Uniforms of shading.js besides those of the spectrum.
  uniforms() {
    return { ...this.shown, uStretch: STRETCH, uEdge: Math.asinh(MAX_U / STRETCH), uRangeW: this.range };
  }

  rangeW(state) {
    const coat = Math.max(state.coat / state.air, 1);
    return [Math.max(MIN_W, 2 * Math.sqrt(coat ** 2 - 1)), 2 * coat];
  }

  // Continues for about `budget` ms; true when what is shown has changed. Some wait until no slider moves.
  prepare(state, budget, wait = false) {
    const { material, index, coat, heightScale, coherenceLength } = state;
    const of = JSON.stringify([material, index, coat, heightScale, coherenceLength]);
    if (of !== this.of) {
      const sums = this.areOrders(state);
      if (sums !== this.sums) this.show(null);
      if (this.made) this.gl.deleteTexture(this.made.texture);
      Object.assign(this, { of, sums, level: 0, layer: 0, made: null });
    }
    if (this.sums) {
      if (this.level > 0) return false;
      this.show(this.ofOrders(state), this.rangeW(state));
      this.level = TABLES.length;
      return true;
    }
    const start = performance.now();
    while (this.level < TABLES.length && !(wait && this.level > 0) && performance.now() - start < budget) {
      if (this.drawLayer(state)) return true;
    }
    return false;
  }

  get isReady() {
    return this.level === TABLES.length;
  }

  // One layer of a table; true if it is the last.
  drawLayer(state) {
    const { gl, renderer } = this;
    const { size, layers, wavelengths } = TABLES[this.level];
    if (!this.made) {
      this.made = texture(gl, gl.TEXTURE_2D_ARRAY);
      gl.texStorage3D(gl.TEXTURE_2D_ARRAY, Math.log2(size), gl.RGBA16F, size, size, layers);
      this.layer = 0;
    }
    const [first, last] = this.rangeW(state);
    const at = (k) => first + ((last - first) * k) / (layers - 1);
    const coat = last / 2;
    this.draw(state, 0, wavelengths, [size, size], {
      uW: at(this.layer), uStretchOfNodes: STRETCH,
      // The pairs of directions have a w above that of the layer before.
      uMaxU: 2 * Math.min(1, Math.sqrt(Math.max(coat ** 2 - (at(Math.max(this.layer - 1, 0)) / 2) ** 2, 0))),
    }, () => gl.framebufferTextureLayer(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, this.made.texture, 0, this.layer));
    this.layer += 1;
    if (this.layer < layers) return false;
    gl.framebufferTextureLayer(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, this.made.texture, 0, layers >> 1);
    const values = new Float32Array(4 * size * size);
    gl.readPixels(0, 0, size, size, gl.RGBA, gl.FLOAT, values);
    const sums = Float64Array.from({ length: size * size }, (_, k) => values[4 * k] + values[4 * k + 1] + values[4 * k + 2]);
    interpolated(gl, this.made, gl.LINEAR_MIPMAP_LINEAR);
    gl.generateMipmap(gl.TEXTURE_2D_ARRAY);
    this.show({ uColours: this.made, uDrawn: numbers2D(gl, drawnOfTable(sums, size, STRETCH), SAMPLES, 1, 4) }, this.rangeW(state));
    this.level += 1;
    this.made = null;
    return true;
  }

  ofOrders(state) {
    const { gl } = this;
    const [uGaussians, uRatios] = [[CENTRES, WIDTHS], [COSINES, COSINES]].map(([width, height], k) => {
      const made = texture(gl, gl.TEXTURE_2D);
      gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA16F, width, height);
      this.draw(state, k + 1, 90, [width, height], {}, () =>
        gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, made.texture, 0));
      return interpolated(gl, made, gl.LINEAR);
    });
    const perNu = 2 * Math.PI * 0.8 * this.rangeW(state)[1] * state.heightScale;
    const drawn = drawnOfOrders((order, nu) => this.spectrum.powerAt(order, perNu * nu), this.spectrum.spectrum.max_order);
    return { uGaussians, uRatios, uDrawn: numbers2D(gl, drawn, SAMPLES, 1, 4) };
  }

  // A part of table.glsl.
  draw(state, part, wavelengths, size, uniforms, attach) {
    const { gl, renderer, spectrum } = this;
    const program = renderer.programOf(state, `#define PART ${part}\nconst int WAVELENGTHS = ${wavelengths};`, SHADERS.table);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.framebuffer);
    attach();
    gl.viewport(0, 0, ...size);
    program.use({
      ...spectrum.uniforms(state), ...wavelengthsOf(state, spectrum.materials[state.material], wavelengths),
      uMatching: renderer.matching, uSize: size, ...uniforms,
    });
    renderer.quad();
  }

  show(textures, range) {
    for (const made of Object.values(this.shown || {})) this.gl.deleteTexture(made.texture);
    Object.assign(this, { shown: textures, range });
  }
}

// A texture that is read between its texels.
function interpolated(gl, made, filter) {
  gl.bindTexture(made.kind, made.texture);
  gl.texParameteri(made.kind, gl.TEXTURE_MAG_FILTER, gl.LINEAR);
  gl.texParameteri(made.kind, gl.TEXTURE_MIN_FILTER, filter);
  return made;
}
