// The spectrum of a pixel, and the orders that reach the eye there.

const DARK = 1e-6;  // f cos theta, 1/sr, of what no eye sees

// XYZ under the light of the page of values at equidistant wavelengths, [nm, value].
function coloursOf(values) {
  const step = values[1][0] - values[0][0];
  const sum = [0, 0, 0];
  for (const [nm, value] of values) {
    const i = 4 * (nm - 360);
    for (let k = 0; k < 3; k++) sum[k] += step * value * matching[i + 3] * matching[i + k];
  }
  return sum;
}

class Picker {
  constructor(renderer, state) {
    Object.assign(this, { renderer, state });
  }

  // Directions along the pattern's axes at a pixel of the canvas, from its upper left corner; null beside the surface.
  directionsAt(x, y) {
    const { renderer, state } = this;
    const { gl, geometry } = renderer;
    const [width, height] = renderer.drawn;
    const camera = cameraOf(state, width, height);
    renderer.geometryFrame = -1;  // The state may have changed since the last frame.
    renderer.drawGeometry(state, camera, 0);
    const at = [Math.floor(x * renderer.scale), height - 1 - Math.floor(y * renderer.scale)];
    gl.bindFramebuffer(gl.FRAMEBUFFER, geometry.framebuffer);
    const [position, normal, tangent] = geometry.textures.map((_, i) => {
      gl.readBuffer(gl.COLOR_ATTACHMENT0 + i);
      const found = new Float32Array(4);
      gl.readPixels(...at, 1, 1, gl.RGBA, gl.FLOAT, found);
      return [...found];
    });
    if (position[3] === 0) return null;
    const n = unit(normal.slice(0, 3));
    const s = unit(sum(tangent.slice(0, 3), scaled(n, -dot(n, tangent))));
    const t = cross(n, s);
    const turn = radians(state.orientation);
    const axes = [sum(scaled(s, Math.cos(turn)), scaled(t, Math.sin(turn))), sum(scaled(t, Math.cos(turn)), scaled(s, -Math.sin(turn))), n];
    const local = (v) => axes.map((axis) => dot(axis, v));
    const mean = renderer.model.mean.read(...at, 1, 1);
    return {
      wi: local(towardsLight(state)),
      wo: local(outgoingAt(state, camera, position.slice(0, 3))),
      luminance: mean[1] / (mean[3] || 1),  // of the pixel, with all of the lamp and the sky
    };
  }

  // f cos theta_i from 380 to 740 nm, in steps of 2 nm, of parallel light.
  spectrumOf({ wi, wo }) {
    const wavelengths = Array.from({ length: 181 }, (_, i) => 380 + 2 * i);
    const pairs = wavelengths.flatMap((nm) => [...wi, ...wo, nm]);
    const values = this.renderer.evaluatePairs(this.state, Float32Array.from(pairs));
    return wavelengths.map((nm, i) => [nm, wo[2] > 0 && wi[2] > 0 ? (values[i] * wi[2]) / wo[2] : 0]);
  }

  // The orders (m_x, m_y) within whose lobes the eye lies, with their wavelengths in nm.
  ordersOf({ wi, wo }) {
    const { spectrum } = this.renderer.data;
    if (spectrum.kind !== "orders" || Math.max(...spectrum.tile_size) > 12) return [];
    const t = [-(wi[0] + wo[0]), -(wi[1] + wo[1])];
    const square = t[0] ** 2 + t[1] ** 2;
    const far = 4 * lobeWidth(this.state.coherenceLength);
    const found = [];
    const [M, N] = spectrum.max_order;
    for (let m = -M; m <= M; m++) {
      for (let n = -N; n <= N; n++) {
        const q = [m / spectrum.tile_size[0], n / spectrum.tile_size[1]];
        const perLambda = square > 0 ? (q[0] * t[0] + q[1] * t[1]) / square : 0;
        if (m === 0 && n === 0) {
          if (Math.sqrt(square) / 0.56 < far) found.push({ order: [0, 0], nanometres: null });
          continue;
        }
        const lambda = 1e3 / perLambda;
        const distance = Math.hypot(q[0] - t[0] * perLambda, q[1] - t[1] * perLambda);
        if (lambda >= 380 && lambda <= 740 && distance < far) found.push({ order: [m, n], nanometres: lambda });
      }
    }
    return found;
  }

