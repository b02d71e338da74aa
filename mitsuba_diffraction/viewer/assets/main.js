// Starts the page.

const MAX_FRAMES = 128;
const EXPOSED_FRAMES = [1, 4, 16];  // after which the exposure is found, from less and less noise
const BUSY_MILLISECONDS = 60;  // of a frame while dragging, above which fewer pixels are drawn

function initialState(data) {
  const { material, spectrum } = data;
  return {
    shape: "sphere",
    azimuth: -90, elevation: 20, distance: 5,
    lightAzimuth: -50.7, lightElevation: 51.7, lightWidth: 3, lightLength: spectrum.max_order.includes(0) ? 30 : 0,
    sky: 0.02, exposure: 0,
    orientation: material.orientation,
    heightScale: material.height_scale,
    coherenceLength: spectrum.coherence_length,
    material: material.material === "" ? "dielectric" : material.material,
    index: material.int_ior,
    hasBase: false, pigment: "#40301c",
    wavelengths: 48,
    drag: "light",
    maxFrames: MAX_FRAMES,
  };
}

function prepareControls(data) {
  const { spectrum } = data;
  const options = [["dielectric", "dielectric"], ["none", "perfect mirror"], ...Object.keys(data.metals).map((m) => [m, m])];
  for (const [value, text] of options) $("material").add(new Option(text, value));
  if (!data.coil) $("shape").querySelector("[value=coil]").remove();
  $("heightScale").max = data.material.max_height_scale;
  const [shortest, longest] = coherenceLengths(spectrum);
  Object.assign($("coherenceLength"), { min: Math.log(shortest), max: Math.log(longest), step: "any" });
  $("coherenceLength").disabled = shortest === longest;
  $("source").textContent = data.source;
  if (spectrum.warning) {
    $("warning").textContent = spectrum.warning;
    $("warning").hidden = false;
  }
}

async function start() {
  const data = JSON.parse($("data").textContent);
  window.SHADERS = JSON.parse($("shaders").textContent);
  const canvas = $("canvas");
  const gl = contextOf(canvas);
  const light = (await decoded(data.light)).values;
  matching = light;
  const metals = {};
  for (const [name, content] of Object.entries(data.metals)) {
    metals[name] = numbers2D(gl, (await decoded(content)).values, 471, 1, 2);
  }
  const coil = data.coil && (await coilOf(gl, data.coil));
  const renderer = new Renderer(gl, data, { table: await decoded(data.spectrum.table), metals, light, coil });
  renderer.normal = 1;
  const state = initialState(data);
  let dirty = true;
  let exposed = false;
  prepareControls(data);
  const controls = new Controls(state, () => { dirty = true; }, {
    auto: () => { exposed = false; dirty = true; },
  });

  const background = () => {
    const colour = getComputedStyle(canvas).backgroundColor.match(/[\d.]+/g).slice(0, 3);
    return colour.map((c) => c / 255);
  };

  function fit() {
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    const width = Math.max(Math.round(canvas.clientWidth * ratio), 1);
    const height = Math.max(Math.round(canvas.clientHeight * ratio), 1);
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    renderer.resize(width, height);
  }

  function draw() {
    if (dirty) {
      renderer.restart();
      dirty = false;
    }
    renderer.drawFrame(state, () => [0, 1]);
    if (!exposed && EXPOSED_FRAMES.includes(renderer.frame)) {
      renderer.normal = renderer.autoExposure();
      exposed = renderer.frame === EXPOSED_FRAMES.at(-1);
    }
    renderer.drawScreen(state, background());
    $("time").textContent = `${renderer.model.milliseconds.toFixed(1)} ms`;
    $("frames").textContent = `${renderer.frame} of ${state.maxFrames}`;
  }

  function tick() {
    fit();
    const slow = renderer.model.milliseconds > BUSY_MILLISECONDS;
    if (controls.dragging && dirty && slow) renderer.scale = Math.max(renderer.scale / 2, 0.25);
    else if (!controls.dragging && renderer.scale < 1) {
      renderer.scale = 1;
      dirty = true;
    }
    if (dirty || renderer.frame < state.maxFrames) draw();
    requestAnimationFrame(tick);
  }

  fit();
  draw();
  requestAnimationFrame(tick);
  new MutationObserver(() => { dirty = true; }).observe(document.documentElement, { attributes: true });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { dirty = true; });
  Object.assign(window.viewer, {
    state, renderer, data,
    set: (changes) => controls.set(changes),
    evaluate: (pairs) => Array.from(renderer.evaluatePairs(state, Float32Array.from(pairs))),
  });
}

window.viewer = {};
window.viewer.ready = start().catch((error) => {
  const text = error instanceof NotSupported ? error.message : `This page failed: ${error.message}`;
  $("failure").textContent = text;
  $("failure").hidden = false;
  document.body.classList.add("failed");
  if (!(error instanceof NotSupported)) throw error;
});
