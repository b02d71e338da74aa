// The page of test_material_for_three.py: pictures by the material, as numbers.
import * as THREE from 'three';
import { loadDiffraction, shadingOf, DiffractionMaterial } from './module/diffraction-material.js';

const renderer = new THREE.WebGLRenderer({ antialias: false });
renderer.shadowMap.enabled = true;

function drawn(scene, camera, width, height = width) {
  renderer.setSize(width, height);
  const target = new THREE.WebGLRenderTarget(width, height, { type: THREE.FloatType, colorSpace: THREE.LinearSRGBColorSpace });
  renderer.setRenderTarget(target);
  renderer.render(scene, camera);
  const pixels = new Float32Array(4 * width * height);
  renderer.readRenderTargetPixels(target, 0, 0, width, height, pixels);
  return Array.from(pixels);
}
// f cos of pairs of directions, as XYZ; pairs are 8 numbers, ω_i and ω_o.
window.pairs = async (name, pairs) => {
  const data = await loadDiffraction(name), count = pairs.length / 8;
  const texture = new THREE.DataTexture(new Float32Array(pairs), 2 * count, 1, THREE.RGBAFormat, THREE.FloatType);
  texture.needsUpdate = true;
  const uniforms = { ...data.uniforms, uHeightScale: 1, uPairs: texture };
  const material = new THREE.ShaderMaterial({
    glslVersion: THREE.GLSL3, uniforms: Object.fromEntries(Object.entries(uniforms).map(([name, value]) => [name, { value }])),
    vertexShader: 'void main() { gl_Position = vec4(position.xy, 0.0, 1.0); }',
    fragmentShader: `uniform highp sampler2D uPairs;
${shadingOf(data)}
out vec4 oColour;
vec3 underSky(vec3 XYZ, vec3 wi, float solidAngle) { return XYZ; }
void main() {
  int pair = int(gl_FragCoord.x);
  vec3 wi = texelFetch(uPairs, ivec2(2 * pair, 0), 0).xyz, wo = texelFetch(uPairs, ivec2(2 * pair + 1, 0), 0).xyz;
  oColour = vec4(ofLamp(wi, vec3(0.0), vec3(0.0), true, wo), 1.0);
}`,
  });
  const scene = new THREE.Scene();
  scene.add(new THREE.Mesh(new THREE.PlaneGeometry(2, 2), material));
  return drawn(scene, new THREE.OrthographicCamera(-1, 1, 1, -1, -1, 1), count, 1);
};
// A square of 2 × 2 in the plane z = 0 from above, in light of one kind; linear sRGB.
window.plane = async (name, options) => {
  const scene = new THREE.Scene(), camera = new THREE.PerspectiveCamera(40, 1, 0.1, 50), color = 0xffffff;
  camera.position.set(...options.eye);
  camera.up.set(0, 1, 0);
  camera.lookAt(0, 0, 0);
  const material = new DiffractionMaterial(await loadDiffraction(name), { ...options.material, side: THREE.DoubleSide });
  const geometry = new THREE.PlaneGeometry(2, 2);
  const mesh = options.instanced ? new THREE.InstancedMesh(geometry, material, 1) : new THREE.Mesh(geometry, material);
  if (options.instanced) mesh.setMatrixAt(0, new THREE.Matrix4());
  mesh.receiveShadow = true;
  scene.add(mesh);
  if (options.sky) {
    const texels = new Uint16Array(64 * 32 * 4).fill(THREE.DataUtils.toHalfFloat(1));
    const sky = new THREE.DataTexture(texels, 64, 32, THREE.RGBAFormat, THREE.HalfFloatType);
    Object.assign(sky, { mapping: THREE.EquirectangularReflectionMapping, needsUpdate: true });
    scene.environment = sky;
  }
  const light = { directional: () => new THREE.DirectionalLight(color, 1), point: () => new THREE.PointLight(color, 1),
    spot: () => new THREE.SpotLight(color, 1, 0, 1),
    area: () => new THREE.RectAreaLight(color, 1, ...options.sizes ?? []) }[options.light]?.();
  if (light) {
    light.position.set(...options.position);
    if (light.isRectAreaLight) light.lookAt(0, 0, 0);
    light.userData = options.lamp ?? {};
    scene.add(light);
  }
  if (options.shadow) {
    light.castShadow = true;
    const screen = new THREE.Mesh(new THREE.PlaneGeometry(6, 6), new THREE.MeshBasicMaterial({ side: THREE.DoubleSide }));
    screen.position.set(...options.position).multiplyScalar(0.5);
    screen.castShadow = true;
    screen.layers.set(1);
    light.shadow.camera.layers?.enable(1);
    scene.add(screen);
  }
  return drawn(scene, camera, options.size);
};
window.isReady = true;
