/* The viewer's page: its tabs, and its start. */
(function () {
  "use strict";

  const Viewer = window.ShapespaceViewer;
  const { $, page, modelTab, compareTab, fitsTab, scanTab, uploads, landmarks, save, alertUser, guarded, json, binary } = Viewer;
  const TABS = ["model", "compare", "fits", "scan"];

  window.shapespaceReady = false;

  let isChosen = false; // whether the user chose a tab before the fits were there
  window.shapespaceTimes = []; // ms from a slider's event to the picture, as drawn

  function show(name) {
    page.shown = name;
    modelTab.stop();
    compareTab.stop();
    for (const tab of TABS) {
      $(`tab-${tab}`).setAttribute("aria-selected", String(tab === name));
      $(`tab-${tab}`).tabIndex = tab === name ? 0 : -1;
      $(tab).hidden = tab !== name;
    }
    page.fitView.stop();
    page.scanView.stop();
    page.fitView.active = name === "fits";
    page.scanView.active = name === "scan" && !(page.own && page.own.placing);
    if (name === "model") modelTab.draw();
    else if (name === "compare") compareTab.draw(true);
    else {
      page.stage.clear();
      page.stage.split(false);
      if (name === "fits") fitsTab.draw();
      else scanTab.draw();
    }
    if (name === "model" || name === "compare") page.stage.a.frame(["model"]);
  }

  function apply(values) {
    modelTab.setShape(values);
    show("model");
    if (innerWidth <= 760) scrollTo({ top: 0 });
  }

  function startTabs() {
    for (const tab of TABS) {
      $(`tab-${tab}`).addEventListener("click", () => { isChosen = true; show(tab); });
      $(`tab-${tab}`).addEventListener("keydown", (event) => {
        const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
        if (!step) return;
        const next = TABS[(TABS.indexOf(tab) + step + TABS.length) % TABS.length];
        show(next);
        $(`tab-${next}`).focus();
      });
    }
    Viewer.startTheme(() => { for (const view of [page.stage.a, page.stage.b]) if (view) view.request(); });
    $("view-home").addEventListener("click", () => page.stage.a.reset());
    $("picture").addEventListener("click", guarded(async () => save(await page.stage.picture(), "shapespace.png")));
  }

  function ready() {
    window.shapespaceReady = true;
    document.body.dataset.ready = "true";
  }

  async function begin() {
    const about = await json("api/about");
    const unpacked = await binary("api/model");
    const model = new Shapespace.Model(unpacked), stage = new Viewer.Stage();
    Object.assign(page, { about, model, stage, share: unpacked.arrays.share, z: new Float64Array(about.modes) });
    document.title = `${about.model} \u2013 shapespace`;
    $("about").textContent = `${about.model}: ${about.vertices.toLocaleString("en")} vertices, ${about.modes} ${about.modes === 1 ? "mode" : "modes"}`;
    const context = { stage, model, about, apply, download: modelTab.download, alert: alertUser };
    page.fitView = new Viewer.FitView($("fit-detail"), context, "fit");
    page.scanView = new Viewer.FitView($("scan-detail"), context, "scan");
    stage.a.on("click", landmarks.placeAt);
    stage.a.on("draw", ready);
    window.shapespaceStage = stage;
    modelTab.start();
    compareTab.start();
    startTabs();
    Viewer.startMessages();
    modelTab.draw();
    stage.a.frame(["model"]);
    $("loading").hidden = true;
    if (!stage.a.works) ready();
    await fitsTab.start();
    if (about.has_fits && !isChosen) show("fits");
    await uploads.start();
  }

  Object.assign(Viewer, { show, apply });
  guarded(begin)();
})();
