/* Surfaces in correspondence side by side: a click on one marks the same vertex on all of them. */
(function () {
  "use strict";

  const Viewer = window.ShapespaceViewer;
  const { $, h, save, alertUser, ask, guarded, json, binary } = Viewer;
  const WORDS = { unreadable: "unreadable", excluded: "excluded", doubtful: "doubtful", look: "needs review", converged: "converged" };
  const DOTS = { unreadable: "unreadable", excluded: "failed", doubtful: "doubtful", look: "doubtful", converged: "converged" };

  window.shapespaceReady = false;

  let about, mean, scans;
  let rows = []; // all scans, as listed
  let wanted = []; // those with a surface that the filter leaves
  let first = 0; // number of the first one that is shown
  let cells = []; // the mean shape, then one a scan
  let marks = []; // numbers of vertices
  let named = []; // landmarks of the studio's project: {name, vertex}
  let colour = "squares";
  let turn = 0; // a page that is still on its way is not shown when another was asked for

  const percent = (share) => `${(100 * share).toFixed(share > 0 && share < 0.0995 ? 1 : 0)} %`;

  // The grid --------------------------------------------------------------------------------------------------------

  function makeCells() {
    for (let k = 0; k <= about.page; k++) {
      const canvas = h("div", { class: "view", "data-testid": `view-${k}` });
      const name = h("strong", {}), note = h("span", { class: "note", "data-testid": `note-${k}` });
      const box = h("div", { class: "cell", "data-testid": `cell-${k}` }, canvas, note, h("p", {}, name));
      $("grid").append(box);
      const cell = { box, name, note, marked: [], positions: null, std: null, view: new Shapespace.View(canvas, { label: "A surface in 3-D" }) };
      cell.view.on("click", (event) => {
        const hit = cell.view.pick(event.clientX, event.clientY, ["surface"]);
        if (hit) addMark(hit.vertex);
      });
      startDragging(cell, canvas);
      cells.push(cell);
    }
  }

  function put(cell, name, { positions, std }) {
    cell.positions = positions;
    cell.std = std;
    cell.name.textContent = name;
    cell.view.label = `${name} in 3-D`;
    cell.view.setSurface("surface", { positions, faces: mean.faces, draft: mean.draft, colour: about.clay });
    paint(cell);
    drawMarks(cell);
  }

  function paint(cell) {
    if (!cell.positions) return;
    if (colour === "plain") cell.view.paint("surface", null);
    else if (colour === "squares") cell.view.paint("surface", mean.places, { squares: about.squares });
    else if (colour === "std") cell.view.paint("surface", cell.std || null, { map: about.sequential, range: [0, stdLimit] });
    else cell.view.paint("surface", missing, { map: about.sequential, range: [0, most()] });
  }

  let missing, stdLimit;
  const most = () => [5, 10, 25, 50, 100].find((limit) => missing.every((value) => value <= limit));

  function drawBar() {
    const title = { missing: "Scans that do not show the vertex", std: "Standard deviation along the surface, of the size" }[colour];
    $("scale").hidden = !title;
    if (title) Shapespace.colourBar($("scale"), { map: about.sequential, range: [0, colour === "std" ? stdLimit : most()], unit: "%", title });
  }

  // Marks -----------------------------------------------------------------------------------------------------------

  const markColour = (k) => about.marks[k % about.marks.length];

  function addMark(vertex) {
    if (marks.includes(vertex)) return;
    if (marks.length >= about.most_marked) {
      alertUser(`At most ${about.most_marked} vertices can be marked at a time; clear some first.`);
      return;
    }
    marks.push(vertex);
    drawAllMarks();
    postToStudio({ vertex });
  }

  /** The studio names landmarks by the vertex that was marked last, and stores those that were moved. */
  function postToStudio(message) {
    if (window.parent !== window) window.parent.postMessage(message, location.origin);
  }

  function startLandmarks() {
    addEventListener("message", (event) => {
      if (event.source !== window.parent || event.origin !== location.origin || !Array.isArray(event.data?.landmarks)) return;
      named = event.data.landmarks.filter((one) => one.vertex < about.vertices);
      drawAllMarks();
    });
    postToStudio({ ready: true });
  }

  /** A mark follows the pointer that takes it, on all surfaces at once. */
  function startDragging(cell, canvas) {
    let taken = null;
    const during = (action) => (event) => {
      if (!taken) return;
      event.stopPropagation(); // the surface does not turn
      action(event);
    };
    canvas.addEventListener("pointerdown", (event) => {
      const hit = event.button === 0 && cell.marked.length ? cell.view.pick(event.clientX, event.clientY, ["marks", "surface"]) : null;
      if (!hit || hit.id !== "marks") return;
      event.stopPropagation();
      taken = cell.marked[hit.vertex];
      canvas.setPointerCapture(event.pointerId);
    }, true);
    canvas.addEventListener("pointermove", during((event) => {
      const hit = cell.view.pick(event.clientX, event.clientY, ["surface"]);
      if (!hit || hit.vertex === taken.vertex || marks.includes(hit.vertex)) return;
      if (taken.name === undefined) marks[marks.indexOf(taken.vertex)] = hit.vertex;
      else named.find((one) => one.name === taken.name).vertex = hit.vertex;
      taken = { ...taken, vertex: hit.vertex };
      drawAllMarks();
    }), true);
    const end = during(() => {
      postToStudio(taken.name === undefined ? { vertex: taken.vertex } : { landmark: taken.name, vertex: taken.vertex });
      taken = null;
    });
    for (const kind of ["pointerup", "pointercancel"]) canvas.addEventListener(kind, end, true);
  }

  function drawMarks(cell) {
    const shown = [], gone = [];
    cell.marked = [];
    [...marks.map((vertex) => ({ vertex })), ...named].forEach((mark, k) => {
      const position = Array.from(cell.positions.subarray(3 * mark.vertex, 3 * mark.vertex + 3));
      if (!position.every(Number.isFinite)) { gone.push(mark.name ?? mark.vertex); return; }
      cell.marked.push(mark);
      shown.push({ position, label: mark.name ?? String(mark.vertex), colour: markColour(k) });
    });
    cell.view.marks("marks", shown);
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
        type: "button", class: "small quiet", "aria-label": `Remove the mark of vertex ${vertex}`, onclick: () => { marks = marks.filter((one) => one !== vertex); drawAllMarks(); },
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
    $("clear").addEventListener("click", () => { marks = []; drawAllMarks(); });
    $("save").addEventListener("click", guarded(async () => {
      const answer = await ask(`api/places?vertices=${marks.join(",")}`);
      save(await answer.blob(), `${about.name.replace(/[^\w.-]+/g, "_")}.places.csv`);
    }));
  }

  // Scans -----------------------------------------------------------------------------------------------------------

  const words = (row) => `${WORDS[row.status]}${row.mirrored ? ", mirrored" : ""}`;
  const pictured = (row) => row.status !== "unreadable" && row.status !== "excluded";

  function filterRows() {
    const asked = $("filter").value.trim().toLowerCase();
    const found = rows.filter((row) => `${row.name} ${words(row)} ${row.reason}`.toLowerCase().includes(asked));
    wanted = found.filter(pictured);
    $("list").replaceChildren(...found.slice(0, 500).map((row) => h("p", { class: DOTS[row.status], "data-testid": `row-${row.name}` },
      h("span", { class: "dot" }), h("span", {}, h("strong", {}, row.name), ` ${words(row)}`, row.status === "converged" ? null : h("small", {}, row.reason)))));
    return showPage(0);
  }

  const showPage = guarded(async (from) => {
    const mine = ++turn;
    first = Math.max(0, Math.min(from, Math.max(0, wanted.length - 1)));
    const shown = wanted.slice(first, first + about.page);
    $("previous").disabled = first === 0;
    $("next").disabled = first + about.page >= wanted.length;
    $("which").textContent = shown.length ? `${first + 1} to ${first + shown.length} of ${wanted.length}` : "No scan";
    cells.slice(1).forEach((cell, k) => { cell.box.hidden = k >= shown.length; });
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
    for (const cell of cells.slice(1 + shown.length)) {
      cell.positions = null;
      cell.view.remove("surface");
      cell.view.remove("marks");
    }
    window.shapespaceReady = true;
    document.body.dataset.ready = "true";
    if (problems.length) throw new Error(problems.join(" "));
  });

  function startScans() {
    $("previous").addEventListener("click", () => showPage(first - about.page));
    $("next").addEventListener("click", () => showPage(first + about.page));
    $("front").addEventListener("click", () => cells[0].view.reset());
    $("filter").addEventListener("input", filterRows);
    for (const button of $("colours").querySelectorAll("button")) {
      button.addEventListener("click", () => {
        colour = button.dataset.colour;
        for (const other of $("colours").querySelectorAll("button")) other.setAttribute("aria-pressed", String(other === button));
        cells.forEach(paint);
        drawBar();
      });
    }
  }

  async function begin() {
    about = await json("api/about");
    document.title = `${about.name} \u2013 shapespace`;
    $("about").textContent = `${about.name}: ${about.corresponding} of ${about.scans} scans in correspondence, ${about.vertices.toLocaleString("en")} vertices`;
    mean = (await binary("api/mean")).arrays;
    makeCells();
    put(cells[0], "Mean shape", mean);
    cells[0].view.frame(["surface"], 1.2); // scans are larger than the mean shape in some directions
    for (const cell of cells.slice(1)) cells[0].view.link(cell.view);
    Viewer.startTheme(() => cells.forEach((cell) => cell.view.request()));
    Viewer.startMessages();
    startMarks();
    startLandmarks();
    startScans();
    $("loading").hidden = true;
    window.shapespaceCells = cells;
    if (!about.is_large) await summarise();
    rows = await json(about.is_large ? "api/names" : "api/surfaces");
    await filterRows();
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

  guarded(begin)();
})();