  pick(x, y) {
    const found = this.directionsAt(x, y);
    $("picked").hidden = !found;
    if (!found) return null;
    const values = this.spectrumOf(found);
    const orders = this.ordersOf(found);
    const xyz = coloursOf(values);
    const rgb = toRGB(xyz);
    const hex = `#${this.renderer.displayed(xyz, this.state).map((c) => Math.round(255 * c).toString(16).padStart(2, "0")).join("")}`;
    $("swatch").hidden = !(xyz[1] > 0);
    $("swatch").style.background = hex;
    const angle = (v) => `${((Math.acos(Math.min(Math.max(v[2], -1), 1)) * 180) / Math.PI).toFixed(1)}°`;
    const isLine = this.renderer.data.spectrum.max_order[1] === 0;
    const named = orders.map(({ order, nanometres }) =>
      `${isLine ? order[0] : `(${order.join(", ")})`}${nanometres === null ? "" : ` at ${nanometres.toFixed(0)} nm`}`);
    const digits = (v) => v.map((x) => x.toPrecision(3)).join(", ");
    $("picked-text").textContent = [
      `Light at ${angle(found.wi)}, eye at ${angle(found.wo)} from the normal.`,
      this.remark(values, found.luminance),
      named.length ? `Orders, by the grating equation: ${named.join("; ")}.` : "",
      `Curve in daylight: ${xyz[1] > 0 ? `${hex}, ` : ""}XYZ ${digits(xyz)}; linear sRGB ${digits(rgb)}.`,
    ].join(" ");
    this.plot(values, orders);
    return { ...found, values, orders, xyz, rgb, hex };
  }

  // What a dark spectrum beside a colour means: it is that of the middle of the lamp alone.
  remark(values, luminance) {
    if (Math.max(...values.map(([, value]) => value)) > DARK) return "";
    const { lightWidth, sky, coat } = this.state;
    const others = [
      ...(lightWidth > 0 ? ["other parts of the lamp"] : []),
      ...(sky > 0 ? ["the sky"] : []),
      ...(lightWidth > 0 && coat > 1 ? ["the image of the lamp in the clear layer"] : []),
    ];
    return luminance > DARK && others.length
      ? `From the middle of the lamp nothing is diffracted to the eye; the colour is from ${others.join(" or ")}.`
      : "Nothing is diffracted from this light to the eye.";
  }

  plot(values, orders) {
    const peak = Math.max(...values.map(([, value]) => value), DARK);
    const x = (nm) => (((nm - 380) / 360) * 280).toFixed(1);
    const y = (value) => (92 - (74 * value) / peak).toFixed(1);
    const make = (name, attributes, text = "") => {
      const element = document.createElementNS("http://www.w3.org/2000/svg", name);
      for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
      element.textContent = text;
      return element;
    };
    const line = make("polyline", { points: values.map(([nm, value]) => `${x(nm)},${y(value)}`).join(" "), class: "curve" });
    const marks = orders.filter(({ nanometres }) => nanometres !== null)
      .map(({ nanometres }) => make("line", { x1: x(nanometres), x2: x(nanometres), y1: 4, y2: 92, class: "mark" }));
    const axis = make("line", { x1: 0, x2: 280, y1: 92, y2: 92, class: "axis" });
    const labels = [400, 500, 600, 700].map((nm) => make("text", { x: x(nm), y: 106, "text-anchor": "middle" }, `${nm}`));
    const top = make("text", { x: 2, y: 10 }, `f cos θ ${peak > DARK ? `up to ${peak.toPrecision(3)} sr⁻¹` : "in sr⁻¹: zero"}`);
    const below = make("text", { x: 140, y: 120, "text-anchor": "middle" }, "wavelength in nm");
    $("plot").replaceChildren(axis, ...marks, line, ...labels, top, below);
  }
}
