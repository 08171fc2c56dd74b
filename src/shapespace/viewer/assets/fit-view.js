/* One fit as it is drawn: stages, overlay or side by side, distance maps, regions, iterations. */
(function () {
  "use strict";

  const Viewer = window.ShapespaceViewer;

  const STAGE_TITLES = {
    before: "Before: centroids together", initial: "After phase 1: the pose", final: "After phase 2: pose and shape",
    dense: "Dense: the rest of the way to the scan",
  };
  const NEARER = "the nearer one is shown";
  const REGIONS = { followed: "followed", rejected: "rejected as not matching", border: "at the scan's border", unseen: "not shown by the scan" };
  const REGION_CODES = ["followed", "rejected", "border", "unseen"];

  /**
   * One fit, with its controls in `element` and its pictures in `context.stage`.
   * context: {stage, model, about, apply(z), download(question, kind, name)}.
   */
  Viewer.FitView = class {
    constructor(element, context) {
      this.element = element;
      this.context = context;
      this.payload = null;
      this.active = false;
      this.controls = null;
      this._playing = 0;
    }

    /** Show the fit in `payload` (unpacked); `source` says where its fitted surface is exported from. */
    show(payload, source) {
      const { facts, arrays } = payload;
      this.stop();
      this.payload = payload;
      this.source = source;
      this.n = arrays.history_phase ? arrays.history_phase.length : 0;
      this.K = arrays.b.length;
      this.stddev = this.context.about.stddev;
      this.limit = facts.scale_mm > 0 ? facts.scale_mm : 1;
      const keep = this.view || {};
      this.colours = [["plain", "Plain"]];
      if (arrays.scan) this.colours.push(["model", "Model to scan"], ["scan", "Scan to model"]);
      if (arrays.regions) this.colours.push(["regions", "Regions"]);
      if (arrays.colours_final && arrays.scan_colours) this.colours.push(["colour", "Colour of the scan"]);
      this.view = {
        stage: "final", moment: null, layout: (arrays.scan && keep.layout) || "overlay", colour: this.colours.some(([key]) => key === keep.colour) ? keep.colour : "plain",
        scanOpacity: 1, modelOpacity: 1, marked: false, threshold: Math.min(this.limit / 2, 2),
      };
      this.controls = new Viewer.FitControls(this);
      this._fill();
      this.setOpacities();
      if (this.active) this.draw(true);
      return facts;
    }

    clear() {
      this.stop();
      this.payload = null;
      this.element.replaceChildren();
    }

    /** Put the surfaces of the payload into the views. */
    _fill() {
      const { arrays } = this.payload;
      this.scan = arrays.scan ? { positions: arrays.scan, faces: arrays.scan_faces || null } : null;
      this.surface = (stage) => arrays[`surface_${stage}`];
      this._moved = new Float32Array(this.surface("final").length);
    }

    /** Show both surfaces, or only the painted one of two that are overlaid. */
    setOpacities() {
      const view = this.view;
      const overlay = view.layout === "overlay";
      const only = { plain: null, model: "model", regions: "model", scan: "scan", colour: "model" }[view.colour];
      view.scanOpacity = overlay && only === "model" ? 0 : 1;
      view.modelOpacity = overlay && only === "scan" ? 0 : 1;
    }

    /** Go to a saved iteration. */
    goTo(index) {
      this.view.moment = Math.max(0, Math.min(this.n - 1, index));
      if (this.view.colour !== "plain") {
        this.view.colour = "plain";
        this.setOpacities();
      }
      this.draw();
    }

    toggle() {
      if (this._playing) { this.stop(); return; }
      this.controls.playing(true);
      let at = this.view.moment === null || this.view.moment >= this.n - 1 ? 0 : this.view.moment;
      const pause = Math.max(40, Math.min(250, 6000 / this.n));
      const step = () => {
        this.goTo(at);
        at += 1;
        this._playing = at < this.n ? setTimeout(step, pause) : 0;
        if (!this._playing) this.stop();
      };
      this._playing = 1;
      step();
    }

    stop() {
      clearTimeout(this._playing);
      this._playing = 0;
      if (this.controls) this.controls.playing(false);
    }

    /** The model's vertices at a saved iteration, in the frame of the final pose. */
    _at(moment) {
      const { history_b: b, history_T: T } = this.payload.arrays;
      const z = new Float64Array(this.context.model.K);
      for (let k = 0; k < Math.min(z.length, this.K); k++) z[k] = b[moment * this.K + k] / this.stddev[k];
      const from = this.context.model.vertices(z), to = this._moved, t = 12 * moment;
      for (let i = 0; i < from.length; i += 3) {
        for (let r = 0; r < 3; r++) {
          to[i + r] = T[t + 4 * r] * from[i] + T[t + 4 * r + 1] * from[i + 1] + T[t + 4 * r + 2] * from[i + 2] + T[t + 4 * r + 3];
        }
      }
      return to;
    }

    /** Draw everything as the controls say; `frame` also moves the camera to where it fills the picture. */
    draw(frame) {
      if (!this.payload || !this.active) return;
      const { view, payload } = this, { arrays, facts } = payload;
      const { stage } = this.context;
      const side = view.layout === "side";
      stage.split(side);
      const model = side ? stage.b : stage.a;
      const other = side ? stage.a : stage.b;
      if (other) other.remove("model");
      const positions = view.moment === null ? this.surface(view.stage) : this._at(view.moment);
      if (stage.holds !== this) {
        stage.clear();
        stage.holds = this;
        if (this.scan) stage.a.setSurface("scan", { ...this.scan, colour: Shapespace.colours.scan });
        this._drawn = payload;
      } else if (this._drawn !== payload) {
        if (this.scan) stage.a.setSurface("scan", { ...this.scan, colour: Shapespace.colours.scan });
        else stage.a.remove("scan");
        model.remove("model");
        this._drawn = payload;
      }
      if (!model.has("model")) model.setSurface("model", { positions, faces: arrays.faces || null, colour: Shapespace.colours.model });
      else model.move("model", positions);
      if (this.scan) stage.a.set("scan", { opacity: view.scanOpacity, visible: view.scanOpacity > 0.01 });
      model.set("model", { opacity: view.modelOpacity, visible: view.modelOpacity > 0.01 });
      this._paint(model);
      if (frame) stage.a.frame(["scan", "model"].filter((id) => stage.a.has(id)));
      if (frame && side) stage.a.link(stage.b);
      const ended = view.stage === "final" && !facts.stages.includes("initial");
      const when = view.moment === null ? (ended ? "The fitted model" : STAGE_TITLES[view.stage] || view.stage)
        : `Phase ${arrays.history_phase[view.moment]}, iteration ${arrays.history_iteration[view.moment]}: RMS ${arrays.history_rms_mm[view.moment].toFixed(2)} mm`;
      const name = facts.label || facts.name;
      stage.captions(side ? `${name}: the scan` : `${name}. ${when}`, side ? when : "");
      this.controls.update();
    }

    _paint(model) {
      const { view } = this, { arrays } = this.payload, { stage } = this.context;
      if (this.scan) stage.a.paint("scan", null);
      model.paint("model", null);
      stage.bar(null);
      stage.legend(null);
      this.shared = null;
      if (view.moment !== null || view.colour === "plain") {
        const both = [...(this.scan ? [["scan", Shapespace.colours.scan]] : []), ["model", Shapespace.colours.model]];
        const opaque = view.scanOpacity > 0.99 && view.modelOpacity > 0.99;
        stage.legend(view.layout === "overlay" ? both : null, opaque && this.scan ? NEARER : "");
        return;
      }
      if (view.colour === "regions") {
        model.paint("model", arrays.regions, { categories: REGION_CODES.map((name) => Shapespace.colours.regions[name]) });
        stage.legend(REGION_CODES.map((name) => [REGIONS[name], Shapespace.colours.regions[name]]));
        return;
      }
      if (view.colour === "colour") {
        stage.a.paint("scan", arrays.scan_colours, { rgb: true });
        model.paint("model", arrays[`colours_${view.stage}`] || arrays.colours_final, { rgb: true });
        stage.legend([["not followed on the scan", [0.5, 0.5, 0.5]]]);
        return;
      }
      const onModel = view.colour === "model";
      const values = arrays[onModel ? `model_to_scan_${view.stage}` : `scan_to_model_${view.stage}`];
      const { diverging, sequential, unknown, signal } = Shapespace.colours;
      const scale = Shapespace.distanceScale(this.payload.facts, values, onModel, { diverging, sequential, unknown });
      const options = { map: scale.map, range: scale.range, threshold: view.marked ? view.threshold : null, signal, unknown };
      if (onModel) model.paint("model", values, options);
      else stage.a.paint("scan", values, options);
      const beyond = view.marked ? [["beyond the threshold", signal]] : [];
      stage.bar({ ...scale, keys: [...beyond, ...scale.keys] });
      this.shared = { values, onModel };
    }
  };
})();
