/* Surfaces in correspondence side by side: a click on one marks the same vertex on all of them. */
(function () {
  "use strict";

  const Viewer = window.ShapespaceViewer;
  const { save, alertUser, guarded } = Viewer;
  const { make: h, partControls } = Shapespace.widgetParts;
  const WORDS = { unreadable: "unreadable", excluded: "excluded", doubtful: "doubtful", look: "needs review", converged: "converged" };
  const DOTS = { unreadable: "unreadable", excluded: "failed", doubtful: "doubtful", look: "doubtful", converged: "converged" };

  const percent = (share) => `${(100 * share).toFixed(share > 0 && share < 0.0995 ? 1 : 0)} %`;

  /**
   * Show the surfaces at the address `base` in `root`; return {dispose(), place(), oriented(), setLandmarks(list)}.
   * options: {landmarks: [{name, vertex}], onvertex(vertex), onlandmark(name, vertex), onplace(), place, onready()}.
   */
  Viewer.openSurfaces = function (root, base, options) {
    const { colours } = Shapespace;
    const $ = (id) => root.getElementById(id);
    const ask = (path) => Viewer.ask(base + path), json = (path) => Viewer.json(base + path), binary = (path) => Viewer.binary(base + path);
    const wantedPlace = options.place || {};

    let about, mean, scans;
    let rows = []; // all scans, as listed
    let wanted = []; // those with a surface that the filter leaves
    let first = 0; // number of the first one that is shown
    let cells = []; // the mean shape, then one a scan
    let marks = []; // numbers of vertices
    let named = options.landmarks || []; // of the project: {name, vertex}
    let colour = "squares";
    let sides = 2; // views of each surface, the second from the opposite side
    let faults = new Map(); // name of a scan of the page -> {places, arrays}
    let turned = null; // rows of the rotation from the frame of the folder to the views
    let turn = 0; // a page that is still on its way is not shown when another was asked for

    // The grid --------------------------------------------------------------------------------------------------------

    const numbersOf = (text) => (text || "").split(",").filter(Boolean).map(Number).filter((number) => Number.isInteger(number) && number >= 0);
    const perPage = () => (sides === 2 ? Math.max(1, Math.floor((about.page + 1) / 2) - 1) : about.page);
    const viewsOf = (cell) => [cell.view, cell.back].slice(0, sides);

    function makeCells() {
      for (let k = 0; k <= about.page; k++) {
        const front = h("div", { class: "view front", "data-testid": `view-${k}` }), behind = h("div", { class: "view behind", "data-testid": `back-${k}` });
        const name = h("strong", {}), note = h("span", { class: "note", "data-testid": `note-${k}` });
        const box = h("div", { class: "cell", "data-testid": `cell-${k}` }, front, behind, note, h("p", {}, name));
        $("grid").append(box);
        const cell = { box, name, note, marked: [], positions: null, std: null };
        [cell.view, cell.back] = [front, behind].map((element) => {
          const view = new Shapespace.View(element, { label: "A surface in 3-D" });
          view.on("click", (event) => {
            const hit = view.pick(event.clientX, event.clientY, ["surface"]);
            if (hit) addMark(hit.vertex);
          });
          startDragging(cell, view, element);
          return view;
        });
        cells.push(cell);
      }
    }

    function put(cell, name, { positions, std }) {
      cell.positions = positions;
      cell.std = std;
      cell.name.textContent = name;
      cell.scan = name;
      viewsOf(cell).forEach((view, k) => {
        view.label = `${name} in 3-D${k ? ", from the opposite side" : ""}`;
        view.setSurface("surface", { positions, faces: mean.faces, draft: mean.draft, parts: mean.parts, colour: colours.clay });
      });
      paint(cell);
      drawMarks(cell);
    }

    const AREA_LIMIT = Math.log(2); // as in the report: half to twice the area
    const percentOf = (values) => values.map((value) => 100 * value);

    /** Values and colours of a surface: arguments of `View.paint`. */
    function coloursOf(cell) {
      const found = faults.get(cell.scan)?.arrays;
      if (colour === "squares") return [mean.places, { squares: about.squares }];
      if (colour === "missing") return [missing, { map: colours.sequential, range: [0, most()] }];
      if (colour === "std") return [cell.std || null, { map: colours.sequential, range: [0, stdLimit] }];
      if (colour === "growth") return [found?.growth || null, { map: colours.diverging, range: [-AREA_LIMIT, AREA_LIMIT] }];
      if (colour === "distance") return [found?.distance || null, { map: colours.sequential, range: [0, distanceLimit()] }];
      return [null];
    }

    function paint(cell) {
      if (cell.positions) for (const view of viewsOf(cell)) view.paint("surface", ...coloursOf(cell));
    }

    /** End of the scale of distances, percent: 98 % of the vertices of each surface of the page are nearer. */
    const distanceLimit = () => Math.max(0.1, ...Array.from(faults.values(), ({ limit }) => limit));

    let missing, stdLimit;
    const most = () => [5, 10, 25, 50, 100].find((limit) => missing.every((value) => value <= limit));

    function drawBar() {
      const title = { missing: "Scans that do not show the vertex", std: "Standard deviation along the surface, of the size", distance: "Distance from the scan, of the size", growth: "Area relative to the mean shape" }[colour];
      $("scale").hidden = !title;
      if (!title) return;
      const range = colour === "growth" ? [-1, 1] : [0, { std: stdLimit, distance: distanceLimit(), missing: most() }[colour]];
      const scale = colour === "growth" ? { map: colours.diverging, unit: "", labels: ["half", "equal", "twice"] } : { map: colours.sequential, unit: "%" };
      Shapespace.colourBar($("scale"), { ...scale, range, title });
    }

    // Marks -----------------------------------------------------------------------------------------------------------

    const markColour = (k) => colours.categories[k % colours.categories.length];

    function addMark(vertex) {
      if (marks.includes(vertex)) return;
      if (marks.length >= about.most_marked) {
        alertUser(`At most ${about.most_marked} vertices can be marked at a time; clear some first.`);
        return;
      }
      marks.push(vertex);
      drawAllMarks();
      options.onvertex?.(vertex);
      placed();
    }

    /** Report a change of the view, for the address. */
    const placed = () => options.onplace?.();

    /** A mark follows the pointer that takes it, on all surfaces at once. */
    function startDragging(cell, view, canvas) {
      let taken = null;
      const during = (action) => (event) => {
        if (!taken) return;
        event.stopPropagation(); // the surface does not turn
        action(event);
      };
      canvas.addEventListener("pointerdown", (event) => {
        const hit = event.button === 0 && cell.marked.length ? view.pick(event.clientX, event.clientY, ["marks", "surface"]) : null;
        if (!hit || hit.id !== "marks") return;
        event.stopPropagation();
        taken = cell.marked[hit.vertex];
        canvas.setPointerCapture(event.pointerId);
      }, true);
      canvas.addEventListener("pointermove", during((event) => {
        const hit = view.pick(event.clientX, event.clientY, ["surface"]);
        if (!hit || hit.vertex === taken.vertex || marks.includes(hit.vertex)) return;
        if (taken.name === undefined) marks[marks.indexOf(taken.vertex)] = hit.vertex;
        else named.find((one) => one.name === taken.name).vertex = hit.vertex;
        taken = { ...taken, vertex: hit.vertex };
        drawAllMarks();
      }), true);
      const end = during(() => {
        if (taken.name === undefined) options.onvertex?.(taken.vertex);
        else options.onlandmark?.(taken.name, taken.vertex);
        taken = null;
      });
      for (const kind of ["pointerup", "pointercancel"]) canvas.addEventListener(kind, end, true);
    }

    function drawMarks(cell) {
      const shown = [], gone = [];
      cell.marked = [];
      const placed = cell.view.placed("surface", cell.positions);
      [...marks.map((vertex) => ({ vertex })), ...named.filter((one) => one.vertex < about.vertices)].forEach((mark, k) => {
        const position = Array.from(placed.subarray(3 * mark.vertex, 3 * mark.vertex + 3));
        if (!position.every(Number.isFinite)) { gone.push(mark.name ?? mark.vertex); return; }
        cell.marked.push(mark);
        shown.push({ position, label: mark.name ?? String(mark.vertex), colour: markColour(k) });
      });
      for (const view of viewsOf(cell)) view.marks("marks", shown);
      cell.note.textContent = gone.length ? `${gone.length > 3 ? `${gone.length} marked vertices` : gone.join(", ")} not shown` : "";
    }

    function drawAllMarks() {
      for (const cell of cells) if (cell.positions) drawMarks(cell);
      $("marks").replaceChildren(...marks.map((vertex, k) => {
        const seen = mean.seen?.[vertex];
        const dot = h("span", { class: "dot" });
        dot.style.background = `rgb(${markColour(k).map((c) => Math.round(255 * c)).join(",")})`;
        const shownBy = seen === undefined ? "" : `shown by ${seen === scans ? `all ${scans}` : `${seen} of ${scans}`} scans`;
        return h("p", { "data-testid": `marked-${vertex}` }, dot, h("strong", {}, `Vertex ${vertex}`), h("span", {}, shownBy), h("button", {
          type: "button", class: "small quiet", "aria-label": `Remove the mark of vertex ${vertex}`, onclick: () => { marks = marks.filter((one) => one !== vertex); drawAllMarks(); placed(); },
        }, "\u00d7"));
      }));
      $("clear").disabled = $("save").disabled = !marks.length;
    }

    function startMarks() {
      $("number").max = String(about.vertices - 1);
      const typed = guarded(async () => {
        const text = $("number").value.trim(), vertex = Number(text);
        if (!text || !Number.isInteger(vertex) || vertex < 0 || vertex >= about.vertices) {
          throw new Error(`The vertices have the numbers 0 to ${about.vertices - 1}; give one of them.`);
        }
        addMark(vertex);
      });
      $("mark").addEventListener("click", typed);
      $("number").addEventListener("keydown", (event) => { if (event.key === "Enter") typed(); });
      $("clear").addEventListener("click", () => { marks = []; drawAllMarks(); placed(); });
      $("save").addEventListener("click", guarded(async () => {
        const answer = await ask(`api/places?vertices=${marks.join(",")}`);
        save(await answer.blob(), `${about.name.replace(/[^\w.-]+/g, "_")}.places.csv`);
      }));
    }

    // Scans -----------------------------------------------------------------------------------------------------------

    const words = (row) => `${WORDS[row.status]}${row.mirrored ? ", mirrored" : ""}`;
    const pictured = (row) => row.status !== "unreadable" && row.status !== "excluded";

    function filterRows(from = 0) {
      const asked = $("filter").value.trim().toLowerCase();
      const found = rows.filter((row) => `${row.name} ${words(row)} ${row.reason}`.toLowerCase().includes(asked));
      wanted = found.filter(pictured);
      $("list").replaceChildren(...found.slice(0, 500).map((row) => h("p", { class: DOTS[row.status], "data-testid": `row-${row.name}` },
        h("span", { class: "dot" }), h("span", {}, h("strong", {}, row.name), ` ${words(row)}`, row.status === "converged" ? null : h("small", {}, row.reason)))));
      return showPage(from);
    }

    const showPage = guarded(async (from) => {
      const mine = ++turn, count = perPage();
      first = Math.max(0, Math.min(from, Math.max(0, wanted.length - 1)));
      const shown = wanted.slice(first, first + count);
      $("previous").disabled = first === 0;
      $("next").disabled = first + count >= wanted.length;
      $("which").textContent = shown.length ? `${first + 1} to ${first + shown.length} of ${wanted.length}` : "No scan";
      cells.slice(1).forEach((cell, k) => { cell.box.hidden = k >= shown.length; });
      faults = new Map();
      drawFaults();
      const problems = [];
      for (let k = 0; k < shown.length; k++) {
        const cell = cells[k + 1];
        let arrays = null;
        try {
          arrays = (await binary(`api/surfaces/${encodeURIComponent(shown[k].name)}`)).arrays;
        } catch (error) {
          problems.push(error.message);
        }
        if (mine !== turn) return;
        if (arrays) put(cell, shown[k].name, arrays);
        else cell.box.hidden = true;
      }
      for (const cell of cells.slice(1 + shown.length)) clear(cell);
      options.onready?.();
      placed();
      findFaults(mine, shown);
      if (problems.length) throw new Error(problems.join(" "));
    });

    function clear(cell) {
      cell.positions = null;
      for (const view of [cell.view, cell.back]) { view.remove("surface"); view.remove("marks"); }
    }

    // Worst places ----------------------------------------------------------------------------------------------------

    const FAULTS = {
      fold: ["Folds", (value) => `${value} folded ${value === 1 ? "triangle" : "triangles"}`],
      stretch: ["Stretch", (value) => `${value < 0 ? "shrunk" : "grown"} ${Math.exp(Math.abs(value)).toFixed(1)} times`],
      distance: ["Distance from the scan", (value) => `${percent(value)} of the size`],
      uncertain: ["Uncertain position", (value) => `\u00b1 ${percent(value)} of the size`],
    };
    const MOST_FAULTS = 4; // places of each kind

    /** Ask for the worst places of the surfaces of the page, one after the other, as each scan is read for them. */
    async function findFaults(mine, shown) {
      $("faults").ariaBusy = "true";
      for (const { name } of shown) {
        let found = null;
        try { found = await binary(`api/faults/${encodeURIComponent(name)}`); } catch (error) { /* its surface is not shown either */ }
        if (mine !== turn) return;
        if (found) faults.set(name, { places: found.facts.places, limit: found.facts.distance_limit, arrays: { growth: found.arrays.growth, distance: found.arrays.distance && percentOf(found.arrays.distance) } });
        drawFaults();
      }
      if (colour === "growth" || colour === "distance") { cells.forEach(paint); drawBar(); }
      $("faults").ariaBusy = "false";
    }

    /** Turn all surfaces so that a place faces the user, and mark it. */
    function lookAt({ vertex, normal: [x, y, z] }) {
      addMark(vertex);
      cells[0].view.camera = { yaw: Math.atan2(x, z), pitch: Math.asin(Math.max(-1, Math.min(1, y))) };
    }

    function drawFaults() {
      const all = Array.from(faults, ([name, { places }]) => places.map((place) => ({ name, ...place }))).flat();
      const kinds = Object.entries(FAULTS).map(([kind, [title, words]]) => {
        const worst = all.filter((place) => place.kind === kind).sort((a, b) => Math.abs(b.value) - Math.abs(a.value)).slice(0, MOST_FAULTS);
        return worst.length ? h("div", { "data-testid": `faults-${kind}` }, h("h3", {}, title), ...worst.map((place) => h("button", { type: "button", class: "small quiet", onclick: () => lookAt(place) }, h("strong", {}, place.name), ` ${words(place.value)}`))) : null;
      });
      $("faults").replaceChildren(...kinds.filter(Boolean));
      for (const name of ["growth", "distance"]) $("colours").querySelector(`[data-colour=${name}]`).hidden = !faults.size;
    }

    /** Controls of the parts of a subject, whose colours the surfaces have where no map is on. */
    function startParts() {
      if (!about.parts.length) return;
      $("colours").querySelector("[data-colour=plain]").textContent = "Parts";
      $("parts").replaceChildren(h("h2", {}, "Parts"), partControls(about.parts, () => cells.flatMap(({ view, back }) => [view, back]), drawAllMarks).element);
    }

    function startScans() {
      $("previous").addEventListener("click", () => showPage(first - perPage()));
      $("next").addEventListener("click", () => showPage(first + perPage()));
      $("front").addEventListener("click", () => cells[0].view.reset());
      $("filter").addEventListener("input", () => filterRows());
      for (const button of $("sides").querySelectorAll("button")) {
        button.addEventListener("click", () => {
          sides = Number(button.dataset.sides);
          for (const other of $("sides").querySelectorAll("button")) other.setAttribute("aria-pressed", String(other === button));
          $("grid").classList.toggle("two", sides === 2);
          cells.slice(1).forEach(clear);
          put(cells[0], "Mean shape", mean);
          showPage(first);
          placed();
        });
      }
      for (const button of $("colours").querySelectorAll("button")) {
        button.addEventListener("click", () => { setColour(button.dataset.colour); placed(); });
      }
    }

    function setColour(name) {
      colour = name;
      for (const button of $("colours").querySelectorAll("button")) button.setAttribute("aria-pressed", String(button.dataset.colour === name));
      cells.forEach(paint);
      drawBar();
    }

    async function begin() {
      about = await json("api/about");
      $("about").textContent = `${about.corresponding} of ${about.scans} scans in correspondence, ${about.vertices.toLocaleString("en")} vertices`;
      const { arrays, facts: { turn: upright } } = await binary("api/mean");
      if (disposed) return;
      mean = arrays;
      turned = upright;
      marks = numbersOf(wantedPlace.vertices).filter((vertex) => vertex < about.vertices);
      makeCells();
      put(cells[0], "Mean shape", mean);
      cells[0].view.frame(["surface"], 1.2); // scans are larger than the mean shape in some directions
      Viewer.setCamera(cells[0].view, wantedPlace.camera);
      for (const cell of cells.slice(1)) cells[0].view.link(cell.view);
      for (const cell of cells) cell.view.link(cell.back, true);
      cells[0].view.on("camera", placed);
      startMarks();
      startScans();
      startParts();
      drawAllMarks();
      $("loading").hidden = true;
      window.shapespaceCells = cells;
      if (!about.is_large) await summarise();
      rows = await json(about.is_large ? "api/names" : "api/surfaces");
      await filterRows(Number(wantedPlace.first) || 0);
      if (wantedPlace.colour && $("colours").querySelector(`[data-colour="${CSS.escape(wantedPlace.colour)}"]`)) setColour(wantedPlace.colour);
      if (!about.is_large) return;
      // All surfaces are read for what follows; those of the page are shown first.
      await summarise();
      rows = await json("api/surfaces");
      if (first === 0) filterRows();
    }

    /** Which vertices scans show, and how certain their positions are. */
    async function summarise() {
      const { facts, arrays } = await binary("api/population");
      Object.assign(mean, arrays);
      ({ scans, std_limit: stdLimit } = facts);
      missing = Float32Array.from(mean.seen, (count) => (100 * (scans - count)) / Math.max(scans, 1));
      cells[0].std = mean.std;
      $("colours").querySelector("[data-colour=missing]").hidden = false;
      $("colours").querySelector("[data-colour=std]").hidden = !mean.std;
      drawAllMarks();
    }

    let disposed = false;
    guarded(begin)();
    return {
      dispose() {
        disposed = true;
        turn = NaN; // of no page
        for (const cell of cells) for (const view of [cell.view, cell.back]) view.dispose();
      },
      place: () => (cells.length ? { camera: Viewer.cameraOf(cells[0].view), first: first || "", vertices: marks.join(","), colour: colour === "squares" ? "" : colour } : wantedPlace),
      oriented: () => ({ view: cells[0].view, turn: turned }),
      setLandmarks(list) {
        named = list;
        drawAllMarks();
      },
    };
  };
})();
