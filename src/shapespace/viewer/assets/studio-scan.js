/* A raw scan in 3-D: its surface from any side, its borders, a scale bar, and what the check found. */
(function () {
  "use strict";

  const { html, useState, useEffect, useRef } = window.Preact;
  const Viewer = window.ShapespaceViewer;
  const Studio = window.ShapespaceStudio;
  const S = window.ShapespaceTexts.specimens;
  const { Button, Dialog } = Studio;
  const BORDER = [0.85, 0.1, 0.1];
  const SCRIPTS = ["three.min", ...["data", "camera", "material", "surfaces", "drawing", "controls", "view", "colours"].map((part) => `scene-${part}`)];
  // Yaw and pitch, radians.
  const SIDES = { front: [0, 0], back: [Math.PI, 0], left: [-Math.PI / 2, 0], right: [Math.PI / 2, 0], top: [0, Math.PI / 2], bottom: [0, -Math.PI / 2] };

  /** Load what draws in 3-D, once it is needed. */
  let loading = null;
  const load = () => (loading ||= SCRIPTS.reduce((before, name) => before.then(() => new Promise((resolve, reject) => {
    document.head.append(Object.assign(document.createElement("script"), { src: `/assets/${name}.js`, onload: resolve, onerror: () => reject(new Error(S.scan.failed)) }));
  })), Promise.resolve()));

  /** The longest length of 1, 2 or 5 times a power of 10 that is at most `most`. */
  function nice(most) {
    const power = 10 ** Math.floor(Math.log10(most));
    return power * ([5, 2, 1].find((step) => step * power <= most) || 1);
  }

  /** A bar of a round length in the unit of the scan, at the depth of its middle. */
  function drawScale(view, bar, unit) {
    const { target } = view.camera, { right } = view._camera.axes();
    const [from] = view.project(target), [to] = view.project(target.map((value, axis) => value + right[axis]));
    const length = nice(120 / Math.abs(to - from));
    bar.style.width = `${length * Math.abs(to - from)}px`;
    bar.textContent = `${length.toLocaleString("en", { maximumSignificantDigits: 2 })} ${unit}`;
  }

  Studio.Scan = function Scan({ specimen, onclose }) {
    const box = useRef(null), bar = useRef(null), view = useRef(null);
    const [state, setState] = useState(S.scan.reading);
    const [borders, setBorders] = useState(0);
    useEffect(() => {
      let ended = false;
      const show = async () => {
        await load();
        const { arrays } = window.Shapespace.unpack(await (await Studio.ask(`/api/scans/${encodeURIComponent(specimen.id)}`)).arrayBuffer());
        if (ended) return;
        const made = new window.Shapespace.View(box.current, { label: S.scan.label(specimen.id), embedded: false });
        view.current = made;
        made.setSurface("scan", { positions: arrays.positions, faces: arrays.faces || null, draft: arrays.draft || null });
        if (arrays.borders?.length) {
          const points = Array.from({ length: arrays.borders.length / 3 }, (_, k) => Array.from(arrays.borders.subarray(3 * k, 3 * k + 3)));
          made.lines("borders", points, BORDER);
          setBorders(points.length / 2);
        }
        made.frame(["scan"], 1.1);
        made.on("draw", () => drawScale(made, bar.current, specimen.unit || S.scan.units));
        setState("");
      };
      show().catch((error) => setState(error.message));
      return () => { ended = true; if (view.current) view.current.dispose(); };
    }, []);
    const turn = (side) => { const [yaw, pitch] = SIDES[side]; if (view.current) view.current.camera = { ...view.current._camera.home, yaw, pitch }; };
    return html`
      <${Dialog} title=${specimen.id} testid="scan" onclose=${onclose} wide>
        <div class="row" role="group" aria-label=${S.scan.sides}>${Object.keys(SIDES).map((side) => html`<${Button} small testid=${`scan-${side}`} onclick=${() => turn(side)}>${S.scan[side]}<//>`)}
          <span class="grow"></span><${Button} small testid="scan-close" onclick=${onclose}>${window.ShapespaceTexts.close}<//></div>
        <div class="scan-view"><div ref=${box} class="canvas" data-testid="scan-view" data-ready=${state === ""}></div><p class="hint" role="status">${state}</p><span ref=${bar} class="scale-bar" data-testid="scan-scale"></span></div>
        <${Studio.Groom} specimen=${specimen} view=${view} ready=${state === ""} />
        <p class="hint">${S.scan.axes}${borders ? ` ${S.scan.borders}` : ""}</p>
        <${Studio.Findings} specimen=${specimen} />
      <//>`;
  };
})();
