/* The tab Fits: the list of saved fits, and how the quality of a fit is shown. */
(function () {
  "use strict";

  const Viewer = window.ShapespaceViewer;
  const { guarded } = Viewer;
  const { make: h, button, slider, animation, fit: showFit } = Shapespace.widgetParts;
  const FILTERED_FROM = 12;
  const STATUS = {
    converged: "No problems detected", doubtful: "Do not trust this fit", max_iterations: "The fit was cut off",
    failed: "The scan could not be fitted", unreadable: "This result cannot be read",
  };

  function verdictCard(facts) {
    const notes = facts.notes && facts.notes.length ? h("ul", {}, ...facts.notes.map((note) => h("li", {}, note))) : null;
    return h("div", { class: `status ${facts.status}`, "data-testid": "fit-status", "data-status": facts.status },
      h("strong", {}, STATUS[facts.status] || facts.status), h("span", {}, plainReason(facts.reason || "")), notes);
  }

  /** A reason without the words of the heading. */
  function plainReason(reason) {
    const said = "Do not trust this fit: ";
    if (!reason.startsWith(said)) return reason; // it may begin with the name of a file
    const rest = reason.slice(said.length);
    return rest.charAt(0).toUpperCase() + rest.slice(1);
  }

  const mm = (value) => (Number.isFinite(value) ? `${value.toFixed(2)} mm` : "unknown");
  const sharePercent = (share) => (Number.isFinite(share) ? `${Math.round(100 * share)} %` : "an unknown share");

  /** Distances where scan and model overlap, mm of the scan. */
  function distanceFacts(facts) {
    const overlap = facts.shown;
    if (!overlap) return null;
    const rows = [
      ["Model to scan", "model_to_scan", `the scan shows it, ${sharePercent(overlap.model_seen_share)} of the model`],
      ["Scan to model", "scan_to_model", `the model covers it, ${sharePercent(overlap.scan_covered_share)} of the scan`],
    ].map(([name, way, where]) => {
      const { mean, p95 } = overlap[way];
      return [name, `${mm(mean)} mean where ${where}; 95 % within ${mm(p95)}`];
    });
    return h("dl", { class: "facts", "data-testid": "shown" }, ...rows.flatMap(([name, value]) => [h("dt", {}, name), h("dd", {}, value)]));
  }

  function shortly(row) {
    if (row.shown) return `${[row.shown.model_to_scan, row.shown.scan_to_model].map(({ mean }) => (Number.isFinite(mean) ? mean.toFixed(2) : "?")).join(" / ")} mm`;
    return row.scan_to_model_mm === null ? row.status : `${row.scan_to_model_mm.toFixed(2)} mm`;
  }

  /** The saved iterations of `fit`, on the model of `page`: their element, and update(state) and stop(); null without them. */
  function makeIterations(fit, { arrays }, { model, about }) {
    const { history_b: b, history_T: T, history_phase: phases, history_iteration: numbers, history_rms_mm: rms } = arrays;
    const n = phases ? phases.length : 0, K = arrays.b.length, to = new Float32Array(3 * model.V);
    if (n < 2) return null;

    /** The model's vertices at an iteration, in the frame of the final pose. */
    function positionsAt(index) {
      const from = model.vertices(Array.from({ length: Math.min(model.K, K) }, (_, k) => b[index * K + k] / about.stddev[k])), t = 12 * index;
      for (let i = 0; i < from.length; i += 3) {
        for (let r = 0; r < 3; r++) {
          to[i + r] = T[t + 4 * r] * from[i] + T[t + 4 * r + 1] * from[i + 1] + T[t + 4 * r + 2] * from[i + 2] + T[t + 4 * r + 3];
        }
      }
      return to;
    }

    const goTo = (index) => fit.showMoment({ index, positions: positionsAt(index), caption: `Phase ${phases[index]}, iteration ${numbers[index]}: RMS ${rms[index].toFixed(2)} mm` });
    const moments = slider({ label: "Iteration", min: 0, max: n - 1, step: 1, value: n - 1, show: (index) => `${index + 1} / ${n}`, testid: "fit-moment", input: (index) => { stop(); goTo(index); } });
    const { toggle, stop } = animation(moments.row, () => {
      const now = fit.state.moment?.index ?? n - 1, from = now < n - 1 ? now : 0, pause = Math.max(0.04, Math.min(0.25, 6 / n)); // s
      return (seconds) => {
        const index = Math.min(n - 1, from + Math.floor(seconds / pause));
        if (index !== fit.state.moment?.index) goTo(index);
        return index === n - 1;
      };
    }, "Play the fit", "fit-play");
    const chart = h("div");
    return {
      stop,
      element: h("div", {}, h("h2", { text: "Iterations" }), moments.row, h("div", { class: "row" }, toggle), chart),
      update(state) {
        if (!state.moment) stop();
        moments.put(state.moment?.index ?? n - 1);
        Viewer.rmsChart(chart, Array.from(rms), Array.from(phases), moments.get());
      },
    };
  }

  /** The tab of `page`, see `Viewer.openModel`. */
  Viewer.makeFitsTab = function (page) {
    const { $ } = page;
    let selected = -1;
    let fit = null, steps = null; // controls and iterations of the selected fit, if it is drawn
    let wanted = { layout: "overlay", colour: "plain" }; // as the user chose for the last one

    function stop() {
      steps?.stop();
    }

    /** Draw the fit of a row, with its controls and exports in `detail`. */
    function open(row, payload, detail) {
      const { about } = page, { facts, arrays } = payload, { b_stddev } = arrays, z = Array.from(arrays.z), controls = h("div", { class: "ss-controls" }), chart = h("div");
      const heading = h("h2", { "data-testid": "fit-exported" });
      const onchange = (state) => {
        wanted = state;
        steps?.update(state);
        heading.textContent = `Export the ${state.stage === "dense" ? "dense" : "fitted"} surface`;
      };
      fit = showFit(payload, { stage: page.stage, controls, wanted, onchange });
      steps = makeIterations(fit, payload, page);
      const surface = (kind) => {
        const isDense = fit.state.stage === "dense";
        return page.download({ fit: row.name, stage: isDense ? "dense" : "final" }, kind, `${facts.name}.${isDense ? "dense" : "fitted"}`);
      };
      const name = facts.name.replace(/\.[^.]*$/, ""), error = Array.from(b_stddev, (sd, k) => sd / about.stddev[k]);
      detail.append(controls, ...[steps?.element, chart, heading].filter(Boolean), h("div", { class: "row" },
        ...page.exportButtons("fit-export", surface, { name, status: facts.status, b: Array.from(arrays.b), z, sd: Array.from(b_stddev) }),
        button("Use in Model", () => page.apply(z), { "data-testid": "fit-use" })));
      Viewer.coefficientChart(chart, [{ z, error }], arrays.b.length);
      steps?.update(fit.state);
    }

    async function start(name) {
      $("tab-fits").hidden = !page.about.has_fits;
      if (!page.about.has_fits) return;
      page.fits = await Viewer.json(`${page.base}api/fits`);
      page.compareTab.fillChoices();
      $("fit-filter-label").hidden = page.fits.length <= FILTERED_FROM;
      $("fit-filter").addEventListener("input", filterFits);
      $("fit-list").replaceChildren(...page.fits.map((row, i) => h("div", {
        role: "option", id: `fit-${i}`, class: row.status, "aria-selected": "false", "data-testid": "fit", "data-name": row.name,
        title: row.reason, onclick: () => selectFit(i),
      }, h("i", { class: "dot" }), h("span", {}, row.label, h("b", { hidden: true }, ` ${row.status}`)),
      h("small", {}, shortly(row)))));
      $("fit-list").addEventListener("keydown", (event) => {
        const step = { ArrowDown: 1, ArrowUp: -1 }[event.key];
        if (!step) return;
        event.preventDefault();
        for (let i = selected + step; i >= 0 && i < page.fits.length; i += step) {
          if (!$(`fit-${i}`).hidden) { selectFit(i); return; }
        }
      });
      const isDoubtful = (row) => row.status !== "converged";
      const go = (step) => {
        for (let i = 1; i <= page.fits.length; i++) {
          const at = (((selected < 0 && step < 0 ? 0 : selected) + step * i) % page.fits.length + page.fits.length) % page.fits.length;
          if (isDoubtful(page.fits[at])) { selectFit(at); return; }
        }
      };
      $("fit-next").addEventListener("click", () => go(1));
      $("fit-previous").addEventListener("click", () => go(-1));
      const count = page.fits.filter(isDoubtful).length;
      $("fit-next").disabled = $("fit-previous").disabled = count === 0;
      if (!count) $("fit-next").title = $("fit-previous").title = "No fit is doubtful";
      selected = page.fits.findIndex((row) => row.name === name);
    }

    /** The fit to open on: the first good one that can be drawn, or else the first that can. */
    function firstFit() {
      const good = page.fits.findIndex((row) => row.pictured && row.status === "converged");
      return Math.max(0, good >= 0 ? good : page.fits.findIndex((row) => row.pictured));
    }

    /** Show the fits whose name, label or status contains the typed text. */
    function filterFits() {
      const wanted = $("fit-filter").value.trim().toLowerCase();
      let left = 0;
      page.fits.forEach((row, i) => {
        const fits = `${row.label}\n${row.name}\n${row.status}`.toLowerCase().includes(wanted);
        $(`fit-${i}`).hidden = !fits;
        left += fits ? 1 : 0;
      });
      $("fit-filter-said").textContent = wanted ? `${left} of ${page.fits.length} fits` : "";
    }

    const selectFit = guarded(async (index) => {
      selected = index;
      page.onplace();
      const row = page.fits[index];
      for (const option of $("fit-list").children) option.setAttribute("aria-selected", String(option.id === `fit-${index}`));
      $("fit-list").setAttribute("aria-activedescendant", `fit-${index}`);
      $(`fit-${index}`).scrollIntoView({ block: "nearest" });
      const detail = h("div");
      stop();
      fit = steps = null;
      $("fit-detail").replaceChildren(...[verdictCard(row), distanceFacts(row), detail].filter(Boolean));
      if (!row.pictured) {
        if (row.why_not) $("fit-detail").append(h("p", {}, row.why_not));
        if (row.z) $("fit-detail").append(h("button", { type: "button", onclick: () => page.apply(row.z) }, "Use in Model"));
        if (page.shown === "fits") page.stage.nothing(`There is no picture of ${row.label}`);
        return;
      }
      $("loading").textContent = "Loading the fit";
      $("loading").hidden = false;
      try {
        const payload = await Viewer.binary(`${page.base}api/fits/${encodeURIComponent(row.name)}`);
        if (selected !== index) return;
        if (page.shown === "fits") open(row, payload, detail);
      } finally {
        $("loading").hidden = true;
      }
    });

    function draw() {
      if (!fit) page.stage.take(null);
      if (!page.fits.length) return page.stage.nothing("There are no fits");
      if (!fit) return selectFit(selected >= 0 ? selected : firstFit());
      fit.draw();
      return fit.frame();
    }

    return { start, draw, stop, name: () => page.fits[selected]?.name };
  };
})();
