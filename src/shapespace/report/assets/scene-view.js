/* A view: a canvas that shows surfaces, with a camera that the user turns. */
(function () {
  "use strict";

  const Shapespace = window.Shapespace;
  const parts = Shapespace.sceneParts;
  const { copyCamera, gpu, views, waiting } = parts;

  const NO_WEBGL = "This browser shows no 3-D pictures here, because WebGL is switched off or missing.";
  // Where the processor draws: pixels of all views that move together, of a view at rest, and the time until it rests.
  const DRAFT_PIXELS = 3.2e5, STILL_PIXELS = 3e6, RESTS_MS = 160;
  const MANY = 4; // views; more take as long to show as to draw, and share half of the pixels

  /** The camera on the opposite side of the target, upright as this one. */
  const opposite = (state) => ({ ...copyCamera(state), yaw: state.yaw + Math.PI, pitch: -state.pitch, roll: -state.roll });

  /**
   * A canvas in `element` that shows surfaces and points, turned by mouse, touch and keys; drawn only when it changed.
   *
   * Options: label (what is seen, for screen readers), background (a CSS colour; none shows the page through), embedded
   * (true: a page can be scrolled over it, so the wheel zooms only once it has the focus, and one finger turns only
   * sideways).
   */
  Shapespace.View = class extends parts.Surfaces {
    constructor(element, options) {
      super(gpu() !== null);
      const { label = "3-D picture", background = null, embedded = true } = options || {};
      this.element = element;
      this.frames = 0; // drawn so far
      this.lastRedrawMs = NaN; // how long the last one kept the page busy
      this._background = background;
      this._embedded = embedded;
      this._linked = new Map(); // view -> whether it looks from the opposite side
      this._listeners = {};
      this._frame = document.createElement("div");
      this._camera = new parts.OrbitCamera(this._frame);
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
      Object.assign(this._frame.style, { position: "relative", width: "100%", height: "100%", overflow: "hidden" });
      this._names = document.createElement("canvas");
      this._names.setAttribute("aria-hidden", "true");
      Object.assign(this._names.style, {
        position: "absolute", inset: "0", width: "100%", height: "100%", pointerEvents: "none", display: "none",
      });
      this._frame.append(this.canvas, this._names);
      element.appendChild(this._frame);
      this._shown = this.canvas.getContext("bitmaprenderer");
      this._eye = new THREE.PerspectiveCamera(20, 1, 1, 1000);
      this._eye.matrixAutoUpdate = false;
      this._watch();
      parts.listen(this);
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

    // Camera

    /** Go to where all that is visible, or the given ids, fills the picture from the front, or `turned` from any side; margin 1.1 leaves more. */
    frame(ids, margin = 1, turned = false) {
      if (!this._enclose(ids, margin, turned)) return;
      Object.assign(this._camera.state, { yaw: 0, pitch: 0, roll: 0, zoom: 1 });
      this._camera.home = copyCamera(this._camera.state);
      this._moved();
    }

    /** Enclose what `frame` did, which is larger or smaller now, from where the camera is. */
    refit() {
      if (!this._framed || !this._enclose(...this._framed)) return;
      const { target, extent } = copyCamera(this._camera.state);
      Object.assign(this._camera.home, { target, extent });
      this._moved();
    }

    /** Centre the camera on the visible objects and fit its extent to them; return whether an object is visible. */
    _enclose(ids, margin, turned) {
      if (!this.works) return false;
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
      if (!(low[0] <= high[0])) return false;
      this._framed = [ids, margin, turned];
      const { state } = this._camera;
      state.target = low.map((value, axis) => (value + high[axis]) / 2);
      state.extent = low.map((value, axis) => Math.max((high[axis] - value) * margin, 1e-3));
      if (turned) state.extent.fill(Math.max(...state.extent));
      return true;
    }

    get camera() {
      return copyCamera(this._camera.state);
    }

    set camera(value) {
      this._camera.state = copyCamera({ ...this._camera.state, ...value });
      this._moved();
    }

    /** Go back to where `frame` put the camera. */
    reset() {
      if (this._camera.home) this.camera = this._camera.home;
    }

    /** From now on both views share one camera, or look from opposite sides. */
    link(other, isOpposite = false) {
      this._linked.set(other, isOpposite);
      other._linked.set(this, isOpposite);
      const copy = isOpposite ? opposite : copyCamera;
      other._camera.state = copy(this._camera.state);
      other._camera.home = this._camera.home && copy(this._camera.home);
      other.request();
    }

    _moved(from) {
      this.request();
      this._emit("camera", this);
      for (const [other, isOpposite] of this._linked) {
        if (other === from) continue;
        other._camera.state = (isOpposite ? opposite : copyCamera)(this._camera.state);
        other._moved(this);
      }
    }

    // Drawing

    /** Ask for a redraw with the next frame of the browser. */
    request() {
      if (!this.works || this._disposed) return;
      parts.requestRedraw(this);
    }

    /** Whether what is seen is final: nothing waits to be drawn, or to be drawn finer. */
    get rests() {
      return !waiting.has(this) && !this._later;
    }

    /** Draw at once as while something moves, wait until the picture is there, and return the milliseconds it took. */
    redraw() {
      if (!this.works) return NaN;
      const start = performance.now();
      this._draw(1, true);
      return performance.now() - start;
    }

    /** together: number of views that are drawn with the same frame. */
    _draw(together, wait) {
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
        const pixels = (together > MANY ? DRAFT_PIXELS / 2 : DRAFT_PIXELS) / together;
        ratio = Math.min(ratio, Math.max(Math.sqrt(pixels / area), 0.5));
        this._later = setTimeout(() => {
          this._later = 0;
          if (this._near) this._present(Math.min(2, Math.sqrt(STILL_PIXELS / area)));
        }, RESTS_MS);
      }
      this._present(ratio, page.bySoftware, wait);
    }

    _present(ratio, isDraft, wait) {
      const page = gpu();
      if (!page || page.lost || this._disposed) return;
      const width = Math.round(this._frame.clientWidth * ratio), height = Math.round(this._frame.clientHeight * ratio);
      if (width < 1 || height < 1) return;
      const start = performance.now();
      this._size = [width, height];
      if (page.canvas.width !== width || page.canvas.height !== height) page.renderer.setSize(width, height, false);
      this._camera.aim(this._eye, width, height);
      parts.drawSurfaces(this, page.renderer, height, ratio, isDraft);
      if (wait) page.context.readPixels(0, 0, 1, 1, page.context.RGBA, page.context.UNSIGNED_BYTE, new Uint8Array(4));
      this._shown.transferFromImageBitmap(page.canvas.transferToImageBitmap());
      parts.writeNames(this);
      this.frames += 1;
      this.lastRedrawMs = performance.now() - start;
      this._emit("draw", this);
    }

    /** CSS pixels of a point in the canvas, and how far it lies behind the camera's target. */
    project(point) {
      return this._camera.project(point);
    }

    // Asking

    /** What is under a point of the window: {id, point, vertex}, or null. */
    pick(clientX, clientY, ids) {
      return parts.pick(this, clientX, clientY, ids);
    }

    /** The current picture as PNG, on the page's own background. */
    png() {
      if (!this.works) return Promise.reject(new Error(NO_WEBGL));
      clearTimeout(this._later);
      this._present(2);
      const copyOf = document.createElement("canvas");
      [copyOf.width, copyOf.height] = this._size;
      const context = copyOf.getContext("2d");
      context.fillStyle = this._background || parts.backgroundOf(this.element);
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
      for (const other of this._linked.keys()) other._linked.delete(this);
      if (this._resizes) this._resizes.disconnect();
      if (this._sees) this._sees.disconnect();
      for (const id of Array.from(this._things.keys())) this.remove(id);
      clearTimeout(this._later);
      this._frame.remove();
      if (this._note) this._note.remove();
    }

    /** Redraw when the canvas has another size, or comes near the screen. */
    _watch() {
      this._resizes = new ResizeObserver(() => this.request());
      this._resizes.observe(this.canvas);
      this._sees = new IntersectionObserver((entries) => {
        this._near = entries[entries.length - 1].isIntersecting;
        if (this._near) this.request();
      }, { rootMargin: "200px" });
      this._sees.observe(this.canvas);
    }
  };
})();
