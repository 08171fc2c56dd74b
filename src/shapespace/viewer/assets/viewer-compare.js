/* The tab Compare: two shapes, the walk from one to the other, and tables of coefficients. */
(function () {
  "use strict";

  const Viewer = window.ShapespaceViewer;
  const { h, sign, paintTrack, nice, quantile, guarded, csvRows } = Viewer;

  /** The tab of `page`, see `Viewer.openModel`. */
  Viewer.makeCompareTab = function (page) {
    const { $ } = page;
    let walking = 0;
    let positions; // of the vertices, written anew by each shape

    function fillChoices() {
      page.shapes.set("mean", { name: "the mean shape", z: [] });
      page.shapes.set("current", { name: "the shape in Model", get z() { return Array.from(page.z); } });
      for (const row of page.fits) if (row.z) page.shapes.set(`fit ${row.name}`, { name: row.label, z: row.z });
      for (const [select, first] of [[$("compare-a"), "mean"], [$("compare-b"), "current"]]) {
        const before = select.value || first;
        select.replaceChildren(...Array.from(page.shapes, ([key, one]) => h("option", { value: key }, one.name)), h("option", { value: "random" }, "a new random shape"));
        select.value = page.shapes.has(before) ? before : first;
      }
    }

    function pair() {
      return [$("compare-a"), $("compare-b")].map((select) => page.shapes.get(select.value));
    }

    function choose(event) {
      if (event.target.value === "random") {
        const number = Array.from(page.shapes.keys()).filter((key) => key.startsWith("random ")).length + 1;
        page.shapes.set(`random ${number}`, { name: `random shape ${number}`, z: page.modelTab.randomShape() });
        fillChoices();
        event.target.value = `random ${number}`;
      }
      drawCompare(true);
    }

    /** Where the walk is: both shapes, their coefficients, those in between, and how far along. */
    function onTheWay() {
      const [a, b] = pair();
      const K = page.about.modes, t = Number($("walk").value);
      const [za, zb] = [a, b].map((one) => {
        const given = one.z;
        return Float64Array.from({ length: K }, (_, k) => given[k] || 0);
      });
      return { a, b, za, zb, t, K, now: za.map((value, k) => value + t * (zb[k] - value)) };
    }

    function drawCompare(changed) {
      const { about, model, stage } = page;
      if (page.shown !== "compare") return;
      const { a, b, za, zb, t, K, now } = onTheWay();
      const from = $("difference").checked ? model.vertices(za).slice() : null;
      positions = model.vertices(now, positions);
      if (stage.holds !== "compare") {
        stage.clear();
        stage.split(false);
        stage.holds = "compare";
        stage.a.setSurface("model", { positions, faces: model.faces, colour: Shapespace.colours.clay });
      } else {
        stage.a.move("model", positions);
      }
      if (from) {
        const values = Float32Array.from({ length: model.V }, (_, v) =>
          Math.hypot(positions[3 * v] - from[3 * v], positions[3 * v + 1] - from[3 * v + 1], positions[3 * v + 2] - from[3 * v + 2]));
        const range = [0, differenceRange(za, zb)];
        stage.a.paint("model", values, { map: Shapespace.colours.sequential, range, changed: true });
        stage.bar({ map: Shapespace.colours.sequential, range, unit: "mm", title: `Moved from ${a.name}` });
      } else {
        stage.a.paint("model", null);
        stage.bar(null);
      }
      $("walk-value").textContent = `${Math.round(100 * t)} %`;
      paintTrack($("walk"));
      stage.captions(t === 0 ? a.name : t === 1 ? b.name : `${Math.round(100 * t)} % of the way to ${b.name}`);
      if (!changed) return;
      const steps = za.map((value, k) => zb[k] - value);
      // By what it moves on the surface: a faint mode may be many standard deviations off and move nothing.
      const moved = Float64Array.from(steps, (value, k) => Math.abs(value * about.stddev[k]) / Math.sqrt(model.V));
      const apart = Math.hypot(...moved);
      const most = moved.reduce((best, value, k) => (value > moved[best] ? k : best), 0);
      const facts = [
        ["Apart", `${apart.toFixed(2)} mm (RMS over the vertices)`],
        ["", `${Math.hypot(...steps).toFixed(2)} standard deviations`],
        ["Most in", apart > 0 ? `mode ${most + 1}: it moves ${moved[most].toFixed(2)} mm, at ${sign(steps[most])} standard deviations` : "no mode; they are equal"],
      ];
      $("compare-facts").replaceChildren(...facts.flatMap(([name, value]) => [h("dt", {}, name), h("dd", {}, value)]));
      Viewer.coefficientChart($("compare-chart"), [{ z: Array.from(za), name: "from" }, { z: Array.from(zb), name: "to" }], K);
    }

    function differenceRange(za, zb) {
      const { model } = page;
      const a = model.vertices(za).slice(), b = model.vertices(zb);
      const values = Float32Array.from({ length: model.V }, (_, v) =>
        Math.hypot(a[3 * v] - b[3 * v], a[3 * v + 1] - b[3 * v + 1], a[3 * v + 2] - b[3 * v + 2]));
      return nice(Math.max(quantile(values, 0.995), 0.1));
    }

    function stopWalk() {
      cancelAnimationFrame(walking);
      walking = 0;
      $("walk-play").setAttribute("aria-pressed", "false");
      $("walk-play").textContent = "Play";
    }

    function startWalk() {
      $("walk-play").setAttribute("aria-pressed", "true");
      $("walk-play").textContent = "Stop";
      const began = performance.now(), phase = Math.acos(1 - 2 * Number($("walk").value));
      const step = (now) => {
        $("walk").value = 0.5 - 0.5 * Math.cos(phase + ((now - began) / 1000) * 1.6);
        drawCompare(false);
        walking = requestAnimationFrame(step);
      };
      walking = requestAnimationFrame(step);
    }

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
      for (const id of ["compare-a", "compare-b"]) $(id).addEventListener("change", choose);
      $("walk").addEventListener("input", () => { stopWalk(); drawCompare(false); });
      $("walk-play").addEventListener("click", () => (walking ? stopWalk() : startWalk()));
      $("walk-use").addEventListener("click", () => page.apply(onTheWay().now));
      $("difference").addEventListener("change", () => drawCompare(false));
      $("swap").addEventListener("click", () => {
        const [a, b] = [$("compare-a").value, $("compare-b").value];
        [$("compare-a").value, $("compare-b").value] = [b, a];
        drawCompare(true);
      });
      $("csv-button").addEventListener("click", () => $("csv-file").click());
      $("csv-file").addEventListener("change", () => { if ($("csv-file").files[0]) readCsv($("csv-file").files[0]); $("csv-file").value = ""; });
    }

    return { start, draw: drawCompare, stop: stopWalk, fillChoices };
  };
})();
