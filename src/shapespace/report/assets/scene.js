/* What turns in the browser: arrays, a shape model, and a view of surfaces. Needs three.min.js before it; no network. */
(function () {
  "use strict";

  const Shapespace = (window.Shapespace = window.Shapespace || {});

  // Arrays ----------------------------------------------------------------------------------------------------------

  const TYPES = {
    float32: Float32Array, int32: Int32Array, uint32: Uint32Array, uint16: Uint16Array, int16: Int16Array,
    uint8: Uint8Array,
  };
  const UNKNOWN = -32768; // the int16 that stands for NaN

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

  // The shape model -------------------------------------------------------------------------------------------------

  /** Surfaces from coefficients in standard deviations: mean + modes z. What moved since the last call is added. */
  Shapespace.Model = class {
    constructor(unpacked) {
      const { mean, faces, modes } = unpacked.arrays;
      this.facts = unpacked.facts;
      this.mean = mean;
      this.faces = faces && faces.length ? faces : null;
      this.V = mean.length / 3;
      this.K = modes ? modes.shape[0] : 0;
      this._modes = [];
      for (let k = 0; k < this.K; k++) this._modes.push(modes.subarray(k * mean.length, (k + 1) * mean.length));
      this._offset = new Float64Array(mean.length);
      this._z = new Float64Array(this.K);
    }

    /** One mode's displacement of one standard deviation, Float32Array(3V), mm. */
    mode(k) {
      return this._modes[k];
    }

    _moveTo(z) {
      for (let k = 0; k < this.K; k++) {
        const wanted = k < z.length && Number.isFinite(z[k]) ? z[k] : 0;
        const step = wanted - this._z[k];
        if (step === 0) continue;
        const mode = this._modes[k], offset = this._offset;
        for (let i = 0; i < offset.length; i++) offset[i] += step * mode[i];
        this._z[k] = wanted;
      }
    }

    vertices(z, out) {
      this._moveTo(z);
      const to = out || new Float32Array(this.mean.length);
      const mean = this.mean, offset = this._offset;
      for (let i = 0; i < to.length; i++) to[i] = mean[i] + offset[i];
      return to;
    }

    /** How far each vertex moves along the normal of the mean, outwards positive, mm. */
    displacement(z) {
      this._moveTo(z);
      const out = new Float32Array(this.V), offset = this._offset;
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

  // Light and material ----------------------------------------------------------------------------------------------

  // One light for all: a soft key from the camera's upper left, and more from the sky than from the ground. Squares and
  // roots stand for the sRGB curve, as powers cost a third of the frame where the processor draws.
  const LIGHT = `
    vec3 lit(vec3 colour, vec3 n, float back, float painted) {
      vec3 base = colour * colour;
      base = mix(base, base * vec3(0.42, 0.45, 0.52), back);
      float key = clamp(dot(n, vec3(-0.412, 0.514, 0.752)) * 0.92 + 0.08, 0.0, 1.0);
      float sky = 0.5 + 0.5 * n.y;
      vec3 light = key * vec3(0.80, 0.785, 0.76) + mix(vec3(0.17, 0.165, 0.17), vec3(0.33, 0.35, 0.38), sky);
      float edge = 1.0 - clamp(n.z, 0.0, 1.0);
      light += 0.10 * edge * edge * edge;
      light = mix(light, 0.55 + 0.45 * light, painted);
      return sqrt(min(base * light, 1.0));
    }`;

  const COLOUR = `
    uniform vec3 colour; uniform vec3 signal; uniform vec3 unknown; uniform sampler2D map;
    uniform vec2 range; uniform float threshold; uniform int paint; uniform float squares;
    vec3 painted(vec2 value, vec3 own) {
      if (paint == 0) return colour;
      if (paint == 2) return own;
      if (paint == 3) {
        // As render.squares: every other one is paper, the others take turns so that near ones differ.
        vec2 at = floor(value);
        float turn = mod(at.x + at.y, 2.0) > 0.5 ? 0.0 : 1.0 + mod(floor((3.0 * at.x - at.y) / 2.0), squares - 1.0);
        return texture2D(map, vec2((turn + 0.5) / squares, 0.5)).rgb;
      }
      if (value.y < 0.999) return unknown;
      if (abs(value.x) > threshold) return signal;
      return texture2D(map, vec2(clamp((value.x - range.x) / (range.y - range.x), 0.0, 1.0), 0.5)).rgb;
    }`;

  const SURFACE_VERTEX = `
    attribute vec2 value; attribute vec3 own;
    uniform float nearer;
    varying vec3 vNormal; varying vec2 vValue; varying vec3 vOwn;
    void main() {
      vNormal = normalMatrix * normal; vValue = value; vOwn = own;
      vec4 seen = modelViewMatrix * vec4(position, 1.0);
      seen.xyz *= 1.0 - nearer;
      gl_Position = projectionMatrix * seen;
    }`;
  const SURFACE_FRAGMENT = LIGHT + COLOUR + `
    uniform float opacity;
    varying vec3 vNormal; varying vec2 vValue; varying vec3 vOwn;
    void main() {
      vec3 n = normalize(vNormal);
      float back = gl_FrontFacing ? 0.0 : 1.0;
      if (back > 0.5) n = -n;
      gl_FragColor = vec4(lit(painted(vValue, vOwn), n, back, paint == 0 ? 0.0 : paint == 3 ? 0.4 : 1.0), opacity);
    }`;

  const POINT_VERTEX = `
    attribute vec2 value; attribute vec3 own;
    uniform float size; uniform float pixels; uniform float inPixels; uniform float nearer;
    varying vec2 vValue; varying vec3 vOwn;
    void main() {
      vValue = value; vOwn = own;
      vec4 seen = modelViewMatrix * vec4(position, 1.0);
      seen.xyz *= 1.0 - nearer;
      gl_Position = projectionMatrix * seen;
      gl_PointSize = clamp(inPixels > 0.5 ? size : size * pixels / -seen.z, 1.5, 64.0);
    }`;
  const POINT_FRAGMENT = LIGHT + COLOUR + `
    uniform float opacity; uniform float rim;
    varying vec2 vValue; varying vec3 vOwn;
    void main() {
      vec2 at = (gl_PointCoord - 0.5) * vec2(2.0, -2.0);
      float r = dot(at, at);
      if (r > 1.0) discard;
      vec3 n = vec3(at, sqrt(1.0 - r));
      vec3 seen = lit(painted(vValue, vOwn), n, 0.0, paint == 1 ? 1.0 : 0.5);
      if (rim > 0.5 && r > 0.62) seen = vec3(1.0);
      gl_FragColor = vec4(seen, opacity);
    }`;

  // One WebGL context for the whole page -----------------------------------------------------------------------------

  // Browsers refuse more than some 8 to 16 contexts, so all views share one and keep a plain canvas each.
  let shared;
  const views = new Set();
  const NO_WEBGL = "This browser shows no 3-D pictures here, because WebGL is switched off or missing.";

  function gpu() {
    if (shared !== undefined) return shared;
    shared = null;
    if (!window.THREE) return shared;
    try {
      const aside = typeof OffscreenCanvas === "function" && new OffscreenCanvas(8, 8);
      const probe = aside && aside.getContext("webgl2");
      if (!aside || !probe) return shared;
      const info = probe.getExtension("WEBGL_debug_renderer_info");
      const name = String(probe.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : probe.RENDERER));
      lose(probe);
      const bySoftware = /swiftshader|llvmpipe|softpipe|software|basic render/i.test(name);
      const canvas = new OffscreenCanvas(8, 8);
      canvas.style = {};
      const options = { alpha: true, antialias: !bySoftware, depth: true, stencil: false, premultipliedAlpha: true };
      const context = canvas.getContext("webgl2", options);
      if (!context) return shared;
      const renderer = new THREE.WebGLRenderer({ canvas, context, ...options });
      renderer.autoClear = false;
      renderer.setClearColor(0x000000, 0);
      renderer.debug.checkShaderErrors = false;
      shared = { canvas, context, renderer, bySoftware, lost: false };
      canvas.addEventListener("webglcontextlost", (event) => {
        event.preventDefault();
        shared.lost = true;
      });
      canvas.addEventListener("webglcontextrestored", () => {
        shared.lost = false;
        views.forEach((view) => view.request());
      });
    } catch (error) {
      shared = null;
    }
    return shared;
  }

  function lose(context) {
    const extension = context.getExtension("WEBGL_lose_context");
    if (extension) extension.loseContext();
  }

  /** Take the drawing context away for a moment, as a driver may do at any time; to try out what happens then. */
  Shapespace.loseContext = function () {
    const extension = gpu() && gpu().context.getExtension("WEBGL_lose_context");
    if (!extension) return;
    extension.loseContext();
    setTimeout(() => extension.restoreContext(), 50);
  };

  const waiting = new Set();
  let scheduled = 0;
  function flush() {
    scheduled = 0;
    const now = Array.from(waiting);
    waiting.clear();
    now.forEach((view) => view._draw());
  }

  // Another resolution of the screen, or another theme behind the names.
  const redrawAll = () => views.forEach((view) => view.request());
  window.addEventListener("resize", redrawAll);
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redrawAll);
  new MutationObserver(redrawAll).observe(document.documentElement, { attributes: true });

  // A view ----------------------------------------------------------------------------------------------------------

  const DRAFT_PIXELS = 3.2e5, STILL_PIXELS = 3e6, RESTS_MS = 160; // where the processor draws
  const FIELD = (20 * Math.PI) / 180;
  const GREY = [0.66, 0.66, 0.66];
  const SIGNAL = [0.8, 0.1, 0.45];
  const CLAY = [0.82, 0.76, 0.7];

  /**
   * A canvas in `element` that shows surfaces and points, turned by mouse, touch and keys; drawn only when it changed.
   *
   * Options: label (what is seen, for screen readers), background (a CSS colour; none shows the page through), embedded
   * (true: a page can be scrolled over it, so the wheel zooms only once it has the focus, and one finger turns only
   * sideways).
   */
  Shapespace.View = class {
    constructor(element, options) {
      const { label = "3-D picture", background = null, embedded = true } = options || {};
      this.element = element;
      this.frames = 0; // drawn so far
      this.lastRedrawMs = NaN; // how long the last one kept the page busy
      this.works = gpu() !== null; // false where there is no WebGL; then all methods do nothing
      this._background = background;
      this._embedded = embedded;
      this._things = new Map();
      this._marks = new Map();
      this._texts = new Map();
      this._linked = new Set();
      this._listeners = {};
      this._camera = { yaw: 0, pitch: 0, roll: 0, zoom: 1, target: [0, 0, 0], extent: [100, 100, 100] };
      this._home = null;
      this._near = true;
      this._size = [1, 1];
      this.canvas = document.createElement("canvas");
      this.canvas.className = "shapespace-canvas";
      Object.assign(this.canvas.style, {
        position: "absolute", inset: "0", width: "100%", height: "100%", touchAction: embedded ? "pan-y" : "none",
        cursor: "grab", background: background || "transparent",
      });
      if (!this.works) {
        this._note = document.createElement("p");
        this._note.className = "shapespace-note";
        this._note.setAttribute("role", "note");
        this._note.textContent = NO_WEBGL;
        element.appendChild(this._note);
        return;
      }
      this.label = label;
      this.canvas.tabIndex = 0;
      this.canvas.setAttribute("role", "application");
      this._frame = document.createElement("div");
      Object.assign(this._frame.style, { position: "relative", width: "100%", height: "100%", overflow: "hidden" });
      this._names = document.createElement("canvas");
      this._names.setAttribute("aria-hidden", "true");
      Object.assign(this._names.style, {
        position: "absolute", inset: "0", width: "100%", height: "100%", pointerEvents: "none", display: "none",
      });
      this._frame.append(this.canvas, this._names);
      element.appendChild(this._frame);
      this._shown = this.canvas.getContext("bitmaprenderer");
      this._scene = new THREE.Scene();
      this._eye = new THREE.PerspectiveCamera(20, 1, 1, 1000);
      this._eye.matrixAutoUpdate = false;
      this._listen();
      views.add(this);
      this.request();
    }

    set label(text) {
      this._label = text;
      this.canvas.setAttribute(
        "aria-label", `${text}. Turn it by dragging or with the arrow keys; plus and minus zoom, Home goes back.`
      );
    }

    get label() {
      return this._label;
    }

    // What is shown

    /** Show a surface, or points where faces is null; positions Float32Array(3V), faces Uint32Array(3F). */
    setSurface(id, { positions, faces = null, colour = CLAY, opacity = 1, visible = true, size = null }) {
      if (!this.works) return;
      this.remove(id);
      const thing = { id, colour, opacity, visible, faces: null, given: faces, positions, paint: null, size };
      const geometry = new THREE.BufferGeometry();
      const known = new Float32Array(positions);
      const bad = replaceUnknown(known);
      thing.faces = faces && faces.length ? usable(faces, known.length / 3, bad) : null;
      thing.positions = known;
      geometry.setAttribute("position", dynamic(known, 3));
      geometry.setAttribute("value", dynamic(new Float32Array((2 * known.length) / 3), 2));
      geometry.setAttribute("own", new THREE.BufferAttribute(new Uint8Array(known.length), 3, true));
      // Rays and frames are tested against the triangles themselves, never against bounds that a slider would outgrow.
      geometry.boundingSphere = new THREE.Sphere(new THREE.Vector3(), Infinity);
      const isPoints = !(faces && faces.length);
      if (!isPoints) {
        geometry.setIndex(new THREE.BufferAttribute(thing.faces, 1));
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
    }

    /** Move the vertices of a surface; triangles and paint stay. */
    move(id, positions) {
      const thing = this._things.get(id);
      if (!thing) return;
      const attribute = thing.object.geometry.attributes.position;
      let sum = 0;
      for (let i = 0; i < positions.length; i++) sum += positions[i];
      if (positions.length !== attribute.array.length || !Number.isFinite(sum)) {
        const { colour, opacity, visible, given, paint, size } = thing;
        this.setSurface(id, { positions, faces: given, colour, opacity, visible, size });
        const each = paint && paint.options.squares ? 2 : 1;
        if (paint && paint.values.length === (each * positions.length) / 3) this.paint(id, paint.values, paint.options);
        return;
      }
      attribute.array.set(positions);
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

    /** Show small balls with names: [{position, label, colour}]; names stand beside them while there are few. */
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

    // Camera

    /** Go to where all that is visible, or the given ids, fills the picture from the front; margin 1.1 leaves more. */
    frame(ids, margin = 1) {
      if (!this.works) return;
      const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
      for (const thing of this._things.values()) {
        if (ids ? !ids.includes(thing.id) : !thing.visible || thing.isMarks) continue;
        const p = thing.object.geometry.attributes.position.array;
        for (let i = 0; i < p.length; i++) {
          const axis = i % 3;
          if (p[i] < low[axis]) low[axis] = p[i];
          if (p[i] > high[axis]) high[axis] = p[i];
        }
      }
      if (!(low[0] <= high[0])) return;
      this._camera.target = low.map((value, axis) => (value + high[axis]) / 2);
      this._camera.extent = low.map((value, axis) => Math.max((high[axis] - value) * margin, 1e-3));
      Object.assign(this._camera, { yaw: 0, pitch: 0, roll: 0, zoom: 1 });
      this._home = copy(this._camera);
      this._moved();
    }

    get camera() {
      return copy(this._camera);
    }

    set camera(value) {
      this._camera = copy({ ...this._camera, ...value });
      this._moved();
    }

    /** Go back to where `frame` put the camera. */
    reset() {
      if (this._home) this.camera = this._home;
    }

    /** From now on both views share one camera. */
    link(other) {
      this._linked.add(other);
      other._linked.add(this);
      other._camera = copy(this._camera);
      other._home = this._home && copy(this._home);
      other.request();
    }

    _moved(from) {
      this.request();
      this._emit("camera", this);
      for (const other of this._linked) {
        if (other === from) continue;
        other._camera = copy(this._camera);
        other._moved(this);
      }
    }

    _turn(yaw, pitch) {
      this._camera.yaw += yaw;
      this._camera.pitch = Math.min(Math.max(this._camera.pitch + pitch, -Math.PI / 2), Math.PI / 2);
      this._moved();
    }

    _zoom(factor) {
      this._camera.zoom = Math.min(Math.max(this._camera.zoom * factor, 0.05), 5);
      this._moved();
    }

    _pan(dx, dy) {
      const { right, up } = this._axes();
      const perPixel = (2 * this._distance() * Math.tan(FIELD / 2)) / Math.max(this._frame.clientHeight, 1);
      this._camera.target = this._camera.target.map((t, i) => t + (-dx * right[i] + dy * up[i]) * perPixel);
      this._moved();
    }

    _axes() {
      const { yaw, pitch, roll } = this._camera;
      const cy = Math.cos(yaw), sy = Math.sin(yaw), cp = Math.cos(pitch), sp = Math.sin(pitch);
      const back = [sy * cp, sp, cy * cp];
      const flatRight = [cy, 0, -sy], flatUp = [-sy * sp, cp, -cy * sp];
      const cr = Math.cos(roll), sr = Math.sin(roll);
      return {
        back,
        right: flatRight.map((r, i) => cr * r + sr * flatUp[i]),
        up: flatUp.map((u, i) => cr * u - sr * flatRight[i]),
      };
    }

    _distance() {
      const [w, h, d] = this._camera.extent;
      const aspect = Math.max(this._frame.clientWidth, 1) / Math.max(this._frame.clientHeight, 1);
      const half = 0.5 * Math.max(h, Math.max(w, 0.7 * d) / aspect) * 1.08;
      return (half / Math.tan(FIELD / 2) + 0.2 * d) * this._camera.zoom;
    }

    // Drawing

    /** Ask for a redraw with the next frame of the browser. */
    request() {
      if (!this.works || this._disposed) return;
      waiting.add(this);
      if (!scheduled) scheduled = requestAnimationFrame(flush);
    }

    /** Whether what is seen is final: nothing waits to be drawn, or to be drawn finer. */
    get rests() {
      return !waiting.has(this) && !this._later;
    }

    /** Draw at once as while something moves, wait until the picture is there, and return the milliseconds it took. */
    redraw() {
      if (!this.works) return NaN;
      const start = performance.now();
      this._draw(true);
      return performance.now() - start;
    }

    _draw(wait) {
      const page = gpu();
      waiting.delete(this);
      clearTimeout(this._later);
      this._later = 0;
      if (!page || page.lost || this._disposed || !(this._near || wait)) return;
      const area = this._frame.clientWidth * this._frame.clientHeight;
      if (!area) return;
      let ratio = Math.min(window.devicePixelRatio || 1, 2);
      if (page.bySoftware) {
        // What moves is drawn coarser, and again at twice the resolution once it rests.
        ratio = Math.min(ratio, Math.max(Math.sqrt(DRAFT_PIXELS / area), 0.5));
        this._later = setTimeout(() => {
          this._later = 0;
          if (this._near) this._present(Math.min(2, Math.sqrt(STILL_PIXELS / area)));
        }, RESTS_MS);
      }
      this._present(ratio, wait);
    }

    _present(ratio, wait) {
      const page = gpu();
      if (!page || page.lost || this._disposed) return;
      const width = Math.round(this._frame.clientWidth * ratio), height = Math.round(this._frame.clientHeight * ratio);
      if (width < 1 || height < 1) return;
      const start = performance.now();
      this._size = [width, height];
      if (page.canvas.width !== width || page.canvas.height !== height) page.renderer.setSize(width, height, false);
      this._aim(width, height);
      this._render(page.renderer, height, ratio);
      if (wait) page.context.readPixels(0, 0, 1, 1, page.context.RGBA, page.context.UNSIGNED_BYTE, new Uint8Array(4));
      this._shown.transferFromImageBitmap(page.canvas.transferToImageBitmap());
      this._write();
      this.frames += 1;
      this.lastRedrawMs = performance.now() - start;
      this._emit("draw", this);
    }

    _aim(width, height) {
      const { right, up, back } = this._axes();
      const distance = this._distance();
      const t = this._camera.target, extent = this._camera.extent;
      const eye = t.map((value, i) => value + back[i] * distance);
      const reach = Math.hypot(...extent) * 1.5 + Math.hypot(t[0] - (this._home ? this._home.target[0] : t[0]), 0);
      const camera = this._eye;
      camera.aspect = width / height;
      camera.near = Math.max(distance - reach, distance * 0.02);
      camera.far = distance + reach;
      camera.updateProjectionMatrix();
      camera.matrix.set(
        right[0], up[0], back[0], eye[0], right[1], up[1], back[1], eye[1], right[2], up[2], back[2], eye[2], 0, 0, 0, 1
      );
      camera.matrixWorldNeedsUpdate = true;
      camera.updateMatrixWorld(true);
    }

    _render(renderer, height, ratio) {
      const all = Array.from(this._things.values());
      const shown = all.filter((thing) => thing.visible && thing.opacity > 0.004);
      const solid = shown.filter((thing) => thing.opacity > 0.996 || thing.isMarks);
      const clear = shown.filter((thing) => !solid.includes(thing));
      // A clear surface comes nearer by a little, or it would dapple a solid one that it nearly coincides with.
      const nearer = (0.008 * Math.hypot(...this._camera.extent)) / this._distance();
      const pass = (things, colour, blend) => {
        if (!things.length) return;
        for (const thing of all) thing.object.visible = things.includes(thing);
        for (const thing of things) {
          thing.material.colorWrite = colour;
          thing.material.transparent = blend;
          if (!thing.isMarks && !thing.isLines) thing.material.uniforms.nearer.value = clear.includes(thing) ? nearer : 0;
          if (thing.isPoints) {
            const uniforms = thing.material.uniforms;
            uniforms.inPixels.value = thing.isMarks ? 1 : 0;
            uniforms.size.value = thing.isMarks ? 13 * ratio : thing.size;
            uniforms.pixels.value = height / (2 * Math.tan(FIELD / 2));
          }
        }
        renderer.render(this._scene, this._eye);
      };
      renderer.clear(true, true, false);
      pass(solid, true, false);
      // Of a clear surface only the nearest layer is seen: its depth first, on top of that of the solid ones.
      clear.forEach((thing, k) => {
        if (k > 0) {
          renderer.clearDepth();
          pass(solid, false, false);
        }
        pass([thing], false, false);
        pass([thing], true, true);
      });
    }

    _write() {
      const names = this._names, some = this._marks.size + this._texts.size > 0;
      names.style.display = some ? "block" : "none";
      if (!some) return;
      const ratio = Math.min(window.devicePixelRatio || 1, 2);
      names.width = Math.round(this._frame.clientWidth * ratio);
      names.height = Math.round(this._frame.clientHeight * ratio);
      const context = names.getContext("2d"), style = getComputedStyle(this.element);
      const page = this._background || behind(this.element), ink = style.color;
      context.font = `${12 * ratio}px ${style.fontFamily || "sans-serif"}`;
      context.textBaseline = "middle";
      context.lineJoin = "round";
      context.lineWidth = 3.5 * ratio;
      const write = (label, x, y) => {
        context.strokeStyle = page;
        context.strokeText(label, x * ratio, y * ratio);
        context.fillStyle = ink;
        context.fillText(label, x * ratio, y * ratio);
      };
      for (const [id, marks] of this._marks) {
        const thing = this._things.get(id);
        if (!thing || !thing.visible) continue;
        marks.forEach((mark, k) => {
          const named = marks.length <= 12 || (this._hovered && this._hovered.id === id && this._hovered.vertex === k);
          const [x, y, depth] = this.project(mark.position);
          // What is well behind the middle is on the far side of the surface.
          if (mark.label && named && depth < 0.02 * Math.hypot(...this._camera.extent)) write(mark.label, x + 10, y);
        });
      }
      const taken = [], font = context.font;
      for (const { position, label, small, left } of Array.from(this._texts.values()).flat()) {
        context.font = small ? font.replace(/^[\d.]+px/, `${10.5 * ratio}px`) : font;
        const [x, y] = this.project(position), width = context.measureText(label).width / ratio;
        const at = !small ? [x + 4, y] : left ? [x - width - 5, y] : [x - width / 2, y + 9];
        const place = [at[0] - 3, at[1] - 6, at[0] + width + 3, at[1] + 6];
        // Small ones give way where an axis is seen from its end.
        if (small && taken.some((t) => t[0] < place[2] && place[0] < t[2] && t[1] < place[3] && place[1] < t[3])) continue;
        taken.push(place);
        write(label, ...at);
      }
      context.font = font;
    }

    /** CSS pixels of a point in the canvas, and how far it lies behind the camera's target. */
    project(point) {
      const { right, up, back } = this._axes();
      const distance = this._distance();
      const d = point.map((value, i) => value - this._camera.target[i]);
      const dot = (axis) => d[0] * axis[0] + d[1] * axis[1] + d[2] * axis[2];
      const depth = -dot(back);
      const scale = this._frame.clientHeight / (2 * Math.tan(FIELD / 2) * Math.max(distance + depth, 1e-6));
      return [this._frame.clientWidth / 2 + dot(right) * scale, this._frame.clientHeight / 2 - dot(up) * scale, depth];
    }

    // Asking

    /** What is under a point of the window: {id, point, vertex}, or null. */
    pick(clientX, clientY, ids) {
      if (!this.works) return null;
      const box = this.canvas.getBoundingClientRect();
      if (!box.width || !box.height) return null;
      const x = clientX - box.left, y = clientY - box.top;
      this._aim(box.width, box.height);
      const ray = new THREE.Raycaster();
      ray.setFromCamera(new THREE.Vector2((2 * x) / box.width - 1, 1 - (2 * y) / box.height), this._eye);
      let best = null, nearest = Infinity;
      for (const thing of this._things.values()) {
        if (thing.isLines || (ids ? !ids.includes(thing.id) : !thing.visible)) continue;
        const p = thing.object.geometry.attributes.position.array;
        if (!thing.isPoints) {
          const hit = ray.intersectObject(thing.object, false)[0];
          if (!hit || hit.distance >= nearest) continue;
          const point = hit.point.toArray();
          let vertex = hit.face.a, least = Infinity;
          for (const v of [hit.face.a, hit.face.b, hit.face.c]) {
            const far = Math.hypot(p[3 * v] - point[0], p[3 * v + 1] - point[1], p[3 * v + 2] - point[2]);
            if (far < least) { least = far; vertex = v; }
          }
          nearest = hit.distance;
          best = { id: thing.id, point, vertex };
          continue;
        }
        const distance = this._distance();
        for (let v = 0; v < p.length / 3; v++) {
          const point = [p[3 * v], p[3 * v + 1], p[3 * v + 2]];
          const [px, py, depth] = this.project(point);
          const reach = thing.isMarks ? 12 : 9;
          if ((px - x) ** 2 + (py - y) ** 2 > reach * reach) continue;
          // Marks win over the surface that they stand on.
          const far = distance + depth - (thing.isMarks ? 0.02 * distance : 0) + Math.hypot(px - x, py - y) * 1e-3;
          if (far < nearest) { nearest = far; best = { id: thing.id, point, vertex: v }; }
        }
      }
      return best;
    }

    /** The picture as it stands, as PNG, on the page's own background. */
    png() {
      if (!this.works) return Promise.reject(new Error(NO_WEBGL));
      clearTimeout(this._later);
      this._present(2);
      const copyOf = document.createElement("canvas");
      [copyOf.width, copyOf.height] = this._size;
      const context = copyOf.getContext("2d");
      context.fillStyle = this._background || behind(this.element);
      context.fillRect(0, 0, copyOf.width, copyOf.height);
      context.drawImage(this.canvas, 0, 0, copyOf.width, copyOf.height);
      if (this._names.style.display === "block") context.drawImage(this._names, 0, 0, copyOf.width, copyOf.height);
      return new Promise((resolve, reject) =>
        copyOf.toBlob((blob) => (blob ? resolve(blob) : reject(new Error("The picture could not be made."))), "image/png")
      );
    }

    /** Call handler on "click" (not after dragging), "hover", "camera" or "draw". */
    on(event, handler) {
      (this._listeners[event] = this._listeners[event] || []).push(handler);
    }

    _emit(event, value) {
      (this._listeners[event] || []).forEach((handler) => handler(value));
    }

    dispose() {
      if (this._disposed) return;
      this._disposed = true;
      views.delete(this);
      waiting.delete(this);
      this._linked.forEach((other) => other._linked.delete(this));
      if (this._resizes) this._resizes.disconnect();
      if (this._sees) this._sees.disconnect();
      for (const id of Array.from(this._things.keys())) this.remove(id);
      clearTimeout(this._later);
      if (this._frame) this._frame.remove();
      if (this._note) this._note.remove();
    }

    _hover(event) {
      const crowded = Array.from(this._marks).filter(([, marks]) => marks.length > 12).map(([id]) => id);
      if (crowded.length) {
        const before = this._hovered;
        this._hovered = this.pick(event.clientX, event.clientY, crowded);
        if (before || this._hovered) this._write();
      }
      this._emit("hover", event);
    }

    _listen() {
      const canvas = this.canvas;
      this._resizes = new ResizeObserver(() => this.request());
      this._resizes.observe(canvas);
      this._sees = new IntersectionObserver((entries) => {
        this._near = entries[entries.length - 1].isIntersecting;
        if (this._near) this.request();
      }, { rootMargin: "200px" });
      this._sees.observe(canvas);
      const down = new Map();
      let travelled = 0;
      canvas.addEventListener("pointerdown", (event) => {
        down.set(event.pointerId, [event.clientX, event.clientY]);
        if (down.size === 1) travelled = 0;
        try { canvas.setPointerCapture(event.pointerId); } catch (error) { /* the pointer is gone already */ }
        canvas.style.cursor = "grabbing";
      });
      canvas.addEventListener("pointermove", (event) => {
        const last = down.get(event.pointerId);
        if (!last) {
          this._hover(event);
          return;
        }
        const dx = event.clientX - last[0], dy = event.clientY - last[1];
        travelled += Math.abs(dx) + Math.abs(dy);
        if (down.size === 1) {
          down.set(event.pointerId, [event.clientX, event.clientY]);
          if (event.buttons & 6 || event.shiftKey) this._pan(dx, dy);
          else this._turn(-dx * 0.008, dy * 0.008);
          return;
        }
        const others = Array.from(down.entries()).filter(([key]) => key !== event.pointerId);
        const other = others[0][1];
        const before = Math.hypot(last[0] - other[0], last[1] - other[1]);
        const after = Math.hypot(event.clientX - other[0], event.clientY - other[1]);
        down.set(event.pointerId, [event.clientX, event.clientY]);
        if (before > 0 && after > 0) this._zoom(before / after);
        this._pan(dx / 2, dy / 2);
      });
      const up = (event) => {
        const had = down.delete(event.pointerId);
        if (!down.size) canvas.style.cursor = "grab";
        if (had && event.type === "pointerup" && !down.size && travelled < 5 && event.button === 0) {
          this._emit("click", event);
        }
      };
      canvas.addEventListener("pointerup", up);
      canvas.addEventListener("pointercancel", up);
      canvas.addEventListener("pointerleave", (event) => this._hover(event));
      canvas.addEventListener("contextmenu", (event) => event.preventDefault());
      canvas.addEventListener("dblclick", () => this.reset());
      canvas.addEventListener("wheel", (event) => {
        if (this._embedded && !event.ctrlKey && document.activeElement !== canvas) return;
        event.preventDefault();
        const lines = event.deltaMode === 1 ? 16 : 1;
        this._zoom(Math.exp(Math.max(-80, Math.min(80, event.deltaY * lines)) * 0.002));
      }, { passive: false });
      canvas.addEventListener("keydown", (event) => {
        if (event.ctrlKey || event.metaKey || event.altKey) return;
        const step = Math.PI / 24;
        const keys = {
          ArrowLeft: () => this._turn(-step, 0), ArrowRight: () => this._turn(step, 0),
          ArrowUp: () => this._turn(0, step), ArrowDown: () => this._turn(0, -step),
          "+": () => this._zoom(1 / 1.12), "=": () => this._zoom(1 / 1.12), "-": () => this._zoom(1.12),
          Home: () => this.reset(),
        };
        const act = keys[event.key];
        if (!act) return;
        event.preventDefault();
        act();
      });
    }
  };

  function copy(camera) {
    return { ...camera, target: Array.from(camera.target), extent: Array.from(camera.extent) };
  }

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

  function useMap(thing, colours) {
    if (thing.texture) thing.texture.dispose();
    thing.texture = thing.material.uniforms.map.value = texture(colours);
  }

  function texture(map) {
    const data = new Uint8Array(4 * map.length);
    map.forEach((colour, k) => data.set([255 * colour[0], 255 * colour[1], 255 * colour[2], 255].map(Math.round), 4 * k));
    const out = new THREE.DataTexture(data, map.length, 1);
    out.minFilter = out.magFilter = THREE.LinearFilter;
    out.needsUpdate = true;
    return out;
  }

  function material(isPoints) {
    const uniforms = {
      colour: { value: new THREE.Vector3() }, signal: { value: new THREE.Vector3() },
      unknown: { value: new THREE.Vector3() }, map: { value: null }, range: { value: new THREE.Vector2(0, 1) },
      threshold: { value: 1e30 }, paint: { value: 0 }, squares: { value: 2 }, opacity: { value: 1 }, nearer: { value: 0 },
    };
    if (isPoints) {
      Object.assign(uniforms, {
        size: { value: 1 }, pixels: { value: 1 }, inPixels: { value: 0 }, rim: { value: 0 },
      });
    }
    return new THREE.ShaderMaterial({
      uniforms,
      vertexShader: isPoints ? POINT_VERTEX : SURFACE_VERTEX,
      fragmentShader: isPoints ? POINT_FRAGMENT : SURFACE_FRAGMENT,
      side: THREE.DoubleSide,
    });
  }

  function behind(element) {
    for (let e = element; e; e = e.parentElement) {
      const colour = getComputedStyle(e).backgroundColor;
      if (colour && colour !== "transparent" && colour !== "rgba(0, 0, 0, 0)") return colour;
    }
    return "#ffffff";
  }

  // Colour bar ------------------------------------------------------------------------------------------------------

  /** Fill `element` with a bar of `map` from range[0] to range[1], its title and unit; open: values may lie beyond; keys: [text, colour] below it. */
  Shapespace.colourBar = function (element, { map, range, unit = "mm", title = "", open = false, keys = [] }) {
    const css = map.map((c) => `rgb(${c.map((v) => Math.round(255 * v)).join(",")})`);
    const middle = (range[0] + range[1]) / 2;
    element.replaceChildren();
    element.classList.add("shapespace-bar");
    element.setAttribute("role", "img");
    const others = keys.map(([text]) => `; apart from the scale: ${text}`).join("");
    element.setAttribute("aria-label", `${title}, from ${number(range[0])} to ${number(range[1])} ${unit}${others}`);
    const heading = document.createElement("span");
    heading.className = "shapespace-bar-title";
    heading.textContent = unit ? `${title} (${unit})` : title;
    const bar = document.createElement("span");
    bar.className = "shapespace-bar-colours";
    bar.style.background = `linear-gradient(to right, ${css.join(",")})`;
    const ticks = document.createElement("span");
    ticks.className = "shapespace-bar-ticks";
    for (const value of [range[0], middle, range[1]]) {
      const tick = document.createElement("span");
      const beyond = !open || value === middle || (value === range[0] && value === 0) ? "" : value < middle ? "\u2264 " : "\u2265 ";
      tick.textContent = beyond + number(value);
      ticks.appendChild(tick);
    }
    element.append(heading, bar, ticks);
    for (const [text, colour] of keys) {
      const key = document.createElement("span"), dot = document.createElement("span");
      key.className = "shapespace-bar-key";
      dot.className = "shapespace-bar-dot";
      dot.style.background = `rgb(${colour.map((v) => Math.round(255 * v)).join(",")})`;
      key.append(dot, text);
      element.append(key);
    }
  };

  function number(value) {
    const digits = Math.abs(value) >= 10 || Number.isInteger(value) ? 0 : Math.abs(value) >= 1 ? 1 : 2;
    return value.toFixed(digits).replace("-", "\u2212");
  }
  Shapespace.number = number;

  /**
   * What the colours of a fit's distances mean, for report and viewer: {title, range, map, keys} of `colourBar`.
   * onModel: painted on the model, else on the scan; colours: {diverging, sequential, unknown}.
   */
  Shapespace.distanceScale = function (facts, values, onModel, colours) {
    const top = facts.scale_mm > 0 ? facts.scale_mm : 1, signed = facts.signed !== false;
    const unsigned = onModel ? "Distance to the points" : "Distance of the points to the model";
    const grey = onModel ? "not shown by the scan" : "beyond the model\u2019s rim, not counted";
    return {
      title: signed ? "Scan inside (\u2212) or outside (+) of the model" : unsigned,
      range: [signed ? -top : 0, top],
      map: signed ? colours.diverging : colours.sequential,
      keys: values.some(Number.isNaN) ? [[grey, colours.unknown]] : [],
      unit: "mm",
      open: true,
    };
  };
})();
