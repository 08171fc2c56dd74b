/* Data of scenes: arrays that Python packed, and a shape model. The first of the scripts of scenes; no network. */
(function () {
  "use strict";

  const Shapespace = (window.Shapespace = window.Shapespace || {});
  Shapespace.sceneParts = {}; // shared by the scripts of scenes, which need three.min.js before them

  const TYPES = {
    float32: Float32Array, int32: Int32Array, uint32: Uint32Array, uint16: Uint16Array, int16: Int16Array,
    uint8: Uint8Array,
  };
  const UNKNOWN = -32768; // int16 of missing coordinates

  /** Return {facts, arrays} of the bytes that shapespace.report.render.scene.pack made. */
  Shapespace.unpack = function (buffer) {
    const damaged = new Error("These data are cut short or damaged; make the page again.");
    if (!(buffer instanceof ArrayBuffer) || buffer.byteLength < 4) throw damaged;
    const length = new DataView(buffer).getUint32(0, true);
    if (4 + length > buffer.byteLength) throw damaged;
    let header;
    try {
      header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
    } catch (error) {
      throw damaged;
    }
    const arrays = {}, integers = {};
    const start = 8 * Math.ceil((4 + length) / 8);
    for (const name of Object.keys(header.arrays)) {
      const spec = header.arrays[name];
      const count = spec.shape.reduce((product, n) => product * n, 1);
      const Type = TYPES[spec.dtype];
      if (!Type || start + spec.offset + count * Type.BYTES_PER_ELEMENT > buffer.byteLength) throw damaged;
      let values;
      if (spec.coded) {
        const columns = spec.shape.length > 1 ? spec.shape[spec.shape.length - 1] : 1;
        values = decoded(new Uint8Array(buffer, start + spec.offset, 2 * count), new Type(count), columns, integers[spec.coded]);
      } else {
        values = new Type(buffer, start + spec.offset, count);
      }
      integers[name] = values;
      if (spec.scale !== undefined) values = dequantised(values, spec.scale);
      values.shape = spec.shape;
      arrays[name] = values;
    }
    return { facts: header.facts, arrays };
  };

  /** 16-bit integers from the byte planes of their differences from row to row, or from an array of before. */
  function decoded(bytes, out, columns, before) {
    const rows = columns ? out.length / columns : 0;
    for (let c = 0; c < columns; c++) {
      const low = 2 * c * rows, high = low + rows;
      let value = 0;
      for (let r = 0, i = c; r < rows; r++, i += columns) {
        const zigzag = bytes[low + r] | (bytes[high + r] << 8);
        value += (zigzag >>> 1) ^ -(zigzag & 1);
        out[i] = before ? value + before[i] : value; // the array takes it modulo 2^16
      }
    }
    return out;
  }

  function dequantised(steps, scale) {
    const out = new Float32Array(steps.length);
    const scales = Array.isArray(scale) ? scale : [scale];
    const row = scales.length ? steps.length / scales.length : 0;
    for (let k = 0; k < scales.length; k++) {
      const s = scales[k];
      for (let i = k * row; i < (k + 1) * row; i++) out[i] = steps[i] === UNKNOWN ? NaN : steps[i] * s;
    }
    return out;
  }

  /** Return the bytes of base64 text. */
  Shapespace.fromBase64 = function (text) {
    const raw = atob(text.trim());
    const bytes = new Uint8Array(raw.length);
    for (let i = 0; i < raw.length; i++) bytes[i] = raw.charCodeAt(i);
    return bytes.buffer;
  };

  /**
   * Surfaces from coefficients in standard deviations: mean + modes z; of several parts with relative poses, these are
   * tangent vertices, from which the surface is composed. What moved since the last call is added.
   */
  Shapespace.Model = class {
    constructor(unpacked) {
      const { mean, faces, modes, template, parts = null } = unpacked.arrays, { joints = null } = unpacked.facts;
      this.faces = faces && faces.length ? faces : null;
      this.parts = parts; // number of the part of each vertex
      this.V = mean.length / 3;
      this.K = modes ? modes.shape[0] : 0;
      this._modes = [];
      for (let k = 0; k < this.K; k++) this._modes.push(modes.subarray(k * mean.length, (k + 1) * mean.length));
      this._offset = new Float64Array(mean.length);
      this._z = new Float64Array(this.K);
      if (joints) {
        this.articulation = new Shapespace.sceneParts.Articulation(template, parts, joints);
        for (let i = 0; i < mean.length; i++) this._offset[i] = mean[i] - template[i];
      }
      this.mean = joints ? Float32Array.from(this._offsets([]), (off, i) => off + template[i]) : mean;
      this._from = joints ? template : mean;
    }

    /** One mode's displacement of one standard deviation, Float32Array(3V), mm; of tangent vertices if there are some. */
    mode(k) {
      return this._modes[k];
    }

    /** Displacements at coefficients z, from the mean or the template; moves: see `Articulation.vertices`. */
    _offsets(z, moves) {
      for (let k = 0; k < this.K; k++) {
        const wanted = k < z.length && Number.isFinite(z[k]) ? z[k] : 0;
        const step = wanted - this._z[k];
        if (step === 0) continue;
        const mode = this._modes[k], offset = this._offset;
        for (let i = 0; i < offset.length; i++) offset[i] += step * mode[i];
        this._z[k] = wanted;
      }
      if (!this.articulation) return this._offset;
      const { template } = this.articulation;
      return this.articulation.vertices(this._offset, moves).map((value, i) => value - template[i]);
    }

    vertices(z, out, moves) {
      const offset = this._offsets(z, moves), to = out || new Float32Array(offset.length), from = this._from;
      for (let i = 0; i < to.length; i++) to[i] = from[i] + offset[i];
      return to;
    }

    /** How far each vertex moves along the normal of the mean, outwards positive, from z = `from` to `z`, mm. */
    displacement(z, from = [], moves) {
      const start = Float64Array.from(this._offsets(from, moves)), offset = this._offsets(z, moves).map((value, i) => value - start[i]);
      const out = new Float32Array(this.V);
      if (!this.faces) {
        for (let v = 0, i = 0; v < this.V; v++, i += 3) out[v] = Math.hypot(offset[i], offset[i + 1], offset[i + 2]);
        return out;
      }
      if (!this._normals) this._normals = normalsOf(this.mean, this.faces, new Float32Array(this.mean.length));
      const n = this._normals;
      for (let v = 0, i = 0; v < this.V; v++, i += 3) {
        out[v] = offset[i] * n[i] + offset[i + 1] * n[i + 1] + offset[i + 2] * n[i + 2];
      }
      return out;
    }
  };

  function normalsOf(p, faces, out) {
    out.fill(0);
    for (let f = 0; f < faces.length; f += 3) {
      const a = 3 * faces[f], b = 3 * faces[f + 1], c = 3 * faces[f + 2];
      const ux = p[b] - p[a], uy = p[b + 1] - p[a + 1], uz = p[b + 2] - p[a + 2];
      const vx = p[c] - p[a], vy = p[c + 1] - p[a + 1], vz = p[c + 2] - p[a + 2];
      const nx = uy * vz - uz * vy, ny = uz * vx - ux * vz, nz = ux * vy - uy * vx;
      out[a] += nx; out[a + 1] += ny; out[a + 2] += nz;
      out[b] += nx; out[b + 1] += ny; out[b + 2] += nz;
      out[c] += nx; out[c + 1] += ny; out[c + 2] += nz;
    }
    for (let i = 0; i < out.length; i += 3) {
      const length = Math.sqrt(out[i] * out[i] + out[i + 1] * out[i + 1] + out[i + 2] * out[i + 2]);
      if (length > 0) { out[i] /= length; out[i + 1] /= length; out[i + 2] /= length; }
    }
    return out;
  }

  Shapespace.sceneParts.normalsOf = normalsOf;
})();
