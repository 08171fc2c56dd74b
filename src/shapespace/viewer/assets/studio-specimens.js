/* The screen of the specimens: adding scans, cards or table, selection, counts and notes. */
(function () {
  "use strict";

  const { html, useState, useMemo, useCallback, useRef } = window.Preact;
  const Viewer = window.ShapespaceViewer;
  const Studio = window.ShapespaceStudio;
  const T = window.ShapespaceTexts;
  const S = T.specimens;
  const { Button, Confirm, FileButton, DropZone, UploadStatus, FolderBrowser } = Studio;
  const SHOWN = 200; // specimens drawn at first, and by each "Show more"
  const FEW = 3; // findings that are not folded

  const include = (specimen, box) => Studio.editBy({ what: "include", ids: [specimen.id], included: box.checked }, () => { box.checked = specimen.included; });

  Studio.Include = ({ specimen, label }) => html`<label class="include"><input type="checkbox" checked=${specimen.included} aria-label=${S.includeOne(specimen.id)} data-testid=${`include-${specimen.id}`}
    disabled=${specimen.state === "unusable" || Studio.state.read_only} onchange=${(event) => include(specimen, event.target)} />${label && html`<span aria-hidden="true">${label}</span>`}</label>`;

  /** The scans of a specimen: its own, and those of its further parts. */
  Studio.scansOf = (specimen) => [specimen, ...(specimen.part ? Studio.state.project.specimens.filter((one) => one.subject === specimen.id) : [])];

  /** The number of landmarks that are placed on a scan. */
  Studio.placed = (specimen) => Object.keys(specimen.points).length;

  /** A button that opens a scan in 3-D. */
  Studio.ShowScan = function ShowScan({ specimen }) {
    const [open, setOpen] = useState(false);
    if (specimen.state === "waiting") return null;
    return html`<${Button} small class="quiet show-scan" aria-label=${S.scan.show(specimen.id)} testid=${`show-${specimen.id}`} onclick=${() => setOpen(true)}>${specimen.part || S.scan.open}<//>
      ${open && html`<${Studio.Scan} key=${specimen.file} specimen=${specimen} onclose=${() => setOpen(false)} />`}`;
  };

  /** A select of units; the first one leaves scans as they are. */
  Studio.Unit = ({ value, onunit, ...rest }) => html`<select value=${value} onchange=${(event) => onunit(event.target)} ...${rest}>
    ${["", ...Studio.state.units].map((unit) => html`<option value=${unit}>${S.unit(unit)}</option>`)}</select>`;

  /** Why a scan cannot be used; repairs and notes in one line, which unfolds. */
  Studio.Findings = ({ specimen }) => {
    const line = (finding) => html`<p class=${`finding ${finding.level}`} title=${finding.text}>${specimen.part && `${specimen.part}: `}${S[finding.level]}${finding.text}</p>`;
    const refused = specimen.findings.filter((finding) => finding.level === "refused"), others = specimen.findings.filter((finding) => finding.level !== "refused");
    return html`
      ${specimen.state === "waiting" && html`<p class="finding waiting">${S.states.waiting}</p>`}
      ${refused.map(line)}
      ${others.length > 0 && html`<details class="findings-more"><summary>${S.found(others.filter((finding) => finding.level === "fixed").length, others.filter((finding) => finding.level === "note").length)}</summary>${others.map(line)}</details>`}`;
  };

  // Blue, orange, green, ...: those of the figures, for the classes of the first column.
  const COLOURS = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9"];

  /** The classes of a specimen as a text that is compared: [column, class, colour] each, the first column in colour. */
  function groupsOf(specimen, counts) {
    const columns = Object.entries(counts);
    return JSON.stringify(columns.map(([column, classes], k) => [column, specimen.cells[column] || "", k ? "" : COLOURS[Object.keys(classes).filter(Boolean).sort().indexOf(specimen.cells[column])] || ""]).filter(([, name]) => name));
  }

  function Card({ specimen, groups, names, views, selected, onselect }) {
    const tags = [specimen.set === "new" && S.new, specimen.mirrored && S.mirrored, specimen.groomed && S.groom.done, specimen.unit && S.unit(specimen.unit)].filter(Boolean);
    const scans = Studio.scansOf(specimen);
    return useMemo(() => html`
      <li class=${`card ${specimen.included ? "" : "excluded"}`} data-testid=${`card-${specimen.id}`} data-state=${specimen.state}>
        <button type="button" class="picture" aria-pressed=${selected} data-testid=${`select-${specimen.id}`} onclick=${(event) => onselect(specimen.id, event)}>
          <span class="hidden">${S.selectOne(specimen.id)}</span>
          ${scans.map((one) => html`<span class="scan">${one.state === "ready"
            ? html`<img class=${one.mirrored ? "mirrored" : ""} src=${`/api/thumbnails/${encodeURIComponent(one.id)}?scan=${one.scan}`} alt="" loading="lazy" />`
            : S.states[one.state]}</span>`)}
        </button>
        <div class="row"><${Studio.Include} specimen=${specimen} /><strong title=${specimen.id}>${specimen.id}</strong>${!specimen.part && html`<${Studio.ShowScan} specimen=${specimen} />`}</div>
        ${specimen.part && html`<div class="row parts">${scans.map((one) => html`<${Studio.ShowScan} key=${one.id} specimen=${one} />`)}</div>`}
        ${tags.length > 0 && html`<div class="row">${tags.map((tag) => html`<span class="tag">${tag}</span>`)}</div>`}
        ${groups !== "[]" && html`<div class="row">${JSON.parse(groups).map(([column, name, colour]) => html`<span class="tag group" title=${`${column}: ${name}`}>${colour && html`<i style=${{ background: colour }}></i>`}${name}</span>`)}</div>`}
        ${Studio.placed(specimen) > 0 && html`<p class="finding" data-testid=${`placed-${specimen.id}`}>${S.marks.placed(Studio.placed(specimen), names.length)}</p>`}
        ${scans.map((one) => html`<${Studio.Findings} key=${one.id} specimen=${one} />`)}
      </li>`, [groups, names, views, selected, onselect, scans.length, ...scans]);
  }

  /** Specimens that differ from the others, each with its view and a unit in which it would not. */
  const Odd = ({ project }) => {
    const line = ({ id, text, unit }) => html`<p key=${id} data-testid=${`odd-${id}`}><strong>${id}</strong>: ${text}
      ${unit && html` <${Button} edits small testid=${`odd-unit-${id}`} onclick=${() => Studio.edit({ what: "unit", ids: [id], unit })}>${S.odd.setUnit(S.unit(unit))}<//>`}
      <${Studio.ShowScan} specimen=${project.specimens.find((one) => one.id === id)} /></p>`;
    return project.odd.length > 0 && html`
      <section class="notes" aria-label=${S.odd.title} data-testid="odd"><h3>${S.odd.title}</h3>${project.odd.slice(0, FEW).map(line)}
        ${project.odd.length > FEW && html`<details><summary>${S.odd.more(project.odd.length - FEW)}</summary>${project.odd.slice(FEW, SHOWN).map(line)}</details>`}
      </section>`;
  };

  /** Notes on the table, and the number of specimens of each class. */
  const About = ({ project }) => html`
    <${Odd} project=${project} />
    ${project.notes.length > 0 && html`<section class="notes" aria-label=${S.notes} data-testid="notes"><h3>${S.notes}</h3>${project.notes.map((note) => html`<p>${note}</p>`)}</section>`}
    ${Object.keys(project.counts).length > 0 && html`
      <section aria-label=${S.classes} class="counts" data-testid="counts">
        ${Object.entries(project.counts).map(([column, classes]) => html`
          <dl key=${column}><dt>${column}</dt>${Object.entries(classes).map(([name, number]) => html`<dd><span class=${name ? "" : "hint"}>${name || S.noClass}</span> <b>${number}</b>
            <meter aria-hidden="true" min="0" max=${Math.max(...Object.values(classes))} value=${number}></meter></dd>`)}</dl>`)}
      </section>`}`;

  const AddFromHere = ({ onclose, set }) => {
    const [copy, setCopy] = useState(false);
    const add = Viewer.guarded(async (path) => {
      const { added, left_out: leftOut } = await Studio.json("/api/import", Viewer.post({ path, copy, set }));
      Studio.uploads = { total: added, done: added, added, notes: leftOut };
      onclose();
      await Studio.refresh();
    });
    return html`
      <${FolderBrowser} title=${S.addTitle} onclose=${onclose}>
        ${(listing) => html`
          <fieldset class="choices"><legend class="hidden">${S.addHere}</legend>
            ${[[false, S.byReference], [true, S.byCopy]].map(([value, text]) => html`<label class="check"><input type="radio" name="copy" checked=${copy === value} data-testid=${`copy-${value}`} onchange=${() => setCopy(value)} />${text}</label>`)}
          </fieldset>
          <div class="row end"><${Button} testid="folder-cancel" onclick=${onclose}>${T.cancel}<//>
            <${Button} strong testid="add-folder" disabled=${!listing.scans} onclick=${() => add(listing.path)}>${S.addFolder}<//></div>`}
      <//>`;
  };

  /** Buttons that add scans to `set`. */
  const AddButtons = (Studio.AddButtons = function AddButtons({ set, strong, table }) {
    const [browsing, setBrowsing] = useState(false);
    const add = (files) => Studio.upload(files, set);
    if (Studio.state.read_only) return null;
    return html`
      <${FileButton} strong=${strong} label=${S.chooseFiles} testid="choose-files" onfiles=${add} />
      <${FileButton} folder label=${S.chooseFolder} testid="choose-folder" onfiles=${add} />
      <${Button} testid="add-here" onclick=${() => setBrowsing(true)}>${S.addHere}<//>
      ${table && html`<${FileButton} label=${S.importTable} testid="import-table" accept=".csv,.tsv,.xlsx" onfiles=${add} />`}
      ${table && html`<${FileButton} label=${S.importLandmarks} testid="import-landmarks" onfiles=${(files) => Studio.upload(files, set, "landmarks")} />`}
      ${browsing && html`<${AddFromHere} set=${set} onclose=${() => setBrowsing(false)} />`}`;
  });

  const Empty = () => html`
    <div class="empty" data-testid="empty">
      <h2>${S.dropTitle}</h2><p class="hint">${S.dropHint(Studio.state.formats.join(", "))}</p>
      <div class="row"><${AddButtons} set="training" strong /></div>
    </div>`;

  /** Write one class into a column of the selected specimens, which is added where it is new. */
  function Group({ ids, onclose }) {
    const { columns } = Studio.state.project;
    const [column, setColumn] = useState(columns[0] || S.groupColumn);
    const [value, setValue] = useState("");
    const seen = useRef(Studio.state.project.specimens); // the cells that the user saw; another tab may change them in the meantime
    const save = async (event) => {
      event.preventDefault();
      const name = column.trim();
      const before = Object.fromEntries(seen.current.map((one) => [one.id, one.cells[name] || ""]));
      const isThere = columns.includes(name) || (await Studio.edit({ what: "add-column", column: name }));
      if (isThere && (await Studio.edit({ what: "cells", cells: ids.map((id) => ({ id, column: name, value, before: before[id] })) }))) onclose();
      else seen.current = Studio.state.project.specimens;
    };
    return html`
      <form class="row inline" data-testid="group-form" onsubmit=${save}>
        <label>${S.groupIn} <input list="group-columns" required size="10" data-testid="group-column" value=${column} oninput=${(event) => setColumn(event.target.value)} /></label>
        <datalist id="group-columns">${columns.map((name) => html`<option value=${name}></option>`)}</datalist>
        <label>${S.groupName} <input required size="10" data-testid="group-value" value=${value} oninput=${(event) => setValue(event.target.value)} /></label>
        <button class="small strong" data-testid="group-save" disabled=${!column.trim() || !value.trim()}>${S.add}</button>
        <${Button} small testid="group-cancel" onclick=${onclose}>${T.cancel}<//>
      </form>`;
  }

  /** Join scans called SPECIMEN_PART to specimens of several parts. */
  function JoinParts({ selected, onclose }) {
    const ends = selected.map((one) => /^.+[_.-]([^_.-]*[^\d_.-][^_.-]*)$/.exec(one.id)).filter(Boolean).map((found) => found[1]);
    const [names, setNames] = useState([...new Set(ends)].join(", "));
    const join = async (event) => {
      event.preventDefault();
      if (await Studio.edit({ what: "parts", ids: selected.map((one) => one.id), parts: names.split(",") })) onclose();
    };
    return html`
      <form class="row inline" data-testid="parts-form" onsubmit=${join}>
        <label>${S.parts.names} <input required size="24" data-testid="parts-names" value=${names} oninput=${(event) => setNames(event.target.value)} /></label>
        <button class="small strong" data-testid="parts-join" disabled=${!names.trim()}>${S.parts.join}</button>
        <${Button} small testid="parts-cancel" onclick=${onclose}>${T.cancel}<//>
        <p class="hint">${S.parts.hint}</p>
      </form>`;
  }

  /** What is done with the selected specimens. */
  Studio.SelectionBar = function SelectionBar({ selected, onclear }) {
    const [removing, setRemoving] = useState(false);
    const [grouping, setGrouping] = useState(false);
    const [grooming, setGrooming] = useState(false);
    const [joining, setJoining] = useState(false);
    if (Studio.state.read_only) return null;
    const ids = selected.map((one) => one.id);
    const toNew = selected.some((one) => one.set === "training"), mirrored = selected.some((one) => !one.mirrored);
    const include = (included) => Studio.edit({ what: "include", ids, included });
    return html`
      <div class="row selection" role="group" aria-label=${S.selected(ids.length)} data-testid="selection">
        <strong role="status">${S.selected(ids.length)}</strong>
        <${Button} small testid="include-selected" onclick=${() => include(true)}>${S.include}<//>
        <${Button} small testid="exclude-selected" onclick=${() => include(false)}>${S.exclude}<//>
        <${Button} small testid="set-selected" onclick=${() => Studio.edit({ what: "set", ids, set: toNew ? "new" : "training" })}>${toNew ? S.toNew : S.toTraining}<//>
        <${Button} small testid="group-selected" disabled=${grouping} onclick=${() => setGrouping(true)}>${S.group}<//>
        ${selected.length > 1 && selected.every((one) => !one.part) && html`<${Button} small testid="parts-selected" disabled=${joining} onclick=${() => setJoining(true)}>${S.parts.open}<//>`}
        <${Button} small testid="mirror-selected" onclick=${() => Studio.edit({ what: "mirror", ids, mirrored })}>${mirrored ? S.mirror : S.unmirror}<//>
        <${Button} small testid="groom-selected" disabled=${grooming} onclick=${() => setGrooming(true)}>${S.groom.open}<//>
        <label>${S.columns.unit} <${Studio.Unit} aria-label=${S.setUnit} data-testid="unit-selected" value=${selected.every((one) => one.unit === selected[0].unit) ? selected[0].unit : ""}
          onunit=${(select) => Studio.edit({ what: "unit", ids, unit: select.value })} /></label>
        <${Button} small testid="remove-selected" onclick=${() => setRemoving(true)}>${S.remove}<//>
        <${Button} small testid="clear-selection" onclick=${onclear}>${S.clear}<//>
        ${/* Last, on a line of its own: where it stood between the buttons, a click that met its closing went to another of them. */ grouping && html`<${Group} ids=${ids} onclose=${() => setGrouping(false)} />`}
        ${joining && html`<${JoinParts} selected=${selected} onclose=${() => { setJoining(false); onclear(); }} />`}
        ${grooming && html`<${Studio.GroomForm} specimens=${selected} onclose=${() => setGrooming(false)} />`}
        ${removing && html`<${Confirm} title=${S.removeTitle(ids.length)} text=${S.removeText} action=${S.remove} onclose=${() => setRemoving(false)}
          onyes=${async () => { if (await Studio.edit({ what: "remove", ids })) onclear(); }} />`}
      </div>`;
  };

  const matches = (specimen, words) => {
    const found = Studio.scansOf(specimen).flatMap((one) => [one.part, ...one.findings.map((finding) => finding.text)]);
    const text = [specimen.id, specimen.set === "new" ? S.new : "", ...Object.values(specimen.cells), ...found].join(" ").toLowerCase();
    return words.every((word) => text.includes(word));
  };

  Studio.Specimens = function Specimens({ project, next }) {
    const [layout, setLayout] = useState(project.columns.length ? "table" : "cards");
    const [filter, setFilter] = useState("");
    const [limit, setLimit] = useState(SHOWN);
    const [selection, setSelection] = useState(new Set());
    const words = filter.toLowerCase().split(/\s+/).filter(Boolean);
    const listed = project.rows.filter((one) => matches(one, words));
    const shown = listed.slice(0, limit);
    const order = useRef({ listed, last: null });
    order.current.listed = listed;
    const select = useCallback((id, event) => setSelection((before) => {
      const after = new Set(before), ids = order.current.listed.map((one) => one.id);
      const from = ids.indexOf(order.current.last), to = ids.indexOf(id);
      const range = event.shiftKey && from >= 0 ? ids.slice(Math.min(from, to), Math.max(from, to) + 1) : [id];
      const add = !before.has(id);
      for (const one of range) { if (add) after.add(one); else after.delete(one); }
      order.current.last = id;
      return after;
    }), []);
    const selected = project.rows.filter((one) => selection.has(one.id));
    const all = listed.length > 0 && listed.every((one) => selection.has(one.id));
    const selectAll = () => setSelection(new Set(all ? [] : listed.map((one) => one.id)));
    const included = project.rows.filter((one) => one.included && one.state !== "unusable").length;
    const unusable = project.rows.filter((one) => one.state === "unusable").length;
    const add = (files) => Studio.upload(files, "training");
    if (!project.specimens.length) return html`<${DropZone} testid="drop-zone" class="fill" onfiles=${add}><${UploadStatus} /><${Empty} /><//>`;
    return html`
      <${DropZone} testid="drop-zone" class="fill scroll" onfiles=${add}>
        <div class="row bar">
          <h2 data-testid="specimens-summary">${S.summary(project.rows.length, included, unusable)}</h2><span class="grow"></span>
          <${AddButtons} set="training" table />
          <${Button} strong=${included > 0} testid="next" onclick=${next}>${T.next.specimens}<//>
        </div>
        <${UploadStatus} />
        <${About} project=${project} />
        <div class="row bar">
          <div class="segments" role="group" aria-label=${S.layout}>
            ${["cards", "table"].map((name) => html`<button type="button" data-testid=${`layout-${name}`} aria-pressed=${layout === name} onclick=${() => setLayout(name)}>${S[name]}</button>`)}
          </div>
          <label class="filter">${S.filter} <input type="search" placeholder=${S.filterHint} data-testid="filter" value=${filter} oninput=${(event) => setFilter(event.target.value)} /></label>
          <${Button} edits testid="undo" disabled=${!project.undo || Studio.uploading()} title=${project.undo ? S.undoOf(project.undo) : S.undo} onclick=${Studio.undo}>${S.undo}<//>
          <${Button} edits testid="redo" disabled=${!project.redo || Studio.uploading()} title=${project.redo ? S.redoOf(project.redo) : S.redo} onclick=${Studio.redo}>${S.redo}<//>
          <${Studio.ManageLandmarks} project=${project} />
          ${layout === "table" ? html`<${Studio.AddColumn} />` : html`<${Button} testid="select-all" onclick=${selectAll}>${all ? S.clear : S.selectAll}<//>`}
          ${selected.length > 0 && html`<${Studio.SelectionBar} selected=${selected} onclear=${() => setSelection(new Set())} />`}
        </div>
        ${!listed.length && html`<p class="hint">${S.nothing}</p>`}
        ${layout === "cards"
          ? html`<ul class="cards" data-testid="cards">${shown.map((one) => html`<${Card} key=${one.id} specimen=${one} groups=${groupsOf(one, project.counts)} names=${project.point_names} views=${project.views} selected=${selection.has(one.id)} onselect=${select} />`)}</ul>`
          : html`<${Studio.Table} listed=${listed} shown=${shown} columns=${project.columns} selection=${selection} onselect=${select} onselectall=${selectAll} />`}
        ${listed.length > limit && html`<${Button} class="more" testid="show-more" onclick=${() => setLimit(limit + SHOWN)}>${S.more(Math.min(SHOWN, listed.length - limit))}<//>`}
      <//>`;
  };
})();
