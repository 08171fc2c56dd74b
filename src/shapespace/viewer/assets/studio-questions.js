/* The screen of the questions: a card each, its form with checks, and the answer in words, figures and text. */
(function () {
  "use strict";

  const { html } = window.Preact;
  const Studio = window.ShapespaceStudio;
  const T = window.ShapespaceTexts;
  const Q = T.questions;
  const { Button, CopyButton, Elsewhere, JobForm, Jobs, Settings, Step, useResult } = Studio;
  const KINDS = []; // filled when the forms are known
  const CORRESPONDENCES = ["correspond", "redo"];
  const SOURCES = { identify: ["fit"] }; // others also take surfaces in correspondence
  const sources = (kind) => SOURCES[kind] || [...CORRESPONDENCES, "fit"];

  const hint = (kind) => Q.hints[kind] || `${Studio.forms[kind].summary[0].toUpperCase()}${Studio.forms[kind].summary.slice(1)}.`;

  Studio.QUESTIONS = KINDS;

  /** Questions other than `kind` that run or wait, or failed last: the strip above the screen has those of other screens. */
  const Others = ({ kind }) => html`<${Elsewhere} testid="other-questions" kinds=${Studio.state.project.jobs.map((job) => job.kind).filter((one) => one === kind || !KINDS.includes(one))} />`;

  const Answer = ({ job }) => html`
    <div class="answer" data-testid="answer">
      ${job.sentences.length > 0 && html`<h3>${Q.findings}</h3><ul data-testid="sentences">${job.sentences.map((sentence) => html`<li>${sentence}</li>`)}</ul>`}
      <div class="row"><${Button} edits small testid="figures" onclick=${() => Studio.runFigures(job)}>${Q.figures}<//>${job.methods && html`<details data-testid="methods"><summary>${Q.paper}</summary><p>${job.methods}</p><${CopyButton} text=${job.methods} label=${Q.copyPaper} testid="copy-methods" /></details>`}</div>
    </div>`;

  function Question({ kind, next, onback }) {
    const [job, select] = useResult([kind]);
    const ready = Boolean(Studio.newest(...sources(kind))) || Studio.hasPlaced(kind);
    const busy = Studio.jobsOf([kind]).some(Studio.isActive);
    const controls = html`
      <${Button} small testid="all-questions" onclick=${onback}>← ${Q.all}<//>
      <h2>${Studio.action(kind)}</h2>
      <p class="hint">${ready ? hint(kind) : Q.none}</p>
      <${Jobs} kinds=${[kind]} />
      <${Others} kind=${kind} />
      ${job && html`<${Button} class="wide" strong=${!busy} testid="next" onclick=${next}>${T.next.questions}<//>`}
      <${Settings} key="settings" kinds=${[kind]}><${JobForm} kind=${kind} sources=${sources(kind)} strong=${!job && !busy} checked disabled=${!ready || busy} /><//>`;
    return html`<${Step} name="question" title=${Studio.action(kind)} controls=${controls} select=${select} job=${job} empty=${Q.empty}>${job && html`<${Answer} job=${job} />`}<//>`;
  }

  Studio.Questions = function Questions({ next }) {
    const { question: kind } = Studio.place().place;
    const ask = (question, result) => Studio.goTo("questions", { question, result });
    if (KINDS.includes(kind)) return html`<${Question} key=${kind} kind=${kind} next=${next} onback=${() => ask()} />`;
    const earlier = Studio.newestOfEach(Studio.jobsOf(KINDS));
    return html`
      <div class="fill scroll" data-testid="screen-questions">
        <div class="row bar"><h2>${Q.title}</h2><span class="grow"></span>
          ${earlier.some((job) => job.status === "done") && html`<${Button} strong testid="next" onclick=${next}>${T.next.questions}<//>`}</div>
        <${Others} />
        <ul class="questions">
          ${KINDS.filter((one) => Studio.forms[one] && !Studio.state.read_only).map((one) => html`<li key=${one}><button type="button" data-testid=${`question-${one}`} onclick=${() => ask(one)}><strong>${Studio.action(one)}</strong><span class="hint">${hint(one)}</span></button></li>`)}
        </ul>
        ${earlier.length > 0 && html`<h3>${Q.earlier}</h3>
          <ul class="recent">${earlier.map((job) => html`<li key=${job.number}><button type="button" data-testid=${`earlier-${job.number}`} onclick=${() => ask(job.kind, job.number)}>
            <strong>${Studio.kindOf(job)}</strong><span>${Studio.titleOf(job)}${job.outdated ? html` <span class="tag">${T.jobs.isOutdated}</span>` : ""}</span><span class="hint">${T.jobs.statuses[job.status]}${job.sentences.length ? `: ${job.sentences[0]}` : ""}</span></button></li>`)}</ul>`}
      </div>`;
  };
})();
