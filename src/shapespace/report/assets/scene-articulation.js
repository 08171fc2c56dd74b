/* Several parts of one subject: shape of each part, and relative pose at their joints; S4 to S6 of docs/structures.md. */
(function () {
  "use strict";

  const mean = (p, rows) => {
    let x = 0, y = 0, z = 0;
    for (const v of rows) { x += p[3 * v]; y += p[3 * v + 1]; z += p[3 * v + 2]; }
    return [x / rows.length, y / rows.length, z / rows.length];
  };
  const minus = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const apply = (R, v) => R.map((row) => dot(row, v));
  const product = (A, B) => A.map((row) => B[0].map((_, c) => row.reduce((sum, value, k) => sum + value * B[k][c], 0)));

  /** The rotation by a rotation vector, as rows (Rodrigues). */
  function exponential(omega) {
    const angle = Math.hypot(...omega), [x, y, z] = omega;
    const a = angle < 1e-6 ? 1 : Math.sin(angle) / angle, b = angle < 1e-6 ? 0.5 : (1 - Math.cos(angle)) / angle ** 2;
    const K = [[0, -z, y], [z, 0, -x], [-y, x, 0]], square = product(K, K);
    return K.map((row, r) => row.map((value, c) => (r === c ? 1 : 0) + a * value + b * square[r][c]));
  }

  /** The inverse of a symmetric matrix, as rows. */
  function inverse([a, b, c]) {
    const columns = [cross(b, c), cross(c, a), cross(a, b)], determinant = dot(a, columns[0]);
    return columns.map((column) => column.map((value) => value / determinant));
  }

  /** Move `p` rigidly to `template`, in place: least squares by the largest eigenvector of Horn's matrix (JOSA A 4, 1987). */
  function align(p, template) {
    const all = Array.from({ length: p.length / 3 }, (_, v) => v), from = mean(p, all), to = mean(template, all);
    const S = [[0, 0, 0], [0, 0, 0], [0, 0, 0]];
    for (let i = 0; i < p.length; i += 3) {
      for (let r = 0; r < 3; r++) for (let c = 0; c < 3; c++) S[r][c] += (p[i + r] - from[r]) * (template[i + c] - to[c]);
    }
    const [[xx, xy, xz], [yx, yy, yz], [zx, zy, zz]] = S, size = Math.hypot(...S.flat());
    let N = [[xx + yy + zz, yz - zy, zx - xz, xy - yx], [yz - zy, xx - yy - zz, xy + yx, zx + xz], [zx - xz, xy + yx, yy - xx - zz, yz + zy], [xy - yx, zx + xz, yz + zy, zz - xx - yy]];
    N = N.map((row, r) => row.map((value, c) => value + (r === c ? 2 * size : 0))); // all eigenvalues are positive
    for (let k = 0; k < 40; k++) { // powers of two; only the largest eigenvalue is left
      const trace = N[0][0] + N[1][1] + N[2][2] + N[3][3];
      N = product(N, N.map((row) => row.map((value) => value / trace / trace)));
    }
    const column = N.reduce((best, row) => (Math.hypot(...row) > Math.hypot(...best) ? row : best));
    const [w, x, y, z] = column.map((value) => value / Math.hypot(...column));
    const R = [
      [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
      [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
      [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ];
    turn(p, all, R, from, to);
  }

  /** Turn the points `rows` of `p` by R about `from`, which moves to `to`, in place. */
  function turn(p, rows, R, from, to) {
    const [a, b, c] = R;
    for (const v of rows) {
      const i = 3 * v, x = p[i] - from[0], y = p[i + 1] - from[1], z = p[i + 2] - from[2];
      p[i] = a[0] * x + a[1] * y + a[2] * z + to[0];
      p[i + 1] = b[0] * x + b[1] * y + b[2] * z + to[1];
      p[i + 2] = c[0] * x + c[1] * y + c[2] * z + to[2];
    }
  }

  /** Positions (3V) with the parts apart: each moves along the line from the middle of all parts to its centre, by a multiple. */
  function explode(positions, parts, multiple) {
    const rows = [];
    for (let v = 0, i = 0; v < parts.length; v++, i += 3) {
      if (Number.isFinite(positions[i] + positions[i + 1] + positions[i + 2])) (rows[parts[v]] = rows[parts[v]] || []).push(v);
    }
    const centres = rows.map((own) => mean(positions, own)), known = centres.filter(Boolean), out = Float32Array.from(positions);
    const middle = mean(known.flat(), known.map((_, k) => k));
    rows.forEach((own, part) => {
      for (let axis = 0; axis < 3; axis++) {
        const shift = multiple * (centres[part][axis] - middle[axis]);
        for (const v of own) out[3 * v + axis] += shift;
      }
    });
    return out;
  }

  /** template (3V); parts (V): number of the part of each vertex; joints: [{part, parent, own, other}], as in Python. */
  class Articulation {
    constructor(template, parts, joints) {
      Object.assign(this, { template: Float64Array.from(template), joints });
      this._rows = Array.from({ length: joints.length + 1 }, () => []);
      parts.forEach((part, v) => this._rows[part].push(v));
      this._centres = this._rows.map((rows) => mean(template, rows));
      this._inverse = this._rows.map((rows, k) => {
        const M = [[0, 0, 0], [0, 0, 0], [0, 0, 0]], centre = this._centres[k];
        for (const v of rows) {
          const x = [0, 1, 2].map((axis) => template[3 * v + axis] - centre[axis]);
          for (let r = 0; r < 3; r++) for (let c = 0; c < 3; c++) M[r][c] += (r === c ? dot(x, x) : 0) - x[r] * x[c];
        }
        return inverse(M);
      });
      this._gaps = joints.map(({ own, other }) => minus(mean(template, own), mean(template, other)));
    }

    /** Vertices, Float64Array(3V), of displacements `off` of tangent vertices; moves: "shape" or "pose" for one of them alone. */
    vertices(off, moves) {
      const out = Float64Array.from(this.template), withShape = moves !== "pose", withPose = moves !== "shape";
      const theta = this._rows.map((rows, k) => this._takeShape(out, off, rows, k, withShape)), R = [[[1, 0, 0], [0, 1, 0], [0, 0, 1]]];
      this.joints.forEach(({ part, parent, own, other }, j) => {
        const gap = this._gaps[j], shift = minus(minus(mean(off, own), mean(off, other)), cross(theta[parent], gap));
        R[part] = withPose ? product(R[parent], exponential(minus(theta[part], theta[parent]))) : R[parent];
        const to = apply(R[parent], withPose ? gap.map((value, axis) => value + shift[axis]) : gap), joint = mean(out, other);
        turn(out, this._rows[part], R[part], mean(out, own), joint.map((value, axis) => value + to[axis]));
      });
      align(out, this.template);
      return out;
    }

    /** Add the shape of part k to `out`, and return the rotation vector of the part. */
    _takeShape(out, off, rows, k, withShape) {
      const { template } = this, [x0, y0, z0] = this._centres[k], middle = mean(off, rows), torque = [0, 0, 0];
      for (const v of rows) {
        const i = 3 * v, x = template[i] - x0, y = template[i + 1] - y0, z = template[i + 2] - z0;
        torque[0] += y * off[i + 2] - z * off[i + 1];
        torque[1] += z * off[i] - x * off[i + 2];
        torque[2] += x * off[i + 1] - y * off[i];
      }
      const theta = apply(this._inverse[k], torque), [a, b, c] = theta;
      if (!withShape) return theta;
      for (const v of rows) {
        const i = 3 * v, x = template[i] - x0, y = template[i + 1] - y0, z = template[i + 2] - z0;
        out[i] += off[i] - middle[0] - (b * z - c * y);
        out[i + 1] += off[i + 1] - middle[1] - (c * x - a * z);
        out[i + 2] += off[i + 2] - middle[2] - (a * y - b * x);
      }
      return theta;
    }
  }

  Object.assign(window.Shapespace.sceneParts, { Articulation, explode });
})();
