/* A scan and the model that was fitted to it. */
(function () {
  "use strict";

  const Shapespace = window.Shapespace;
  const { colours, make, slider, tick, select, choice, swatches, lazily, stage } = Shapespace.widgetParts;

  const STAGES = { before: "Before", initial: "Phase 1", final: "Phase 2", dense: "Dense" };
  const REGIONS = ["followed", "rejected", "border", "unseen"];
  const REGION_WORDS = {
    followed: "follows the scan", rejected: "does not match", border: "at the scan\u2019s border", unseen: "not shown by the scan",
  };

  /** A scan and the model that was fitted to it: stages, opacity, distances, regions. */
  Shapespace.widgets.fit = (element, payload) =>
    lazily(element, payload, (unpacked) => {
      const { facts, arrays } = unpacked;
      const { view, controls } = stage(element, `Scan and fitted model of ${facts.label || facts.name}`);
      const stages = facts.stages;
      // How far the fit lies from the scan is what one looks for first.
      const state = { stage: "final", map: arrays.scan ? "model" : "none", threshold: null };
      if (arrays.scan) {
        const scanShown = { positions: arrays.scan, faces: arrays.scan_faces || null, colour: colours().scan };
        view.setSurface("scan", { ...scanShown, opacity: 0.5, visible: false });
      }
      view.setSurface("model", {
        positions: arrays[`surface_${state.stage}`], faces: arrays.faces || null, colour: colours().model,
      });
      view.frame(["model"], 1.12);

      const bar = make("div", { class: "ss-bar" }), legend = make("div", { class: "ss-bar" });
      legend.append(swatches(REGIONS.map((name) => [REGION_WORDS[name], colours().regions[name]])));
      const announcement = make("p", { class: "ss-said", "aria-live": "polite" });

      const values = () =>
        state.map === "model" ? arrays[`model_to_scan_${state.stage}`]
          : state.map === "scan" ? arrays[`scan_to_model_${state.stage}`] : null;

      function paint() {
        const distances = state.map === "model" || state.map === "scan";
        const scale = distances ? Shapespace.distanceScale(facts, values(), state.map === "model", colours()) : {};
        const { signal, unknown } = colours();
        const map = { map: scale.map, range: scale.range, threshold: state.threshold, signal, unknown };
        if (distances) {
          const beyond = state.threshold === null ? [] : [[`beyond ${state.threshold.toFixed(1)} mm`, signal]];
          Shapespace.colourBar(bar, { ...scale, keys: [...beyond, ...scale.keys] });
        }
        if (arrays.scan) view.paint("scan", state.map === "scan" ? values() : null, map);
        if (state.map === "colour") {
          view.paint("scan", arrays.scan_colours, { rgb: true });
          view.paint("model", arrays[`colours_${state.stage}`] || arrays.colours_final, { rgb: true });
        } else if (state.map === "regions") {
          view.paint("model", arrays.regions, { categories: REGIONS.map((name) => colours().regions[name]) });
        } else {
          view.paint("model", state.map === "model" ? values() : null, map);
        }
        bar.hidden = limit.hidden = !distances;
        beyond.row.hidden = !distances || state.threshold === null;
        legend.hidden = state.map !== "regions";
        announcement.textContent = distances ? sentence() : state.map === "regions" ? regions() : state.map === "colour" ? "Grey: vertices where the fit does not follow the scan." : facts.without_scan ? facts.without_scan : "Where scan and model overlap, the nearer one is shown.";
        announcement.hidden = !announcement.textContent;
      }

      // Figures are of all vertices, also where fewer are drawn.
      function sentence() {
        const known = facts.mean_mm[state.stage][state.map];
        if (known === null) return "No distance is known here.";
        const mean = `Mean distance ${known.toFixed(2)} mm.`;
        if (state.threshold === null) return mean;
        const share = 100 * arrays[`beyond_${state.map}_${state.stage}`][Math.round(10 * state.threshold)];
        return `${mean} ${share.toFixed(share < 9.95 ? 1 : 0)} % lie beyond ${state.threshold.toFixed(1)} mm.`;
      }

      function regions() {
        const words = REGIONS.map((name, k) => `${REGION_WORDS[name]}: ${Math.round(100 * facts.region_shares[k])} %`);
        return `${words.join("; ")}.`;
      }

      const beyond = slider({
        label: "Threshold", min: 0.2, max: 10, step: 0.1, value: Math.min(2, facts.scale_mm),
        show: (value) => `${value.toFixed(1)} mm`,
        input: (value) => {
          state.threshold = value;
          paint();
        },
      });
      const limit = tick("Mark what lies beyond a threshold", false, (on) => {
        state.threshold = on ? beyond.get() : null;
        paint();
      });
      const layer = (id, name, opacity) => {
        const row = slider({
          label: name, min: 0, max: 100, step: 5, value: opacity, show: (value) => `${value} %`,
          input: (value) => {
            box.checked = value > 0;
            view.set(id, { opacity: value / 100, visible: value > 0 });
          },
        });
        const box = make("input", { type: "checkbox", "aria-label": `Show ${name.toLowerCase()}` });
        box.checked = opacity > 0;
        box.addEventListener("change", () => {
          if (box.checked && row.get() === 0) row.put(100);
          view.set(id, { visible: box.checked, opacity: row.get() / 100 });
        });
        const dot = make("span", { class: "ss-dot", "aria-hidden": "true" });
        dot.style.background = `rgb(${colours()[id].map((c) => Math.round(255 * c)).join(",")})`;
        row.row.classList.add("ss-layer");
        row.row.prepend(box, dot);
        return { row: row.row, show: (percent) => {
          row.put(percent);
          box.checked = percent > 0;
          view.set(id, { visible: percent > 0, opacity: percent / 100 });
        } };
      };
      const scan = arrays.scan ? layer("scan", "Scan", 0) : null, model = layer("model", "Model", 100);
      const maps = [["none", "plain"]];
      if (arrays.scan) maps.push(["model", "distance, model to scan"], ["scan", "distance, scan to model"]);
      if (arrays.regions) maps.push(["regions", "regions that the fit used"]);
      if (arrays.colours_final && arrays.scan_colours) maps.push(["colour", "colour of the scan"]);
      const called = (name) => (name === "final" && !stages.includes("initial") ? "Fitted" : STAGES[name] || name);
      if (stages.length > 1) {
        controls.append(choice("Stage", stages.map((name) => [name, called(name)]), state.stage, (name) => {
          state.stage = name;
          view.move("model", arrays[`surface_${name}`]);
          paint();
        }));
      }
      controls.append(
        make("div", { class: "ss-sliders", role: "group", "aria-label": "Visibility and opacity" }, ...[scan && scan.row, model.row].filter(Boolean)),
        select("Colour", maps, state.map, (key) => {
          state.map = key;
          // The coloured surface is seen alone; the sliders bring the other one back.
          if (scan) scan.show(key === "scan" || key === "none" ? 100 : 0);
          model.show(key === "scan" ? 0 : 100);
          paint();
        }).row,
        bar, legend, limit, beyond.row, announcement
      );
      if (facts.thinned) {
        controls.append(make("p", { class: "ss-hint", text: "Drawn with fewer triangles than there are; the numbers are of all." }));
      }
      paint();
      return { view, state };
    });
})();
