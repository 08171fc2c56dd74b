/* The screens of the steps with one command each: correspondence, model and fit. */
(function () {
  "use strict";

  const { html, useState, useEffect } = window.Preact;
  const Studio = window.ShapespaceStudio;
  const T = window.ShapespaceTexts;
  const LEAST = 2; // scans that can be brought into correspondence
  const { Button, JobForm, Jobs, Settings, Result, useResult, DropZone, UploadStatus } = Studio;

  /** Controls on the left, the result on the right. */
  const Step = (Studio.Step = function Step({ name, title, controls, select, job, empty, children, on }) {
    return html`
      <div class="step" data-testid=${`screen-${name}`}>
        <section class="side" aria-label=${title}>${controls}</section>
        <section class="result" aria-label=${T.jobs.result}>${job ? html`${select}${children}<${Result} key=${job.number} job=${job} on=${on} />` : html`<p class="empty hint">${empty}</p>`}</section>
      </div>`;
  });

  const Next = ({ name, next, ready }) => html`<${Button} class="wide" strong=${ready} testid="next" onclick=${next}>${T.next[name]}<//>`;
  const isBusy = (...kinds) => Studio.jobsOf(kinds).some(Studio.isActive);

  // Correspondence --------------------------------------------------------------------------------------------------

  function Redo({ specimens }) {
    const [name, setName] = useState("");
    if (Studio.state.read_only) return null;
    return html`
      <details data-testid="redo-panel"><summary>${T.correspondence.redoTitle}</summary>
        <p class="hint">${T.correspondence.redoHint}</p>
        <div class="row"><label>${T.correspondence.redoWhich} <select data-testid="redo-name" value=${name} onchange=${(event) => setName(event.target.value)}>
          <option value=""></option>${specimens.map((one) => html`<option key=${one.id} value=${one.id}>${one.id}</option>`)}</select></label>
          <${Button} testid="run-redo" disabled=${!name || isBusy("redo", "correspond")} onclick=${() => Studio.runJob("redo", { name })}>${T.correspondence.redo}<//></div>
      </details>`;
  }

  /** Named vertices; `clicked` is the vertex that was clicked last on the surfaces. */
  function Landmarks({ landmarks, elsewhere, clicked, save }) {
    const [name, setName] = useState("");
    const [vertex, setVertex] = useState("");
    useEffect(() => { if (clicked !== null) setVertex(String(clicked)); }, [clicked]);
    const add = async (event) => {
      event.preventDefault();
      if (await save({ ...landmarks, [name.trim()]: Number(vertex) })) setName("");
    };
    const without = (gone) => Object.fromEntries(Object.entries(landmarks).filter(([one]) => one !== gone));
    return html`
      <details data-testid="landmarks"><summary>${T.correspondence.landmarksTitle} (${Object.keys(landmarks).length})</summary>
        <p class="hint">${T.correspondence.landmarksHint}</p>
        ${elsewhere && html`<p class="hint">${T.correspondence.landmarksElsewhere(elsewhere)}</p>`}
        <ul class="landmarks">${Object.entries(landmarks).map(([one, number]) => html`<li key=${one} data-testid=${`landmark-${one}`}><strong>${one}</strong>
          <input type="number" min="0" step="1" aria-label=${T.correspondence.vertexOf(one)} data-testid=${`landmark-vertex-${one}`} readonly=${Studio.state.read_only} value=${number} onchange=${(event) => save({ ...landmarks, [one]: Number(event.target.value) })} />
          <${Button} edits small testid=${`landmark-remove-${one}`} aria-label=${T.correspondence.removeLandmark(one)} onclick=${() => save(without(one))}>×<//></li>`)}</ul>
        ${!Studio.state.read_only && html`<form class="row" onsubmit=${add}>
          <label>${T.correspondence.landmark} <input size="9" data-testid="landmark-name" value=${name} oninput=${(event) => setName(event.target.value)} /></label>
          <label>${T.correspondence.vertex} <input type="number" min="0" step="1" data-testid="landmark-vertex" value=${vertex} oninput=${(event) => setVertex(event.target.value)} /></label>
          <button class="small" data-testid="landmark-add" disabled=${!name.trim() || vertex === ""}>${T.correspondence.addLandmark}</button>
        </form>`}
      </details>`;
  }

  Studio.Correspondence = function Correspondence({ project, next }) {
    const [clicked, setClicked] = useState(null);
    const [job, select] = useResult(["correspond", "redo"]);
    // Landmarks belong to the surfaces that they were placed on.
    const elsewhere = job && Object.keys(project.landmarks).length && ![job.output, ""].includes(project.landmarks_on) ? project.landmarks_on : "";
    const landmarks = elsewhere ? {} : project.landmarks;
    const [refused, setRefused] = useState(0); // edits that were refused, after which landmarks are drawn where they were
    const save = async (changed) => {
      const done = !Studio.state.read_only && (await Studio.edit({ what: "landmarks", landmarks: changed, on: job.output }));
      if (!done) setRefused(refused + 1);
      return done;
    };
    const on = {
      landmarks: Object.entries(landmarks).map(([name, vertex]) => ({ name, vertex, refused })),
      onvertex: setClicked, onlandmark: (name, vertex) => save({ ...landmarks, [name]: vertex }),
    };
    const training = project.rows.filter((one) => one.included && one.set === "training" && one.state !== "unusable");
    const busy = isBusy("correspond", "redo");
    const controls = html`
      <h2>${T.correspondence.title}</h2>
      <p class="hint">${training.length < LEAST ? T.correspondence.none : T.correspondence.intro(training.length)}</p>
      <${Jobs} kinds=${["correspond", "redo"]} />
      ${job && html`<${Next} name="correspondence" next=${next} ready=${!busy} />`}
      <${Settings} key="settings" kinds=${["correspond"]}><${JobForm} kind="correspond" strong=${!job && !busy} disabled=${training.length < LEAST || busy} /><//>
      ${job && html`<${Redo} specimens=${training} /><${Landmarks} landmarks=${landmarks} elsewhere=${elsewhere} clicked=${clicked} save=${save} />`}`;
    return html`<${Step} name="correspondence" title=${T.correspondence.title} controls=${controls} select=${select} job=${job} empty=${T.correspondence.empty} on=${on} />`;
  };

  // Model -----------------------------------------------------------------------------------------------------------

  const More = ({ kind, ...rest }) => Studio.forms[kind] && !Studio.state.read_only ? html`<details data-testid=${`more-${kind}`}><summary>${Studio.action(kind)}</summary><p class="hint">${Studio.forms[kind].summary}</p><${JobForm} kind=${kind} ...${rest} /></details>` : null;

  Studio.Model = function Model({ project, next, go }) {
    const kinds = ["build", "quality", "morphospace"];
    const [job, select] = useResult(kinds);
    const [names, setNames] = useState([]); // those that are selected in the morphospace
    const selected = project.rows.filter((one) => names.includes(one.id));
    const ready = Boolean(Studio.newest("correspond", "redo"));
    const built = Boolean(Studio.newest("build"));
    const sources = ["correspond", "redo"];
    const controls = html`
      <h2>${T.model.title}</h2>
      <p class="hint">${ready ? T.model.intro : T.model.none}</p>
      <${Jobs} kinds=${kinds} />
      ${built && html`<div class="row nexts"><${Next} name="model" next=${next} ready=${!isBusy("build")} /><${Button} class="wide" testid="go-fit" onclick=${() => go("fit")}>${T.fitNext}<//></div>`}
      <${Settings} key="settings" kinds=${["build"]}><${JobForm} kind="build" sources=${sources} strong=${ready && !built && !isBusy("build")} disabled=${!ready || isBusy("build")} /><//>
      ${ready && html`<${More} kind="quality" sources=${sources} disabled=${isBusy("quality")} />`}
      ${(ready || Studio.hasPlaced("morphospace")) && html`<${More} kind="morphospace" sources=${sources} defaults=${{ "--group": Object.keys(project.counts)[0] || "" }} disabled=${isBusy("morphospace")} />`}`;
    return html`<${Step} name="model" title=${T.model.title} controls=${controls} select=${select} job=${job} empty=${T.model.empty} on=${{ onselected: setNames }}>
      ${selected.length > 0 && html`<${Studio.SelectionBar} selected=${selected} onclear=${() => setNames([])} />`}<//>`;
  };

  // Fit -------------------------------------------------------------------------------------------------------------

  Studio.Fit = function Fit({ project, next }) {
    const kinds = ["fit", "complete", "report"];
    const [job, select] = useResult(["fit", "complete"]);
    const ready = Boolean(Studio.newest("build"));
    const scans = project.specimens.filter((one) => one.set === "new" && one.included && one.state !== "unusable");
    const fitted = Studio.newest("fit");
    const busy = isBusy("fit");
    const controls = html`
      <h2>${T.fit.title}</h2>
      <p class="hint">${ready ? T.fit.intro : T.fit.none}</p>
      <${DropZone} testid="drop-new" class="small-drop" onfiles=${(files) => Studio.upload(files, "new")}>
        ${!Studio.state.read_only && html`<strong>${T.fit.drop}</strong>`}<div class="row"><${Studio.AddButtons} set="new" /></div>
        <p data-testid="new-scans" class="hint">${T.fit.scans(scans.length)}${scans.length ? `: ${scans.slice(0, 8).map((one) => one.id).join(", ")}${scans.length > 8 ? " \u2026" : ""}` : ""}</p>
        <${UploadStatus} />
      <//>
      <${Jobs} kinds=${kinds} />
      ${fitted && html`<${Next} name="fit" next=${next} ready=${!busy} /><${Button} edits class="wide" testid="report-fits" disabled=${isBusy("report")} onclick=${() => Studio.runJob("report", {}, fitted.number)}>${T.fit.report}<//>`}
      <${Settings} key="settings" kinds=${["fit"]}><${JobForm} kind="fit" sources=${["build"]} strong=${ready && scans.length > 0 && !fitted && !busy} disabled=${!ready || !scans.length || busy} /><//>
      ${ready && scans.length > 0 && html`<${More} kind="complete" sources=${["build"]} disabled=${isBusy("complete")} />`}`;
    return html`<${Step} name="fit" title=${T.fit.title} controls=${controls} select=${select} job=${job} empty=${T.fit.empty} />`;
  };
})();
