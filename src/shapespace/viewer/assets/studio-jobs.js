/* Jobs: the form made from a command's options, its run with progress and log, and its results. */
(function () {
  "use strict";

  const { html, useState, useEffect, useRef, useMemo } = window.Preact;
  const Studio = window.ShapespaceStudio;
  const T = window.ShapespaceTexts;
  const J = T.jobs;
  const { Button, CopyButton } = Studio;
  const SHORT_HELP = 100; // characters, about two lines
  const CORRESPONDENCES = ["correspond", "redo"];
  const CHECK_AFTER = 400; // ms without a change of the form

  const duration = (seconds) => seconds < 90 ? J.seconds(Math.max(1, Math.round(seconds))) : seconds < 5400 ? J.minutes(Math.round(seconds / 60)) : J.hours((seconds / 3600).toFixed(1));
  const action = (kind) => (Studio.forms[kind] ? Studio.forms[kind].label : J.kinds[kind] || kind);
  const kindOf = (job) => action(job.kind);

  const NAMED_BY = ["--formula", "--target", "--along", "--group", "--subject", "--time", "--reference"]; // options that name a run
  const titleOf = (job) => J.title(job.number, NAMED_BY.map((flag) => job.options[flag]).filter(Boolean).join(", ") || job.output || job.kind);

  Studio.titleOf = titleOf;
  Studio.fileAddress = (path) => `/files/${path.split("/").map(encodeURIComponent).join("/")}`;

  const PLACED = "0", MISSING = "missing-landmarks"; // landmarks on scans as the data of a question, and its option for them
  /** Whether a question can be about the landmarks on scans. */
  const hasPlaced = (kind) => Boolean(Studio.forms[kind]?.options.some((option) => option.flag === MISSING)) && Studio.state.project.specimens.some((one) => one.included && one.set === "training" && Object.keys(one.points).length > 0);

  // Forms -----------------------------------------------------------------------------------------------------------

  const quoted = (column) => (/^[A-Za-z_]\w*$/.test(column) ? column : `\`${column}\``);
  const terms = (formula) => (formula.replace(/^\s*~/, "").match(/(`[^`]*`|[^`+])+/g) || []).map((term) => term.trim()).filter(Boolean);

  /** A formula, built from ticked columns and editable. */
  function Formula({ option, value, columns, onvalue }) {
    const chosen = terms(value);
    const toggle = (column) => {
      const term = quoted(column), rest = chosen.filter((one) => one !== term);
      const next = rest.length < chosen.length ? rest : [...chosen, term];
      onvalue(next.length ? `~ ${next.join(" + ")}` : "");
    };
    const choices = [...columns.map((column) => [column, column]), ["log_size", T.questions.size]];
    return html`
      <fieldset class="choices"><legend>${T.questions.columns}</legend>
        ${!columns.length && html`<p class="hint">${T.questions.noColumns}</p>`}
        ${choices.map(([column, label]) => html`<label class="check" key=${column}><input type="checkbox" data-testid=${`term-${column}`} checked=${chosen.includes(quoted(column))} onchange=${() => toggle(column)} />${label}</label>`)}
      </fieldset>
      <label class="option"><span>${option.label}</span><input data-testid=${`option${option.flag}`} placeholder="~ sex + age" title=${option.help} value=${value} spellcheck=${false} oninput=${(event) => onvalue(event.target.value)} /></label>`;
  }

  /** The classes that are counted, as `column=value`. */
  const classesOf = ({ counts }) => Object.entries(counts).flatMap(([column, classes]) => Object.keys(classes).filter(Boolean).map((value) => `${column}=${value}`));

  /** A help text; what follows its first clause unfolds by a click, not by the focus, which would move a button under the pointer. */
  function Help({ id, text }) {
    const end = text.length > SHORT_HELP ? text.search(/[;.] /) : -1;
    if (end < 0) return html`<small class="hint" id=${id}>${text}</small>`;
    const rest = text.slice(end + 2).trim();
    return html`<details class="hint" id=${id}><summary>${text.slice(0, end)}</summary>${rest[0].toUpperCase()}${rest.slice(1)}</details>`;
  }

  function Option({ option, value, columns, onvalue }) {
    const { flag, kind, choices, initial, required } = option;
    const label = html`<span>${option.label}${required && html` <small>(${J.required})</small>`}</span>`;
    const common = { "data-testid": `option${flag}`, "aria-describedby": `help${flag}`, required };
    const text = option.help.replace(` (default: ${initial})`, ""); // the field shows it already
    const help = html`<${Help} id=${`help${flag}`} text=${text} />`;
    if (kind === "formula") return html`<${Formula} option=${option} value=${value || ""} columns=${columns} onvalue=${onvalue} />`;
    if (kind === "flag") return html`<div class="option"><label class="check"><input type="checkbox" ...${common} checked=${value === true} onchange=${(event) => onvalue(event.target.checked)} />${option.label}</label>${help}</div>`;
    if (kind === "choice" || kind === "column" || kind === "class") {
      const values = kind === "choice" ? choices : kind === "column" ? columns : classesOf(Studio.state.project);
      return html`<div class="option"><label>${label}<select ...${common} value=${value || ""} onchange=${(event) => onvalue(event.target.value)}>
        ${!(initial && values.includes(initial)) && html`<option value="">${required ? "" : kind === "choice" ? J.default : J.none}</option>`}
        ${values.map((one) => html`<option key=${one} value=${one} selected=${one === value}>${kind === "class" ? one.replace("=", ": ") : one}</option>`)}</select></label>${help}</div>`;
    }
    return html`<div class="option"><label>${label}<input ...${common} inputmode=${kind === "number" ? "decimal" : undefined} value=${value || ""} placeholder=${initial || required ? "" : J.default} oninput=${(event) => onvalue(event.target.value)} /></label>${help}</div>`;
  }

  /** The options that differ from the initial ones. */
  function changedOptions(form, values) {
    const options = {};
    for (const { flag, initial, required } of form.options) {
      const value = typeof values[flag] === "string" ? values[flag].trim() : values[flag];
      if (value === undefined || value === "" || value === false) continue;
      if (required || value !== initial) options[flag] = value;
    }
    return options;
  }

  /** The form of a command with its checks and its button. */
  function JobForm({ kind, sources = [], defaults, strong, checked = kind === "correspond", disabled, label, children }) {
    const form = Studio.forms[kind];
    const initial = useMemo(() => Object.fromEntries((form ? form.options : []).map((option) => [option.flag, option.initial === null ? "" : option.initial])), [form]);
    // The settings open as the last run had them.
    const [values, setValues] = useState(() => ({ ...initial, ...defaults, ...Studio.jobsOf([kind])[0]?.options }));
    const placed = hasPlaced(kind);
    const [on, setOn] = useState(() => (placed && Studio.jobsOf([kind])[0]?.on === 0 ? PLACED : ""));
    const [checks, setChecks] = useState(null);
    const [checkedFor, setCheckedFor] = useState(null); // settings of these checks; a problem of earlier ones does not keep a run back
    const [starting, setStarting] = useState(false);
    const { columns, jobs, revision, odd } = Studio.state.project;
    const ready = jobs.filter((job) => sources.includes(job.kind) && (job.status === "done" || String(job.number) === on)).reverse();
    const ofPlaced = placed && (on === PLACED || (!on && !ready.some((job) => CORRESPONDENCES.includes(job.kind))));
    const options = form ? changedOptions(form, values) : {};
    if (!ofPlaced) delete options[MISSING];
    const asked = JSON.stringify([options, on]);
    useEffect(() => {
      if (!checked) return undefined;
      let current = true;
      const timer = setTimeout(async () => {
        let result = null;
        try { result = await Studio.post("/api/checks", { kind, options, on: on ? Number(on) : null }); } catch (error) { result = [{ level: "problem", text: error.message }]; }
        if (current) { setChecks(result); setCheckedFor(asked); }
      }, CHECK_AFTER);
      return () => { current = false; clearTimeout(timer); };
    }, [asked, revision, kind]);
    if (!form) return null;
    const running = jobs.findLast((job) => sources.includes(job.kind) && CORRESPONDENCES.includes(job.kind) && Studio.isActive(job));
    const wait = html`<label class="check"><input type="checkbox" data-testid="wait" checked=${on === String(running?.number)} onchange=${(event) => setOn(event.target.checked ? String(running.number) : "")} />${J.wait}</label>`;
    const show = (option) => html`<${Option} key=${option.flag} option=${option} value=${values[option.flag]} columns=${columns} onvalue=${(value) => setValues((before) => ({ ...before, [option.flag]: value }))} />`;
    const folded = form.options.filter((option) => !option.visible);
    const missing = form.options.some((option) => option.required && !options[option.flag]);
    const problem = checkedFor === asked && checks && checks.some((check) => check.level === "problem");
    const run = async (event) => {
      event.preventDefault();
      setStarting(true);
      await Studio.runJob(kind, options, on ? Number(on) : null);
      setStarting(false);
      event.target.closest(".side")?.scrollTo(0, 0);
    };
    const word = label || (jobs.some((job) => job.kind === kind) ? J.runAgain : J.runOf[kind] || J.run);
    return html`
      <form class="job-form" data-testid=${`form-${kind}`} onsubmit=${run} novalidate>
        ${running && on !== PLACED && html`<div class="outdated" role="status" data-testid="newer-runs"><strong>${J.newerRuns(action(running.kind), running.number, on === String(running.number))}</strong>${wait}</div>`}
        ${ready.length + placed > 1 && html`<label class="option"><span>${J.source}</span><select data-testid="source" value=${on} onchange=${(event) => setOn(event.target.value)}>
          <option value="">${J.newest}</option>${placed && html`<option value=${PLACED} selected=${on === PLACED}>${J.placed}</option>`}${ready.map((job) => html`<option key=${job.number} value=${job.number}>${titleOf(job)}</option>`)}</select></label>`}
        ${placed && !ready.length && html`<p class="hint" data-testid="of-placed">${J.source}: ${J.placed}</p>`}
        ${form.options.filter((option) => option.visible && (ofPlaced || option.flag !== MISSING)).map(show)}
        ${folded.length > 0 && html`<details data-testid="more-options"><summary>${J.more(folded.length)}</summary>${folded.map(show)}</details>`}
        ${children}
        ${kind === "correspond" && odd.length > 0 && html`<p class="odd"><a href="#specimens" data-testid="odd-link">${T.specimens.odd.link(odd.length)}</a></p>`}
        <button class=${strong ? "strong wide" : "wide"} data-testid=${`run-${kind}`} disabled=${disabled || starting || missing || problem}>${word}</button>
        ${/* Below the button, which they must not move while it is pressed. */ checked && html`<div class="checks" role="status" aria-label=${T.questions.checks} data-testid="checks">
          ${checks === null ? html`<p class="hint">${T.questions.checking}</p>` : checks.map((check) => html`<p class=${check.level}><b>${T.questions.levels[check.level]}</b> ${check.text}</p>`)}</div>`}
      </form>`;
  }

  // A job -----------------------------------------------------------------------------------------------------------

  function Log({ job }) {
    const [open, setOpen] = useState(false);
    const [text, setText] = useState("");
    const box = useRef(null);
    useEffect(() => {
      if (!open) return;
      Studio.ask(`/api/jobs/${job.number}/log`).then((answer) => answer.text()).then((log) => {
        setText(log);
        if (box.current && Studio.isActive(job)) box.current.scrollTop = box.current.scrollHeight;
      }).catch((error) => setText(error.message));
    }, [open, job]);
    return html`<details data-testid=${`log-${job.number}`} ontoggle=${(event) => setOpen(event.target.open)}><summary>${J.log}</summary>
      ${open && html`<pre ref=${box} class="log" tabindex="0" aria-label=${J.log}>${text || J.noLog}</pre>`}</details>`;
  }

  /** State, progress, log and command of a job. */
  function JobPanel({ job }) {
    const { progress, status } = job;
    const active = Studio.isActive(job);
    const facts = [J.statuses[status]];
    if (status === "done" || status === "failed") facts.push(J.took(duration(job.seconds || 0)));
    if (status === "running" && job.left_s !== null) facts.push(J.left(duration(job.left_s)));
    return html`
      <section class=${`job ${status}`} data-testid=${`job-${job.number}`} data-status=${status} aria-label=${`${kindOf(job)} ${job.number}`}>
        <div class="row"><strong>${kindOf(job)}</strong><span class="hint">${facts.join(", ")}</span><span class="grow"></span>
          ${active && html`<${Button} edits small testid=${`cancel-${job.number}`} onclick=${() => Studio.act(`/api/jobs/${job.number}/cancel`)}>${J.cancel}<//>`}
          ${job.can_continue && html`<${Button} edits small testid=${`continue-${job.number}`} onclick=${() => Studio.act(`/api/jobs/${job.number}/continue`)}>${J.continue}<//>`}
        </div>
        ${active && html`<progress max=${progress ? progress.total : undefined} value=${progress ? progress.done : undefined} aria-label=${J.progressLabel(kindOf(job))} data-testid=${`progress-${job.number}`}></progress>`}
        <p class="hint message" role="status">${active && progress ? J.progress(progress) : job.message}</p>
        ${job.kind === "report" && job.views.length > 0 && html`<p><a href=${job.views[0].href} target="_blank" rel="noopener" data-testid=${`open-report-${job.number}`}>${J.openReport}</a></p>`}
        <${Log} job=${job} />
        <details><summary>${J.command}</summary><pre class="log" tabindex="0" aria-label=${J.command}>${job.command}</pre><${CopyButton} text=${job.command} label=${J.copy} testid=${`copy-command-${job.number}`} /></details>
      </section>`;
  }

  /** Pictures and log of a result without a page of its own. */
  function Summary({ job }) {
    const [log, setLog] = useState("");
    const [pictures, setPictures] = useState([]);
    useEffect(() => {
      let addresses = [];
      const load = async () => {
        setLog(await (await Studio.ask(`/api/jobs/${job.number}/log`)).text());
        const files = await Studio.json(`/api/jobs/${job.number}/files`);
        const found = files.filter((file) => file.path.endsWith(".png")).slice(0, 12);
        addresses = await Promise.all(found.map(async ({ path }) => URL.createObjectURL(new Blob([await (await Studio.ask(Studio.fileAddress(path))).blob()], { type: "image/png" }))));
        setPictures(addresses.map((address, k) => [address, found[k].path]));
      };
      load().catch((error) => setLog(error.message));
      return () => addresses.forEach((address) => URL.revokeObjectURL(address));
    }, [job.number]);
    const words = log.split("\n").filter((line) => !/^shapespace: .* \.\.\./.test(line)).join("\n");
    return html`<div class="fill scroll" role="region" aria-label=${job.output} tabindex="0" data-testid=${`result-${job.number}`}>${pictures.map(([address, path]) => html`<img class="plot" key=${path} src=${address} alt=${path} />`)}<pre class="words">${words}</pre></div>`;
  }

  /** Result of a job, with a choice of its views; on: see `Studio.Pane`. */
  function Result({ job, on }) {
    const [kind, setKind] = useState(Studio.place().place.view);
    const view = job.views.find((one) => one.kind === kind) || job.views[0];
    if (!view) return html`<${Summary} job=${job} />`;
    return html`
      <div class="frame" data-testid=${`result-${job.number}`}>
        ${job.views.length > 1 && html`<div class="segments" role="group" aria-label=${J.view}>${job.views.map((one) => html`<button type="button" aria-pressed=${one === view} data-testid=${`view-${one.kind}`} onclick=${() => setKind(one.kind)}>${J.views[one.kind]}</button>`)}</div>`}
        <${Studio.Pane} key=${view.href} view=${view} result=${job.number} name=${J.shown(J.views[view.kind], job.output)} on=${{ ...on, isAnswer: job.sentences.length > 0 }} />
      </div>`;
  }

  /** What changed since a result was computed, with a button that computes it again with the same settings. */
  const Outdated = ({ job }) => job.outdated && html`
    <p class="outdated" role="status" data-testid=${`outdated-${job.number}`}><strong>${J.outdated[job.outdated]}</strong>
      ${job.outdated !== "source" && html` <${Button} edits small testid=${`again-${job.number}`} disabled=${Studio.jobsOf([job.kind]).some(Studio.isActive)} onclick=${() => Studio.runJob(job.kind, job.options, job.outdated === "redone" ? null : job.on)}>${J.sameSettings}<//>`}</p>`;

  const reportOf = (job) => job.views.find((view) => view.kind === "report");

  /** The results of `kinds`, that of the address or the newest at first; returns the chosen job and the select. */
  function useResult(kinds) {
    const [chosen, setChosen] = useState(Number(Studio.place().place.result) || null);
    const seen = useRef(undefined);
    const choose = (number) => { const { screen, place } = Studio.place(); Studio.goTo(screen, { question: place.question, result: number }); };
    const finished = Studio.jobsOf(kinds).filter((job) => job.status === "done");
    const job = finished.find((one) => one.number === chosen) || finished[0] || null;
    const newest = finished.length ? finished[0].number : null;
    useEffect(() => {
      if (seen.current !== undefined) setChosen(null); // a new result is shown
      seen.current = newest;
    }, [newest]);
    const select = job && html`
      <div class="row bar result-bar">
        ${finished.length > 1 ? html`<label>${J.result} <select data-testid="result" value=${job.number} onchange=${(event) => choose(Number(event.target.value))}>
          ${finished.map((one) => html`<option key=${one.number} value=${one.number} selected=${one === job}>${kindOf(one)}, ${titleOf(one)}</option>`)}</select></label>` : html`<strong>${kindOf(job)}</strong>`}
        <${Studio.Views} on=${Studio.frameOf(job)} shown=${Studio.pane?.result === job.number ? Studio.pane.oriented?.() : null} />
        <span class="grow"></span>
        ${reportOf(job) && html`<a href=${reportOf(job).href} target="_blank" rel="noopener" data-testid="open-result">${J.full}</a>`}
        <${Outdated} job=${job} />
      </div>`;
    return [job, select];
  }

  /** A form, folded away once a job of its kinds was started. */
  const Settings = ({ kinds, children }) => {
    const started = Studio.jobsOf(kinds).length > 0;
    if (Studio.state.read_only) return null;
    return html`<details class=${started ? "settings" : "settings first"} open=${!started} data-testid="settings"><summary>${J.settings}</summary>${children}</details>`;
  };

  /** The jobs of `kinds` that are shown with their form: those that run or wait, and the last one that ended. */
  const Jobs = ({ kinds }) => {
    const all = Studio.jobsOf(kinds);
    const shown = all.filter(Studio.isActive);
    if (all.length && !shown.includes(all[0])) shown.unshift(all[0]);
    return shown.map((job) => html`<${JobPanel} key=${job.number} job=${job} />`);
  };

  /** Jobs that other screens show: those that run or wait, and the newest one of a kind if it failed. */
  const Elsewhere = ({ kinds, testid = "elsewhere" }) => {
    const newest = new Map(Studio.state.project.jobs.map((job) => [job.kind, job]));
    const shown = Studio.state.project.jobs.filter((job) => !kinds.includes(job.kind) && (Studio.isActive(job) || ((job.status === "failed" || job.partly) && newest.get(job.kind) === job)));
    return shown.length > 0 && html`<div class="elsewhere" data-testid=${testid}>${shown.map((job) => html`<p key=${job.number} class=${job.status} data-testid=${`elsewhere-${job.number}`}>
      <strong>${kindOf(job)}</strong> <span class="hint">${J.statuses[job.status]}${job.progress ? `, ${J.progress(job.progress)}` : job.status === "failed" || job.partly ? `: ${job.message}` : ""}</span>
      ${Studio.isActive(job) && html` <${Button} edits small testid=${`elsewhere-cancel-${job.number}`} onclick=${() => Studio.act(`/api/jobs/${job.number}/cancel`)}>${J.cancel}<//>`}</p>`)}</div>`;
  };

  Object.assign(Studio, { hasPlaced, Elsewhere, Outdated, duration, action, kindOf, JobForm, JobPanel, Result, Settings, Jobs, useResult });
})();
