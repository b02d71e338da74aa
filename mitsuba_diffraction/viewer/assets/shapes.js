// The meshes of shapes; the others are found by formula (analytic.glsl).

const SCALES = { none: 0, elaphe: 1, xenopeltis: 2 };
const ANALYTIC = { sphere: 0, plate: 1, disc: 2, wall: 3 };
const RADII = { sphere: 1, disc: 1, plate: Math.SQRT2 };  // of what encloses them; others may fill the picture
const GROUND_HEIGHTS = { sphere: -1, plate: -0.06, disc: -0.06 };
const FOOTPRINT = { size: 96, edge: 1.6, blur: 2 };  // texels, half the edge, texels; see ground.glsl

class Mesh {
  // A sheet of points (rows, columns), closed along its rows; the tangent and u follow the columns, by `step` each.
  constructor(gl, points, rows, columns, step) {
    const at = (j, i) => points.subarray(3 * (j * columns + i), 3 * (j * columns + i) + 3);
    const vertices = new Float32Array(11 * rows * columns);
    for (let j = 0; j < rows; j++) {
      for (let i = 0; i < columns; i++) {
        const along = sum(at(j, Math.min(i + 1, columns - 1)), scaled(at(j, Math.max(i - 1, 0)), -1));
        const [before, after] = [j === 0 ? rows - 2 : j - 1, j === rows - 1 ? 1 : j + 1];
        const around = sum(at(after, i), scaled(at(before, i), -1));
        const normal = cross(along, around);
        const length = Math.hypot(...normal) || 1;
        const uv = [Math.min(i * step, 1), j / (rows - 1)];
        vertices.set([...at(j, i), ...scaled(normal, 1 / length), ...unit(along), ...uv], 11 * (j * columns + i));
      }
    }
    const indices = new Uint32Array(6 * (rows - 1) * (columns - 1));
    let k = 0;
    for (let j = 0; j < rows - 1; j++) {
      for (let i = 0; i < columns - 1; i++) {
        const corner = j * columns + i;
        indices.set([corner, corner + 1, corner + columns + 1, corner, corner + columns + 1, corner + columns], k);
        k += 6;
      }
    }
    this.gl = gl;
    this.count = indices.length;
    this.array = gl.createVertexArray();
    gl.bindVertexArray(this.array);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, vertices, gl.STATIC_DRAW);
    for (let place = 0; place < 4; place++) {
      gl.enableVertexAttribArray(place);
      gl.vertexAttribPointer(place, place < 3 ? 3 : 2, gl.FLOAT, false, 44, 12 * place);
    }
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, indices, gl.STATIC_DRAW);
    gl.bindVertexArray(null);
  }

  draw() {
    const { gl } = this;
    gl.bindVertexArray(this.array);
    gl.drawElements(gl.TRIANGLES, this.count, gl.UNSIGNED_INT, 0);
    gl.bindVertexArray(null);
  }
}

// The coiled snake, moved and scaled to about the size of the sphere.
async function coilOf(gl, coil) {
  const { values, shape } = await decoded(coil.positions);
  const [rows, columns] = shape;
  const points = new Float32Array(values.length);
  const middle = coil.origin.map((o, k) => o + (coil.step[k] * 65535) / 2);
  const scale = 2.2 / (65535 * Math.max(coil.step[0], coil.step[1]));
  for (let i = 0; i < values.length; i++) {
    points[i] = scale * (coil.origin[i % 3] + coil.step[i % 3] * values[i] - middle[i % 3]);
  }
  let lowest = Infinity;
  for (let i = 2; i < points.length; i += 3) lowest = Math.min(lowest, points[i]);
  return { mesh: new Mesh(gl, points, rows, columns, coil.step_of_u), middle, scale, lowest, footprint: footprintOf(gl, points) };
}

// Which part of the ground is below points, as a texture, blurred.
function footprintOf(gl, points) {
  const { size, edge, blur } = FOOTPRINT;
  let values = new Float32Array(size * size);
  for (let i = 0; i < points.length; i += 3) {
    const [x, y] = [0, 1].map((k) => Math.floor((0.5 + (0.5 * points[i + k]) / edge) * size));
    if (Math.min(x, y) >= 0 && Math.max(x, y) < size) values[y * size + x] = 1;
  }
  for (const step of [1, size, 1, size]) {
    values = values.map((_, i) => {
      let sum = 0;
      for (let k = -blur; k <= blur; k++) sum += values[i + k * step] || 0;
      return sum / (2 * blur + 1);
    });
  }
  return numbers2D(gl, values, size, size, 1);
}
