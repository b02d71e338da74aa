// The scales of scenes/snake.py over u and v of the coil, along the body towards the snout and around it; the numbers that
// are random for each scale are others.
uniform int uScales;  // none (0), of Elaphe (1), of Xenopeltis (2)

const float TURN = 2.0 * 3.14159265, BODY = 147.24990;  // length of the body in radii
const float BELLY = 0.13, PITCH = 4.2, ELONGATION = 1.33, ROUNDNESS = 6.0;
const float HEAD_PLATES = 3.3, HEAD_RADIUS = 0.928, AROUND = 0.95 * TURN, MOUTH = 0.335;  // cm
// Plates of the head: distance from the snout in cm, and from the back as a fraction of the circumference, to both sides.
const vec2 PLATES[13] = vec2[](vec2(0.05, 0.0), vec2(1.8, 0.0), vec2(0.5, 0.07), vec2(1.0, 0.08), vec2(1.75, 0.2),
  vec2(2.7, 0.085), vec2(2.5, 0.21), vec2(3.1, 0.22), vec2(1.0, 0.2), vec2(0.45, 0.2), vec2(3.6, 0.2), vec2(3.6, 0.12),
  vec2(3.6, 0.04));

// smooth_step of scenes/modelling.py and its derivative.
vec2 stepOf(float x, float start, float end) {
  float t = clamp((x - start) / (end - start), 0.0, 1.0);
  return vec2(t * t * (3.0 - 2.0 * t), 6.0 * t * (1.0 - t) / (end - start));
}

// Three numbers of mean 0 and standard deviation 1 for each scale.
vec3 randomOf(uint number) {
  vec4 u;
  for (int k = 0; k < 4; k++) {
    number = number * 747796405u + 2891336453u;
    uint h = ((number >> ((number >> 28) + 4u)) ^ number) * 277803737u;
    u[k] = (float((h >> 22) ^ h) + 0.5) / 4294967296.0;
  }
  vec2 radius = sqrt(-2.0 * log(u.xz));
  return vec3(radius.x * cos(TURN * u.y), radius.x * sin(TURN * u.y), radius.y * cos(TURN * u.w));
}

// Slopes of a plate of the head along u and v, and its number; x from the snout in cm, `angle` from the back.
vec3 plateOf(float x, float angle) {
  vec3 nearest = vec3(1e9, 0.0, 0.0), second = nearest;  // distance, and its derivatives by x and by the angle
  int number = 0;
  for (int k = 0; k < 27; k++) {
    vec2 site = k < 13 ? PLATES[k] : k < 20 ? vec2(0.35 + 0.5 * float(k - 13), 0.28) : vec2(0.3 + 0.5 * float(k - 20), 0.39);
    for (int side = site.y > 0.0 ? -1 : 1; side <= 1; side += 2) {
      vec2 from = vec2(x, AROUND * angle) - vec2(site.x, AROUND * float(side) * site.y);
      float size = length(from);
      vec3 found = vec3(size, from * vec2(1.0, AROUND) / max(size, 1e-6));
      if (size < nearest.x) {
        second = nearest;
        nearest = found;
        number = 2 * k + max(side, 0);
      } else if (size < second.x) second = found;
    }
  }
  vec2 groove = stepOf(second.x - nearest.x, 0.0, 0.1), open = stepOf(x, 3.0, 2.8);
  float across = (abs(angle) - MOUTH) / 0.012, lips = exp(-across * across);
  vec2 slope = groove.y * (second.yz - nearest.yz);
  if (1.5 * lips * open.x > 1.0 - groove.x) slope = 1.5 * lips * vec2(-open.y, 2.0 * across / 0.012 * sign(angle) * open.x);
  return vec3(clamp(0.02 * slope * vec2(-1.0, 1.0 / (0.9 * TURN)), -0.6, 0.6), float(100000 + number));
}

// Slopes of the scales along u and v, and the angle to the pattern's x axis.
vec3 scaleAt(vec2 uv) {
  bool elaphe = uScales == 1;
  float rows = elaphe ? 48.0 : 32.0, dome = elaphe ? 0.16 : 0.1, tilt = elaphe ? 0.05 : 0.03, roll = elaphe ? 0.55 : 0.5;
  float x = (1.0 - uv.x) * BODY, y = uv.y * rows;
  float along = x * rows / TURN, number = 0.0;
  vec2 slope;
  if (abs(uv.y - 0.5) > 0.5 - BELLY) {
    float column = floor(along / PITCH);
    slope = vec2(roll * stepOf(along / PITCH - column, 0.85, 1.0).x - 0.02, 0.0);
    number = column * 64.0 + 63.0;
  } else {
    vec3 nearest = vec3(1e9);  // distance, along the body and around it, in widths
    for (float across = -1.0; across <= 1.0; across++) {
      float j = floor(y) + across, stagger = 0.5 * mod(j, 2.0), i = round(along / PITCH - stagger);
      vec2 from = vec2(along - (i + stagger) * PITCH, y - j - 0.5);
      float size = length(from / vec2(ELONGATION, 1.0));
      if (size < nearest.x) {
        nearest = vec3(size, from);
        number = floor(i + stagger) * 64.0 + mod(j, rows);
      }
    }
    vec2 at = nearest.yz, slant = vec2(0.5 * PITCH / (ELONGATION * ELONGATION), 1.0);
    slant *= 2.0 / (0.25 * PITCH * PITCH / (ELONGATION * ELONGATION) + 1.0);
    vec3 sides = max(vec3(dot(abs(at), slant), abs(at.y), abs(at.x) * 2.0 / PITCH), 1e-6);
    float edge = pow(dot(pow(sides, vec3(ROUNDNESS)), vec3(1.0)), 1.0 / ROUNDNESS);
    vec3 weights = pow(sides / edge, vec3(ROUNDNESS - 1.0));
    vec2 outward = sign(at) * (weights.x * slant + vec2(weights.z * 2.0 / PITCH, weights.y));
    float groove = sin(0.5 * TURN * clamp((edge - 0.6) / 0.4, 0.0, 1.0)), flatness = 1.0 - stepOf(edge, 0.6, 1.0).x;
    float rim = roll * groove * groove * (0.6 + 0.8 * at.x / PITCH);
    slope = vec2(-tilt, -dome * at.y) * flatness - vec2(-rim, rim) * normalize(outward + 1e-9);
  }
  float cm = x * HEAD_RADIUS, weight = stepOf(cm, HEAD_PLATES + 0.3, HEAD_PLATES - 0.3).x;
  if (weight > 0.0) {
    vec3 plate = plateOf(cm, uv.y - 0.5);
    slope = mix(slope, plate.xy, weight);
    if (weight > 0.5) number = plate.z;
  }
  vec3 random = randomOf(uint(max(number, 0.0)));
  return vec3(slope + (elaphe ? 0.02 : 0.012) * random.xy, radians(elaphe ? 5.0 : 4.0) * random.z);
}
