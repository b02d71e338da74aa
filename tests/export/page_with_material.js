// The page of test_material_for_three.py: pictures by the material, as numbers.
import * as THREE from 'three/webgpu';
import { Fn, textureLoad, ivec2, screenCoordinate, vec4, float } from 'three/tsl';
import { loadDiffraction, DiffractionBRDF, DiffractionMaterial } from './module/diffraction-material.js';

async function drawn(scene, camera, width, height = width) {
  const renderer = new THREE.WebGPURenderer({ forceWebGL: true, antialias: false });
  await renderer.init();
  renderer.setSize(width, height);
  renderer.shadowMap.enabled = true;
  const target = new THREE.RenderTarget(width, height, { type: THREE.FloatType, colorSpace: THREE.LinearSRGBColorSpace });
  renderer.setRenderTarget(target);
  await renderer.render(scene, camera);
  const pixels = Array.from(await renderer.readRenderTargetPixelsAsync(target, 0, 0, width, height));
  renderer.dispose();
  return pixels;
}
// f cos of pairs of directions, as XYZ; pairs are 8 numbers, ω_i and ω_o.
window.pairs = async (name, pairs, radius) => {
  const data = await loadDiffraction(name), brdf = new DiffractionBRDF(data), count = pairs.length / 8;
  const texture = new THREE.DataTexture(new Float32Array(pairs), 2 * count, 1, THREE.RGBAFormat, THREE.FloatType);
  texture.needsUpdate = true;
  const material = new THREE.NodeMaterial();
  material.fragmentNode = Fn(() => {
    const pair = screenCoordinate.x.toInt(), direction = (k) => textureLoad(texture, ivec2(pair.mul(2).add(k), 0)).xyz.toVar();
    return vec4(brdf.evaluate(direction(0), direction(1), radius ? float(radius) : null), 1);
  })();
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
    spot: () => new THREE.SpotLight(color, 1, 0, 1) }[options.light]?.();
  if (light) {
    light.position.set(...options.position);
    light.userData = options.lamp ?? {};
    scene.add(light);
  }
  if (options.shadow) {
    light.castShadow = true;
    const screen = new THREE.Mesh(new THREE.PlaneGeometry(6, 6), new THREE.MeshBasicNodeMaterial({ side: THREE.DoubleSide }));
    screen.position.set(...options.position).multiplyScalar(0.5);
    screen.castShadow = true;
    screen.layers.set(1);
    light.shadow.camera.layers?.enable(1);
    scene.add(screen);
  }
  return drawn(scene, camera, options.size);
};
window.isReady = true;
