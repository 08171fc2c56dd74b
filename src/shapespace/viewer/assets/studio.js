/* The studio's page: start screen or the tabs of a project, keyboard shortcuts, and the connection to the server. */
(function () {
  "use strict";

  const { html, render, useState, useEffect } = window.Preact;
  const Viewer = window.ShapespaceViewer;
  const Studio = window.ShapespaceStudio;
  const T = window.ShapespaceTexts;
  const { Button, Start, moveFocus } = Studio;
  const LONGEST_PRESS = 2000; // ms, as some controls of the browser report no release
  const SCREENS = {
    specimens: Studio.Specimens, correspondence: Studio.Correspondence, model: Studio.Model, fit: Studio.Fit,
    questions: Studio.Questions, export: Studio.Export, history: Studio.History,
  };
  const NAMES = Object.keys(SCREENS);
  const KINDS = { correspondence: ["correspond", "redo"], model: ["build", "quality", "morphospace"], fit: ["fit", "complete"], questions: Studio.QUESTIONS, export: ["report", "convert", "export", "figures"] };
  const AFTER = { specimens: "correspondence", correspondence: "model", model: "questions", fit: "questions", questions: "export" };

  const ofAddress = () => { const { screen } = Studio.place(); return NAMES.includes(screen) ? screen : NAMES[0]; };

  /** Whether a screen's jobs run or have succeeded. */
  function progressOf(name) {
    const jobs = KINDS[name] ? Studio.jobsOf(KINDS[name]) : [];
    if (jobs.some(Studio.isActive)) return "running";
    return jobs.some((job) => job.status === "done") ? "done" : null;
  }

  /** Number of changes of the address; each draws the screen. */
  function useVisit() {
    const [visit, setVisit] = useState(0);
    useEffect(() => {
      const changed = () => setVisit((count) => count + 1);
      addEventListener("hashchange", changed);
      return () => removeEventListener("hashchange", changed);
    }, []);
    return visit;
  }

  /** A single result, without a project. */
  function Single({ result }) {
    const visit = useVisit();
    return html`<main><div id="screen" class="single" tabindex="-1"><${Studio.Result} key=${visit} job=${result} /></div></main>`;
  }

  function Project({ project }) {
    const visit = useVisit();
    const screen = ofAddress();
    const go = (name) => Studio.goTo(name);
    const next = () => { go(AFTER[screen]); document.getElementById(`tab-${AFTER[screen]}`).focus(); };
    const Screen = SCREENS[screen];
    return html`
      <nav class="tabs">
        <div role="tablist" aria-label=${T.screensLabel} onkeydown=${moveFocus}>
          ${NAMES.map((name) => {
            const progress = progressOf(name);
            return html`<button type="button" role="tab" id=${`tab-${name}`} key=${name} data-testid=${`tab-${name}`} aria-controls="screen" aria-selected=${name === screen} tabindex=${name === screen ? 0 : -1} onclick=${() => go(name)}>
              ${T.screens[name]}${progress && html` <span class=${`mark ${progress}`} role="img" aria-label=${T[progress]}>${progress === "done" ? "✓" : "…"}</span>`}</button>`;
          })}
        </div>
        <${Button} edits small testid="close-project" onclick=${() => Studio.act("/api/close")}>${T.closeProject}<//>
      </nav>
      <${Studio.Elsewhere} kinds=${screen === "history" ? project.jobs.map((job) => job.kind) : KINDS[screen] || []} />
      <main>
        <div id="screen" role="tabpanel" tabindex="-1" aria-labelledby=${`tab-${screen}`} data-screen=${screen}><${Screen} key=${`${screen} ${visit}`} project=${project} go=${go} next=${next} /></div>
      </main>`;
  }

  function App() {
    const { project, result, recent } = Studio.state;
    if (result) return html`<${Single} result=${result} />`;
    return project ? html`<${Project} key=${project.folder} project=${project} />` : html`<${Start} recent=${recent} />`;
  }

  function draw() {
    const { project, result } = Studio.state;
    const about = document.getElementById("about"), name = result ? result.output : project ? project.name : "";
    about.textContent = project && Studio.state.read_only ? `${name}${T.readOnly}` : name;
    about.title = project ? project.folder : "";
    document.title = `${name && `${name}, `}shapespace${result ? "" : " studio"}`;
    render(html`<${App} />`, document.getElementById("app"));
    document.body.dataset.ready = "true";
  }

  /** Ctrl-Z and Ctrl-Shift-Z, unless text is being edited. */
  function shortcut(event) {
    if (!(event.ctrlKey || event.metaKey) || event.altKey || !["z", "y"].includes(event.key.toLowerCase())) return;
    const field = event.target.closest && event.target.closest("input:not([type=checkbox]), textarea, dialog");
    if (field && !(field.classList.contains("entry") && field.dataset.edited !== "true")) return;
    const project = Studio.state && Studio.state.project;
    if (!project) return;
    event.preventDefault();
    if (event.shiftKey || event.key.toLowerCase() === "y") { if (project.redo) Studio.redo(); } else if (project.undo) Studio.undo();
  }

  /** Draw when the pointer is up, so that nothing moves under it between press and release. */
  function startDrawing() {
    let pressed = null, late = false;
    const release = () => { clearTimeout(pressed); pressed = null; if (late) setTimeout(() => { late = false; draw(); }); }; // after the click
    addEventListener("pointerdown", () => { clearTimeout(pressed); pressed = setTimeout(release, LONGEST_PRESS); }, true);
    for (const kind of ["pointerup", "pointercancel"]) addEventListener(kind, release, true);
    Studio.changed = () => { if (pressed !== null) late = true; else draw(); };
  }

  async function start() {
    startDrawing();
    Viewer.startMessages();
    Viewer.startTheme(() => document.dispatchEvent(new Event("shapespace:theme")));
    addEventListener("keydown", shortcut);
    // A file that misses the drop zone would replace the page.
    addEventListener("dragover", (event) => event.preventDefault());
    addEventListener("drop", (event) => event.preventDefault());
    addEventListener("beforeunload", (event) => { if (Studio.uploading()) event.preventDefault(); });
    Studio.state = await Studio.json("/api/project");
    if (Studio.state.result) { draw(); return; } // which nothing changes
    Studio.forms = await Studio.json("/api/forms");
    Studio.QUESTIONS.push(...Object.keys(Studio.forms).filter((kind) => Studio.forms[kind].is_question));
    await Studio.refresh();
    Studio.listen();
  }

  Viewer.guarded(start)();
})();
