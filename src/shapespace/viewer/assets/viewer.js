/* A model and its fits: the tabs Model, Compare and Fits, which share one stage. */
(function () {
  "use strict";

  const Viewer = window.ShapespaceViewer;
  const { save, guarded } = Viewer;
  const TABS = ["model", "compare", "fits"];
  const ROOM = 1.2; // of the mean shape in the picture, as other shapes are larger in some directions

  /** Return "2:-1.5,3:0.2" for coefficients z, and the reverse; modes that are 0 are omitted. */
  const textOf = (z) => Array.from(z, (value, k) => [k + 1, Number(value.toFixed(4))]).filter(([, value]) => value).map((pair) => pair.join(":")).join();
  function coefficientsOf(text, count) {
    const z = new Float64Array(count);
    for (const [mode, value] of (text || "").split(",").map((pair) => pair.split(":").map(Number))) {
      if (Number.isInteger(mode) && mode >= 1 && mode <= count && Number.isFinite(value)) z[mode - 1] = value;
    }
    return z;
  }

  /**
   * Show the model at the address `base`, and its fits, in `root`; return {dispose(), place(), oriented()}.
   * options: {place, onplace(), onready()}.
   */
  Viewer.openModel = function (root, base, options) {
    const $ = (id) => root.getElementById(id);
    const wanted = options.place || {};
    /** The state that the tabs share; `begin` fills in what the server sends. */
    const page = {
      $, base, show, apply,
      onplace: () => { if (page.stage) options.onplace?.(); },
      about: null, // facts of the model
      model: null,
      share: null, // of the variance, of each mode
      z: null, // all coefficients of the shape in Model, standard deviations
      stage: null,
      shown: "model", // name of the tab
      shapes: new Map(), // those to compare: key -> {name, z}
      fits: [], // rows of the saved fits
      fitView: null, // the fit that is drawn in Fits
    };
    page.modelTab = Viewer.makeModelTab(page);
    page.compareTab = Viewer.makeCompareTab(page);
    page.fitsTab = Viewer.makeFitsTab(page);
    const { modelTab, compareTab, fitsTab } = page;
    let isChosen = Boolean(wanted.tab); // whether the user chose a tab before the fits were there
    let disposed = false;

    /** Show a tab; return when it is drawn. */
    function show(name) {
      let drawn = null;
      page.shown = name;
      modelTab.stop();
      compareTab.stop();
      for (const tab of TABS) {
        $(`tab-${tab}`).setAttribute("aria-selected", String(tab === name));
        $(`tab-${tab}`).tabIndex = tab === name ? 0 : -1;
        $(tab).hidden = tab !== name;
      }
      page.fitView.stop();
      page.fitView.active = name === "fits";
      if (name === "model") modelTab.draw();
      else if (name === "compare") compareTab.draw(true);
      else {
        page.stage.clear();
        page.stage.split(false);
        drawn = fitsTab.draw();
      }
      if (name !== "fits") page.stage.a.frame(["model"], ROOM);
      page.onplace();
      return drawn;
    }

    function apply(values) {
      modelTab.setShape(values);
      show("model");
    }

    function startTabs() {
      for (const tab of TABS) {
        $(`tab-${tab}`).addEventListener("click", () => { isChosen = true; show(tab); });
        $(`tab-${tab}`).addEventListener("keydown", (event) => {
          const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
          if (!step) return;
          const tabs = TABS.filter((name) => !$(`tab-${name}`).hidden);
          const next = tabs[(tabs.indexOf(tab) + step + tabs.length) % tabs.length];
          show(next);
          $(`tab-${next}`).focus();
        });
      }
      $("view-home").addEventListener("click", () => page.stage.a.reset());
      $("picture").addEventListener("click", guarded(async () => save(await page.stage.picture(), "shapespace.png")));
    }

    async function begin() {
      const about = await Viewer.json(`${base}api/about`);
      const unpacked = await Viewer.binary(`${base}api/model`);
      if (disposed) return;
      const model = new Shapespace.Model(unpacked);
      Object.assign(page, { about, model, share: unpacked.arrays.share, z: coefficientsOf(wanted.z, about.modes) });
      page.stage = new Viewer.Stage(page);
      $("about").textContent = `${about.model}: ${about.vertices.toLocaleString("en")} vertices, ${about.modes} ${about.modes === 1 ? "mode" : "modes"}`;
      page.fitView = new Viewer.FitView($("fit-detail"), { stage: page.stage, model, about, apply, download: modelTab.download });
      window.shapespaceStage = page.stage;
      modelTab.start();
      compareTab.start();
      startTabs();
      modelTab.draw();
      page.stage.a.frame(["model"], ROOM);
      $("loading").hidden = true;
      await fitsTab.start(wanted.fit);
      if (disposed) return;
      const tab = TABS.includes(wanted.tab) && !$(`tab-${wanted.tab}`).hidden ? wanted.tab : about.has_fits && !isChosen ? "fits" : page.shown;
      if (tab !== page.shown) await show(tab);
      if (disposed) return;
      Viewer.setCamera(page.stage.a, wanted.camera);
      page.stage.a.on("camera", page.onplace);
      page.stage.a.on("draw", ready);
      if (page.stage.a.works) page.stage.a.request();
      else ready();
    }

    let isReady = false;
    function ready() {
      if (isReady) return;
      isReady = true;
      options.onready?.();
    }

    guarded(begin)();
    return {
      dispose() {
        disposed = true;
        modelTab.stop();
        compareTab.stop();
        if (!page.stage) return;
        page.fitView.stop();
        page.stage.dispose();
      },
      oriented: () => ({ view: page.stage.a, turn: null }),
      place: () => (page.stage ? { tab: page.shown, z: textOf(page.z), fit: page.shown === "fits" ? fitsTab.name() || "" : "", camera: Viewer.cameraOf(page.stage.a) } : wanted),
    };
  };
})();
