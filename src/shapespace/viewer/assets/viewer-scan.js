/* The tab Your scan: the scans dropped here, their fits as they run, and their results. */
(function () {
  "use strict";

  const Viewer = window.ShapespaceViewer;
  const { $, h, page, save, ask, telling, guarded, binary, fitsTab, compareTab } = Viewer;
  const { verdictCard, distanceFacts, shortly } = fitsTab;

  let positions; // of the vertices, written anew by each state

  /** Say how far a scan is: in full where it is looked at, shortly in the list. */
  function say(mine, text, part) {
    mine.said = { text, part };
    if (page.own === mine) progress(text, part);
    const row = mine.row && mine.row.lastElementChild;
    if (row) row.textContent = stateOf(mine);
  }

  function progress(text, part) {
    $("progress").hidden = false;
    $("stop").hidden = !page.own || !page.own.id;
    $("progress-text").textContent = text;
    if (part === null) $("progress-bar").removeAttribute("value");
    else $("progress-bar").value = part;
  }

  /** Look at one of the dropped scans, wherever its fit is. */
  function look(mine) {
    if (page.own && page.own !== mine) page.own.placing = null;
    page.own = mine;
    $("scan-detail").hidden = false;
    page.scanView.clear();
    for (const part of ["verdict", "placing", "progress"]) $(part).hidden = true;
    $("progress-chart").replaceChildren();
    $("zone").classList.add("compact");
    if (page.shown === "scan") { page.stage.clear(); page.stage.split(false); page.scanView.active = true; }
    listScans();
    if (mine.verdict) telling(async () => { await showVerdict(mine); if (page.own === mine && mine.helped) Viewer.landmarks.offer(mine); })();
    else {
      if (mine.said) progress(mine.said.text, mine.said.part);
      telling(drawPreview)(mine);
    }
  }

  async function drawPreview(mine) {
    if (mine.previewed && !mine.preview) mine.preview = await binary(`api/scans/${mine.id}/preview`);
    if (page.own === mine && mine.preview && !mine.verdict) drawStates();
  }

  function showState(mine) {
    const last = mine.states[mine.states.length - 1];
    const what = last.phase === 1 ? "Finding the pose" : "Fitting pose and shape";
    say(mine, `${what}: iteration ${last.iteration}, RMS ${last.rms_mm.toFixed(2)} mm`, null);
    clearTimeout(mine.quiet);
    const after = mine.dense ? "Following the scan densely, and checking whether the fit can be trusted" : "Checking whether the fit can be trusted";
    mine.quiet = setTimeout(() => { if (!mine.verdict) say(mine, after, null); }, 700);
    if (page.own !== mine) return;
    Viewer.rmsChart($("progress-chart"), mine.states.map((s) => s.rms_mm), mine.states.map((s) => s.phase), null);
    drawStates();
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

  /** The scan, and the model on its way to it. The view starts at the model's first state. */
  function drawStates() {
    const { about, model, own, stage } = page;
    if (page.shown !== "scan" || !own || !own.preview) return;
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
      const shape = Float64Array.from({ length: model.K }, (_, k) => (k < last.b.length ? last.b[k] / about.stddev[k] : 0));
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
      if (page.own !== mine) return;
      if (mine.preview) drawStates();
      else if (page.shown === "scan") page.stage.nothing(`There is no picture of ${mine.name}`);
      return;
    }
    const start = { landmarks: "landmarks", upright: "the pose of the file", rotations: "a search over rotations", given: "a given pose" }[told.start];
    const seconds = Object.values(told.seconds || {}).reduce((sum, value) => sum + value, 0);
    $("verdict").append(h("p", { class: "hint" }, `Started from ${start || told.start}; ${mine.states.length} states in ${seconds.toFixed(1)}\u00a0s.`));
    if (!told.pictured) return;
    const payload = await binary(`api/scans/${mine.id}/picture`);
    if (page.own !== mine || mine.placing) return;
    page.scanView.show(payload, { scan: mine.id, b: told.b, z: told.z, b_stddev: told.b_stddev });
    $("scan-detail").append(h("div", { class: "row" },
      h("button", { type: "button", "data-testid": "scan-record", onclick: guarded(async () => {
        save(await (await ask(`api/scans/${mine.id}/record`)).blob(), `${mine.name.replace(/\.[^.]*$/, "")}.fit.json`);
      }) }, "Record (JSON)"), remove));
  }

  /** Forget a scan that the server has removed, or never had. */
  function drop(mine) {
    page.dropped.splice(page.dropped.indexOf(mine), 1);
    page.shapes.delete(`scan ${mine.id}`);
    compareTab.fillChoices();
    if (page.own !== mine) { listScans(); return; }
    const next = page.dropped[page.dropped.length - 1];
    if (next) { look(next); return; }
    page.own = null;
    listScans();
    page.scanView.clear();
    for (const part of ["verdict", "placing", "progress"]) $(part).hidden = true;
    $("zone").classList.remove("compact");
    page.stage.clear();
    page.stage.split(false);
  }

  function stateOf(mine) {
    if (mine.verdict) return mine.verdict.shown ? shortly(mine.verdict) : mine.verdict.status;
    if (mine.file) return mine.said && mine.said.part !== null ? "being sent" : "waits";
    return mine.states.length ? `iteration ${mine.states[mine.states.length - 1].iteration}` : "waits";
  }

  /** The dropped scans next to each other, if there are several. */
  function listScans() {
    $("own").replaceChildren();
    if (page.dropped.length < 2) return;
    const list = h("div", { class: "list", role: "listbox", tabindex: "0", "aria-label": "Your scans", "data-testid": "own-list" });
    page.dropped.forEach((mine, i) => {
      mine.row = h("div", {
        role: "option", id: `own-${i}`, class: mine.verdict ? mine.verdict.status : "", "aria-selected": String(mine === page.own),
        "data-testid": "own-scan", "data-name": mine.name, onclick: () => look(mine),
      }, h("i", { class: "dot" }), h("span", {}, mine.name), h("small", {}, stateOf(mine)));
      list.append(mine.row);
      if (mine === page.own) list.setAttribute("aria-activedescendant", `own-${i}`);
    });
    list.addEventListener("keydown", (event) => {
      const next = page.dropped[page.dropped.indexOf(page.own) + ({ ArrowDown: 1, ArrowUp: -1 }[event.key] || NaN)];
      if (!next) return;
      event.preventDefault();
      look(next);
      $("own").firstElementChild.nextElementSibling.focus();
    });
    const fitted = page.dropped.filter((one) => one.verdict && one.verdict.b);
    const all = fitted.length > 1 ? h("button", { type: "button", "data-testid": "own-csv", onclick: () => {
      const rows = fitted.map(({ name, verdict: { status, b, z: values, b_stddev: sd } }) => ({ name: name.replace(/\.[^.]*$/, ""), status, b, z: values, sd }));
      save(Viewer.coefficientsCsv(rows, page.about.modes), "coefficients.csv");
    } }, `Coefficients of all ${fitted.length} (CSV)`) : null;
    const head = h("div", { class: "list-head" }, h("span", {}, "Your scans"), h("span", {}, "model to scan / scan to model"));
    $("own").append(head, list, ...(all ? [h("div", { class: "row" }, all)] : []));
  }

  function draw() {
    const { own, scanView, stage } = page;
    if (own && own.placing) Viewer.landmarks.draw(true);
    else if (scanView.payload) scanView.draw(true);
    else if (own && own.preview) drawStates();
    else if (own && own.verdict) stage.nothing(`There is no picture of ${own.name}`);
    else if (!own) stage.faintMean();
  }

  Viewer.scanTab = { draw, look, say, drop, drawPreview, showState, showVerdict, list: listScans, mapping };
})();
