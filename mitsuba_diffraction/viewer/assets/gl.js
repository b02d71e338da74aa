// WebGL2: programs, textures of numbers, targets.

const HEADER = "#version 300 es\nprecision highp float;\nprecision highp int;\nprecision highp sampler2D;\n";

class NotSupported extends Error {}

function contextOf(canvas) {
  const gl = canvas.getContext("webgl2", { antialias: false, alpha: false, preserveDrawingBuffer: true });
  if (!gl) throw new NotSupported("This page needs WebGL2, which this browser does not offer.");
  if (!gl.getExtension("EXT_color_buffer_float")) {
    throw new NotSupported("This page needs WebGL2 with float targets (EXT_color_buffer_float), which this device does not offer.");
  }
  return gl;
}

// Whether the processor draws: software renderers of browsers have these names.
function hasNoGPU(gl) {
  const info = gl.getExtension("WEBGL_debug_renderer_info");
  const name = gl.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : gl.RENDERER);
  return /swiftshader|llvmpipe|softpipe|software/i.test(name);
}

class Program {
  constructor(gl, vertex, ...fragment) {
    this.gl = gl;
    this.program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment.join("\n")]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, HEADER + text);
      gl.compileShader(shader);
      gl.attachShader(this.program, shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS) && !gl.isContextLost()) {
        throw new Error(gl.getShaderInfoLog(shader));
      }
    }
    gl.linkProgram(this.program);
    if (!gl.getProgramParameter(this.program, gl.LINK_STATUS) && !gl.isContextLost()) {
      throw new Error(gl.getProgramInfoLog(this.program));
    }
    this.uniforms = new Map();
    const count = gl.getProgramParameter(this.program, gl.ACTIVE_UNIFORMS);
    for (let i = 0; i < count; i++) {
      const info = gl.getActiveUniform(this.program, i);
      this.uniforms.set(info.name.replace("[0]", ""), { type: info.type, place: gl.getUniformLocation(this.program, info.name) });
    }
  }

  // Sets the uniforms of these names that the program has; textures get a unit each.
  use(values) {
    const { gl } = this;
    gl.useProgram(this.program);
    let unit = 0;
    for (const [name, { type, place }] of this.uniforms) {
      const value = values[name];
      if (value === undefined) throw new Error(`no value of ${name}`);
      switch (type) {
        case gl.FLOAT: gl.uniform1f(place, value); break;
        case gl.FLOAT_VEC2: gl.uniform2fv(place, value); break;
        case gl.FLOAT_VEC3: gl.uniform3fv(place, value); break;
        case gl.FLOAT_VEC4: gl.uniform4fv(place, value); break;
        case gl.FLOAT_MAT3: gl.uniformMatrix3fv(place, false, value); break;
        case gl.FLOAT_MAT4: gl.uniformMatrix4fv(place, false, value); break;
        case gl.INT: case gl.BOOL: gl.uniform1i(place, value); break;
        case gl.INT_VEC2: case gl.BOOL_VEC2: gl.uniform2iv(place, value); break;
        default:
          gl.activeTexture(gl.TEXTURE0 + unit);
          gl.bindTexture(value.kind, value.texture);
          gl.uniform1i(place, unit);
          unit += 1;
      }
    }
  }
}

function texture(gl, kind) {
  const made = gl.createTexture();
  gl.bindTexture(kind, made);
  for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(kind, name, gl.NEAREST);
  for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(kind, name, gl.CLAMP_TO_EDGE);
  return { kind, texture: made };
}

function formatOf(gl, components, half) {
  const formats = {
    1: [gl.RED, gl.R16F, gl.R32F], 2: [gl.RG, gl.RG16F, gl.RG32F],
    3: [gl.RGB, gl.RGB16F, gl.RGB32F], 4: [gl.RGBA, gl.RGBA16F, gl.RGBA32F],
  };
  const [format, of16, of32] = formats[components];
  return [half ? of16 : of32, format, half ? gl.HALF_FLOAT : gl.FLOAT];
}

// A texture of (height, width, components) numbers.
function numbers2D(gl, values, width, height, components) {
  const made = texture(gl, gl.TEXTURE_2D);
  const [internal, format, type] = formatOf(gl, components, values instanceof Uint16Array);
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  gl.texImage2D(gl.TEXTURE_2D, 0, internal, width, height, 0, format, type, values);
  return made;
}

// An array texture of (layers, height, width, components) numbers.
function numbers3D(gl, values, width, height, layers, components) {
  const made = texture(gl, gl.TEXTURE_2D_ARRAY);
  const [internal, format, type] = formatOf(gl, components, values instanceof Uint16Array);
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  gl.texImage3D(gl.TEXTURE_2D_ARRAY, 0, internal, width, height, layers, 0, format, type, values);
  return made;
}

// Float textures to draw into, with a depth buffer if `depth`.
class Target {
  constructor(gl, width, height, count = 1, depth = false) {
    Object.assign(this, { gl, width, height });
    this.framebuffer = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.framebuffer);
    this.textures = [];
    for (let i = 0; i < count; i++) {
      const made = texture(gl, gl.TEXTURE_2D);
      gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA32F, width, height);
      gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + i, gl.TEXTURE_2D, made.texture, 0);
      this.textures.push(made);
    }
    gl.drawBuffers(this.textures.map((_, i) => gl.COLOR_ATTACHMENT0 + i));
    this.depth = null;
    if (depth) {
      this.depth = gl.createRenderbuffer();
      gl.bindRenderbuffer(gl.RENDERBUFFER, this.depth);
      gl.renderbufferStorage(gl.RENDERBUFFER, gl.DEPTH_COMPONENT24, width, height);
      gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.RENDERBUFFER, this.depth);
    }
  }

  bind(width = this.width, height = this.height, x = 0) {
    this.gl.bindFramebuffer(this.gl.FRAMEBUFFER, this.framebuffer);
    this.gl.viewport(x, 0, width, height);
  }

  read(x, y, width, height) {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.framebuffer);
    gl.readBuffer(gl.COLOR_ATTACHMENT0);
    const values = new Float32Array(4 * width * height);
    gl.readPixels(x, y, width, height, gl.RGBA, gl.FLOAT, values);
    return values;
  }

  dispose() {
    const { gl } = this;
    for (const made of this.textures) gl.deleteTexture(made.texture);
    if (this.depth) gl.deleteRenderbuffer(this.depth);
    gl.deleteFramebuffer(this.framebuffer);
  }
}
