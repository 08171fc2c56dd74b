/* A raw scan in 3-D: its surface from any side, its borders, a scale bar, its landmarks, and what the check found. */
(function () {
  "use strict";

  const { html, useState, useEffect, useRef } = window.Preact;
  const Viewer = window.ShapespaceViewer;
  const Studio = window.ShapespaceStudio;
  const S = window.ShapespaceTexts.specimens;
  const { Button, Dialog } = Studio;
  const BORDER = [0.85, 0.1, 0.1];
  // Yaw and pitch, radians.
  const SIDES = { front: [0, 0], back: [Math.PI, 0], left: [-Math.PI / 2, 0], right: [Math.PI / 2, 0], top: [0, Math.PI / 2], bottom: [0, -Math.PI / 2] };

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

  // Landmarks -------------------------------------------------------------------------------------------------------

  const M = S.marks;
  const AXES = ["x", "y", "z"];
  const CHOSEN = [0.84, 0.37, 0], PLACED = [0, 0.45, 0.7]; // orange and blue of the figures
  const STEPS = 500; // of an arrow key along the scan

  const sent = new Map(); // edits on their way: specimen and name -> point

  /** Place a landmark of a specimen, or remove it (null); `seen` is where the user saw it. */
  async function place({ id, points }, name, point, seen = points[name]) {
    const key = `${id}/${name}`, before = sent.has(key) ? sent.get(key) : seen || null;
    sent.set(key, point);
    await Studio.edit({ what: "points", id, points: { [name]: point }, before: { [name]: before } });
    if (sent.get(key) === point) sent.delete(key);
  }

  /**
   * The coordinates of a point in the frame of the file, which are typed, or moved by the arrow keys until they are released.
   * onmove(numbers or null): while they change; onsend(numbers): when they are complete; size: extent of the scan.
   */
  Studio.Coordinates = function Coordinates({ testid, label, axisLabel, point, size, onsend, onmove }) {
    const [draft, setDraft] = useState(null);
    const typing = useRef(false); // whether the draft is unsent: the answer to an earlier edit must not discard it
    const pending = useRef(0); // edits without an answer: until then the draft is newer than the point
    const last = useRef(""); // numbers of the last of them
    useEffect(() => { if (!typing.current && !pending.current) setDraft(null); }, [String(point)]);
    const numbersOf = (texts) => texts.map((text) => (String(text).trim() ? Number(String(text).replace(",", ".")) : NaN));
    const change = (texts) => {
      typing.current = true;
      setDraft(texts);
      onmove(numbersOf(texts).every(Number.isFinite) ? numbersOf(texts) : null);
    };
    const values = draft || point || ["", "", ""], numbers = numbersOf(values);
    const send = async () => {
      typing.current = false;
      if (!draft || !numbers.every(Number.isFinite) || String(numbers) === (pending.current ? last.current : String(point))) return;
      pending.current += 1;
      last.current = String(numbers);
      await onsend(numbers);
      pending.current -= 1;
      if (typing.current || pending.current) return;
      setDraft(null);
      onmove(null);
    };
    const key = (event, axis) => {
      const step = { ArrowUp: 1, ArrowDown: -1 }[event.key];
      if (event.key === "Enter") send();
      if (!step || !numbers.every(Number.isFinite)) return;
      event.preventDefault();
      change(numbers.map((value, k) => (k === axis ? Number((value + (step * size) / STEPS).toPrecision(12)) : value)));
    };
    return html`<fieldset class="choices coordinates" data-testid="coordinates"><legend>${label}</legend>
      ${AXES.map((axis, k) => html`<label>${axis} <input inputmode="decimal" size="9" data-testid=${`${testid}-${axis}`} aria-label=${axisLabel(axis)} value=${values[k]} onkeydown=${(event) => key(event, k)}
        onkeyup=${(event) => { if (event.key.startsWith("Arrow")) send(); }} oninput=${(event) => change(values.map((value, other) => (other === k ? event.target.value : value)))} onblur=${send} /></label>`)}
      <small class="hint">${M.file}</small></fieldset>`;
  };

  const pointsOf = (curves, name) => Array.from({ length: curves[name].points }, (_, k) => `${name}_${k + 1}`);
  const setNames = (names) => Studio.edit({ what: "point-names", names });

  const setCurve = (name, points, closed) => Studio.edit({ what: "curve", name, points: Number(points), closed });

  /** A form that adds a landmark, or a curve with a number of points. */
  function AddName({ onadd }) {
    const [name, setName] = useState("");
    const [points, setPoints] = useState("");
    const add = async (event) => {
      event.preventDefault();
      const curve = Studio.state.project.curves[name.trim()]; // one that exists is chosen, not spaced again
      const done = curve || (points ? await setCurve(name, points, false) : await setNames([...Studio.state.project.point_names, name]));
      if (done) { onadd(curve || points ? `${name.trim()}_1` : name.trim()); setName(""); setPoints(""); }
    };
    return html`<form onsubmit=${add}><div class="row"><input required size="20" aria-label=${M.name} placeholder=${M.name} data-testid="mark-name" value=${name} oninput=${(event) => setName(event.target.value)} />
      <button class="small" data-testid="mark-add" disabled=${!name.trim()}>${M.add}</button></div>
      <label class="row hint">${M.pointsOf} <input type="number" min="3" max="500" data-testid="mark-points" value=${points} oninput=${(event) => setPoints(event.target.value)} /></label></form>`;
  }

  /** Landmarks of a scan: those of the project by name, in the view and as coordinates. `mirrored`: as the view shows it; `cropping`: ref, whether clicks place a crop. */
  function Landmarks({ specimen, view, box, mirrored, cropping }) {
    const { point_names: names, curves, undo } = Studio.state.project, { points } = specimen;
    const [wanted, setChosen] = useState(null);
    const [moving, setMoving] = useState(null); // [name, point] while it is dragged
    const missing = names.filter((name) => !points[name]);
    const chosen = names.includes(wanted) ? wanted : missing[0] || names[0];
    const shown = moving ? { ...points, [moving[0]]: moving[1] } : points;
    const drawn = names.filter((name) => shown[name]);
    const along = Object.keys(curves).find((curve) => pointsOf(curves, curve).includes(chosen));
    const flipped = ([x, y, z]) => [mirrored ? -x : x, y, z];
    const list = useRef(null), now = useRef({});
    useEffect(() => {
      const button = list.current?.querySelector("[aria-pressed=true]");
      if (button) list.current.scrollTop = button.offsetTop - list.current.clientHeight / 2;
    }, [chosen]);
    now.current = { specimen, chosen, missing, drawn, moving, flipped };
    useEffect(() => {
      view.marks("marks", drawn.map((name) => ({ position: flipped(shown[name]), label: name, colour: name === chosen ? CHOSEN : PLACED })));
    }, [view, chosen, JSON.stringify(shown), names]);
    useEffect(() => {
      view.remove("curves");
      const lines = Object.keys(curves).flatMap((curve) => {
        const line = pointsOf(curves, curve).filter((name) => shown[name]).map((name) => flipped(shown[name]));
        return line.slice(1).flatMap((point, k) => [line[k], point]).concat(curves[curve].closed && line.length > 2 ? [line[line.length - 1], line[0]] : []);
      });
      if (lines.length) view.lines("curves", lines, PLACED);
    }, [view, JSON.stringify(shown), JSON.stringify(curves)]);
    useEffect(() => {
      if (Studio.state.read_only) return undefined;
      const under = (event) => view.pick(event.clientX, event.clientY, ["scan"]);
      const of = (hit) => now.current.flipped(hit.point.map((value) => Number(value.toPrecision(9)))); // the digits of float32
      view.on("click", (event) => {
        const { specimen: one, chosen: name, missing: left } = now.current, hit = under(event);
        if (!hit || !name || cropping.current) return;
        if (left.includes(name)) setChosen(left[left.indexOf(name) + 1] || left.find((other) => other !== name) || name);
        place(one, name, of(hit));
      });
      let taken = null;
      const listeners = {
        pointerdown: (event) => {
          const hit = event.button === 0 && view.has("marks") && view.pick(event.clientX, event.clientY, ["marks", "scan"]);
          if (!hit || hit.id !== "marks") return;
          event.stopPropagation(); // the scan does not turn
          const name = now.current.drawn[hit.vertex];
          taken = { name, seen: now.current.specimen.points[name] };
          setChosen(name);
          box.setPointerCapture(event.pointerId);
        },
        pointermove: (event) => {
          if (!taken) return;
          event.stopPropagation();
          const hit = under(event);
          if (hit) setMoving([taken.name, of(hit)]);
        },
        pointerup: async (event) => {
          if (!taken) return;
          event.stopPropagation();
          const { name, seen } = taken, { moving: moved } = now.current;
          taken = null;
          if (moved && event.type === "pointerup") await place(now.current.specimen, name, moved[1], seen);
          setMoving(null);
        },
      };
      listeners.pointercancel = listeners.pointerup;
      for (const [kind, listener] of Object.entries(listeners)) box.addEventListener(kind, listener, true);
      return () => { for (const [kind, listener] of Object.entries(listeners)) box.removeEventListener(kind, listener, true); };
    }, [view]);
    if (Studio.state.read_only && !names.length) return null;
    return html`
      <section class="scan-marks" aria-label=${M.title} data-testid="marks">
        <h3>${M.title} <span class="hint" data-testid="marks-count">${names.length > 0 && M.of(names.length - missing.length, names.length)}</span></h3>
        ${!Studio.state.read_only && html`<p class="hint" role="status">${!names.length ? M.none : along ? M.along(along) : missing.length ? M.hint(chosen) : M.done}</p>`}
        <div ref=${list} class="mark-names" role="group" aria-label=${M.title}>${names.map((name) => html`<button type="button" key=${name} class=${points[name] ? "placed" : "missing"} aria-pressed=${name === chosen} data-testid=${`mark-${name}`}
          onclick=${() => setChosen(name)}>${name} <small>${points[name] ? M.isPlaced : M.missing}</small></button>`)}</div>
        ${!Studio.state.read_only && html`
          ${chosen && html`<${Studio.Coordinates} key=${chosen} testid="mark" label=${M.coordinates(chosen)} axisLabel=${(axis) => M.axis(axis, chosen)} point=${sent.get(`${specimen.id}/${chosen}`) || points[chosen]} size=${specimen.extent}
              onsend=${(point) => place(specimen, chosen, point)} onmove=${(point) => setMoving(point && [chosen, point])} />
            <div class="row"><${Button} small testid="mark-remove" disabled=${!points[chosen]} aria-label=${M.removeOf(chosen)} onclick=${() => place(specimen, chosen, null)}>${M.remove}<//>
              <${Button} small testid="mark-undo" disabled=${!undo} title=${undo ? S.undoOf(undo) : S.undo} onclick=${Studio.undo}>${S.undo}<//></div>`}
          <${AddName} onadd=${setChosen} />`}
      </section>`;
  }

  /** A landmark or a curve of the project: its scans, the number of its points, and its mirrored pair. */
  function MarkRow({ name, project }) {
    const { point_names: names, curves, pairs, specimens } = project, curve = curves[name];
    const [draft, setDraft] = useState(null); // number of points while it is typed
    const points = curve ? pointsOf(curves, name) : [name], onCurves = new Set(Object.keys(curves).flatMap((one) => pointsOf(curves, one)));
    const others = curve ? Object.keys(curves).filter((one) => curves[one].points === curve.points) : names.filter((one) => !onCurves.has(one));
    const pair = pairs.find((one) => one.includes(points[0])), partner = pair && pair.find((one) => one !== points[0]);
    const other = others.find((one) => partner === (curve ? `${one}_1` : one)) || "";
    const locked = Studio.state.read_only;
    return html`<tr><th scope="row">${curve ? M.curve(name) : name}</th><td>${M.of(specimens.filter((one) => points.every((point) => one.points[point])).length, specimens.length)}</td>
      <td>${curve && html`<div class="row"><input type="number" min="3" aria-label=${M.countOf(name)} data-testid=${`curve-points-${name}`} disabled=${locked} value=${draft ?? curve.points} oninput=${(event) => setDraft(event.target.value)} onchange=${async () => { await setCurve(name, draft, curve.closed); setDraft(null); }} />
        <label class="check"><input type="checkbox" aria-label=${M.closedOf(name)} data-testid=${`curve-closed-${name}`} disabled=${locked} checked=${curve.closed} onchange=${(event) => setCurve(name, curve.points, event.target.checked)} />${M.closed}</label></div>`}</td>
      <td><select aria-label=${M.pairOf(name)} data-testid=${`pair-${name}`} disabled=${locked} value=${other} onchange=${(event) => Studio.edit({ what: "pair", name, other: event.target.value })}>
        <option value="">${M.noPair}</option>${others.filter((one) => one !== name).map((one) => html`<option key=${one} value=${one} selected=${one === other}>${one}</option>`)}</select></td>
      <td><${Button} edits small class="quiet" aria-label=${M.removeAll(name)} testid=${`landmark-remove-${name}`} onclick=${() => setNames(names.filter((one) => !points.includes(one)))}>×<//></td></tr>`;
  }

  /** The landmarks of the project: on how many scans each is placed, their curves and mirrored pairs, and their export. */
  Studio.ManageLandmarks = function ManageLandmarks({ project }) {
    const [open, setOpen] = useState(false);
    const { point_names: names, curves } = project;
    if (!names.length) return null;
    const done = Studio.newest("landmarks");
    const onCurves = new Set(Object.keys(curves).flatMap((one) => pointsOf(curves, one)));
    return html`<${Button} testid="landmarks-all" onclick=${() => setOpen(true)}>${M.manage}<//>
      ${open && html`
        <${Dialog} title=${M.title} testid="landmarks-dialog" onclose=${() => setOpen(false)} wide>
          <p class="hint">${M.intro}</p>
          <div class="table-box preview" role="region" aria-label=${M.title} tabindex="0"><table class="plain">
            <thead><tr><th scope="col">${M.title}</th><th scope="col">${M.specimens}</th><th scope="col">${M.points}</th><th scope="col">${M.pair}</th><th scope="col"><span class="hidden">${S.remove}</span></th></tr></thead>
            <tbody>${[...names.filter((name) => !onCurves.has(name)), ...Object.keys(curves)].map((name) => html`<${MarkRow} key=${name} name=${name} project=${project} />`)}</tbody></table></div>
          ${!Studio.state.read_only && html`<${Studio.JobForm} kind="landmarks" label=${Studio.action("landmarks")} />`}
          <${Studio.Jobs} kinds=${["landmarks"]} />
          ${done && html`<${Studio.Outdated} job=${done} />`}
          <div class="row end">${done && html`<a class="button" href=${/[.]/.test(done.output) ? Studio.fileAddress(done.output) : `/zip/${done.number}`} download data-testid="landmarks-download">${M.download}</a>`}
            <${Button} testid="landmarks-close" onclick=${() => setOpen(false)}>${window.ShapespaceTexts.close}<//></div>
        <//>`}`;
  };

  // The view --------------------------------------------------------------------------------------------------------

  Studio.Scan = function Scan({ specimen, onclose }) {
    const box = useRef(null), bar = useRef(null), view = useRef(null);
    const mirrored = useRef(specimen.mirrored).current; // as the surface that is read
    const cropping = useRef(false);
    const [state, setState] = useState(S.scan.reading);
    const [borders, setBorders] = useState(0);
    useEffect(() => {
      let ended = false;
      const show = async () => {
        await Viewer.load("scene");
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
        made.frame(["scan"], 1, true);
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
        <${Studio.Views} on="" shown=${state === "" ? { view: view.current, turn: null } : null} />
        <div class="scan-body"><div class="scan-view"><div ref=${box} class="canvas" data-testid="scan-view" data-ready=${state === ""}></div><p class="hint" role="status">${state}</p><span ref=${bar} class="scale-bar" data-testid="scan-scale"></span></div>
          ${state === "" && html`<${Landmarks} specimen=${specimen} view=${view.current} box=${box.current} mirrored=${mirrored} cropping=${cropping} />`}</div>
        <${Studio.Groom} specimen=${specimen} view=${view} ready=${state === ""} cropping=${cropping} />
        <p class="hint">${S.scan.axes}${borders ? ` ${S.scan.borders}` : ""}</p>
        <${Studio.Findings} specimen=${specimen} />
      <//>`;
  };
})();
