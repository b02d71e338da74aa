// Starts the page.

const MAX_FRAMES = 64;
const EXPOSED_FRAMES = [1, 4];  // after which the exposure is found
const BUDGET_MILLISECONDS = 80;  // of drawing between two turns of the page
const LAMP_DISTANCE = 1.2;
const BUSY_MILLISECONDS = 60;  // of a frame, above which fewer pixels are drawn at first, and while dragging
const PREVIEW_SCALE = 0.25;
const TURNING = location.hash === "#turn";  // alone, without controls, one surface after the other
const TURN = { degrees: 12, surface: 15 };  // a second; seconds

const shapeOf = (data) => (data.shape === "coil" && !data.coil ? "sphere" : data.shape);

// A skin on a snake, a designed plate before its wall, a disc that mirrors a small lamp; other surfaces on a
// plate or a sphere, in a sky that shows a metal as metal.
function firstView(data) {
  if (shapeOf(data) === "coil") {
    return { azimuth: -60, elevation: 38, distance: 4.6, lightAzimuth: -20, lightElevation: 40,
      lightWidth: 8, lightLength: 0, sky: 0.05, hasBase: data.inScene.material === "", pigment: "#100c0a",
      scales: data.scales };
  }
  const isDielectric = data.inScene.material === "";
  if (shapeOf(data) === "wall") {
    return { azimuth: -90, elevation: 50, distance: 5.2, lightAzimuth: -90, lightElevation: 70,
      lightWidth: 0.5, lightLength: 0, sky: 0, hasBase: false, pigment: "#141a22" };
  }
  if (shapeOf(data) === "disc") {
    return { azimuth: -90, elevation: 45, distance: 4.6, lightAzimuth: 98, lightElevation: 26,
      lightWidth: 5, lightLength: 0, sky: 0.15, hasBase: isDielectric, pigment: "#141a22" };
  }
  const lines = data.spectrum.max_order.includes(0);
  return { azimuth: -90, elevation: 20, distance: 5.2, lightAzimuth: -75, lightElevation: 35,
    lightWidth: 6, lightLength: lines ? 60 : 0, sky: isDielectric ? 0.02 : 0.5, hasBase: isDielectric, pigment: "#141a22" };
}

function initialState(data) {
  const { inScene, spectrum } = data;
  return {
    shape: shapeOf(data), scales: "none", ...firstView(data), exposure: 0,
    orientation: inScene.orientation,
    fromRadius: inScene.from_radius,
    heightScale: inScene.height_scale,
    coat: inScene.coat_ior, air: inScene.air,
    coherenceLength: spectrum.coherence_length,
    material: inScene.material === "" ? "dielectric" : inScene.material,
    index: inScene.int_ior,
    right: "none", divider: 0.5, difference: false,
    quirks: allQuirks(true), terms: 37, brightness: PUBLISHED_BRIGHTNESS,
    maxFrames: MAX_FRAMES,
  };
}

function prepareControls(data, number) {
  const { spectrum } = data;
  $("title").textContent = document.title = data.name;
  $("of-surfaces").hidden = NAMES.length === 1;
  for (const [i, name] of NAMES.entries()) $("surface").add(new Option(name, i));
  $("surface").value = number;
  $("surface").addEventListener("input", () => show(Number($("surface").value)));
  const options = [["dielectric", "dielectric"], ["none", "perfect mirror"], ...Object.keys(data.metals).map((m) => [m, m])];
  for (const [value, text] of options) $("material").add(new Option(text, value));
  if (shapeOf(data) !== "wall") $("shape").querySelector("[value=wall]").remove();
  // The coil's tangents follow its body.
  if (!data.coil || data.inScene.from_radius) $("shape").querySelector("[value=coil]").remove();
  $("orientation").disabled = data.inScene.from_radius;
  $("heightScale").max = data.inScene.max_height_scale;
  $("coat").max = data.inScene.coat_ior;
  $("coat").closest(".row").hidden = data.inScene.coat_ior === 1;
  const [shortest, longest] = coherenceLengths(spectrum);
  Object.assign($("coherenceLength"), { min: Math.log(shortest), max: Math.log(longest), step: "any" });
  $("coherenceLength").disabled = shortest === longest;
  Object.assign($("brightness"), { min: Math.log(10), max: Math.log(100000), step: "any" });
  if (!data.heights) for (const name of Object.keys(VARIANTS)) $("right").querySelector(`[value=${name}]`).remove();
  if (!data.picture) $("right").querySelector("[value=picture]").remove();
  $("source").textContent = data.source;
  $("summary").textContent = data.summary;
  if (spectrum.warning) {
    $("warning").textContent = spectrum.warning;
    $("warning").hidden = false;
  }
}

