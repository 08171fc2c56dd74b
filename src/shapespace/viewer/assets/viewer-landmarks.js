/* Landmarks that the user places on a dropped scan, which its fit starts from. */
(function () {
  "use strict";

  const Viewer = window.ShapespaceViewer;
  const { $, h, page, ask, guarded, post, onSurface, scanTab, uploads, LEFT_RED } = Viewer;

  function offer(mine) {
    $("placing").replaceChildren(
      h("p", {}, "Landmarks can help this scan: click a few points on it, and the fit starts from them."),
      h("button", { type: "button", class: "strong", "data-testid": "place", onclick: () => startPlacing(mine) }, "Place landmarks"));
    $("placing").hidden = false;
  }

  function startPlacing(mine) {
    mine.placing = { placed: new Map(), current: page.about.landmarks[0] };
    page.scanView.active = false;
    page.scanView.stop();
    $("scan-detail").hidden = true;
    page.stage.clear();
    page.stage.holds = null;
    page.own.frame = null;
    drawPlacing(true);
    $("placing").scrollIntoView({ block: "nearest" });
  }

  function drawPlacing(first) {
    const { about, model, stage, own: mine } = page, { placed } = mine.placing;
    if (page.shown === "scan") {
      stage.split(true);
      if (first || stage.holds !== mine.placing) {
        stage.clear();
        stage.holds = mine.placing;
        const raw = mine.preview.arrays.vertices, turn = mine.states[0];
        const at = turn ? scanTab.mapping(turn, true)(raw, new Float32Array(raw.length)) : raw;
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
    const hint = missing > 0 ? `${missing} more ${missing === 1 ? "is" : "are"} needed.` : "More landmarks make the start safer.";
    $("placing").replaceChildren(
      h("p", { role: "status", "data-testid": "placing-text" }, `Click ${mine.placing.current.replace(/_/g, " ")} on the scan. ${hint}`),
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
    page.stage.clear();
    page.stage.split(false);
    offer(mine);
    Viewer.show("scan");
  }

  function placeAt(event) {
    if (page.shown !== "scan" || !page.own || !page.own.placing) return;
    const hit = page.stage.a.pick(event.clientX, event.clientY, ["scan"]);
    if (!hit) return;
    const { placed } = page.own.placing;
    placed.delete(page.own.placing.current);
    placed.set(page.own.placing.current, hit.point);
    const open = page.about.landmarks.find((name) => !placed.has(name));
    if (open) page.own.placing.current = open;
    drawPlacing();
  }

  const refit = guarded(async (mine) => {
    const turn = mine.states[0];
    const landmarks = {};
    for (const [name, point] of mine.placing.placed) {
      const there = Float64Array.from(point);
      if (turn) scanTab.mapping(turn, false)(Float64Array.from(point), there);
      landmarks[name] = Array.from(there, (value, i) => value / mine.unit + mine.origin[i]);
    }
    await ask(`api/scans/${mine.id}/landmarks`, post({ landmarks }));
    $("scan-detail").hidden = false;
    page.scanView.active = page.shown === "scan";
    Object.assign(mine, uploads.fresh(), { run: mine.run + 1 });
    scanTab.say(mine, "Starting from your landmarks", null);
    scanTab.look(mine);
    uploads.follow(mine);
  });

  Viewer.landmarks = { offer, draw: drawPlacing, placeAt };
})();
