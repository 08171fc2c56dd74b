/* Contents of a view: surfaces, points, marks, lines and texts. */
(function () {
  "use strict";

  const Shapespace = window.Shapespace;
  const { normalsOf, material, useMap, explode } = Shapespace.sceneParts;

  const GREY = [0.66, 0.66, 0.66];
  const SIGNAL = [0.8, 0.1, 0.45];
  const CLAY = [0.82, 0.76, 0.7];

  /** The contents of a view, by id. The view extends this class, and its `request` asks for a redraw. */
  Shapespace.sceneParts.Surfaces = class {
    /** works: false without WebGL; then all methods do nothing. */
    constructor(works) {
      this.works = works;
      this._things = new Map();
      this._marks = new Map();
      this._texts = new Map();
      this._arrangement = { hidden: new Set(), apart: 0 };
      if (works) this._scene = new THREE.Scene();
    }

    /**
     * Show a surface, or points where faces is null; positions Float32Array(3V), faces Uint32Array(3F). draft: fewer
     * triangles between some of the same vertices, drawn while the surface moves where the processor draws. parts: number
     * of the part of each vertex, if there are several, which have colours of their own, see `arrange`.
     */
    setSurface(id, { positions, faces = null, draft = null, parts = null, colour = CLAY, opacity = 1, visible = true, size = null }) {
      if (!this.works) return;
      this.remove(id);
      const thing = { id, colour, opacity, visible, faces: null, given: { faces, draft, parts }, positions, paint: null, size };
      const geometry = new THREE.BufferGeometry();
      const known = new Float32Array(this._apart(positions, parts));
      const bad = (thing.bad = withHidden(replaceUnknown(known), parts, this._arrangement.hidden));
      thing.faces = faces && faces.length ? usable(faces, known.length / 3, bad) : null;
      geometry.setAttribute("position", dynamic(known, 3));
      geometry.setAttribute("value", dynamic(new Float32Array((2 * known.length) / 3), 2));
      geometry.setAttribute("own", new THREE.BufferAttribute(new Uint8Array(known.length), 3, true));
      // Rays and frames are tested against the triangles themselves, never against bounds that a slider would outgrow.
      geometry.boundingSphere = new THREE.Sphere(new THREE.Vector3(), Infinity);
      const isPoints = !(faces && faces.length);
      if (!isPoints) {
        geometry.setIndex(new THREE.BufferAttribute(thing.faces, 1));
        if (draft) thing.draft = new THREE.BufferAttribute(usable(draft, known.length / 3, bad), 1);
        geometry.setAttribute("normal", dynamic(normalsOf(known, thing.faces, new Float32Array(known.length)), 3));
      } else if (bad) {
        const keep = [];
        for (let v = 0; v < known.length / 3; v++) if (!bad.has(v)) keep.push(v);
        geometry.setIndex(new THREE.BufferAttribute(new Uint32Array(keep), 1));
      }
      thing.material = material(isPoints);
      thing.object = isPoints ? new THREE.Points(geometry, thing.material) : new THREE.Mesh(geometry, thing.material);
      thing.object.frustumCulled = false;
      thing.object.matrixAutoUpdate = false;
      thing.isPoints = isPoints;
      if (isPoints) thing.size = size || spacing(known);
      this._scene.add(thing.object);
      this._things.set(id, thing);
      this.set(id, {});
      this.paint(id, null);
    }

    _apart(positions, parts) {
      return parts && this._arrangement.apart ? explode(positions, parts, this._arrangement.apart) : positions;
    }

    /** Where the vertices of a surface are drawn, not-a-number where its part is hidden. */
    placed(id, positions) {
      const parts = this._things.get(id)?.given.parts, { hidden } = this._arrangement, shown = this._apart(positions, parts);
      return parts && hidden.size ? shown.map((value, i) => (hidden.has(parts[Math.floor(i / 3)]) ? NaN : value)) : shown;
    }

    /** Hide the parts whose numbers are in `hidden`, and move parts apart by a multiple of their distances from the middle. */
    arrange({ hidden, apart }) {
      const moves = apart !== this._arrangement.apart;
      this._arrangement = { hidden: new Set(hidden), apart };
      for (const thing of Array.from(this._things.values())) if (thing.given?.parts) this._setAgain(thing, thing.positions);
      if (moves) this.refit();
    }

    /** Show a surface again at other positions, as it was. */
    _setAgain({ id, colour, opacity, visible, given, paint, size }, positions) {
      this.setSurface(id, { positions, ...given, colour, opacity, visible, size });
      const each = paint && paint.options.squares ? 2 : 1;
      if (paint && paint.values.length === (each * positions.length) / 3) this.paint(id, paint.values, paint.options);
    }

    /** Move the vertices of a surface; triangles and paint stay. */
    move(id, positions) {
      const thing = this._things.get(id);
      if (!thing) return;
      const attribute = thing.object.geometry.attributes.position;
      const shown = this._apart(positions, thing.given.parts);
      let sum = 0;
      for (let i = 0; i < shown.length; i++) sum += shown[i];
      if (shown.length !== attribute.array.length || !Number.isFinite(sum)) return this._setAgain(thing, positions);
      thing.positions = positions;
      attribute.array.set(shown);
      attribute.needsUpdate = true;
      if (thing.faces) {
        normalsOf(attribute.array, thing.faces, thing.object.geometry.attributes.normal.array);
        thing.object.geometry.attributes.normal.needsUpdate = true;
      }
      this.request();
    }

    /**
     * Colour a surface by numbers at its vertices: {map, range, threshold, signal}, or {categories: [[r,g,b], ...]}
     * where they are codes, or {squares: [[r,g,b], ...]} where they are two a vertex: places on a checkerboard.
     * {rgb: true} where they are three bytes a vertex, its colour. values null goes back to the plain colour.
     */
    paint(id, values, options) {
      const thing = this._things.get(id);
      if (!thing) return;
      const uniforms = thing.material.uniforms;
      if (!values) {
        thing.paint = null;
        uniforms.paint.value = 0;
        if (thing.given?.parts) {
          const { own } = thing.object.geometry.attributes, bytes = Shapespace.colours.parts.map((colour) => colour.map((c) => Math.round(255 * c)));
          thing.given.parts.forEach((part, v) => own.array.set(bytes[part % bytes.length], 3 * v));
          own.needsUpdate = true;
          uniforms.paint.value = 4;
        }
        this.request();
        return;
      }
      const { map = null, range = [0, 1], threshold = null, signal = SIGNAL, unknown = GREY, categories = null, squares = null, rgb = false } = options;
      const attributes = thing.object.geometry.attributes;
      const count = Math.min(values.length, attributes.position.count);
      if (rgb) {
        attributes.own.array.set(values.subarray(0, attributes.own.array.length));
        attributes.own.needsUpdate = true;
        uniforms.paint.value = 2;
      } else if (categories) {
        const own = attributes.own.array;
        for (let v = 0; v < count; v++) {
          const colour = categories[values[v]] || unknown;
          for (let c = 0; c < 3; c++) own[3 * v + c] = Math.round(255 * colour[c]);
        }
        attributes.own.needsUpdate = true;
        uniforms.paint.value = 2;
      } else if (squares) {
        attributes.value.array.set(values.subarray(0, attributes.value.array.length));
        attributes.value.needsUpdate = true;
        uniforms.squares.value = squares.length;
        useMap(thing, squares);
        uniforms.paint.value = 3;
      } else {
        // The same numbers again, as when a threshold moves, need no new upload.
        if (!thing.paint || thing.paint.values !== values || options.changed) {
          const value = attributes.value.array;
          value.fill(0);
          for (let v = 0; v < count; v++) {
            if (Number.isFinite(values[v])) {
              value[2 * v] = values[v];
              value[2 * v + 1] = 1;
            }
          }
          attributes.value.needsUpdate = true;
        }
        if (!thing.paint || thing.paint.options.map !== map) useMap(thing, map || [[0, 0, 0], [1, 1, 1]]);
        uniforms.range.value.set(range[0], range[1] > range[0] ? range[1] : range[0] + 1e-9);
        uniforms.threshold.value = threshold === null || !Number.isFinite(threshold) ? 1e30 : threshold;
        uniforms.signal.value.fromArray(signal);
        uniforms.paint.value = 1;
      }
      uniforms.unknown.value.fromArray(unknown);
      thing.paint = { values, options };
      this.request();
    }

    /** Change visible, opacity or colour of a surface. */
    set(id, { visible, opacity, colour }) {
      const thing = this._things.get(id);
      if (!thing) return;
      if (visible !== undefined) thing.visible = Boolean(visible);
      if (opacity !== undefined) thing.opacity = Math.min(Math.max(Number(opacity) || 0, 0), 1);
      if (colour !== undefined) thing.colour = colour;
      thing.material.uniforms.colour.value.fromArray(thing.colour);
      if (!thing.isLines) thing.material.uniforms.opacity.value = thing.opacity;
      this.request();
    }

    has(id) {
      return this._things.has(id);
    }

    remove(id) {
      const thing = this._things.get(id);
      if (thing) {
        this._scene.remove(thing.object);
        thing.object.geometry.dispose();
        thing.material.dispose();
        if (thing.texture) thing.texture.dispose();
        this._things.delete(id);
      }
      this._marks.delete(id);
      this._texts.delete(id);
      this.request();
    }

    /** Show small balls with names: [{position, label, colour}]; names are written next to them while there are few. */
    marks(id, marks) {
      if (!this.works) return;
      this.remove(id);
      if (!marks.length) return;
      const positions = new Float32Array(3 * marks.length);
      marks.forEach((mark, k) => positions.set(mark.position, 3 * k));
      this.setSurface(id, { positions, faces: null });
      const thing = this._things.get(id);
      const own = thing.object.geometry.attributes.own.array;
      marks.forEach((mark, k) => (mark.colour || [0.85, 0.2, 0.1]).forEach((c, j) => (own[3 * k + j] = 255 * c)));
      thing.material.uniforms.paint.value = 2;
      thing.material.uniforms.rim.value = 1;
      thing.material.uniforms.nearer.value = 0.004;
      thing.isMarks = true;
      this._marks.set(id, marks);
      this.request();
    }

    /** Show straight lines: points [[x,y,z], ...], each two joined. */
    lines(id, points, colour) {
      if (!this.works) return;
      this.remove(id);
      const geometry = new THREE.BufferGeometry();
      geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(points.flat()), 3));
      const line = new THREE.ShaderMaterial({
        uniforms: { colour: { value: new THREE.Vector3(...colour) } },
        vertexShader: "void main() { gl_Position = projectionMatrix * (modelViewMatrix * vec4(position, 1.0)); }",
        fragmentShader: "uniform vec3 colour; void main() { gl_FragColor = vec4(colour, 1.0); }",
      });
      const object = new THREE.LineSegments(geometry, line);
      object.frustumCulled = object.matrixAutoUpdate = false;
      this._scene.add(object);
      this._things.set(id, { id, object, material: line, colour, opacity: 1, visible: true, isLines: true });
      this.request();
    }

    /** Write words at places: [{position, label, small, left}]; small ones give way to others; left: left of the place. */
    texts(id, texts) {
      this._texts.set(id, texts);
      this.request();
    }
  };

  function dynamic(array, size) {
    const attribute = new THREE.BufferAttribute(array, size);
    attribute.setUsage(THREE.DynamicDrawUsage);
    return attribute;
  }

  /** Put zeros where positions are not finite, and return the set of those vertices, or null. */
  function replaceUnknown(positions) {
    let bad = null;
    for (let i = 0; i < positions.length; i++) {
      if (Number.isFinite(positions[i])) continue;
      bad = bad || new Set();
      bad.add(Math.floor(i / 3));
    }
    if (bad) for (const v of bad) positions.fill(0, 3 * v, 3 * v + 3);
    return bad;
  }

  /** The set of vertices that are not drawn, with those of hidden parts, or null. */
  function withHidden(bad, parts, hidden) {
    if (!parts || !hidden.size) return bad;
    const all = bad || new Set();
    parts.forEach((part, v) => { if (hidden.has(part)) all.add(v); });
    return all;
  }

  /** The triangles whose three vertices exist and are finite. */
  function usable(faces, count, bad) {
    const out = new Uint32Array(faces.length - (faces.length % 3));
    let n = 0;
    for (let f = 0; f + 2 < faces.length; f += 3) {
      const a = faces[f], b = faces[f + 1], c = faces[f + 2];
      if (!(a < count && b < count && c < count)) continue;
      if (bad && (bad.has(a) || bad.has(b) || bad.has(c))) continue;
      out[n] = a; out[n + 1] = b; out[n + 2] = c;
      n += 3;
    }
    return n === out.length ? out : out.slice(0, n);
  }

  /** The size of a ball, mm, so that points of a surface nearly touch. */
  function spacing(p) {
    const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
    for (let i = 0; i < p.length; i++) {
      low[i % 3] = Math.min(low[i % 3], p[i]);
      high[i % 3] = Math.max(high[i % 3], p[i]);
    }
    const sides = low.map((value, axis) => high[axis] - value).sort((a, b) => b - a);
    return p.length ? Math.max(1.4 * Math.sqrt((sides[0] * sides[1]) / (p.length / 3)), 1e-3) : 1;
  }
})();
