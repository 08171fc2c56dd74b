/* The controls of one fit: stages, layout, colours, opacities, threshold, iterations and exports. */
(function () {
  "use strict";

  const Viewer = window.ShapespaceViewer;
  const { h } = Viewer;
  const STAGES = { before: "Before", initial: "Phase 1", final: "Phase 2", dense: "Dense" };

  /** Fill the track of a slider from its middle (a range about zero) or from its start. */
  const paintTrack = (Viewer.paintTrack = function (slider) {
    const low = Number(slider.min), high = Number(slider.max), value = Number(slider.value);
    const share = (v) => `${((100 * (v - low)) / (high - low || 1)).toFixed(2)}%`;
    const zero = low < 0 ? 0 : low;
    slider.style.setProperty("--from", share(Math.min(value, zero)));
    slider.style.setProperty("--to", share(Math.max(value, zero)));
  });

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

  /** The controls of `fit`, a FitView, in its element: made for a payload, and updated with each picture. */
  Viewer.FitControls = class {
    constructor(fit) {
      const { view } = fit, { arrays, facts } = fit.payload;
      this.fit = fit;
      const id = (name) => `fit-${name}`;
      this.stageButtons = segments(facts.stages.map((s) => [s, s === "final" && !facts.stages.includes("initial") ? "Fitted" : STAGES[s] || s]), "Stage", id("stage"), (stage) => {
        fit.stop();
        Object.assign(fit.view, { stage, moment: null });
        fit.draw();
      });
      this.layoutButtons = segments([["overlay", "Overlaid"], ["side", "Side by side"]], "Layout", id("layout"), (layout) => {
        fit.view.layout = layout;
        fit.setOpacities();
        fit.draw();
      });
      this.colourButtons = segments(fit.colours, "Colour", id("colour"), (colour) => {
        fit.view.colour = colour;
        if (fit.view.moment !== null) Object.assign(fit.view, { moment: null, stage: "final" });
        fit.stop();
        fit.setOpacities();
        fit.draw();
      });
      const slider = (name, text, low, high, step, value, oninput) => {
        const input = h("input", { type: "range", id: id(name), "data-testid": id(name), min: low, max: high, step, value });
        const output = h("output", { for: id(name) });
        input.addEventListener("input", () => oninput(Number(input.value)));
        return { row: h("label", { class: "slider" }, h("span", {}, text), input, output), input, output };
      };
      this.scanSlider = slider("scan-opacity", "Scan", 0, 1, 0.01, 1, (v) => { fit.view.scanOpacity = v; fit.draw(); });
      this.modelSlider = slider("model-opacity", "Model", 0, 1, 0.01, 1, (v) => { fit.view.modelOpacity = v; fit.draw(); });
      this.mark = h("input", { type: "checkbox", id: id("mark"), "data-testid": id("mark") });
      this.mark.addEventListener("change", () => { fit.view.marked = this.mark.checked; fit.draw(); });
      this.threshold = slider("threshold", "Threshold", 0, 2 * fit.limit, fit.limit > 5 ? 0.1 : 0.05, view.threshold, (v) => {
        Object.assign(fit.view, { threshold: v, marked: true });
        fit.draw();
      });
      this.share = h("p", { class: "share", id: id("share"), "data-testid": id("share"), role: "status" });
      this.mapControls = h("div", {}, this.threshold.row, h("label", { class: "check" }, this.mark, "Mark what lies beyond"), this.share);
      const last = Math.max(fit.n - 1, 0);
      this.moments = slider("moment", "Iteration", 0, last, 1, last, (v) => { fit.stop(); fit.goTo(v); });
      this.play = h("button", { type: "button", id: id("play"), "data-testid": id("play"), "aria-pressed": "false", onclick: () => fit.toggle() }, "Play the fit");
      this.rms = h("div", { class: "chart" });
      this.steps = fit.n > 1 ? h("div", {}, h("h2", {}, "Iterations"), this.moments.row, h("div", { class: "row" }, this.play), this.rms) : null;
      this.bars = h("div", { class: "chart" });
      this.exported = h("h2", { "data-testid": id("exported") });
      const kinds = fit.context.about.exports;
      const exports = h("div", { class: "row" },
        ...kinds.map((kind) => h("button", {
          type: "button", "data-testid": id(`export-${kind}`), onclick: () => this._surface(kind),
        }, `Surface ${kind.toUpperCase()}`)),
        h("button", { type: "button", "data-testid": id("export-csv"), onclick: () => this._csv() }, "Coefficients CSV"),
        h("button", { type: "button", "data-testid": id("use"), onclick: () => fit.context.apply(this._z()) }, "Use in Model"));
      fit.element.replaceChildren(
        ...[facts.without_scan ? h("p", { "data-testid": id("without-scan") }, facts.without_scan) : null,
          ...(facts.stages.length > 1 ? [h("h2", {}, "Stage"), this.stageButtons] : []), h("h2", {}, "Show"), arrays.scan ? this.layoutButtons : null, this.colourButtons,
          arrays.scan ? this.scanSlider.row : null, this.modelSlider.row, this.mapControls, this.steps, this.bars, this.exported, exports].filter(Boolean));
      if (this.steps) Viewer.rmsChart(this.rms, Array.from(arrays.history_rms_mm), Array.from(arrays.history_phase), null);
      const error = Array.from(arrays.b_stddev, (sd, k) => sd / (k < fit.stddev.length ? fit.stddev[k] : NaN));
      Viewer.coefficientChart(this.bars, [{ z: this._z(), error }], fit.K);
    }

    _surface(kind) {
      const { fit } = this, dense = fit.view.stage === "dense";
      fit.context.download({ ...fit.source, stage: dense ? "dense" : "final" }, kind, `${fit.payload.facts.name}.${dense ? "dense" : "fitted"}`);
    }

    _z() {
      return Array.from(this.fit.payload.arrays.z);
    }

    _csv() {
      const { fit } = this, { facts, arrays } = fit.payload;
      const b = Array.from(arrays.b), sd = Array.from(arrays.b_stddev);
      const name = facts.name.replace(/\.[^.]*$/, "");
      Viewer.save(Viewer.coefficientsCsv([{ name, status: facts.status, b, z: this._z(), sd }], fit.context.about.modes), `${name}.coefficients.csv`);
    }

    /** Show that the iterations are played, or that they are not. */
    playing(on) {
      this.play.setAttribute("aria-pressed", String(on));
      this.play.textContent = on ? "Pause" : "Play the fit";
    }

    /** Set the controls to the state of the fit. */
    update() {
      const { fit } = this, { view } = fit, { arrays } = fit.payload;
      press(this.stageButtons, view.moment === null ? view.stage : "");
      press(this.layoutButtons, view.layout);
      this.exported.textContent = view.stage === "dense" ? "Export the dense surface" : "Export the fitted surface";
      press(this.colourButtons, view.colour);
      for (const [slider, value] of [[this.scanSlider, view.scanOpacity], [this.modelSlider, view.modelOpacity]]) {
        slider.input.value = value;
        slider.output.textContent = `${Math.round(100 * value)} %`;
        paintTrack(slider.input);
      }
      this.mapControls.hidden = fit.shared === null;
      if (fit.shared) {
        this.mark.checked = view.marked;
        this.threshold.input.value = view.threshold;
        this.threshold.output.textContent = `${view.threshold.toFixed(fit.limit > 5 ? 1 : 2)} mm`;
        paintTrack(this.threshold.input);
        let beyond = 0, known = 0;
        for (const value of fit.shared.values) {
          if (!Number.isFinite(value)) continue;
          known += 1;
          if (Math.abs(value) > view.threshold) beyond += 1;
        }
        const share = known ? ((100 * beyond) / known).toFixed(1) : "0.0";
        const what = fit.shared.onModel ? "the model's vertices that the scan shows lie" : "the scan's points that the model covers lie";
        this.share.textContent = `${share} % of ${what} beyond ${view.threshold.toFixed(fit.limit > 5 ? 1 : 2)} mm.`;
      }
      if (this.steps) {
        const at = view.moment === null ? fit.n - 1 : view.moment;
        this.moments.input.value = at;
        this.moments.output.textContent = `${at + 1} / ${fit.n}`;
        paintTrack(this.moments.input);
        Viewer.rmsChart(this.rms, Array.from(arrays.history_rms_mm), Array.from(arrays.history_phase), at);
      }
    }
  };
})();
