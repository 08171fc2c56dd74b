/* One fit, saved or just made: stages, overlay or side by side, distance maps with a threshold, regions, iterations. */
(function () {
  "use strict";

  const Viewer = window.ShapespaceViewer;

  const { h } = Viewer;

  /** Fill the track of a slider from its middle (a range about zero) or from its start. */
  const paintTrack = (Viewer.paintTrack = function (slider) {
    const low = Number(slider.min), high = Number(slider.max), value = Number(slider.value);
    const share = (v) => `${((100 * (v - low)) / (high - low || 1)).toFixed(2)}%`;
    const zero = low < 0 ? 0 : low;
    slider.style.setProperty("--from", share(Math.min(value, zero)));
    slider.style.setProperty("--to", share(Math.max(value, zero)));
  });

  /** The next round number at or above a positive one. */
  Viewer.nice = function (value) {
    const power = 10 ** Math.floor(Math.log10(Math.max(value, 1e-3)));
    return [1, 1.5, 2, 3, 4, 5, 6, 8, 10].map((step) => step * power).find((step) => step >= value * 0.9999) || 10 * power;
  };

  /** The q-quantile of the absolute finite values. */
  Viewer.quantile = function (values, q) {
    const sorted = Float32Array.from(values).filter(Number.isFinite).map(Math.abs).sort();
    return sorted.length ? sorted[Math.min(sorted.length - 1, Math.floor(q * sorted.length))] : 0;
  };

  const STAGES = { before: "Before", initial: "Phase 1", final: "Phase 2", dense: "Dense" };
  const STAGE_TITLES = {
    before: "Before: centroids together", initial: "After phase 1: the pose", final: "After phase 2: pose and shape",
    dense: "Dense: the rest of the way to the scan",
  };
  const NEARER = (Viewer.NEARER = "the nearer one is shown");
  const REGIONS = { followed: "followed", rejected: "rejected as not matching", border: "at the scan's border", unseen: "not shown by the scan" };
  const REGION_CODES = ["followed", "rejected", "border", "unseen"];

  function segments(choices, label, id, choose) {
    const element = h("div", { class: "segments", role: "group", "aria-label": label, "data-testid": id });
    for (const [key, text] of choices) {
      element.append(h("button", { type: "button", "data-value": key, "aria-pressed": "false", onclick: () => choose(key) }, text));
    }
    return element;
  }

  function press(element, key) {
    for (const button of element.children) button.setAttribute("aria-pressed", String(button.dataset.value === key));
  }

  /**
   * The controls of one fit in `element`, which draw into `context.stage`.
   * context: {stage, model, about, apply(z, name), download(question, kind, name), alert(sentence)}.
   */
  Viewer.FitView = class {
    constructor(element, context, prefix) {
      this.element = element;
      this.context = context;
      this.prefix = prefix;
      this.payload = null;
      this.active = false;
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
      this._build();
      this._fill();
      this._opacities();
      if (this.active) this.draw(true);
      return facts;
    }

    clear() {
      this.stop();
      this.payload = null;
      this.element.replaceChildren();
    }

    _build() {
      const { prefix, view } = this, { arrays, facts } = this.payload;
      const id = (name) => `${prefix}-${name}`;
      this.stageButtons = segments(facts.stages.map((s) => [s, s === "final" && !facts.stages.includes("initial") ? "Fitted" : STAGES[s] || s]), "Stage", id("stage"), (stage) => {
        this.stop();
        Object.assign(this.view, { stage, moment: null });
        this.draw();
      });
      this.layoutButtons = segments([["overlay", "Overlaid"], ["side", "Side by side"]], "Layout", id("layout"), (layout) => {
        this.view.layout = layout;
        this._opacities();
        this.draw();
      });
      this.colourButtons = segments(this.colours, "Colour", id("colour"), (colour) => {
        this.view.colour = colour;
        if (this.view.moment !== null) Object.assign(this.view, { moment: null, stage: "final" });
        this.stop();
        this._opacities();
        this.draw();
      });
      const slider = (name, text, low, high, step, value, oninput) => {
        const input = h("input", { type: "range", id: id(name), "data-testid": id(name), min: low, max: high, step, value });
        const output = h("output", { for: id(name) });
        input.addEventListener("input", () => oninput(Number(input.value)));
        return { row: h("label", { class: "slider" }, h("span", {}, text), input, output), input, output };
      };
      this.scanSlider = slider("scan-opacity", "Scan", 0, 1, 0.01, 1, (v) => { this.view.scanOpacity = v; this.draw(); });
      this.modelSlider = slider("model-opacity", "Model", 0, 1, 0.01, 1, (v) => { this.view.modelOpacity = v; this.draw(); });
      this.mark = h("input", { type: "checkbox", id: id("mark"), "data-testid": id("mark") });
      this.mark.addEventListener("change", () => { this.view.marked = this.mark.checked; this.draw(); });
      this.threshold = slider("threshold", "Threshold", 0, 2 * this.limit, this.limit > 5 ? 0.1 : 0.05, view.threshold, (v) => {
        Object.assign(this.view, { threshold: v, marked: true });
        this.draw();
      });
      this.share = h("p", { class: "share", id: id("share"), "data-testid": id("share"), role: "status" });
      this.mapControls = h("div", {}, this.threshold.row, h("label", { class: "check" }, this.mark, "Mark what lies beyond"), this.share);
      const last = Math.max(this.n - 1, 0);
      this.moments = slider("moment", "Iteration", 0, last, 1, last, (v) => { this.stop(); this.goTo(v); });
      this.play = h("button", { type: "button", id: id("play"), "data-testid": id("play"), "aria-pressed": "false", onclick: () => this.toggle() }, "Play the fit");
      this.rms = h("div", { class: "chart" });
      this.steps = this.n > 1 ? h("div", {}, h("h2", {}, "Iterations"), this.moments.row, h("div", { class: "row" }, this.play), this.rms) : null;
      this.bars = h("div", { class: "chart" });
      this.exported = h("h2", { "data-testid": id("exported") });
      const kinds = this.context.about.exports;
      const exports = h("div", { class: "row" },
        ...kinds.map((kind) => h("button", {
          type: "button", "data-testid": id(`export-${kind}`), onclick: () => this._surface(kind),
        }, `Surface ${kind.toUpperCase()}`)),
        h("button", { type: "button", "data-testid": id("export-csv"), onclick: () => this._csv() }, "Coefficients CSV"),
        h("button", { type: "button", "data-testid": id("use"), onclick: () => this.context.apply(this._z(), facts.label || facts.name) }, "Use in Model"));
      this.element.replaceChildren(
        ...[facts.without_scan ? h("p", { "data-testid": id("without-scan") }, facts.without_scan) : null,
          ...(facts.stages.length > 1 ? [h("h2", {}, "Stage"), this.stageButtons] : []), h("h2", {}, "Show"), arrays.scan ? this.layoutButtons : null, this.colourButtons,
          arrays.scan ? this.scanSlider.row : null, this.modelSlider.row, this.mapControls, this.steps, this.bars, this.exported, exports].filter(Boolean));
      if (this.steps) Viewer.rmsChart(this.rms, Array.from(arrays.history_rms_mm), Array.from(arrays.history_phase), null);
      const error = Array.from(arrays.b_stddev, (sd, k) => sd / (k < this.stddev.length ? this.stddev[k] : NaN));
      Viewer.coefficientChart(this.bars, [{ z: this._z(), error }], this.K);
    }

    _surface(kind) {
      const dense = this.view.stage === "dense";
      this.context.download({ ...this.source, stage: dense ? "dense" : "final" }, kind, `${this.payload.facts.name}.${dense ? "dense" : "fitted"}`);
    }

    _z() {
      return this.source.z || Array.from(this.payload.arrays.z);
    }

    _csv() {
      const { facts, arrays } = this.payload;
      const b = this.source.b || Array.from(arrays.b), sd = this.source.b_stddev || Array.from(arrays.b_stddev);
      const name = facts.name.replace(/\.[^.]*$/, "");
      Viewer.save(Viewer.coefficientsCsv([{ name, status: facts.status, b, z: this._z(), sd }], this.context.about.modes), `${name}.coefficients.csv`);
    }

    /** Put the surfaces of the payload into the views. */
    _fill() {
      const { arrays } = this.payload;
      this.scan = arrays.scan ? { positions: arrays.scan, faces: arrays.scan_faces || null } : null;
      this.surface = (stage) => arrays[`surface_${stage}`];
      this._moved = new Float32Array(this.surface("final").length);
    }

    _opacities() {
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
        this._opacities();
      }
      this.draw();
    }

    toggle() {
      if (this._playing) { this.stop(); return; }
      this.play.setAttribute("aria-pressed", "true");
      this.play.textContent = "Pause";
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
      if (!this.play) return;
      this.play.setAttribute("aria-pressed", "false");
      this.play.textContent = "Play the fit";
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
      const { stage, about } = this.context;
      const side = view.layout === "side";
      stage.split(side);
      const model = side ? stage.b : stage.a;
      const other = side ? stage.a : stage.b;
      if (other) other.remove("model");
      const positions = view.moment === null ? this.surface(view.stage) : this._at(view.moment);
      if (stage.holds !== this) {
        stage.clear();
        stage.holds = this;
        if (this.scan) stage.a.setSurface("scan", { ...this.scan, colour: about.scan_colour });
        this._drawn = payload;
      } else if (this._drawn !== payload) {
        if (this.scan) stage.a.setSurface("scan", { ...this.scan, colour: about.scan_colour });
        else stage.a.remove("scan");
        model.remove("model");
        this._drawn = payload;
      }
      if (!model.has("model")) model.setSurface("model", { positions, faces: arrays.faces || null, colour: about.model_colour });
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
      this._controls();
    }

    _paint(model) {
      const { view } = this, { arrays } = this.payload, { stage, about } = this.context;
      if (this.scan) stage.a.paint("scan", null);
      model.paint("model", null);
      stage.bar(null);
      stage.legend(null);
      this.shared = null;
      if (view.moment !== null || view.colour === "plain") {
        const both = [...(this.scan ? [["scan", about.scan_colour]] : []), ["model", about.model_colour]];
        const opaque = view.scanOpacity > 0.99 && view.modelOpacity > 0.99;
        stage.legend(view.layout === "overlay" ? both : null, opaque && this.scan ? NEARER : "");
        return;
      }
      if (view.colour === "regions") {
        model.paint("model", arrays.regions, { categories: REGION_CODES.map((name) => about.region_colours[name]) });
        stage.legend(REGION_CODES.map((name) => [REGIONS[name], about.region_colours[name]]));
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
      const { diverging, sequential, unknown_colour: unknown, signal_colour: signal } = about;
      const scale = Shapespace.distanceScale(this.payload.facts, values, onModel, { diverging, sequential, unknown });
      const options = { map: scale.map, range: scale.range, threshold: view.marked ? view.threshold : null, signal, unknown };
      if (onModel) model.paint("model", values, options);
      else stage.a.paint("scan", values, options);
      const beyond = view.marked ? [["beyond the threshold", signal]] : [];
      stage.bar({ ...scale, keys: [...beyond, ...scale.keys] });
      this.shared = { values, onModel };
    }

    _controls() {
      const { view } = this, { arrays } = this.payload;
      press(this.stageButtons, view.moment === null ? view.stage : "");
      press(this.layoutButtons, view.layout);
      this.exported.textContent = view.stage === "dense" ? "Export the dense surface" : "Export the fitted surface";
      press(this.colourButtons, view.colour);
      for (const [slider, value] of [[this.scanSlider, view.scanOpacity], [this.modelSlider, view.modelOpacity]]) {
        slider.input.value = value;
        slider.output.textContent = `${Math.round(100 * value)} %`;
        paintTrack(slider.input);
      }
      this.mapControls.hidden = this.shared === null;
      if (this.shared) {
        this.mark.checked = view.marked;
        this.threshold.input.value = view.threshold;
        this.threshold.output.textContent = `${view.threshold.toFixed(this.limit > 5 ? 1 : 2)} mm`;
        paintTrack(this.threshold.input);
        let beyond = 0, known = 0;
        for (const value of this.shared.values) {
          if (!Number.isFinite(value)) continue;
          known += 1;
          if (Math.abs(value) > view.threshold) beyond += 1;
        }
        const share = known ? ((100 * beyond) / known).toFixed(1) : "0.0";
        const what = this.shared.onModel ? "the model's vertices that the scan shows lie" : "the scan's points that the model covers lie";
        this.share.textContent = `${share} % of ${what} beyond ${view.threshold.toFixed(this.limit > 5 ? 1 : 2)} mm.`;
      }
      if (this.steps) {
        const at = view.moment === null ? this.n - 1 : view.moment;
        this.moments.input.value = at;
        this.moments.output.textContent = `${at + 1} / ${this.n}`;
        paintTrack(this.moments.input);
        Viewer.rmsChart(this.rms, Array.from(arrays.history_rms_mm), Array.from(arrays.history_phase), at);
      }
    }
  };

  /** Coefficients of a model of K modes as CSV in the columns of coefficients.csv: rows of {name, status, b, z, sd}. */
  Viewer.coefficientsCsv = function (rows, K) {
    const whole = (values) => Array.from({ length: K }, (_, k) => (k < values.length ? values[k] : ""));
    const each = (letter, end = "") => Array.from({ length: K }, (_, k) => `${letter}${k + 1}${end}`);
    const withError = rows.some((row) => row.sd);
    const lines = [["scan", "status", ...each("b"), ...each("z"), ...(withError ? each("b", "_stddev") : [])].join(",")];
    // A spreadsheet would run a name that starts like a formula.
    const cell = (text) => `"${(/^[=+\-@\t\r]/.test(text) ? "'" : "") + String(text).replace(/"/g, '""')}"`;
    for (const row of rows) lines.push([cell(row.name), cell(row.status || ""), ...whole(row.b), ...whole(row.z), ...(row.sd ? whole(row.sd) : [])].join(","));
    return new Blob([lines.join("\n") + "\n"], { type: "text/csv" });
  };
})();
