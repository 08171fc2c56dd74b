/* The viewer's page: the model with a slider per mode, two shapes compared, saved fits, and scans dropped here. */
(function () {
  "use strict";

  const Viewer = window.ShapespaceViewer;
  const { $, h, sign, paintTrack, nice, quantile, save, alertUser, ask, telling, guarded, json, binary, post } = Viewer;
  const SHOWN_AT_FIRST = 12;
  const FILTERED_FROM = 12;
  const OTHER_SIZE = 0.02; // share by which the scan's millimetres differ where both are told
  const STATUS = {
    converged: "No problems detected", doubtful: "Do not trust this fit", max_iterations: "The fit was cut off",
    failed: "The scan could not be fitted", unreadable: "This result cannot be read", stopped: "The fit was stopped",
  };
  const LEFT_RED = [0.83, 0.25, 0.15];

  window.shapespaceReady = false;
  window.shapespaceTimes = []; // ms from a slider's event to the picture, as drawn

  let about, model, stddev, share;
  let z; // all coefficients, standard deviations
  let positions;
  let stage;
  let shown = "model";

  const download = guarded(async (question, kind, name) => {
    const { fit, scan, stage: at, z: shape } = question;
    const asked = fit !== undefined ? { fit, stage: at } : scan !== undefined ? { scan, stage: at } : { z: Array.from(shape) };
    const answer = await ask(`api/export?format=${kind}`, post(asked));
    save(await answer.blob(), `${name.replace(/[^\w.-]+/g, "_").replace(/\.(ply|obj|stl|off|vtk|vtp|glb|gltf)(?=\.|$)/i, "")}.${kind}`);
  });

  // The stage: one or two linked views ------------------------------------------------------------------------------

  class Stage {
    constructor() {
      this.a = new Shapespace.View($("view-a"), { label: "The shape in 3-D", embedded: false });
      this.b = null;
      this.holds = null;
    }

    split(two) {
      if (two && !this.b) {
        this.b = new Shapespace.View($("view-b"), { label: "The model in 3-D", embedded: false });
        this.a.link(this.b);
      }
      $("pane-b").hidden = !two;
    }

    /** What is seen as PNG; two views stand side by side. */
    async picture() {
      const views = $("pane-b").hidden ? [this.a] : [this.a, this.b];
      const blobs = await Promise.all(views.map((view) => view.png()));
      if (blobs.length === 1) return blobs[0];
      const images = await Promise.all(blobs.map((blob) => createImageBitmap(blob)));
      const canvas = h("canvas", { width: images[0].width + images[1].width, height: Math.max(images[0].height, images[1].height) });
      const context = canvas.getContext("2d");
      images.forEach((image, k) => context.drawImage(image, k * images[0].width, 0));
      return new Promise((resolve) => canvas.toBlob(resolve, "image/png"));
    }

    captions(a, b) {
      $("caption-a").textContent = a || "";
      $("caption-b").textContent = b || "";
    }

    bar(options) {
      $("bar").hidden = !options;
      const wanted = options ? [options.title, ...options.range, ...(options.keys || []).map(([text]) => text)].join(" ") : "";
      if (options && this._bar !== wanted) Shapespace.colourBar($("bar"), options);
      this._bar = wanted;
    }

    legend(items, note) {
      $("legend").hidden = !items;
      if (!items) return;
      const rgb = (c) => `rgb(${c.map((v) => Math.round(255 * v)).join(",")})`;
      $("legend").replaceChildren(...items.map(([text, colour]) => {
        const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
        const spot = document.createElementNS("http://www.w3.org/2000/svg", "circle");
        for (const [key, value] of [["cx", 6], ["cy", 6], ["r", 6], ["fill", rgb(colour)]]) spot.setAttribute(key, value);
        svg.setAttribute("viewBox", "0 0 12 12");
        svg.append(spot);
        return h("li", {}, svg, text);
      }), ...(note ? [h("li", {}, note)] : []));
    }

    clear() {
      $("empty").hidden = true;
      for (const view of [this.a, this.b]) {
        if (view) for (const id of ["model", "scan", "landmarks", "placed"]) view.remove(id);
      }
      this.bar(null);
      this.legend(null);
      this.captions("", "");
      this.holds = null;
    }
  }

  /** Show no surface, and say why. */
  function nothing(text) {
    stage.clear();
    stage.split(false);
    $("empty").textContent = text;
    $("empty").hidden = false;
  }

  // Model -----------------------------------------------------------------------------------------------------------

  const rows = [];
  let mapRange = 0;

  function makeSliders() {
    const list = $("sliders");
    list.append(h("div", { class: "mode modes-head", "aria-hidden": "true" }, h("span"), h("span", {}, "Mode and its share of the variance"), h("span"), h("span"), h("span")));
    for (let k = 0; k < model.K; k++) {
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
        z[k] = Number(slider.value);
        updateRow(k);
        drawModel(began);
      });
      undo.addEventListener("click", () => { stopAnimation(); z[k] = 0; updateRow(k); drawModel(); slider.focus(); });
      const head = h("span", {}, `${k + 1} `, h("small", {}, percent(share[k])));
      const row = h("div", { class: "mode" }, tick, head, slider, output, undo);
      row.hidden = k >= SHOWN_AT_FIRST;
      rows.push({ row, slider, output, undo, tick });
      list.append(row);
    }
    const rest = model.K - SHOWN_AT_FIRST;
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
    if (Number(slider.value) !== z[k]) slider.value = z[k];
    output.textContent = sign(z[k]);
    undo.disabled = z[k] === 0;
    paintTrack(slider);
  }

  const updateRows = () => rows.forEach((_, k) => updateRow(k));

  function setShape(values) {
    z.fill(0);
    for (let k = 0; k < Math.min(z.length, values.length); k++) z[k] = values[k];
    updateRows();
  }

  let asked = 0;
  function drawModel(began) {
    if (shown !== "model") return;
    if (began !== undefined && !asked) asked = began;
    positions = model.vertices(z, positions);
    if (stage.holds !== "model") {
      stage.clear();
      stage.split(false);
      stage.holds = "model";
      stage.a.setSurface("model", { positions, faces: model.faces, colour: about.clay });
    } else {
      stage.a.move("model", positions);
    }
    const moved = z.some((value) => value !== 0);
    stage.captions(moved ? "" : "The mean shape");
    if ($("map").checked) {
      const values = model.displacement(z);
      const most = quantile(values, 0.995);
      if (most > mapRange || most < mapRange / 4) mapRange = nice(Math.max(most, 0.1));
      const range = [-mapRange, mapRange];
      stage.a.paint("model", values, { map: about.diverging, range, changed: true });
      stage.bar({ map: about.diverging, range, unit: "mm", title: "Moved in (\u2212) or out (+)" });
    } else {
      stage.a.paint("model", null);
      stage.bar(null);
    }
    drawMarks(stage.a, $("marks").checked);
  }

  // Position of a landmark on a surface: `at` has the vertices of its triangle and their barycentric weights.
  function onSurface(positions, at) {
    return [0, 1, 2].map((axis) => at.vertices.reduce((sum, v, k) => sum + at.weights[k] * positions[3 * v + axis], 0));
  }

  let hasMarks = false;
  function drawMarks(view, wanted) {
    if (!wanted && !hasMarks) return;
    const entries = Object.entries(model.facts.landmarks);
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
    const start = chosen.map((k) => Math.asin(Math.max(-1, Math.min(1, z[k] / reach))));
    const step = (now) => {
      const t = (now - began) / 1000;
      chosen.forEach((k, j) => {
        z[k] = reach * Math.sin(start[j] + (t * 2 * Math.PI) / (4 + 0.7 * j));
        updateRow(k);
      });
      drawModel();
      swinging = requestAnimationFrame(step);
    };
    swinging = requestAnimationFrame(step);
  }

  /** A normal deviate (Box and Muller). */
  const normal = () => Math.sqrt(-2 * Math.log(1 - Math.random())) * Math.cos(2 * Math.PI * Math.random());
  const randomShape = () => Array.from({ length: about.modes }, () => Math.max(-3, Math.min(3, normal())));

  function startModel() {
    makeSliders();
    $("reset").addEventListener("click", () => { stopAnimation(); setShape([]); drawModel(); });
    $("random").addEventListener("click", () => { stopAnimation(); setShape(randomShape()); drawModel(); });
    $("animate").addEventListener("click", () => (swinging ? stopAnimation() : startAnimation()));
    $("map").addEventListener("change", () => drawModel());
    $("marks").addEventListener("change", () => drawModel());
    $("marks-label").hidden = !about.landmarks.length;
    if (about.modes_sent < about.modes) {
      $("animate-hint").textContent += ` The first ${about.modes_sent} of ${about.modes} modes are shown; more would not fit here.`;
    }
    for (const kind of about.exports) {
      $("export-shape").append(h("button", {
        type: "button", "data-testid": `export-${kind}`, onclick: () => download({ z }, kind, "shape"),
      }, kind.toUpperCase()));
    }
    $("export-shape").append(h("button", { type: "button", "data-testid": "export-csv", onclick: () => {
      const b = Array.from(z, (value, k) => value * (k < stddev.length ? stddev[k] : 0));
      save(Viewer.coefficientsCsv([{ name: "shape", b, z: Array.from(z) }], about.modes), "shape.coefficients.csv");
    } }, "Coefficients CSV"));
  }

  // Compare ---------------------------------------------------------------------------------------------------------

  const shapes = new Map(); // key -> {name, z}
  let listed = [];
  let walking = 0;

  function fillChoices() {
    shapes.set("mean", { name: "the mean shape", z: [] });
    shapes.set("current", { name: "the shape in Model", get z() { return Array.from(z); } });
    for (const row of listed) if (row.z) shapes.set(`fit ${row.name}`, { name: row.label, z: row.z });
    for (const [select, first] of [[$("compare-a"), "mean"], [$("compare-b"), "current"]]) {
      const before = select.value || first;
      select.replaceChildren(...Array.from(shapes, ([key, one]) => h("option", { value: key }, one.name)), h("option", { value: "random" }, "a new random shape"));
      select.value = shapes.has(before) ? before : first;
    }
  }

  function pair() {
    return [$("compare-a"), $("compare-b")].map((select) => shapes.get(select.value));
  }

  function choose(event) {
    if (event.target.value === "random") {
      const number = Array.from(shapes.keys()).filter((key) => key.startsWith("random ")).length + 1;
      shapes.set(`random ${number}`, { name: `random shape ${number}`, z: randomShape() });
      fillChoices();
      event.target.value = `random ${number}`;
    }
    drawCompare(true);
  }

  /** Where the walk is: both shapes, their coefficients, those in between, and how far along. */
  function onTheWay() {
    const [a, b] = pair();
    const K = about.modes, t = Number($("walk").value);
    const [za, zb] = [a, b].map((one) => {
      const given = one.z;
      return Float64Array.from({ length: K }, (_, k) => given[k] || 0);
    });
    return { a, b, za, zb, t, K, now: za.map((value, k) => value + t * (zb[k] - value)) };
  }

  function drawCompare(changed) {
    if (shown !== "compare") return;
    const { a, b, za, zb, t, K, now } = onTheWay();
    const from = $("difference").checked ? model.vertices(za).slice() : null;
    positions = model.vertices(now, positions);
    if (stage.holds !== "compare") {
      stage.clear();
      stage.split(false);
      stage.holds = "compare";
      stage.a.setSurface("model", { positions, faces: model.faces, colour: about.clay });
    } else {
      stage.a.move("model", positions);
    }
    if (from) {
      const values = Float32Array.from({ length: model.V }, (_, v) =>
        Math.hypot(positions[3 * v] - from[3 * v], positions[3 * v + 1] - from[3 * v + 1], positions[3 * v + 2] - from[3 * v + 2]));
      const range = [0, differenceRange(za, zb)];
      stage.a.paint("model", values, { map: about.sequential, range, changed: true });
      stage.bar({ map: about.sequential, range, unit: "mm", title: `Moved from ${a.name}` });
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
    const moved = Float64Array.from(steps, (value, k) => Math.abs(value * stddev[k]) / Math.sqrt(model.V));
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

  /** Rows of a CSV text: quotes, doubled quotes and line breaks in quotes are understood. */
  function csvRows(text) {
    const lines = [[""]];
    let quoted = false;
    for (let i = 0; i < text.length; i++) {
      const c = text[i], line = lines[lines.length - 1];
      if (quoted && c === '"' && text[i + 1] === '"') { line[line.length - 1] += '"'; i += 1; }
      else if (c === '"') quoted = !quoted;
      else if (!quoted && c === ",") line.push("");
      else if (!quoted && c === "\n") lines.push([""]);
      else if (quoted || c !== "\r") line[line.length - 1] += c;
    }
    return lines.filter((line) => line.length > 1 || line[0]);
  }

  const readCsv = guarded(async (file) => {
    if (file.size > 64 * 2 ** 20) throw new Error(`${file.name} is larger than any table of coefficients; give a coefficients.csv.`);
    const table = csvRows(await file.text());
    const head = table[0] || [];
    const named = (letter) => head.filter((name) => new RegExp(`^${letter}[1-9][0-9]*$`).test(name)).length;
    const letter = named("z") ? "z" : named("b") ? "b" : null;
    if (!letter) throw new Error(`${file.name} has no columns z1, z2, ... or b1, b2, ...; give a coefficients.csv of shapespace fit.`);
    const columns = (of) => Array.from({ length: about.modes }, (_, k) => head.indexOf(`${of}${k + 1}`));
    const at = columns(letter), other = columns(letter === "z" ? "b" : "z");
    if (named(letter) !== about.modes || at.includes(-1)) {
      throw new Error(`${file.name} holds ${named(letter)} coefficients and ${about.model} has ${about.modes}; give a table of fits by this model.`);
    }
    let added = 0;
    for (const line of table.slice(1)) {
      const given = at.map((column) => line[column] || "");
      while (given.length > 1 && given[given.length - 1] === "") given.pop(); // modes that were not fitted
      if (given.includes("")) continue;
      const numbers = given.map(Number);
      const values = letter === "z" ? numbers : numbers.map((value, k) => value / stddev[k]);
      if (!values.every(Number.isFinite)) continue;
      // Tables with b and z tell the standard deviations of their model.
      const differs = letter === "z" && values.some((value, k) => {
        const b = line[other[k]] ? Number(line[other[k]]) : NaN, ours = value * stddev[k];
        return Math.abs(b - ours) > 1e-3 * Math.max(Math.abs(b), Math.abs(ours)) + 1e-6;
      });
      if (differs) throw new Error(`${file.name} was made by another model than ${about.model}, for its modes have other standard deviations; give a table of fits by this model.`);
      const name = line[Math.max(head.indexOf("scan"), 0)] || `row ${added + 1}`;
      shapes.set(`csv ${file.name} ${name}`, { name: `${name} (${file.name})`, z: values });
      added += 1;
      if (added === 1) $("compare-b").dataset.wanted = `csv ${file.name} ${name}`;
    }
    if (!added) throw new Error(`${file.name} has no row with numbers in all its coefficients; give a coefficients.csv of shapespace fit.`);
    fillChoices();
    $("compare-b").value = $("compare-b").dataset.wanted;
    show("compare");
  });

  function startCompare() {
    fillChoices();
    for (const id of ["compare-a", "compare-b"]) $(id).addEventListener("change", choose);
    $("walk").addEventListener("input", () => { stopWalk(); drawCompare(false); });
    $("walk-play").addEventListener("click", () => (walking ? stopWalk() : startWalk()));
    $("walk-use").addEventListener("click", () => apply(onTheWay().now));
    $("difference").addEventListener("change", () => drawCompare(false));
    $("swap").addEventListener("click", () => {
      const [a, b] = [$("compare-a").value, $("compare-b").value];
      [$("compare-a").value, $("compare-b").value] = [b, a];
      drawCompare(true);
    });
    $("csv-button").addEventListener("click", () => $("csv-file").click());
    $("csv-file").addEventListener("change", () => { if ($("csv-file").files[0]) readCsv($("csv-file").files[0]); $("csv-file").value = ""; });
  }

  // Fits ------------------------------------------------------------------------------------------------------------

  let fitView, scanView;
  let selected = -1;

  function verdictCard(facts, where) {
    const notes = facts.notes && facts.notes.length ? h("ul", {}, ...facts.notes.map((note) => h("li", {}, note))) : null;
    return h("div", { class: `status ${facts.status}`, "data-testid": `${where}-status`, "data-status": facts.status },
      h("strong", {}, STATUS[facts.status] || facts.status), h("span", {}, plainReason(facts.reason || "")), notes);
  }

  /** A reason without what the heading says already. */
  function plainReason(reason) {
    const said = "Do not trust this fit: ";
    if (!reason.startsWith(said)) return reason; // it may begin with the name of a file
    const rest = reason.slice(said.length);
    return rest.charAt(0).toUpperCase() + rest.slice(1);
  }

  const mm = (value) => (Number.isFinite(value) ? `${value.toFixed(2)} mm` : "unknown");
  const sharePercent = (share) => (Number.isFinite(share) ? `${Math.round(100 * share)} %` : "an unknown share");

  /** Distances over what scan and model both show, in mm of the model and, where they differ, of the scan. */
  function distanceFacts(facts) {
    const { shown: told, shown_scan_mm: inScan } = facts;
    if (!told) return null;
    const rows = [
      ["Model to scan", "model_to_scan", `the scan shows it, ${sharePercent(told.model_seen_share)} of the model`],
      ["Scan to model", "scan_to_model", `the model covers it, ${sharePercent(told.scan_covered_share)} of the scan`],
    ].map(([name, way, where]) => {
      const { mean, p95 } = told[way], own = inScan ? inScan[way].mean : mean;
      const other = Math.abs(own - mean) > OTHER_SIZE * mean ? ` (${mm(own)} of the scan)` : "";
      return [name, `${mm(mean)}${other} mean where ${where}; 95 % within ${mm(p95)}`];
    });
    return h("dl", { class: "facts", "data-testid": "shown" }, ...rows.flatMap(([name, value]) => [h("dt", {}, name), h("dd", {}, value)]));
  }

  function shortly(row) {
    if (row.shown) return `${[row.shown.model_to_scan, row.shown.scan_to_model].map(({ mean }) => (Number.isFinite(mean) ? mean.toFixed(2) : "?")).join(" / ")} mm`;
    return row.scan_to_model_mm === null ? row.status : `${row.scan_to_model_mm.toFixed(2)} mm`;
  }

  async function startFits() {
    $("fits-none").hidden = about.has_fits;
    $("fits-some").hidden = !about.has_fits;
    if (!about.has_fits) return;
    listed = await json("api/fits");
    fillChoices();
    $("fit-filter-label").hidden = listed.length <= FILTERED_FROM;
    $("fit-filter").addEventListener("input", filterFits);
    $("fit-list").replaceChildren(...listed.map((row, i) => h("div", {
      role: "option", id: `fit-${i}`, class: row.status, "aria-selected": "false", "data-testid": "fit", "data-name": row.name,
      title: row.reason, onclick: () => selectFit(i),
    }, h("i", { class: "dot" }), h("span", {}, row.label, h("b", { hidden: true }, ` ${row.status}`)),
    h("small", {}, shortly(row)))));
    $("fit-list").addEventListener("keydown", (event) => {
      const step = { ArrowDown: 1, ArrowUp: -1 }[event.key];
      if (!step) return;
      event.preventDefault();
      for (let i = selected + step; i >= 0 && i < listed.length; i += step) {
        if (!$(`fit-${i}`).hidden) { selectFit(i); return; }
      }
    });
    const isDoubtful = (row) => row.status !== "converged";
    const go = (step) => {
      for (let i = 1; i <= listed.length; i++) {
        const at = (((selected < 0 && step < 0 ? 0 : selected) + step * i) % listed.length + listed.length) % listed.length;
        if (isDoubtful(listed[at])) { selectFit(at); return; }
      }
    };
    $("fit-next").addEventListener("click", () => go(1));
    $("fit-previous").addEventListener("click", () => go(-1));
    const count = listed.filter(isDoubtful).length;
    $("fit-next").disabled = $("fit-previous").disabled = count === 0;
    if (!count) $("fit-next").title = $("fit-previous").title = "No fit is doubtful";
  }

  /** The fit to open on: the first good one that can be drawn, or else the first that can. */
  function firstFit() {
    const good = listed.findIndex((row) => row.pictured && row.status === "converged");
    return Math.max(0, good >= 0 ? good : listed.findIndex((row) => row.pictured));
  }

  /** Show the fits whose name, label or status holds what is typed. */
  function filterFits() {
    const wanted = $("fit-filter").value.trim().toLowerCase();
    let left = 0;
    listed.forEach((row, i) => {
      const fits = `${row.label}\n${row.name}\n${row.status}`.toLowerCase().includes(wanted);
      $(`fit-${i}`).hidden = !fits;
      left += fits ? 1 : 0;
    });
    $("fit-filter-said").textContent = wanted ? `${left} of ${listed.length} fits` : "";
  }

  const selectFit = guarded(async (index) => {
    selected = index;
    const row = listed[index];
    for (const option of $("fit-list").children) option.setAttribute("aria-selected", String(option.id === `fit-${index}`));
    $("fit-list").setAttribute("aria-activedescendant", `fit-${index}`);
    $(`fit-${index}`).scrollIntoView({ block: "nearest" });
    const detail = h("div");
    fitView.clear();
    fitView.element = detail;
    $("fit-detail").replaceChildren(...[verdictCard(row, "fit"), distanceFacts(row), detail].filter(Boolean));
    if (!row.pictured) {
      if (row.why_not) $("fit-detail").append(h("p", {}, row.why_not));
      if (row.z) $("fit-detail").append(h("button", { type: "button", onclick: () => apply(row.z) }, "Use in Model"));
      if (shown === "fits") nothing(`There is no picture of ${row.label}`);
      return;
    }
    $("loading").textContent = "Loading the fit";
    $("loading").hidden = false;
    try {
      const payload = await binary(`api/fits/${encodeURIComponent(row.name)}`);
      if (selected !== index) return;
      fitView.show(payload, { fit: row.name });
    } finally {
      $("loading").hidden = true;
    }
  });

  function apply(values) {
    setShape(values);
    show("model");
    if (innerWidth <= 760) scrollTo({ top: 0 });
  }

  // Your scan -------------------------------------------------------------------------------------------------------

  let own = null; // the one that is looked at
  const dropped = []; // {id, name, file, dense, states, preview, said, verdict, placing, ...}
  let sending = false;

  const fresh = () => ({ states: [], preview: null, previewed: false, said: null, verdict: null, helped: false, placing: null, frame: null, scheduled: 0, run: 0 });

  function suits(name) {
    const ending = (/\.[^.]+$/.exec(name.toLowerCase()) || [""])[0];
    return about.formats.includes(ending);
  }

  const dropFiles = guarded(async (files) => {
    show("scan");
    const refused = [], taken = [];
    for (const file of files) {
      if (/\.csv$/i.test(file.name)) await readCsv(file);
      else if (!suits(file.name)) refused.push(`${file.name} is not a scan that can be read; drop ${about.formats.join(", ")}.`);
      else if (file.size > about.upload_bytes) {
        refused.push(`${file.name} is larger than the ${Math.round(about.upload_bytes / 2 ** 20)} MB that this viewer takes; thin it, or start the viewer with a larger --max-upload-mb.`);
      } else if (taken.length < about.kept) taken.push(file);
      else refused.push(`${file.name} is left out, for ${about.kept} scans are kept at a time; fit more with shapespace fit.`);
    }
    const records = taken.map((file) => ({ id: null, name: file.name, file, dense: $("dense").checked, ...fresh() }));
    dropped.push(...records);
    for (const mine of records) say(mine, "Waits to be sent", null);
    if (records.length) look(records[0]);
    sendNext();
    if (refused.length) throw new Error(refused.length > 2 ? `${refused[0]} So are ${refused.length - 1} others.` : refused.join(" "));
  });

  const unfinished = () => dropped.filter((one) => one.id && !one.done).length;

  /** Send what waits, one after another, as many as may be fitted at once; the end of a fit calls again. */
  const sendNext = telling(async () => {
    if (sending) return;
    sending = true;
    try {
      for (;;) {
        const mine = dropped.find((one) => one.file);
        if (!mine || unfinished() >= about.unfinished) return;
        const { file } = mine;
        try {
          const facts = await upload(mine, file);
          Object.assign(mine, { id: facts.id, name: facts.name, file: null });
        } catch (error) {
          drop(mine);
          throw error;
        }
        // The oldest goes where there are too many, and the server decides which.
        const kept = new Set((await json("api/scans")).map((scan) => scan.id));
        dropped.filter((one) => one.id && !kept.has(one.id)).forEach(drop);
        if (dropped.includes(mine)) follow(mine);
      }
    } finally {
      sending = false;
      listScans();
    }
  });

  /** PUT with progress, which fetch does not tell. */
  function upload(mine, file) {
    return new Promise((resolve, reject) => {
      const request = new XMLHttpRequest();
      request.open("PUT", `api/scans?name=${encodeURIComponent(file.name)}&dense=${mine.dense ? 1 : 0}`);
      request.responseType = "json";
      request.upload.onprogress = (event) => { if (event.lengthComputable) say(mine, `Sending ${file.name}`, event.loaded / event.total); };
      request.onerror = () => reject(new Error(`${file.name} could not be sent; see whether shapespace view still runs, and try again.`));
      request.onload = () => {
        const told = request.response || {};
        if (request.status === 201) resolve(told);
        else reject(new Error(told.error || `The server answered with the error ${request.status}; reload the page.`));
      };
      say(mine, `Sending ${file.name}`, 0);
      request.send(file);
    });
  }

  /** Say how far a scan is: in full where it is looked at, shortly in the list. */
  function say(mine, text, part) {
    mine.said = { text, part };
    if (own === mine) progress(text, part);
    const row = mine.row && mine.row.lastElementChild;
    if (row) row.textContent = stateOf(mine);
  }

  function progress(text, part) {
    $("progress").hidden = false;
    $("stop").hidden = !own || !own.id;
    $("progress-text").textContent = text;
    if (part === null) $("progress-bar").removeAttribute("value");
    else $("progress-bar").value = part;
  }

  /** Look at one of the dropped scans, wherever its fit is. */
  function look(mine) {
    if (own && own !== mine) own.placing = null;
    own = mine;
    $("scan-detail").hidden = false;
    scanView.clear();
    for (const part of ["verdict", "placing", "progress"]) $(part).hidden = true;
    $("progress-chart").replaceChildren();
    $("zone").classList.add("compact");
    if (shown === "scan") { stage.clear(); stage.split(false); scanView.active = true; }
    listScans();
    if (mine.verdict) telling(async () => { await showVerdict(mine); if (own === mine && mine.helped) offerLandmarks(mine); })();
    else {
      if (mine.said) progress(mine.said.text, mine.said.part);
      telling(drawPreview)(mine);
    }
  }

  async function drawPreview(mine) {
    if (mine.previewed && !mine.preview) mine.preview = await binary(`api/scans/${mine.id}/preview`);
    if (own === mine && mine.preview && !mine.verdict) drawScanStates();
  }

  const POLL_MS = 100;

  /** Ask the server for the progress of a fit until it is done or removed. */
  const follow = telling(async (mine) => {
    const { run } = mine;
    mine.done = false;
    for (let after = 0; dropped.includes(mine) && mine.run === run;) {
      const progress = await json(`api/scans/${mine.id}/progress?after=${after}`);
      after += progress.events.length;
      if (progress.state === "waiting") say(mine, progress.position > 1 ? `Waiting: ${progress.position - 1} before it` : "Waiting for a free place", null);
      else if (!after) say(mine, "Reading the scan", null);
      for (const event of progress.events) await telling(handleEvent)(mine, event);
      if (progress.state === "done") {
        Object.assign(mine, { done: true, helped: progress.can_place_landmarks });
        if (own === mine) {
          $("progress").hidden = true;
          if (mine.helped && !mine.placing) offerLandmarks(mine);
        }
        sendNext();
        return;
      }
      await new Promise((resolve) => setTimeout(resolve, POLL_MS));
    }
  });

  async function handleEvent(mine, event) {
    if (event.event === "scan") {
      Object.assign(mine, { origin: event.origin, unit: event.mm_per_scan_unit, previewed: true });
      say(mine, `${event.vertices.toLocaleString("en")} vertices; looking for a place to start`, null);
      if (own === mine) await drawPreview(mine);
    } else if (event.event === "state") {
      mine.states.push(event);
      if (!mine.scheduled) mine.scheduled = requestAnimationFrame(() => { mine.scheduled = 0; if (!mine.verdict) tellState(mine); });
    } else if (event.event === "verdict") {
      mine.verdict = event;
      if (event.b) {
        shapes.set(`scan ${mine.id}`, { name: mine.name, z: event.z });
        fillChoices();
      }
      listScans();
      if (own === mine) await showVerdict(mine);
    }
  }

  function tellState(mine) {
    const last = mine.states[mine.states.length - 1];
    const what = last.phase === 1 ? "Finding the pose" : "Fitting pose and shape";
    say(mine, `${what}: iteration ${last.iteration}, RMS ${last.rms_mm.toFixed(2)} mm`, null);
    clearTimeout(mine.quiet);
    const after = mine.dense ? "Following the scan densely, and checking whether the fit can be trusted" : "Checking whether the fit can be trusted";
    mine.quiet = setTimeout(() => { if (!mine.verdict) say(mine, after, null); }, 700);
    if (own !== mine) return;
    Viewer.rmsChart($("progress-chart"), mine.states.map((s) => s.rms_mm), mine.states.map((s) => s.phase), null);
    drawScanStates();
  }

  /** R, t, s of a state as a function of a point array, or its inverse. */
  function mapping(state, inverse) {
    const { scale: s, rotation: R, translation: t } = state;
    return (from, to) => {
      for (let i = 0; i < from.length; i += 3) {
        const [x, y, w] = inverse ? [from[i] - t[0], from[i + 1] - t[1], from[i + 2] - t[2]] : [from[i], from[i + 1], from[i + 2]];
        for (let r = 0; r < 3; r++) {
          to[i + r] = inverse ? (R[0][r] * x + R[1][r] * y + R[2][r] * w) / s : s * (R[r][0] * x + R[r][1] * y + R[r][2] * w) + t[r];
        }
      }
      return to;
    };
  }

  /** The scan, and the model on its way to it. What is shown stands as the model does at its first state. */
  function drawScanStates() {
    if (shown !== "scan" || !own || !own.preview) return;
    const { preview, states } = own;
    const first = states[0] || null;
    const raw = preview.arrays.vertices, faces = preview.arrays.faces || null;
    let framed = false;
    if (stage.holds !== own || own.frame !== first) {
      if (stage.holds !== own) { stage.clear(); stage.split(false); }
      stage.holds = own;
      own.frame = first;
      const placed = first ? mapping(first, true)(raw, new Float32Array(raw.length)) : raw;
      stage.a.setSurface("scan", { positions: placed, faces, colour: about.scan_colour });
      framed = true;
    }
    const last = states[states.length - 1];
    if (last) {
      const shape = Float64Array.from({ length: model.K }, (_, k) => (k < last.b.length ? last.b[k] / stddev[k] : 0));
      positions = model.vertices(shape, positions);
      const there = new Float32Array(positions.length);
      mapping(first, true)(mapping(last, false)(positions, there), there);
      if (stage.a.has("model")) stage.a.move("model", there);
      else stage.a.setSurface("model", { positions: there, faces: model.faces, colour: about.model_colour });
      stage.captions(`${own.name}: the model moves onto the scan`);
      stage.legend([["scan", about.scan_colour], ["model", about.model_colour]], Viewer.NEARER);
    } else {
      stage.captions(own.name);
    }
    if (framed) stage.a.frame(["scan", "model"].filter((id) => stage.a.has(id)));
  }

  async function showVerdict(mine) {
    const told = mine.verdict;
    const card = verdictCard(told, "scan");
    $("verdict").replaceChildren(...[card, distanceFacts(told), told.why_not ? h("p", {}, told.why_not) : null].filter(Boolean));
    $("verdict").hidden = false;
    $("progress").hidden = true;
    const remove = h("button", { type: "button", "data-testid": "scan-remove", onclick: guarded(async () => {
      await ask(`api/scans/${mine.id}`, { method: "DELETE" });
      drop(mine);
    }) }, "Remove from the server");
    if (!told.pictured) $("verdict").append(h("div", { class: "row" }, remove));
    if (!told.b) {
      if (mine.previewed && !mine.preview) mine.preview = await binary(`api/scans/${mine.id}/preview`);
      if (own !== mine) return;
      if (mine.preview) drawScanStates();
      else if (shown === "scan") nothing(`There is no picture of ${mine.name}`);
      return;
    }
    const start = { landmarks: "landmarks", upright: "the scan as it stands", rotations: "a search over rotations", given: "a given pose" }[told.start];
    const seconds = Object.values(told.seconds || {}).reduce((sum, value) => sum + value, 0);
    $("verdict").append(h("p", { class: "hint" }, `Started from ${start || told.start}; ${mine.states.length} states in ${seconds.toFixed(1)}\u00a0s.`));
    if (!told.pictured) return;
    const payload = await binary(`api/scans/${mine.id}/picture`);
    if (own !== mine || mine.placing) return;
    scanView.show(payload, { scan: mine.id, b: told.b, z: told.z, b_stddev: told.b_stddev });
    $("scan-detail").append(h("div", { class: "row" },
      h("button", { type: "button", "data-testid": "scan-record", onclick: guarded(async () => {
        save(await (await ask(`api/scans/${mine.id}/record`)).blob(), `${mine.name.replace(/\.[^.]*$/, "")}.fit.json`);
      }) }, "Record (JSON)"), remove));
  }

  /** Forget a scan that the server has removed, or never had. */
  function drop(mine) {
    dropped.splice(dropped.indexOf(mine), 1);
    shapes.delete(`scan ${mine.id}`);
    fillChoices();
    if (own !== mine) { listScans(); return; }
    const next = dropped[dropped.length - 1];
    if (next) { look(next); return; }
    own = null;
    listScans();
    scanView.clear();
    for (const part of ["verdict", "placing", "progress"]) $(part).hidden = true;
    $("zone").classList.remove("compact");
    stage.clear();
    stage.split(false);
  }

  function stateOf(mine) {
    if (mine.verdict) return mine.verdict.shown ? shortly(mine.verdict) : mine.verdict.status;
    if (mine.file) return mine.said && mine.said.part !== null ? "being sent" : "waits";
    return mine.states.length ? `iteration ${mine.states[mine.states.length - 1].iteration}` : "waits";
  }

  /** The dropped scans beside each other, where there are several. */
  function listScans() {
    $("own").replaceChildren();
    if (dropped.length < 2) return;
    const list = h("div", { class: "list", role: "listbox", tabindex: "0", "aria-label": "Your scans", "data-testid": "own-list" });
    dropped.forEach((mine, i) => {
      mine.row = h("div", {
        role: "option", id: `own-${i}`, class: mine.verdict ? mine.verdict.status : "", "aria-selected": String(mine === own),
        "data-testid": "own-scan", "data-name": mine.name, onclick: () => look(mine),
      }, h("i", { class: "dot" }), h("span", {}, mine.name), h("small", {}, stateOf(mine)));
      list.append(mine.row);
      if (mine === own) list.setAttribute("aria-activedescendant", `own-${i}`);
    });
    list.addEventListener("keydown", (event) => {
      const next = dropped[dropped.indexOf(own) + ({ ArrowDown: 1, ArrowUp: -1 }[event.key] || NaN)];
      if (!next) return;
      event.preventDefault();
      look(next);
      $("own").firstElementChild.nextElementSibling.focus();
    });
    const fitted = dropped.filter((one) => one.verdict && one.verdict.b);
    const all = fitted.length > 1 ? h("button", { type: "button", "data-testid": "own-csv", onclick: () => {
      const rows = fitted.map(({ name, verdict: { status, b, z: values, b_stddev: sd } }) => ({ name: name.replace(/\.[^.]*$/, ""), status, b, z: values, sd }));
      save(Viewer.coefficientsCsv(rows, about.modes), "coefficients.csv");
    } }, `Coefficients of all ${fitted.length} (CSV)`) : null;
    $("own").append(h("div", { class: "list-head" }, h("span", {}, "Your scans"), h("span", {}, "model to scan / scan to model")), list, ...(all ? [h("div", { class: "row" }, all)] : []));
  }

  // Landmarks on a scan

  function offerLandmarks(mine) {
    $("placing").replaceChildren(
      h("p", {}, "Landmarks can help this scan: click a few points on it, and the fit starts from them."),
      h("button", { type: "button", class: "strong", "data-testid": "place", onclick: () => startPlacing(mine) }, "Place landmarks"));
    $("placing").hidden = false;
  }

  function startPlacing(mine) {
    mine.placing = { placed: new Map(), current: about.landmarks[0] };
    scanView.active = false;
    scanView.stop();
    $("scan-detail").hidden = true;
    stage.clear();
    stage.holds = null;
    own.frame = null;
    drawPlacing(true);
    $("placing").scrollIntoView({ block: "nearest" });
  }

  function drawPlacing(first) {
    const mine = own, { placed } = mine.placing;
    if (shown === "scan") {
      stage.split(true);
      if (first || stage.holds !== mine.placing) {
        stage.clear();
        stage.holds = mine.placing;
        const raw = mine.preview.arrays.vertices, turn = mine.states[0];
        const at = turn ? mapping(turn, true)(raw, new Float32Array(raw.length)) : raw;
        stage.a.setSurface("scan", { positions: at, faces: mine.preview.arrays.faces || null, colour: about.scan_colour });
        stage.b.setSurface("model", { positions: model.mean, faces: model.faces, colour: about.model_colour });
        stage.a.frame(["scan"]);
        stage.captions(`${mine.name}: click where the landmark is`, "The model: where it belongs");
      }
      stage.a.marks("placed", Array.from(placed, ([label, position]) => ({ position, label, colour: LEFT_RED })));
      stage.b.marks("landmarks", about.landmarks.map((name) => {
        const at = model.facts.landmarks[name], wanted = name === mine.placing.current;
        return { position: onSurface(model.mean, at), label: wanted ? name : "", colour: wanted ? LEFT_RED : placed.has(name) ? [0.1, 0.45, 0.28] : [0.6, 0.6, 0.6] };
      }));
    }
    const names = h("div", { class: "names", role: "group", "aria-label": "Which landmark" }, ...about.landmarks.map((name) => h("button", {
      type: "button", class: placed.has(name) ? "placed" : "", "aria-pressed": String(name === mine.placing.current), "data-testid": `landmark-${name}`,
      onclick: () => { mine.placing.current = name; drawPlacing(); },
    }, name.replace(/_/g, " "))));
    const missing = 3 - placed.size;
    $("placing").replaceChildren(
      h("p", { role: "status", "data-testid": "placing-text" }, `Click ${mine.placing.current.replace(/_/g, " ")} on the scan. ${missing > 0 ? `${missing} more ${missing === 1 ? "is" : "are"} needed.` : "More landmarks make the start safer."}`),
      names,
      h("div", { class: "row" },
        h("button", { type: "button", "data-testid": "undo", onclick: () => undo(mine) , disabled: placed.size === 0 }, "Undo"),
        h("button", { type: "button", class: "strong", "data-testid": "refit", disabled: missing > 0, onclick: () => refit(mine) }, "Fit again"),
        h("button", { type: "button", "data-testid": "placing-cancel", onclick: () => endPlacing(mine) }, "Cancel")));
  }

  function undo(mine) {
    const last = Array.from(mine.placing.placed.keys()).pop();
    mine.placing.placed.delete(last);
    mine.placing.current = last;
    drawPlacing();
  }

  function endPlacing(mine) {
    mine.placing = null;
    $("scan-detail").hidden = false;
    stage.clear();
    stage.split(false);
    offerLandmarks(mine);
    show("scan");
  }

  function placeAt(event) {
    if (shown !== "scan" || !own || !own.placing) return;
    const hit = stage.a.pick(event.clientX, event.clientY, ["scan"]);
    if (!hit) return;
    const { placed } = own.placing;
    placed.delete(own.placing.current);
    placed.set(own.placing.current, hit.point);
    const open = about.landmarks.find((name) => !placed.has(name));
    if (open) own.placing.current = open;
    drawPlacing();
  }

  const refit = guarded(async (mine) => {
    const turn = mine.states[0];
    const landmarks = {};
    for (const [name, point] of mine.placing.placed) {
      const there = Float64Array.from(point);
      if (turn) mapping(turn, false)(Float64Array.from(point), there);
      landmarks[name] = Array.from(there, (value, i) => value / mine.unit + mine.origin[i]);
    }
    await ask(`api/scans/${mine.id}/landmarks`, post({ landmarks }));
    $("scan-detail").hidden = false;
    scanView.active = shown === "scan";
    Object.assign(mine, fresh(), { run: mine.run + 1 });
    say(mine, "Starting from your landmarks", null);
    look(mine);
    follow(mine);
  });

  async function startScan() {
    $("zone-hint").textContent = `${about.formats.map((ending) => ending.slice(1).toUpperCase()).join(", ")}, up to ${Math.round(about.upload_bytes / 2 ** 20)} MB. It is fitted on the machine where the viewer runs, and the file is removed after the fit.`;
    $("file").accept = about.formats.join(",");
    $("choose").addEventListener("click", () => $("file").click());
    $("file").addEventListener("change", () => { dropFiles(Array.from($("file").files)); $("file").value = ""; });
    $("stop").addEventListener("click", guarded(async () => { if (own && own.id) await ask(`api/scans/${own.id}/cancel`, post({})); }));
    let depth = 0;
    const withFiles = (event) => event.dataTransfer && Array.from(event.dataTransfer.types).includes("Files");
    addEventListener("dragenter", (event) => { if (withFiles(event)) { event.preventDefault(); depth += 1; $("cover").hidden = false; } });
    addEventListener("dragover", (event) => { if (withFiles(event)) event.preventDefault(); });
    addEventListener("dragleave", (event) => { if (withFiles(event)) { depth = Math.max(0, depth - 1); $("cover").hidden = depth === 0; } });
    addEventListener("drop", (event) => {
      if (!withFiles(event)) return;
      event.preventDefault();
      depth = 0;
      $("cover").hidden = true;
      dropFiles(Array.from(event.dataTransfer.files));
    });
    const earlier = await json("api/scans");
    for (const { id, name, dense } of earlier) {
      const mine = { id, name, dense, ...fresh() };
      dropped.push(mine);
      follow(mine);
    }
    if (dropped.length) {
      show("scan");
      look(dropped[dropped.length - 1]);
    }
  }

  // Tabs and the rest -----------------------------------------------------------------------------------------------

  const TABS = ["model", "compare", "fits", "scan"];

  function show(name) {
    shown = name;
    stopAnimation();
    stopWalk();
    for (const tab of TABS) {
      $(`tab-${tab}`).setAttribute("aria-selected", String(tab === name));
      $(`tab-${tab}`).tabIndex = tab === name ? 0 : -1;
      $(tab).hidden = tab !== name;
    }
    fitView.stop();
    scanView.stop();
    fitView.active = name === "fits";
    scanView.active = name === "scan" && !(own && own.placing);
    if (name === "model") drawModel();
    else if (name === "compare") drawCompare(true);
    else {
      stage.clear();
      stage.split(false);
      if (name === "fits") {
        if (listed.length && !fitView.payload) selectFit(selected >= 0 ? selected : firstFit());
        else if (fitView.payload) fitView.draw(true);
        else drawEmpty();
      } else if (own && own.placing) drawPlacing(true);
      else if (scanView.payload) scanView.draw(true);
      else if (own && own.preview) drawScanStates();
      else if (own && own.verdict) nothing(`There is no picture of ${own.name}`);
      else if (!own) drawEmpty();
    }
    if (name === "model" || name === "compare") stage.a.frame(["model"]);
  }

  /** Nothing to show yet: the mean, faint. */
  function drawEmpty() {
    stage.a.setSurface("model", { positions: model.mean, faces: model.faces, colour: about.clay, opacity: 0.35 });
    stage.holds = "empty";
    stage.a.frame(["model"]);
  }

  function startTabs() {
    for (const tab of TABS) {
      $(`tab-${tab}`).addEventListener("click", () => show(tab));
      $(`tab-${tab}`).addEventListener("keydown", (event) => {
        const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
        if (!step) return;
        const next = TABS[(TABS.indexOf(tab) + step + TABS.length) % TABS.length];
        show(next);
        $(`tab-${next}`).focus();
      });
    }
    Viewer.startTheme(() => { for (const view of [stage.a, stage.b]) if (view) view.request(); });
    $("view-home").addEventListener("click", () => stage.a.reset());
    $("picture").addEventListener("click", guarded(async () => save(await stage.picture(), "shapespace.png")));
  }

  function ready() {
    window.shapespaceReady = true;
    document.body.dataset.ready = "true";
  }

  async function begin() {
    about = await json("api/about");
    const unpacked = await binary("api/model");
    model = new Shapespace.Model(unpacked);
    stddev = about.stddev;
    share = unpacked.arrays.share;
    z = new Float64Array(about.modes);
    document.title = `${about.model} \u2013 shapespace`;
    $("about").textContent = `${about.model}: ${about.vertices.toLocaleString("en")} vertices, ${about.modes} ${about.modes === 1 ? "mode" : "modes"}`;
    stage = new Stage();
    const context = { stage, model, about, apply, download, alert: alertUser };
    fitView = new Viewer.FitView($("fit-detail"), context, "fit");
    scanView = new Viewer.FitView($("scan-detail"), context, "scan");
    stage.a.on("click", placeAt);
    stage.a.on("draw", () => {
      if (asked) window.shapespaceTimes.push(performance.now() - asked);
      asked = 0;
      ready();
    });
    window.shapespaceStage = stage;
    startModel();
    startCompare();
    startTabs();
    Viewer.startMessages();
    drawModel();
    stage.a.frame(["model"]);
    $("loading").hidden = true;
    if (!stage.a.works) ready();
    await startFits();
    if (about.has_fits) show("fits");
    await startScan();
  }

  guarded(begin)();
})();
