/* The tab Model: a slider per mode, random shapes, animation, the map of displacement and exports. */
(function () {
  "use strict";

  const Viewer = window.ShapespaceViewer;
  const { h, sign, paintTrack, nice, quantile, onSurface, save, alertUser, guarded, post, LEFT_RED } = Viewer;
  const SHOWN_AT_FIRST = 12;

  window.shapespaceTimes = []; // ms from a slider's event to the picture, as drawn

  /** The tab of `page`, see `Viewer.openModel`. */
  Viewer.makeModelTab = function (page) {
    const { $ } = page;
    const rows = [];
    let mapRange = 0;
    let positions; // of the vertices, written anew by each shape

    const download = guarded(async (question, kind, name) => {
      const { fit, stage: at, z: shape } = question;
      const answer = await Viewer.ask(`${page.base}api/export?format=${kind}`, post(fit !== undefined ? { fit, stage: at } : { z: Array.from(shape) }));
      save(await answer.blob(), `${name.replace(/[^\w.-]+/g, "_").replace(/\.(ply|obj|stl|off|vtk|vtp|glb|gltf)(?=\.|$)/i, "")}.${kind}`);
    });

    function makeSliders() {
      const list = $("sliders");
      list.append(h("div", { class: "mode modes-head", "aria-hidden": "true" }, h("span"), h("span", {}, "Mode and its share of the variance"), h("span"), h("span"), h("span")));
      for (let k = 0; k < page.model.K; k++) {
        const name = `Mode ${k + 1}`;
        const tick = h("input", { type: "checkbox", "aria-label": `Animate mode ${k + 1}`, title: `Animate mode ${k + 1}`, "data-testid": `animate-${k + 1}` });
        tick.checked = k === 0;
        const slider = h("input", {
          type: "range", min: -3, max: 3, step: 0.05, value: 0, id: `mode-${k + 1}`, "data-testid": `mode-${k + 1}`,
          "aria-label": `${name}, standard deviations`,
        });
        const output = h("output", { for: slider.id, "data-testid": `value-${k + 1}` });
        const undo = h("button", { type: "button", "aria-label": `Set mode ${k + 1} back to zero`, title: "Back to zero", "data-testid": `reset-${k + 1}` }, "\u00d7");
        slider.addEventListener("input", () => {
          const began = performance.now();
          stopAnimation();
          page.z[k] = Number(slider.value);
          updateRow(k);
          drawModel(began);
          page.onplace();
        });
        undo.addEventListener("click", () => { stopAnimation(); page.z[k] = 0; updateRow(k); drawModel(); page.onplace(); slider.focus(); });
        const head = h("span", {}, `${k + 1} `, h("small", {}, percent(page.share[k])));
        const row = h("div", { class: "mode" }, tick, head, slider, output, undo);
        row.hidden = k >= SHOWN_AT_FIRST;
        rows.push({ row, slider, output, undo, tick });
        list.append(row);
      }
      const rest = page.model.K - SHOWN_AT_FIRST;
      $("more-modes").hidden = rest <= 0;
      $("more-modes").textContent = `Show ${rest} more modes`;
      $("more-modes").addEventListener("click", () => {
        rows.forEach(({ row }) => { row.hidden = false; });
        $("more-modes").hidden = true;
        rows[SHOWN_AT_FIRST].slider.focus();
      });
      updateRows();
    }

    const percent = (part) => `${(100 * part).toFixed(part >= 0.0995 ? 0 : 1)} %`;

    function updateRow(k) {
      const { slider, output, undo } = rows[k];
      if (Number(slider.value) !== page.z[k]) slider.value = page.z[k];
      output.textContent = sign(page.z[k]);
      undo.disabled = page.z[k] === 0;
      paintTrack(slider);
    }

    const updateRows = () => rows.forEach((_, k) => updateRow(k));

    function setShape(values) {
      page.z.fill(0);
      for (let k = 0; k < Math.min(page.z.length, values.length); k++) page.z[k] = values[k];
      updateRows();
    }

    let asked = 0;
    function drawModel(began) {
      const { model, stage } = page;
      if (page.shown !== "model") return;
      if (began !== undefined && !asked) asked = began;
      positions = model.vertices(page.z, positions);
      if (stage.holds !== "model") {
        stage.clear();
        stage.split(false);
        stage.holds = "model";
        stage.a.setSurface("model", { positions, faces: model.faces, colour: Shapespace.colours.clay });
      } else {
        stage.a.move("model", positions);
      }
      const moved = page.z.some((value) => value !== 0);
      stage.captions(moved ? "" : "The mean shape");
      if ($("map").checked) {
        const values = model.displacement(page.z);
        const most = quantile(values, 0.995);
        if (most > mapRange || most < mapRange / 4) mapRange = nice(Math.max(most, 0.1));
        const range = [-mapRange, mapRange];
        stage.a.paint("model", values, { map: Shapespace.colours.diverging, range, changed: true });
        stage.bar({ map: Shapespace.colours.diverging, range, unit: "mm", title: "Moved in (\u2212) or out (+)" });
      } else {
        stage.a.paint("model", null);
        stage.bar(null);
      }
      drawMarks(stage.a, $("marks").checked);
    }

    let hasMarks = false;
    function drawMarks(view, wanted) {
      if (!wanted && !hasMarks) return;
      const entries = Object.entries(page.model.facts.landmarks);
      view.marks("landmarks", wanted ? entries.map(([label, at]) => ({
        position: onSurface(positions, at), label, colour: LEFT_RED,
      })) : []);
      hasMarks = wanted;
    }

    let swinging = 0;
    function stopAnimation() {
      cancelAnimationFrame(swinging);
      swinging = 0;
      $("animate").setAttribute("aria-pressed", "false");
      $("animate").textContent = "Animate";
    }

    function startAnimation() {
      const chosen = rows.map(({ tick }, k) => (tick.checked ? k : -1)).filter((k) => k >= 0);
      if (!chosen.length) {
        alertUser("No mode is ticked; tick one or more modes to animate.");
        return;
      }
      $("animate").setAttribute("aria-pressed", "true");
      $("animate").textContent = "Stop";
      // One mode swings all the way; several together stay where shapes are likely.
      const reach = chosen.length === 1 ? 3 : Math.max(1, 3 / Math.sqrt(chosen.length));
      const began = performance.now();
      const start = chosen.map((k) => Math.asin(Math.max(-1, Math.min(1, page.z[k] / reach))));
      const step = (now) => {
        const t = (now - began) / 1000;
        chosen.forEach((k, j) => {
          page.z[k] = reach * Math.sin(start[j] + (t * 2 * Math.PI) / (4 + 0.7 * j));
          updateRow(k);
        });
        drawModel();
        swinging = requestAnimationFrame(step);
      };
      swinging = requestAnimationFrame(step);
    }

    /** A normal deviate (Box and Muller). */
    const normal = () => Math.sqrt(-2 * Math.log(1 - Math.random())) * Math.cos(2 * Math.PI * Math.random());
    const randomShape = () => Array.from({ length: page.about.modes }, () => Math.max(-3, Math.min(3, normal())));

    function start() {
      const { about } = page;
      page.stage.a.on("draw", () => {
        if (asked) window.shapespaceTimes.push(performance.now() - asked);
        asked = 0;
      });
      makeSliders();
      $("reset").addEventListener("click", () => { stopAnimation(); setShape([]); drawModel(); page.onplace(); });
      $("random").addEventListener("click", () => { stopAnimation(); setShape(randomShape()); drawModel(); page.onplace(); });
      $("animate").addEventListener("click", () => (swinging ? stopAnimation() : startAnimation()));
      $("map").addEventListener("change", () => drawModel());
      $("marks").addEventListener("change", () => drawModel());
      $("marks-label").hidden = !about.landmarks.length;
      if (about.modes_sent < about.modes) {
        $("animate-hint").textContent += ` The first ${about.modes_sent} of ${about.modes} modes are shown; more would not fit here.`;
      }
      for (const kind of about.exports) {
        $("export-shape").append(h("button", {
          type: "button", "data-testid": `export-${kind}`, onclick: () => download({ z: page.z }, kind, "shape"),
        }, kind.toUpperCase()));
      }
      $("export-shape").append(h("button", { type: "button", "data-testid": "export-csv", onclick: () => {
        const b = Array.from(page.z, (value, k) => value * (k < about.stddev.length ? about.stddev[k] : 0));
        save(Viewer.coefficientsCsv([{ name: "shape", b, z: Array.from(page.z) }], about.modes), "shape.coefficients.csv");
      } }, "Coefficients CSV"));
    }

    return { start, draw: drawModel, stop: stopAnimation, setShape, randomShape, download };
  };
})();
