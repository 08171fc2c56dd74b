/* The tab Fits: the list of saved fits, and how the quality of a fit is shown. */
(function () {
  "use strict";

  const Viewer = window.ShapespaceViewer;
  const { h, guarded } = Viewer;
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

  /** The tab of `page`, see `Viewer.openModel`. */
  Viewer.makeFitsTab = function (page) {
    const { $ } = page;
    let selected = -1;

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
      page.fitView.clear();
      page.fitView.element = detail;
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
        page.fitView.show(payload, { fit: row.name });
      } finally {
        $("loading").hidden = true;
      }
    });

    function draw() {
      if (page.fits.length && !page.fitView.payload) return selectFit(selected >= 0 ? selected : firstFit());
      if (page.fitView.payload) page.fitView.draw(true);
      else page.stage.faintMean();
      return null;
    }

    return { start, draw, name: () => page.fits[selected]?.name };
  };
})();
