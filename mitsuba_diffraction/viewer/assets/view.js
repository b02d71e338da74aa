// What the user chooses, and the camera and the light that follow from it.

const radians = (degrees) => (degrees * Math.PI) / 180;
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const scaled = (a, s) => a.map((x) => x * s);
const sum = (a, b) => a.map((x, i) => x + b[i]);
const unit = (a) => scaled(a, 1 / Math.hypot(...a));

const FIELD_OF_VIEW = 28;  // degrees, along the shorter side
const FURTHEST_ELEVATION = 89;

function spherical(azimuth, elevation) {
  const [phi, theta] = [radians(azimuth), radians(elevation)];
  return [Math.cos(theta) * Math.cos(phi), Math.cos(theta) * Math.sin(phi), Math.sin(theta)];
}

function cameraOf(state, width, height) {
  const back = spherical(state.azimuth, state.elevation);
  const right = unit(cross([0, 0, 1], back));
  const up = cross(back, right);
  const tangent = Math.tan(radians(FIELD_OF_VIEW / 2)) / Math.min(width, height);
  return { eye: scaled(back, state.distance), right, up, back, tangents: [tangent * width, tangent * height] };
}

const lightOf = (state) => spherical(state.lightAzimuth, state.lightElevation);

// A small plate above a wall casts light onto it; its lamp lies on the side of the wall.
const PLATE = { height: 1.3, side: 0.06, wall: 1.2, lamp: 0.9 };
const plateOf = (state) => (state.shape === "wall" ? PLATE.height : 0);
const towardsLight = (state) => {
  const [x, y, z] = lightOf(state);
  return [x, y, state.shape === "wall" ? -z : z];
};
const lampOfPlate = (state) => sum([0, 0, PLATE.height], scaled(towardsLight(state), PLATE.lamp));
// Where the light goes from a point of the picture: to the eye, or from the plate to that point of the wall.
const outgoingAt = (state, camera, position) =>
  unit(state.shape === "wall" ? sum(position, [0, 0, -PLATE.height]) : sum(camera.eye, scaled(position, -1)));

// A strip, or a disc if it has no length.
function lightSizeOf(state) {
  const half = (angle) => Math.tan(radians(angle / 2));
  const isDisc = state.lightLength === 0;
  return { uLightIsDisc: Number(isDisc), uLightSize: [half(state.lightWidth), half(isDisc ? state.lightWidth : state.lightLength)] };
}

// Column-major matrix from the world to clip space, shifted by `jitter` pixels.
function projectionOf(camera, jitter, width, height) {
  const [near, far] = [0.1, 100];
  const { eye, right, up, back, tangents } = camera;
  const rows = [
    [...scaled(right, 1 / tangents[0]), -dot(right, eye) / tangents[0]],
    [...scaled(up, 1 / tangents[1]), -dot(up, eye) / tangents[1]],
  ];
  const w = [...scaled(back, -1), dot(back, eye)];
  const shift = [(-2 * jitter[0]) / width, (-2 * jitter[1]) / height];
  const x = rows[0].map((value, i) => value + shift[0] * w[i]);
  const y = rows[1].map((value, i) => value + shift[1] * w[i]);
  const [a, b] = [(far + near) / (far - near), (-2 * far * near) / (far - near)];
  const z = w.map((value, i) => a * value + (i === 3 ? b : 0));
  const matrix = [x, y, z, w];
  return Array.from({ length: 16 }, (_, i) => matrix[i % 4][Math.floor(i / 4)]);
}
