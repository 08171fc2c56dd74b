/* The screens of what leaves the studio: files and reports, and the history of commands. */
(function () {
  "use strict";

  const { html, useState, useEffect } = window.Preact;
  const Viewer = window.ShapespaceViewer;
  const Studio = window.ShapespaceStudio;
  const T = window.ShapespaceTexts;
  const { Button, CopyButton, JobForm, Jobs, JobPanel } = Studio;
  const UNITS = ["B", "kB", "MB", "GB"];

  function bytes(number) {
    const step = number < 1000 ? 0 : Math.min(3, Math.floor(Math.log10(number) / 3));
    return `${(number / 1000 ** step).toFixed(step && number / 1000 ** step < 10 ? 1 : 0)} ${UNITS[step]}`;
  }

  // Export ----------------------------------------------------------------------------------------------------------

  function Files({ job }) {
    const [files, setFiles] = useState(null);
    const open = Viewer.guarded(async (event) => { if (event.target.open) setFiles(await Studio.json(`/api/jobs/${job.number}/files`)); });
    return html`
      <details ontoggle=${open} data-testid=${`files-${job.number}`}><summary>${T.export.show}</summary>
        ${files && !files.length && html`<p class="hint">${T.export.noFiles}</p>`}
        ${files && files.length > 0 && html`<ul class="files">${files.slice(0, 500).map((file) => html`<li key=${file.path}><a href=${Studio.fileAddress(file.path)} download data-testid="download" aria-label=${T.export.download(file.path)}>${file.path}</a> <span class="hint">${bytes(file.bytes)}</span></li>`)}</ul>`}
      </details>`;
  }

  function ExportRow({ job }) {
    const isQuestion = Studio.QUESTIONS.includes(job.kind);
    return html`
      <tr data-testid=${`export-${job.number}`}>
        <th scope="row"><strong>${Studio.kindOf(job)}</strong>${job.outdated && html` <span class="tag">${T.jobs.isOutdated}</span>`}<span class="hint">${Studio.titleOf(job)}</span></th>
        <td><${Files} job=${job} /></td>
        <td><div class="row">
          <a class="button" href=${`/zip/${job.number}`} download data-testid=${`zip-${job.number}`}>${T.export.zip}</a>
          ${["correspond", "redo", "fit"].includes(job.kind) && html`<${Button} edits small testid=${`report-${job.number}`} onclick=${() => Studio.runJob("report", {}, job.number)}>${T.export.reportOf}<//>`}
          ${isQuestion && html`<${Button} edits small testid=${`figures-${job.number}`} onclick=${() => Studio.runFigures(job)}>${T.export.figures}<//>`}
          ${job.views.some((view) => view.kind === "report") && html`<a class="button" href=${`/view/${job.number}/`} target="_blank" rel="noopener" data-testid=${`open-${job.number}`}>${T.jobs.full}</a>`}
        </div></td>
      </tr>`;
  }

  Studio.Export = function Export({ project }) {
    const done = project.jobs.filter((job) => job.status === "done").reverse();
    const busy = Studio.jobsOf(["report"]).some(Studio.isActive), outdated = Studio.newestOfEach(done).filter((job) => job.outdated).length;
    return html`
      <div class="fill scroll" data-testid="screen-export">
        <div class="row bar"><div><h2>${T.export.title}</h2><p class="hint">${T.export.intro}</p></div><span class="grow"></span>
          <${Button} edits strong testid="write-report" disabled=${!done.length || busy} onclick=${() => Studio.runJob("report")}>${T.export.report}<//></div>
        ${outdated > 0 && html`<p class="outdated" role="status" data-testid="outdated">${T.export.outdated(outdated)}</p>`}
        <${Jobs} kinds=${["report", "convert", "export", "figures"]} />
        ${Studio.jobsOf(Studio.QUESTIONS).filter(Studio.isActive).map((job) => html`<${JobPanel} key=${job.number} job=${job} />`)}
        ${Studio.newest("build") && Studio.forms.convert && !Studio.state.read_only && html`<details class="narrow" data-testid="convert"><summary>${T.export.convert}</summary><${JobForm} kind="convert" sources=${["build"]} /></details>`}
        ${!done.length ? html`<p class="hint">${T.export.none}</p>` : html`
          <div class="table-box" role="region" aria-label=${T.export.title} tabindex="0"><table class="plain">
            <thead><tr><th scope="col">${T.export.result}</th><th scope="col">${T.export.files}</th><th scope="col">${T.export.actions}</th></tr></thead>
            <tbody>${done.map((job) => html`<${ExportRow} key=${job.number} job=${job} />`)}</tbody></table></div>`}
      </div>`;
  };

  // History ---------------------------------------------------------------------------------------------------------

  Studio.History = function History({ project }) {
    const H = T.history;
    const [open, setOpen] = useState(null);
    useEffect(() => { setOpen(null); }, [project.folder]);
    const history = async () => (await Studio.ask("/api/history")).text();
    return html`
      <div class="fill scroll" data-testid="screen-history">
        <div class="row bar"><div><h2>${H.title}</h2><p class="hint">${H.intro}</p></div><span class="grow"></span>
          <a class="button" href="/files/history.sh" download data-testid="download-history">${H.download}</a>
          <${CopyButton} strong text=${history} label=${H.copy} testid="copy-commands" /></div>
        ${!project.jobs.length ? html`<p class="hint">${H.none}</p>` : html`
          <div class="table-box" role="region" aria-label=${H.title} tabindex="0"><table class="plain" data-testid="history">
            <thead><tr><th scope="col" class="number">${H.number}</th><th scope="col">${H.action}</th><th scope="col">${H.status}</th><th scope="col" class="number">${H.time}</th><th scope="col">${H.command}</th></tr></thead>
            <tbody>${[...project.jobs].reverse().map((job) => html`
              <tr key=${job.number} class=${job.status} data-testid=${`history-${job.number}`}>
                <td class="number">${job.number}</td>
                <th scope="row"><button type="button" class="small" aria-expanded=${open === job.number} data-testid=${`details-${job.number}`} onclick=${() => setOpen(open === job.number ? null : job.number)}>${Studio.kindOf(job)}</button></th>
                <td class="short"><span class="dot" aria-hidden="true"></span> ${T.jobs.statuses[job.status]}</td>
                <td class="number short">${job.seconds ? Studio.duration(job.seconds) : ""}</td>
                <td><code>${job.command}</code>${open === job.number && html`<${JobPanel} job=${job} />`}</td>
              </tr>`)}</tbody></table></div>`}
      </div>`;
  };
})();
