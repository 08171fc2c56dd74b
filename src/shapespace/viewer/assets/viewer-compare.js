/* The tab Compare: two shapes, the walk from one to the other, and tables of coefficients. */
(function () {
  "use strict";

  const Viewer = window.ShapespaceViewer;
  const { guarded, csvRows } = Viewer;
  const { make, signed, morph, randomShape } = Shapespace.widgetParts;

  /** The tab of `page`, see `Viewer.openModel`. */
  Viewer.makeCompareTab = function (page) {
    const { $ } = page;
    let walk = null;
    let pair; // both shapes, and their coefficients as far as the model has them

    function fillChoices() {
      page.shapes.set("mean", { name: "the mean shape", z: [] });
      page.shapes.set("current", { name: "the shape in Model", get z() { return Array.from(page.z); } });
      for (const row of page.fits) if (row.z) page.shapes.set(`fit ${row.name}`, { name: row.label, z: row.z });
      for (const [select, first] of [[$("compare-a"), "mean"], [$("compare-b"), "current"]]) {
        const before = select.value || first;
        select.replaceChildren(...Array.from(page.shapes, ([key, one]) => make("option", { value: key, text: one.name })), make("option", { value: "random", text: "a new random shape" }));
        select.value = page.shapes.has(before) ? before : first;
      }
    }

    function choose(event) {
      if (event.target.value === "random") {
        const number = Array.from(page.shapes.keys()).filter((key) => key.startsWith("random ")).length + 1;
        page.shapes.set(`random ${number}`, { name: `random shape ${number}`, z: randomShape(page.about.modes) });
        fillChoices();
        event.target.value = `random ${number}`;
      }
      draw();
    }

    /** Show both shapes, which were chosen or changed. */
    function draw() {
      const { about, model } = page, K = about.modes;
      pair = [$("compare-a"), $("compare-b")].map((select) => {
        const { name, z } = page.shapes.get(select.value);
        return { name, z: Float64Array.from({ length: K }, (_, k) => z[k] || 0) };
      });
      walk.draw(true);
      const [za, zb] = pair.map(({ z }) => z), steps = za.map((value, k) => zb[k] - value);
      // By what it moves on the surface: a faint mode may be many standard deviations off and move nothing.
      const moved = steps.map((value, k) => Math.abs(value * about.stddev[k]) / Math.sqrt(model.V));
      const apart = Math.hypot(...moved), most = moved.indexOf(Math.max(...moved));
      const facts = [
        ["Apart", `${apart.toFixed(2)} mm (RMS over the vertices)`],
        ["", `${Math.hypot(...steps).toFixed(2)} standard deviations`],
        ["Most in", apart > 0 ? `mode ${most + 1}: it moves ${moved[most].toFixed(2)} mm, at ${signed(steps[most], 2)} standard deviations` : "no mode; they are equal"],
      ];
      $("compare-facts").replaceChildren(...facts.flatMap(([name, text]) => [make("dt", { text: name }), make("dd", { text })]));
      Viewer.coefficientChart($("compare-chart"), [{ z: za, name: "from" }, { z: zb, name: "to" }], K);
    }

    const at = (value) => pair[0].z.map((from, k) => from + ((value + 1) / 2) * (pair[1].z[k] - from));
    const words = (value) => (!pair ? "" : value <= -1 ? pair[0].name : value >= 1 ? pair[1].name : `${Math.round(50 + 50 * value)} % of the way to ${pair[1].name}`);

    const readCsv = guarded(async (file) => {
      const { about } = page;
      if (file.size > 64 * 2 ** 20) throw new Error(`${file.name} is larger than any table of coefficients; give a coefficients.csv.`);
      const table = csvRows(await file.text());
      const head = table[0] || [];
      const named = (letter) => head.filter((name) => new RegExp(`^${letter}[1-9][0-9]*$`).test(name)).length;
      const letter = named("z") ? "z" : named("b") ? "b" : null;
      if (!letter) throw new Error(`${file.name} has no columns z1, z2, ... or b1, b2, ...; give the coefficients.csv of a folder of fits.`);
      const columns = (of) => Array.from({ length: about.modes }, (_, k) => head.indexOf(`${of}${k + 1}`));
      const at = columns(letter), other = columns(letter === "z" ? "b" : "z");
      if (named(letter) !== about.modes || at.includes(-1)) {
        throw new Error(`${file.name} contains ${named(letter)} coefficients and ${about.model} has ${about.modes}; give a table of fits by this model.`);
      }
      let added = 0;
      for (const line of table.slice(1)) {
        const given = at.map((column) => line[column] || "");
        while (given.length > 1 && given[given.length - 1] === "") given.pop(); // modes that were not fitted
        if (given.includes("")) continue;
        const numbers = given.map(Number);
        const values = letter === "z" ? numbers : numbers.map((value, k) => value / about.stddev[k]);
        if (!values.every(Number.isFinite)) continue;
        // Tables with b and z give the standard deviations of their model.
        const differs = letter === "z" && values.some((value, k) => {
          const b = line[other[k]] ? Number(line[other[k]]) : NaN, ours = value * about.stddev[k];
          return Math.abs(b - ours) > 1e-3 * Math.max(Math.abs(b), Math.abs(ours)) + 1e-6;
        });
        if (differs) throw new Error(`${file.name} was made by another model than ${about.model}, for its modes have other standard deviations; give a table of fits by this model.`);
        const name = line[Math.max(head.indexOf("scan"), 0)] || `row ${added + 1}`;
        page.shapes.set(`csv ${file.name} ${name}`, { name: `${name} (${file.name})`, z: values });
        added += 1;
        if (added === 1) $("compare-b").dataset.wanted = `csv ${file.name} ${name}`;
      }
      if (!added) throw new Error(`${file.name} has no row with numbers in all its coefficients; give the coefficients.csv of a folder of fits.`);
      fillChoices();
      $("compare-b").value = $("compare-b").dataset.wanted;
      page.show("compare");
    });

    function start() {
      fillChoices();
      walk = morph(page.model, { stage: page.stage, controls: $("compare-walk"), at, words, ends: ["From", "To"], label: "Walk" });
      for (const id of ["compare-a", "compare-b"]) $(id).addEventListener("change", choose);
      $("walk-use").addEventListener("click", () => page.apply(walk.now()));
      $("swap").addEventListener("click", () => {
        const [a, b] = [$("compare-a").value, $("compare-b").value];
        [$("compare-a").value, $("compare-b").value] = [b, a];
        draw();
      });
      $("csv-button").addEventListener("click", () => $("csv-file").click());
      $("csv-file").addEventListener("change", () => { if ($("csv-file").files[0]) readCsv($("csv-file").files[0]); $("csv-file").value = ""; });
    }

    return { start, draw, stop: () => walk?.stop(), fillChoices };
  };
})();