const NAMES = JSON.parse($("names").textContent);
const MAIN = document.querySelector("main").innerHTML;
let stop = () => {};  // ends the view before
let turn = 0;  // of starts, as the next may begin before the last is done

// Shows the surface of this number in the list of the page.
async function start(number = 0) {
  stop();
  stop = () => {};
  const mine = ++turn;
  document.querySelector("main").innerHTML = MAIN;
  const data = JSON.parse($(`data${number || ""}`).textContent);
  window.SHADERS = JSON.parse($("shaders").textContent);
  const canvas = $("canvas");
  const gl = contextOf(canvas);
  matching = (await decoded(data.light)).values;
  const metals = {};
  for (const [name, content] of Object.entries(data.metals)) {
    const { values } = await decoded(content);
    metals[name] = { values, texture: numbers2D(gl, values, 471, 1, 2) };
  }
  const tables = {
    table: await decoded(data.spectrum.table),
    metals,
    light: matching,
    coil: data.coil && (await coilOf(gl, data.coil)),
    picture: data.picture && (await pictureOf(gl, data.picture)),
  };
  const heights = data.heights && [(await decoded(data.heights.values)).values, await tapersOf(data.heights)];
  if (mine !== turn) return;
  const renderer = new Renderer(gl, data, tables);
  const shader2014 = data.heights && new Shader2014(gl, data.heights, ...heights, renderer.spectrum);
  const state = initialState(data);
  let dirty = true;
  let exposed = { model: false, shader: false };
  let variant = "none";
  prepareControls(data, number);
  const controls = new Controls(state, () => { dirty = true; }, {
    auto: () => {
      exposed = { model: false, shader: false };
      dirty = true;
    },
    copy: () => copyCommand(data, state, tables.coil),
    reset: () => controls.set({ shape: shapeOf(data), ...firstView(data), exposure: 0 }),
    full: () => (document.fullscreenElement ? document.exitFullscreen() : $("stage").requestFullscreen()),
    save: () => {
      paint();  // what is not drawn now is no longer there
      canvas.toBlob((blob) => download(`${data.name}.png`, blob));
    },
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

  // Makes what the chosen shader needs; true when it can draw.
  let preparing = false;
  let textures = null;
  function prepared() {
    const wanted = state.right in VARIANTS ? state.right : "none";
    if (wanted !== "none" && shader2014.kindOf(state) !== textures) {
      if (!preparing) {
        preparing = true;
        const kind = shader2014.kindOf(state);
        const progress = (x) => { $("progress").textContent = x < 1 ? `transforms of the heights: ${Math.round(100 * x)} %` : ""; };
        shader2014.prepare(state, progress).then(() => {
          [preparing, textures, dirty] = [false, kind, true];
        });
      }
      if (variant !== wanted) renderer.setShader(null, null);
      variant = "none";
      return;
    }
    if (wanted === variant) return;
    renderer.setShader(shader2014, wanted === "none" ? null : wanted);
    [variant, exposed.shader, dirty] = [wanted, false, true];
  }

  // The columns that a side needs.
  function region(side) {
    if (state.right === "none" || state.difference) return [0, 1];
    if (!exposed[side === renderer.model ? "model" : "shader"] && side.frame === 0) return [0, 1];
    return side === renderer.model ? [0, state.divider] : [state.divider, 1];
  }

  function expose(side, name) {
    if (exposed[name] || side.row > 0 || !EXPOSED_FRAMES.includes(side.frame)) return;
    if (name === "model") renderer.normal = renderer.exposureOf(state);
    else renderer.otherNormal = renderer.autoExposure(side);
    // What was drawn for the exposure alone is drawn again in the columns of the side.
    exposed[name] = name === "shader" || side.frame === EXPOSED_FRAMES.at(-1);
  }

  // A picture of fewer pixels is shown until the first frame is complete.
  let held = false;
  function paint() {
    held &&= renderer.model.frame === 0;
    if (!held) renderer.drawScreen(state, background());
  }

  function draw(budget = BUDGET_MILLISECONDS) {
    while (!renderer.colours.shown) renderer.colours.prepare(state, Infinity);
    // The first frame of this model does not wait for a slow shader.
    const sides = renderer.model.frame === 0 ? [renderer.model] : renderer.sides;
    const busy = sides.filter((side) => side.frame < state.maxFrames);
    for (const side of busy) {
      renderer.draw(side, state, region(side), budget / busy.length);
      expose(side, side === renderer.model ? "model" : "shader");
    }
    paint();
    showTimes(renderer, state);
  }

  function preview() {
    renderer.scale = PREVIEW_SCALE;
    renderer.restart();
    draw(Infinity);
    renderer.scale = 1;
    renderer.restart();
    held = true;
  }

  let stopped = false;
  let before = null;
  function turnOn(now) {
    state.azimuth += TURN.degrees * Math.min((now - (before ?? now)) / 1000, 0.1);
    state.lightAzimuth += 0.4 * TURN.degrees * Math.min((now - (before ?? now)) / 1000, 0.1);
    before = now;
    dirty = true;
  }

  function tick(now) {
    if (stopped) return;
    if (TURNING && !controls.dragging) turnOn(now);
    const moving = controls.dragging || TURNING;
    fit();
    prepared();
    const slow = renderer.sides.some((side) => !(side.milliseconds <= BUSY_MILLISECONDS) || side.row > 0);
    if (moving && dirty && slow) renderer.scale = Math.max(renderer.scale / 2, 0.25);
    else if (!moving && renderer.scale < 1) {
      renderer.scale = 1;
      dirty = true;
    }
    if (renderer.colours.prepare(state, BUDGET_MILLISECONDS, controls.dragging)) dirty = true;
    if (dirty) {
      dirty = false;
      if (slow && !moving) preview();
      else {
        held = false;
        renderer.restart();
        draw();
      }
    } else if (renderer.sides.some((side) => side.frame < state.maxFrames)) draw();
    requestAnimationFrame(tick);
  }

  fit();
  preview();
  dirty = false;
  requestAnimationFrame(tick);
  const redraw = () => {
    if (!held) paint();
    else dirty = true;
  };
  const resized = new ResizeObserver(() => { dirty = true; });
  resized.observe(canvas);
  const dark = matchMedia("(prefers-color-scheme: dark)");
  dark.addEventListener("change", redraw);
  stop = () => {
    stopped = true;
    resized.disconnect();
    dark.removeEventListener("change", redraw);
    gl.getExtension("WEBGL_lose_context")?.loseContext();
  };
  const picker = new Picker(renderer, state);
  controls.pick = (x, y) => picker.pick(x, y);
  Object.assign(window.viewer, {
    state, renderer, data, picker,
    set: (changes) => controls.set(changes),
    evaluate: (pairs) => Array.from(renderer.evaluatePairs(state, Float32Array.from(pairs))),
    evaluateColours: (pairs) => Array.from(renderer.evaluateColours(state, Float32Array.from(pairs))),
    evaluateShader: async (pairs) => {
      await shader2014.prepare(state, () => {});
      return Array.from(renderer.evaluateShader(shader2014, state, Float32Array.from(pairs)));
    },
    command: () => commandOf(data, state),
    scene: () => sceneOf(data, state, tables.coil),
  });
}

function showTimes(renderer, state) {
  const of = (side) => (Number.isNaN(side.milliseconds) ? "…" : `${Number(side.milliseconds.toPrecision(3))} ms`);
  const drawing = Boolean(renderer.shader) && renderer.shader.frame === 0;
  $("drawing").hidden = !drawing;
  showLamp(state, renderer.width, renderer.height);
  const texts = [
    ...(hasNoGPU(renderer.gl) ? ["This browser has no GPU: the processor draws, in seconds a frame."] : []),
    `This model: ${of(renderer.model)} a frame; ${renderer.model.frame} of ${state.maxFrames} frames.`,
  ];
  if (renderer.shader) texts.push(`Shader of 2014: ${of(renderer.shader)} a frame; ${renderer.shader.frame} averaged.`);
  $("times").textContent = texts.join(" ");
}

// The lamp where its direction is seen, just outside of the surface.
function showLamp(state, width, height) {
  const camera = cameraOf(state, width, height);
  const place = state.shape === "wall" ? lampOfPlate(state) : scaled(lightOf(state), LAMP_DISTANCE);
  const depth = state.distance - dot(place, camera.back);
  const at = [camera.right, camera.up].map((axis, i) => dot(place, axis) / (depth * camera.tangents[i]));
  const clipped = at.map((x) => Math.min(Math.max(x, -0.97), 0.97));
  $("lamp").style.left = `${50 + 50 * clipped[0]}%`;
  $("lamp").style.top = `${50 - 50 * clipped[1]}%`;
  $("lamp").classList.toggle("behind", dot(place, camera.back) < 0);
}

function download(name, blob) {
  const link = Object.assign(document.createElement("a"), { href: URL.createObjectURL(blob), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

async function pictureOf(gl, picture) {
  const { values, shape } = await decoded(picture);
  const [height, width] = shape;
  return { width, height, texture: numbers2D(gl, values, width, height, 3) };
}

window.viewer = {};
document.body.classList.toggle("turning", TURNING);
function show(number) {
  if (TURNING) setTimeout(() => show((number + 1) % NAMES.length), 1000 * TURN.surface);
  window.viewer.ready = start(number).catch((error) => {
    const text = error instanceof NotSupported ? error.message : `This page failed: ${error.message}`;
    $("failure").textContent = text;
    $("failure").hidden = false;
    document.body.classList.add("failed");
    if (!(error instanceof NotSupported)) throw error;
  });
}
show(0);
