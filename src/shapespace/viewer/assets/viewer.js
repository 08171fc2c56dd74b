/* A model and its fits: the tabs Model, Compare and Fits, which share one stage. */
(function () {
  "use strict";

  const Viewer = window.ShapespaceViewer;
  const { save, guarded, post } = Viewer;
  const { make, button, Stage, modes } = Shapespace.widgetParts;
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

  /** The picture of a stage as PNG; two views are side by side. */
  async function picture({ views }) {
    const blobs = await Promise.all(views.map((view) => view.png()));
    if (blobs.length === 1) return blobs[0];
    const images = await Promise.all(blobs.map((blob) => createImageBitmap(blob)));
    const canvas = make("canvas", { width: images[0].width + images[1].width, height: Math.max(images[0].height, images[1].height) });
    images.forEach((image, k) => canvas.getContext("2d").drawImage(image, k * images[0].width, 0));
    return new Promise((resolve) => canvas.toBlob(resolve, "image/png"));
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
      $, base, show, apply, download, exportButtons,
      onplace: () => { if (page.stage) options.onplace?.(); },
      about: null, // facts of the model
      model: null,
      z: null, // all coefficients of the shape in Model, standard deviations
      stage: null,
      shown: "model", // name of the tab
      shapes: new Map(), // those to compare: key -> {name, z}
      fits: [], // rows of the saved fits
    };
    page.compareTab = Viewer.makeCompareTab(page);
    page.fitsTab = Viewer.makeFitsTab(page);
    const { compareTab, fitsTab } = page;
    let modelTab = null;
    let isChosen = Boolean(wanted.tab); // whether the user chose a tab before the fits were there
    let disposed = false;

    /** Show a tab; return when it is drawn. */
    function show(name) {
      page.shown = name;
      stop();
      for (const tab of TABS) {
        $(`tab-${tab}`).setAttribute("aria-selected", String(tab === name));
        $(`tab-${tab}`).tabIndex = tab === name ? 0 : -1;
        $(tab).hidden = tab !== name;
      }
      const drawn = { model: modelTab, compare: compareTab, fits: fitsTab }[name].draw();
      if (name !== "fits") page.stage.a.frame(["model"], ROOM);
      page.onplace();
      return drawn;
    }

    function stop() {
      for (const tab of [modelTab, compareTab, fitsTab]) tab?.stop();
    }

    async function download(question, kind, name) {
      const answer = await Viewer.ask(`${base}api/export?format=${kind}`, post(question));
      save(await answer.blob(), `${name.replace(/[^\w.-]+/g, "_").replace(/\.(ply|obj|stl|off|vtk|vtp|glb|gltf)(?=\.|$)/i, "")}.${kind}`);
    }

    /** Buttons that save a surface, by surface(kind), and the coefficients of `row`, see `Viewer.coefficientsCsv`. */
    function exportButtons(testid, surface, row) {
      const kinds = page.about.exports.map((kind) => button(kind.toUpperCase(), guarded(() => surface(kind)), { "data-testid": `${testid}-${kind}` }));
      return [...kinds, button("Coefficients CSV", () => save(Viewer.coefficientsCsv([row], page.about.modes), `${row.name}.coefficients.csv`), { "data-testid": `${testid}-csv` })];
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
      $("picture").addEventListener("click", guarded(async () => save(await picture(page.stage), "shapespace.png")));
    }

    async function begin() {
      const about = await Viewer.json(`${base}api/about`);
      const unpacked = await Viewer.binary(`${base}api/model`);
      if (disposed) return;
      const model = new Shapespace.Model(unpacked);
      const z = coefficientsOf(wanted.z, about.modes), stage = new Stage($("stage"), false);
      Object.assign(page, { about, model, z, stage });
      stage.panes.append($("tools"));
      stage.setParts(unpacked.facts.parts);
      window.shapespaceStage = stage;
      const unsent = about.modes_sent < about.modes ? `, of which the first ${about.modes_sent} are shown; more would not fit here` : "";
      $("about").textContent = `${about.model}: ${about.vertices.toLocaleString("en")} vertices, ${about.modes} ${about.modes === 1 ? "mode" : "modes"}${unsent}`;
      modelTab = modes(unpacked, { stage, controls: $("model-controls"), model, z, onchange: page.onplace });
      const shape = { name: "shape", get z() { return Array.from(z); }, get b() { return Array.from(z, (value, k) => value * about.stddev[k]); } };
      $("export-shape").append(...exportButtons("export", (kind) => download({ z: shape.z }, kind, "shape"), shape));
      compareTab.start();
      startTabs();
      modelTab.draw();
      stage.a.frame(["model"], ROOM);
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
        stop();
        page.stage?.dispose();
      },
      oriented: () => ({ view: page.stage.a, turn: null }),
      place: () => (page.stage ? { tab: page.shown, z: textOf(page.z), fit: page.shown === "fits" ? fitsTab.name() || "" : "", camera: Viewer.cameraOf(page.stage.a) } : wanted),
    };
  };
})();
