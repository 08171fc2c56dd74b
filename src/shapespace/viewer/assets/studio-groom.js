/* Grooming of raw scans: the steps for several specimens, and in the 3-D view of one a crop by a sphere or a plane. */
(function () {
  "use strict";

  const { html, useState, useEffect, useRef } = window.Preact;
  const Studio = window.ShapespaceStudio;
  const T = window.ShapespaceTexts;
  const G = T.specimens.groom;
  const { Button } = Studio;
  const COLOUR = [0.2, 0.5, 1], ROUND = 48; // of the lines that show a crop, and their number in a circle
  const KEEPS = { sphere: ["inside", "outside"], plane: ["behind", "front"] };
  const HOLES = "30"; // border edges, at first: the default of MeshLab

  const isActive = (id) => Studio.jobsOf(["groom"]).some((job) => Studio.isActive(job) && job.options.ids.includes(id));

  /** The steps that are ticked, as options of the command. */
  function useSteps() {
    const [steps, setSteps] = useState({});
    const [holes, setHoles] = useState(HOLES);
    const box = (flag, label) => html`<label class="check"><input type="checkbox" data-testid=${`groom${flag}`} checked=${Boolean(steps[flag])} onchange=${(event) => setSteps({ ...steps, [flag]: event.target.checked })} />${label}</label>`;
    const fields = html`${box("--largest", G.largest)}${box("--outer", G.outer)}${box("--fill-holes", G.holes)}
      <input inputmode="numeric" size="4" aria-label=${G.holes} data-testid="groom-edges" value=${holes} oninput=${(event) => { setHoles(event.target.value); setSteps({ ...steps, "--fill-holes": true }); }} />`;
    const options = Object.fromEntries(Object.entries(steps).filter(([, isOn]) => isOn).map(([flag]) => [flag, flag === "--fill-holes" ? holes.trim() : true]));
    return [fields, options];
  }

  const Original = ({ specimens, ondone }) => specimens.some((one) => one.groomed) && html`
    <${Button} small testid="groom-original" onclick=${async () => { if (await Studio.edit({ what: "original", ids: specimens.filter((one) => one.groomed).map((one) => one.id) })) ondone(); }}>${G.original}<//>`;

  /** Steps for the selected specimens. */
  Studio.GroomForm = function GroomForm({ specimens, onclose }) {
    const [fields, options] = useSteps();
    const run = async (event) => {
      event.preventDefault();
      if (await Studio.runJob("groom", { ids: specimens.map((one) => one.id), ...options })) onclose();
    };
    return html`<form class="row inline" data-testid="groom-form" onsubmit=${run}>${fields}
      <button class="small strong" data-testid="groom-apply" disabled=${!Object.keys(options).length}>${G.apply}</button>
      <${Original} specimens=${specimens} ondone=${onclose} /><${Button} small testid="groom-cancel" onclick=${onclose}>${T.cancel}<//><span class="hint">${G.hint}</span></form>`;
  };

  const add = (point, ...steps) => steps.reduce((sum, [axis, length]) => sum.map((value, k) => value + length * axis[k]), point);
  const ring = (step) => Array.from({ length: ROUND }, (_, k) => [step(k), step(k + 1)]).flat();

  /** Lines along a crop: three circles of a sphere, or a square in a plane with its normal to the part that is kept. */
  function outline({ tool, point, radius, axes: [right, up, back], keep }, size) {
    if (tool === "sphere") {
      const circle = (a, b) => ring((k) => add(point, [a, radius * Math.cos((2 * Math.PI * k) / ROUND)], [b, radius * Math.sin((2 * Math.PI * k) / ROUND)]));
      return [...circle([1, 0, 0], [0, 1, 0]), ...circle([0, 1, 0], [0, 0, 1]), ...circle([0, 0, 1], [1, 0, 0])];
    }
    const [a, b, c, d] = [[1, 1], [1, -1], [-1, -1], [-1, 1]].map(([x, y]) => add(point, [right, 0.45 * x * size], [up, 0.45 * y * size]));
    return [a, b, b, c, c, d, d, a, point, add(point, [back, keep === "front" ? 0.3 * size : -0.3 * size])];
  }

  /** A point or direction of the view in the frame of the file, and the reverse: a mirrored scan is shown reflected. */
  const reflected = ([x, y, z], mirrored) => [mirrored ? -x : x, y, z].map((value) => Number(value.toPrecision(9)));

  /** Centre and radius, or point and normal, as the command takes them. */
  function cropText({ tool, point, radius, axes, keep }, mirrored) {
    const there = (values) => reflected(values, mirrored);
    const numbers = tool === "sphere" ? [...there(point), radius] : [...there(point), ...there(axes[2]).map((value) => (keep === "front" ? value : -value))];
    return `${tool === "plane" ? "plane" : keep === "inside" ? "sphere" : "outside"}:${numbers.map((value) => Number(value.toPrecision(9))).join(",")}`;
  }

  /** Share of the drawn points that a crop keeps. */
  function keptShare({ tool, point, radius, axes, keep }, positions) {
    let kept = 0;
    for (let i = 0; i < positions.length; i += 3) {
      const d = [positions[i] - point[0], positions[i + 1] - point[1], positions[i + 2] - point[2]];
      const inside = tool === "sphere" ? Math.hypot(...d) <= radius : d[0] * axes[2][0] + d[1] * axes[2][1] + d[2] * axes[2][2] <= 0;
      if (inside === (keep === "inside" || keep === "behind")) kept += 1;
    }
    return kept / (positions.length / 3);
  }

  /** The steps for one scan, in its 3-D view. */
  Studio.Groom = function Groom({ specimen, view, ready, cropping }) {
    const [fields, options] = useSteps();
    const [tool, setTool] = useState("");
    const [crop, setCrop] = useState(null);
    const click = useRef(null), size = useRef(1);
    cropping.current = Boolean(tool);
    /** Move the crop to a point of the view, facing the user. */
    const put = (name, point) => {
      const { right, up, back } = view.current._camera.axes();
      setCrop({ tool: name, keep: KEEPS[name][0], radius: size.current / 4, ...(crop && crop.tool === name ? { keep: crop.keep, radius: crop.radius } : {}), point, axes: [right, up, back] });
    };
    click.current = (event) => {
      const hit = tool && view.current.pick(event.clientX, event.clientY, ["scan"]);
      if (hit) put(tool, hit.point);
    };
    useEffect(() => {
      if (!ready || !view.current.works) return;
      size.current = Math.max(...view.current._camera.home.extent);
      view.current.on("click", (event) => click.current(event));
    }, [ready]);
    useEffect(() => {
      if (!ready) return;
      if (crop) view.current.lines("crop", outline(crop, size.current), COLOUR);
      else view.current.remove("crop");
    }, [crop, ready]);
    if (Studio.state.read_only) return null;
    const choose = (chosen) => {
      setTool(chosen === tool ? "" : chosen);
      if (chosen === tool) setCrop(null);
      else put(chosen, view.current._camera.home.target); // where the keyboard starts from
    };
    const move = (point) => { if (point) put(tool, reflected(point, specimen.mirrored)); };
    const failed = Studio.jobsOf(["groom"]).slice(0, 1).find((job) => job.status === "failed" && job.options.ids.includes(specimen.id));
    const run = async () => {
      const all = { ids: [specimen.id], ...(crop ? { "--crop": cropText(crop, specimen.mirrored) } : {}), ...options };
      if (await Studio.runJob("groom", all)) { setTool(""); setCrop(null); }
    };
    const busy = isActive(specimen.id);
    return html`
      <fieldset class="choices groom" data-testid="groom"><legend>${G.title}</legend>
        <div class="row">${fields}${["sphere", "plane"].map((name) => html`<${Button} small aria-pressed=${tool === name} testid=${`crop-${name}`} disabled=${!ready} onclick=${() => choose(name)}>${G[name]}<//>`)}</div>
        ${tool && html`<div class="row crop"><span class="hint">${G.click[tool]}</span>
          ${crop && html`<${Studio.Coordinates} key=${tool} testid="crop" label=${G.point[tool]} axisLabel=${(axis) => G.axis(axis, tool)} point=${reflected(crop.point, specimen.mirrored)} size=${specimen.extent} onsend=${move} onmove=${move} />`}
          ${tool === "plane" && html`<${Button} small testid="crop-face" onclick=${() => put(tool, crop.point)}>${G.face}<//>`}
          ${crop && crop.tool === "sphere" && html`<label>${G.radius} <input type="range" min="0.01" max="1" step="0.01" data-testid="crop-radius" value=${crop.radius / size.current} oninput=${(event) => setCrop({ ...crop, radius: size.current * Number(event.target.value) })} /></label>`}
          ${crop && html`<label>${G.keep} <select data-testid="crop-keep" value=${crop.keep} onchange=${(event) => setCrop({ ...crop, keep: event.target.value })}>${KEEPS[tool].map((side) => html`<option value=${side}>${G.sides[side]}</option>`)}</select></label>
          <span class="hint" role="status" data-testid="crop-share">${G.keeps(Math.round(100 * keptShare(crop, view.current._things.get("scan").object.geometry.attributes.position.array)))}</span>`}</div>`}
        <div class="row"><${Button} small strong testid="groom-apply" disabled=${busy || !(crop || Object.keys(options).length)} onclick=${run}>${G.apply}<//>
          <${Original} specimens=${[specimen]} ondone=${() => {}} /><span class="hint" role="status">${busy ? G.running : failed ? failed.message : G.hint}</span></div>
      </fieldset>`;
  };
})();
