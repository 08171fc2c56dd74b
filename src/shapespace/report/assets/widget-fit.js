/* A scan and the model that was fitted to it. */
(function () {
  "use strict";

  const Shapespace = window.Shapespace;
  const parts = Shapespace.widgetParts;
  const { colours, make, dot, slider, tick, choice, percent, staged } = parts;

  const STAGES = {
    before: ["Before", "Before: centroids together"], initial: ["Phase 1", "After phase 1: the pose"], final: ["Phase 2", "After phase 2: pose and shape"],
    dense: ["Dense", "Dense: the rest of the way to the scan"],
  };
  const REGIONS = { followed: "follows the scan", rejected: "does not match", border: "at the scan\u2019s border", unseen: "not shown by the scan" };
  // The surfaces that are shown in each colouring where both are overlaid.
  const SHOWN = { plain: ["scan", "model"], model: ["model"], scan: ["scan"], regions: ["model"], colour: ["model"] };

  /**
   * A scan and the model that was fitted to it: stages, layout, colours, opacities, threshold.
   * wanted: initial {layout, colour}; onchange(state): called after each drawing.
   */
  parts.fit = function ({ facts, arrays }, { stage, controls, wanted, onchange = () => {} }) {
    const { stages } = facts, limit = facts.scale_mm > 0 ? facts.scale_mm : 1;
    const colourings = [["plain", "Plain"]];
    if (arrays.scan) colourings.push(["model", "Model to scan"], ["scan", "Scan to model"]);
    if (arrays.regions) colourings.push(["regions", "Regions"]);
    if (arrays.colours_final && arrays.scan_colours) colourings.push(["colour", "Colour of the scan"]);
    const state = {
      stage: "final",
      moment: null, // {positions, caption} in place of a stage
      layout: arrays.scan ? wanted.layout : "overlay",
      colour: colourings.some(([key]) => key === wanted.colour) ? wanted.colour : "plain",
      marked: false,
      threshold: Math.min(limit / 2, 2),
    };
    const announcement = make("p", { class: "ss-said", "aria-live": "polite", "data-testid": "fit-share" });
    const nameOf = (name, long) => (name !== "final" || stages.includes("initial") ? STAGES[name][long] : long ? "The fitted model" : "Fitted");
    const isSide = () => state.layout === "side";
    const distances = () => (state.colour === "model" ? arrays[`model_to_scan_${state.stage}`] : state.colour === "scan" ? arrays[`scan_to_model_${state.stage}`] : null);

    function draw() {
      stage.split(isSide());
      const view = isSide() ? stage.b : stage.a, other = isSide() ? stage.a : stage.b;
      const positions = state.moment ? state.moment.positions : arrays[`surface_${state.stage}`];
      if (stage.take(draw) && arrays.scan) stage.a.setSurface("scan", { positions: arrays.scan, faces: arrays.scan_faces || null, colour: colours().scan });
      if (other) other.remove("model");
      if (view.has("model")) view.move("model", positions);
      else view.setSurface("model", { positions, faces: arrays.faces || null, parts: arrays.parts || null, colour: colours().model });
      if (scan) stage.a.set("scan", scan.shown());
      view.set("model", model.shown());
      paint(view);
      const when = state.moment ? state.moment.caption : nameOf(state.stage, 1), label = facts.label || facts.name;
      if (isSide()) stage.captions(`${label}: the scan`, when);
      else stage.captions(`${label}. ${when}`);
      for (const [row, value] of [[stageRow, state.moment ? null : state.stage], [layoutRow, state.layout], [colourRow, state.colour]]) if (row) row.put(value);
      onchange(state);
    }

    function frame() {
      stage.a.frame(undefined, 1.12);
      if (isSide()) stage.a.link(stage.b);
    }

    function paint(view) {
      const values = distances(), { signal, unknown, regions, scan: ofScan, model: ofModel } = colours();
      const options = { signal, unknown, threshold: state.marked ? state.threshold : null };
      const scale = values ? Shapespace.distanceScale(facts, values, state.colour === "model", colours()) : null;
      if (scale) Object.assign(options, { map: scale.map, range: scale.range });
      const painted = { model: [values, options], regions: [arrays.regions, { categories: Object.keys(REGIONS).map((name) => regions[name]) }],
        colour: [arrays[`colours_${state.stage}`] || arrays.colours_final, { rgb: true }] };
      view.paint("model", ...(painted[state.colour] || [null]));
      if (arrays.scan) stage.a.paint("scan", ...(state.colour === "scan" ? [values, options] : state.colour === "colour" ? [arrays.scan_colours, { rgb: true }] : [null]));
      stage.bar(scale && { ...scale, keys: [...(state.marked ? [["beyond the threshold", signal]] : []), ...scale.keys] });
      const both = arrays.scan && !isSide();
      if (state.colour === "plain") stage.legend(both ? [["scan", ofScan], ...(arrays.parts ? [] : [["model", ofModel]])] : null, "the nearer one is shown");
      else if (state.colour === "regions") stage.legend(Object.entries(REGIONS).map(([name, text]) => [text, regions[name]]));
      else if (state.colour === "colour") stage.legend([["the fit does not follow the scan", unknown]]);
      else stage.legend(null);
      mark.hidden = !values;
      beyond.row.hidden = !values || !state.marked;
      announcement.textContent = values ? sentence() : state.colour === "regions" && facts.region_shares ? shares() : "";
      announcement.hidden = !announcement.textContent;
    }

    // Figures are of all vertices, also where fewer are drawn.
    function sentence() {
      const mean = facts.mean_mm[state.stage][state.colour];
      if (mean === null) return "No distance is known here.";
      if (!state.marked) return `Mean distance ${mean.toFixed(2)} mm.`;
      const shares = arrays[`beyond_${state.colour}_${state.stage}`];
      return `Mean distance ${mean.toFixed(2)} mm. ${percent(shares[Math.round((50 * state.threshold) / limit)])} lie beyond ${state.threshold.toFixed(2)} mm.`;
    }

    const shares = () => `${Object.values(REGIONS).map((text, k) => `${text}: ${Math.round(100 * facts.region_shares[k])} %`).join("; ")}.`;

    /** Visibility and opacity of a surface. */
    function layer(id, name) {
      const row = slider({
        label: name, min: 0, max: 100, step: 5, value: 100, show: (value) => `${value} %`, testid: `fit-${id}-opacity`,
        input: (value) => {
          box.checked = value > 0;
          draw();
        },
      });
      const box = make("input", { type: "checkbox", "aria-label": `Show ${name.toLowerCase()}`, onchange: () => {
        if (box.checked && row.get() === 0) row.put(100);
        draw();
      } });
      row.row.classList.add("ss-layer");
      row.row.prepend(box, id === "model" && arrays.parts ? make("span") : dot(colours()[id]));
      return {
        row: row.row,
        shown: () => ({ visible: box.checked, opacity: row.get() / 100 }),
        put: (isShown) => {
          row.put(isShown ? 100 : 0);
          box.checked = isShown;
        },
      };
    }
    const scan = arrays.scan ? layer("scan", "Scan") : null, model = layer("model", "Model");
    const putLayers = () => {
      for (const [id, row] of [["scan", scan], ["model", model]]) if (row) row.put(isSide() || SHOWN[state.colour].includes(id));
    };
    const stageRow = stages.length > 1 ? choice("Stage", stages.map((name) => [name, nameOf(name, 0)]), null, (name) => {
      Object.assign(state, { stage: name, moment: null });
      draw();
    }, "fit-stage") : null;
    const layoutRow = scan ? choice("Layout", [["overlay", "Overlaid"], ["side", "Side by side"]], null, (layout) => {
      state.layout = layout;
      putLayers();
      draw();
    }, "fit-layout") : null;
    const colourRow = choice("Colour", colourings, null, (colour) => {
      if (state.moment) Object.assign(state, { stage: "final", moment: null });
      state.colour = colour;
      putLayers();
      draw();
    }, "fit-colour");
    const mark = tick("Mark what lies beyond a threshold", false, (on) => {
      state.marked = on;
      draw();
    }, "fit-mark");
    const beyond = slider({
      label: "Threshold", min: 0, max: 2 * limit, step: limit / 50, value: state.threshold, show: (value) => `${value.toFixed(2)} mm`, testid: "fit-threshold",
      input: (value) => {
        state.threshold = value;
        draw();
      },
    });
    state.threshold = beyond.get();
    controls.append(
      ...(facts.without_scan ? [make("p", { text: facts.without_scan, "data-testid": "fit-without-scan" })] : []), ...[stageRow, layoutRow, colourRow].filter(Boolean).map(({ row }) => row), mark, beyond.row, announcement,
      make("div", { class: "ss-sliders", role: "group", "aria-label": "Visibility and opacity" }, scan && scan.row, model.row)
    );
    if (facts.thinned) controls.append(make("p", { class: "ss-hint", text: "Drawn with fewer triangles than there are; the numbers are of all." }));
    putLayers();
    draw();
    frame();
    return {
      state,
      draw,
      frame,
      /** Show {positions, caption} of an iteration in place of a stage. */
      showMoment(moment) {
        state.moment = moment;
        if (state.colour !== "plain") {
          state.colour = "plain";
          putLayers();
        }
        draw();
      },
    };
  };

  Shapespace.widgets.fit = staged((unpacked, options) => {
    options.stage.a.label = `Scan and fitted model of ${unpacked.facts.label || unpacked.facts.name}`;
    // How far the fit lies from the scan is what one looks for first.
    return parts.fit(unpacked, { ...options, wanted: { layout: "overlay", colour: "model" } });
  });
})();
