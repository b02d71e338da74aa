// The scene and the command that path-trace the view.

function element(name, value) {
  const kind = typeof value === "boolean" ? "boolean" : typeof value === "string" ? "string" : "float";
  const text = String(value).replace(/&/g, "&amp;").replace(/"/g, "&quot;").replace(/</g, "&lt;");
  return `<${kind} name="${name}" value="${text}"/>`;
}

const list = (v) => v.map((x) => Number(x.toFixed(5))).join(", ");

function sceneOf(data, state, coil) {
  const grating = { ...data.grating };
  const own = data.spectrum.coherence_length;
  const differs = Math.abs(state.coherenceLength / own - 1) > 1e-3;
  if (grating.profile && differs) grating.coherence_length = Number(state.coherenceLength.toPrecision(4));
  const material = state.material === "dielectric" ? { int_ior: state.index } : { material: state.material };
  const orientation = state.fromRadius ? (state.orientation === 0 ? "radial" : "tangential") : state.orientation;
  const coat = state.coat === 1 ? {} : { coat_ior: state.coat };
  // A texture of directions for each scale, which the pattern's own angle would replace.
  const scales = state.shape === "coil" ? state.scales : "none";
  const turned = scales !== "none" && orientation === 0;
  const parameters = { ...grating, ...material, ...coat, ...(turned ? {} : { orientation }), height_scale: state.heightScale, conserve_energy: false };
  const lines = Object.entries(parameters).map(([name, value]) =>
    data.integers.includes(name) ? element(name, value).replace(/float/, "integer") : element(name, value));
  if (state.hasBase && state.material === "dielectric") {
    lines.push(`<bsdf type="diffuse" name="base"><rgb name="reflectance" value="${list(linearOf(state.pigment))}"/></bsdf>`);
  }
  if (turned) lines.push(coilTexture("orientation", scales, "turn", "nearest"));
  const note = differs && !grating.profile
    ? `  <!-- The view has a coherence length of ${state.coherenceLength.toPrecision(4)} um, the file ${own.toPrecision(4)}. -->\n` : "";
  const camera = cameraOf(state, 1, 1);
  const light = lightOf(state);
  const { uLightIsDisc, uLightSize } = lightSizeOf(state);
  const far = 1000;
  const area = (uLightIsDisc ? Math.PI : 4) * uLightSize[0] * uLightSize[1];
  const emitter = area === 0
    ? `<emitter type="directional"><vector name="direction" value="${list(scaled(light, -1))}"/><spectrum name="irradiance" type="d65"/></emitter>`
    : `<shape type="${uLightIsDisc ? "disk" : "rectangle"}">
    <transform name="to_world"><scale x="${far * uLightSize[0]}" y="${far * uLightSize[1]}"/><lookat origin="${list(scaled(light, far))}" target="0, 0, 0" up="0, 0, 1"/></transform>
    <emitter type="area"><spectrum name="radiance" type="d65"><float name="scale" value="${1 / area}"/></spectrum></emitter>
  </shape>`;
  const sky = state.sky > 0 ? skyOf(state.sky / Math.PI, 2 * far) : "";
  const shape = { sphere: ["sphere", ""], plate: ["rectangle", ""], disc: ["disk", ""] }[state.shape] || ["ply",
    `<string name="filename" value="scenes/coil/snake.ply"/>
    <transform name="to_world"><translate value="${list(scaled(coil.middle, -1))}"/><scale value="${coil.scale.toFixed(6)}"/></transform>
    `];
  const skin = `<bsdf type="diffraction_grating">
      ${lines.join("\n      ")}
    </bsdf>`;
  const bsdf = scales === "none" ? skin : `<bsdf type="normalmap">${coilTexture("normalmap", scales, "normals", "bilinear")}
    ${skin}</bsdf>`;
  // Light that a grating casts on a wall is found by `diffraction_path`.
  const [integrator, depth] = state.shape === "wall" ? ["diffraction_path", 3] : ["path", 2];
  const { width, height } = $("canvas");
  return `<scene version="3.0.0">
${note}  <integrator type="${integrator}"><integer name="max_depth" value="${depth}"/></integrator>
  <sensor type="perspective">
    <float name="fov" value="${FIELD_OF_VIEW}"/><string name="fov_axis" value="smaller"/>
    <transform name="to_world"><lookat origin="${list(camera.eye)}" target="0, 0, 0" up="0, 0, 1"/></transform>
    <film type="hdrfilm"><integer name="width" value="${width}"/><integer name="height" value="${height}"/><rfilter type="box"/></film>
  </sensor>
${state.shape === "wall" ? wallOf(state, bsdf) : `  <shape type="${shape[0]}">
    ${shape[1]}${state.shape === "disc" && data.rings ? ofRings(data.rings, state.coat, bsdf) : bsdf}
  </shape>
  ${emitter}`}${sky}
</scene>`;
}

const coilTexture = (name, scales, kind, filter) => `<texture type="bitmap" name="${name}">
      <string name="filename" value="scenes/coil/${scales}_${kind}.exr"/><boolean name="raw" value="true"/><string name="filter_type" value="${filter}"/></texture>`;

// A plate above a wall that it faces, and the torch at it.
function wallOf(state, bsdf) {
  const { height, side, wall, lamp } = PLATE;
  const beam = (Math.atan(side / lamp) * 180) / Math.PI;
  return `  <shape type="rectangle">
    <transform name="to_world"><scale value="${side}"/><lookat origin="0, 0, ${height}" target="0, 0, 0" up="0, 1, 0"/></transform>
    ${bsdf}
  </shape>
  <shape type="rectangle">
    <transform name="to_world"><scale value="${wall}"/></transform>
    <bsdf type="diffuse"><rgb name="reflectance" value="0.8"/></bsdf>
  </shape>
  <emitter type="spot"><float name="cutoff_angle" value="${beam.toFixed(3)}"/><float name="beam_width" value="${(0.99 * beam).toFixed(3)}"/>
    <spectrum name="intensity" type="d65"/>
    <transform name="to_world"><lookat origin="${list(lampOfPlate(state))}" target="0, 0, ${height}" up="1, 0, 0"/></transform>
  </emitter>`;
}

const [GROUND, ZENITH] = [0.5, 5];  // as in model.glsl
const SKY_DISCS = 12;

// The sky: constant, and above the horizon discs one behind the other, each for its range of elevations.
function skyOf(radiance, far) {
  const of = (value) => `<spectrum name="radiance" type="d65"><float name="scale" value="${(radiance * value).toPrecision(6)}"/></spectrum>`;
  const discs = Array.from({ length: SKY_DISCS }, (_, k) => {
    const low = Math.max(1 - (k + 1) / SKY_DISCS, 0.01);
    const [height, middle] = [far + 10 * k, 1 - (k + 0.5) / SKY_DISCS];
    const radius = height * Math.sqrt(1 / low ** 2 - 1);
    return `
  <shape type="disk">
    <transform name="to_world"><scale x="${radius.toFixed(1)}" y="${radius.toFixed(1)}"/><lookat origin="0, 0, ${height}" target="0, 0, 0" up="0, 1, 0"/></transform>
    <emitter type="area">${of(GROUND + (ZENITH - GROUND) * middle ** 2)}</emitter>
  </shape>`;
  });
  return `\n  <emitter type="constant">${of(GROUND)}</emitter>${discs.join("")}`;
}

// A texture that is one where u, of a disk the radius, lies between two numbers, and zero elsewhere.
function ring(name, first, last) {
  const scale = 0.5 / (last - first);
  return `<texture type="checkerboard" name="${name}"><float name="color0" value="0"/><float name="color1" value="1"/>
      <transform name="to_uv"><scale x="${scale.toFixed(6)}" y="1e-6"/><translate x="${(-first * scale).toFixed(6)}" y="1e-7"/></transform></texture>`;
}

// A grating between two radii of a clear disc with a hole.
function ofRings([hole, first, last], coat, bsdf) {
  if (coat === 1) return `<bsdf type="mask">${ring("opacity", first, last)}
    ${bsdf}</bsdf>`;
  return `<bsdf type="mask">${ring("opacity", hole, 1.5)}
    <bsdf type="blendbsdf">${ring("weight", first, last)}
    <bsdf type="thindielectric"><float name="int_ior" value="${coat}"/></bsdf>
    ${bsdf}</bsdf></bsdf>`;
}

// The same words in bash and PowerShell.
function commandOf(data, state) {
  const examples = state.shape in ANALYTIC ? [] : ["mitsuba-diffraction examples"];
  return [...(data.command ? [data.command] : []), ...examples, "mitsuba-diffraction render view.xml --spp 64", ""].join("\n");
}

function copyCommand(data, state, coil) {
  download("view.xml", new Blob([sceneOf(data, state, coil)], { type: "text/xml" }));
  const text = commandOf(data, state);
  const file = data.grating.filename && !data.command ? `In a folder with ${data.grating.filename} and view.xml:\n` : "In the folder of view.xml:\n";
  $("command").value = file + text;
  $("command").hidden = false;
  navigator.clipboard?.writeText(text).catch(() => {});
}
