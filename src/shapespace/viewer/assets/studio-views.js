/* Named views, such as dorsal: set once by turning an object and naming its view. */
(function () {
  "use strict";

  const { html, useState } = window.Preact;
  const Studio = window.ShapespaceStudio;
  const T = window.ShapespaceTexts;
  const V = T.views;
  const { Button } = Studio;
  const DIGITS = 6; // of a direction

  const dot = (a, b) => a.reduce((sum, value, k) => sum + value * b[k], 0);
  const degrees = (angle) => Math.round((180 / Math.PI) * Math.atan2(Math.sin(angle), Math.cos(angle)));

  /** The directions of a camera in the frame of the object's file; turn: rows of the rotation from that frame to the camera's, or null. */
  function directionsOf({ view, turn }) {
    const { back, up } = view._camera.axes();
    const inFile = (axis) => [0, 1, 2].map((k) => Number((turn ? dot(turn.map((row) => row[k]), axis) : axis[k]).toFixed(DIGITS)));
    return { toward_viewer: inFile(back), up: inFile(up) };
  }

  /** Turn an object to a named view, so that it fills the picture. */
  function turnTo({ view, turn }, { toward_viewer: toward, up }) {
    const shown = (axis) => (turn ? turn.map((row) => dot(row, axis)) : axis);
    const { home } = view._camera, [x, y, z] = shown(toward), above = shown(up);
    view.camera = { ...home, yaw: Math.atan2(x, z), pitch: Math.atan2(y, Math.hypot(x, z)), roll: 0 };
    const upright = view._camera.axes();
    view.camera = { roll: Math.atan2(-dot(above, upright.right), dot(above, upright.up)) };
    if (new Set(home.extent).size === 1) return; // a box that shows the object from any side
    const axes = view._camera.axes();
    view.camera = { extent: [axes.right, axes.up, axes.back].map((axis) => dot(axis.map(Math.abs), home.extent)) };
  }

  /** The folder of the surfaces whose named views a result has; undefined if it has none. */
  Studio.frameOf = (job) => {
    if (!["correspond", "redo", "build"].includes(job.kind)) return undefined;
    if (job.kind !== "build") return job.output;
    const words = job.command.split(/[\s/]+/); // the mean shape of a model has the frame of its surfaces
    return Studio.jobsOf(["correspond"]).map((other) => other.output).find((output) => words.includes(output));
  };

  /** A form that names the current view, and renames and removes existing ones. */
  function Form({ views, shown, save, onclose, hint }) {
    const [name, setName] = useState("");
    const [roll, setRoll] = useState(degrees(shown.view.camera.roll));
    const rotate = (event) => { setRoll(Number(event.target.value)); shown.view.camera = { roll: (Number(event.target.value) * Math.PI) / 180 }; };
    const add = async (event) => {
      event.preventDefault();
      const view = { name: name.trim(), ...directionsOf(shown) };
      const isKnown = views.some((known) => known.name === view.name);
      if (await save(isKnown ? views.map((known) => (known.name === view.name ? view : known)) : [...views, view])) setName("");
    };
    const rename = async (old, field) => { if (!(await save(views.map((known) => (known === old ? { ...known, name: field.value.trim() } : known))))) field.value = old.name; };
    return html`
      <form class="row" data-testid="views-form" onsubmit=${add} onkeydown=${(event) => { if (event.key === "Escape") { event.preventDefault(); event.stopPropagation(); onclose(); } }}>
        <label>${V.name} <input required size="10" list="view-names" data-testid="view-name" value=${name} oninput=${(event) => setName(event.target.value)} /></label>
        <datalist id="view-names">${[...new Set([...views.map((known) => known.name), ...V.names])].map((known) => html`<option value=${known}></option>`)}</datalist>
        <label>${V.roll} <input type="range" min="-180" max="180" step="1" data-testid="view-roll" value=${roll} oninput=${rotate} /></label>
        <button class="small strong" data-testid="view-save" disabled=${!name.trim()}>${V.save}</button>
        ${views.map((known) => html`<span class="tag" key=${known.name}><input size="8" aria-label=${V.rename(known.name)} data-testid=${`view-rename-${known.name}`} value=${known.name} onchange=${(event) => rename(known, event.target)} />
          <${Button} small class="quiet" testid=${`view-remove-${known.name}`} aria-label=${V.remove(known.name)} onclick=${() => save(views.filter((other) => other !== known))}>×<//></span>`)}
        <${Button} small testid="views-close" onclick=${onclose}>${T.close}<//><span class="hint">${hint}</span></form>`;
  }

  /** The named views of the surfaces in the folder `on`, or of scans (""), none if it is undefined; shown: {view, turn} of the object, or null while it is read. */
  Studio.Views = function Views({ on, shown }) {
    const [naming, setNaming] = useState(false);
    const { views: all } = Studio.state.project, views = all[on] || [];
    const save = (changed) => Studio.edit({ what: "views", on, views: changed, before: views });
    const other = on && !views.length && Object.keys(all).filter((key) => key && all[key].length).at(-1);
    if (on === undefined || (Studio.state.read_only && !views.length)) return null;
    return html`
      <div class="row named-views" role="group" aria-label=${V.title} data-testid="views">
        ${views.map((known) => html`<${Button} small key=${known.name} disabled=${!shown} testid=${`named-view-${known.name}`} onclick=${() => turnTo(shown, known)}>${known.name}<//>`)}
        ${!naming && html`<${Button} edits small class="quiet" disabled=${!shown} testid="views-edit" onclick=${() => setNaming(true)}>${views.length ? V.edit : V.first}<//>`}
        ${other && html`<${Button} edits small class="quiet" testid="views-take" onclick=${() => save(all[other])}>${V.take(other)}<//>`}
        ${naming && html`<${Form} views=${views} shown=${shown} save=${save} onclose=${() => setNaming(false)} hint=${on ? V.hint : V.scans} />`}
      </div>`;
  };
})();
