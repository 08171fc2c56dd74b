/* The table of specimens, edited in place: typing, Enter, Tab, arrow keys, and blocks pasted from a spreadsheet. */
(function () {
  "use strict";

  const { html, useState, useMemo, useRef, useEffect } = window.Preact;
  const Viewer = window.ShapespaceViewer;
  const Studio = window.ShapespaceStudio;
  const T = window.ShapespaceTexts;
  const S = T.specimens;
  const { Button, Confirm, Dialog } = Studio;
  const MOST_PREVIEWED = 100; // rows of a pasted block that are shown before it is pasted

  /** Move to the cell `down` rows and `right` columns from `input`. */
  function move(input, down, right) {
    const row = Number(input.dataset.row) + down, column = Number(input.dataset.column) + right;
    const next = input.closest("table").querySelector(`input[data-row="${row}"][data-column="${column}"]`);
    if (next) { next.focus(); next.select(); }
    return Boolean(next);
  }

  /** Rows and columns of pasted text, where a spreadsheet put quotation marks around cells with line breaks or quotation marks. */
  function block(pasted) {
    const text = pasted.replace(/\r\n?/g, "\n").replace(/\n$/, ""), rows = [[]];
    let cell = "", isQuoted = false;
    const end = () => { rows.at(-1).push(cell); cell = ""; };
    for (let k = 0; k < text.length; k++) {
      const letter = text[k];
      if (isQuoted) {
        if (letter !== '"') cell += letter;
        else if (text[k + 1] === '"') cell += text[++k];
        else isQuoted = false;
      } else if (letter === '"' && cell === "") isQuoted = true;
      else if (letter === "\t") end();
      else if (letter === "\n") { end(); rows.push([]); } else cell += letter;
    }
    end();
    // A quotation mark that does not end, as of inches, is a letter.
    return isQuoted ? text.split("\n").map((line) => line.split("\t")) : rows;
  }

  /** A cell: its text is sent when it is left; Escape restores it. */
  function Cell({ value, label, testid, row, column, onedit, onblock }) {
    const [draft, setDraft] = useState(null);
    const current = useRef(null); // the draft at once, as a key may follow before the next drawing
    const before = useRef(value); // the text that the user began to edit; another tab may change it in the meantime
    const set = (text) => { if (current.current === null) before.current = value; current.current = text; setDraft(text); };
    const send = async () => {
      const text = current.current;
      if (text === null) return;
      if (text.trim() !== value || value !== before.current) await onedit(text.trim(), before.current);
      if (current.current === text) set(null);
    };
    const key = (event) => {
      if (event.isComposing) return; // Enter and arrow keys are those of an input method
      const input = event.target, caret = input.selectionStart === input.selectionEnd ? input.selectionStart : -1;
      const all = input.selectionEnd - input.selectionStart === input.value.length;
      if (event.key === "Escape") { set(null); return; }
      const down = { Enter: event.shiftKey ? -1 : 1, ArrowDown: 1, ArrowUp: -1 }[event.key] || 0;
      let right = 0;
      if (event.key === "ArrowRight" && (all || caret === input.value.length)) right = 1;
      if (event.key === "ArrowLeft" && (all || caret === 0)) right = -1;
      if (!down && !right) return;
      event.preventDefault();
      if (!move(input, down, right) && event.key === "Enter") send();
    };
    const paste = (event) => {
      const rows = block(event.clipboardData.getData("text/plain"));
      if (!onblock || (rows.length === 1 && rows[0].length === 1)) return;
      event.preventDefault();
      set(null);
      onblock(rows);
    };
    return html`<td class=${column ? "" : "name"}><input class="entry" size="8" style=${{ minWidth: `var(--width-${column})` }} aria-label=${label} data-testid=${testid} data-row=${row} data-column=${column} value=${draft === null ? value : draft} title=${value} readonly=${Studio.state.read_only}
      data-edited=${draft !== null} oninput=${(event) => set(event.target.value)} onblur=${send} onkeydown=${key} onpaste=${paste} /></td>`;
  }

  const setUnit = (specimen, select) => Studio.editBy({ what: "unit", ids: [specimen.id], unit: select.value }, () => { select.value = specimen.unit; });
  const setMirror = (specimen, box) => Studio.editBy({ what: "mirror", ids: [specimen.id], mirrored: box.checked }, () => { box.checked = specimen.mirrored; });

  function Row({ specimen, row, columns, names, views, selected, onselect, onblock }) {
    // Unchanged rows are not compared again; the state keeps unchanged specimens.
    const scans = Studio.scansOf(specimen);
    return useMemo(() => html`
      <tr class=${`${specimen.included ? "" : "excluded"} ${selected ? "selected" : ""}`} data-testid=${`row-${specimen.id}`}>
        <td class="tick"><input type="checkbox" checked=${selected} aria-label=${S.selectOne(specimen.id)} data-testid=${`select-${specimen.id}`} onclick=${(event) => onselect(specimen.id, event)} /></td>
        <td class="tick"><${Studio.Include} specimen=${specimen} /></td>
        <${Cell} value=${specimen.id} label=${S.rename(specimen.id)} testid=${`cell-${specimen.id}-id`} row=${row} column=${0}
          onedit=${(to) => to && Studio.edit({ what: "rename", id: specimen.id, to })} onblock=${(rows) => onblock(specimen.id, "", rows)} />
        ${columns.map((name, k) => html`<${Cell} key=${name} value=${specimen.cells[name] || ""} label=${S.cell(name, specimen.id)} testid=${`cell-${specimen.id}-${name}`} row=${row} column=${k + 1}
          onedit=${(value, before) => Studio.edit({ what: "cells", cells: [{ id: specimen.id, column: name, value, before }] })} onblock=${(rows) => onblock(specimen.id, name, rows)} />`)}
        <td>${specimen.set === "new" ? S.new : S.training}</td>
        <td><${Studio.Unit} aria-label=${S.unitOf(specimen.id)} data-testid=${`unit-${specimen.id}`} disabled=${Studio.state.read_only} value=${specimen.unit} onunit=${(select) => setUnit(specimen, select)} /></td>
        <td class="tick"><input type="checkbox" checked=${specimen.mirrored} aria-label=${S.mirrorOne(specimen.id)} data-testid=${`mirror-${specimen.id}`} disabled=${Studio.state.read_only} onchange=${(event) => setMirror(specimen, event.target)} /></td>
        ${names.length > 0 && html`<td class="number" data-testid=${`placed-${specimen.id}`}>${Studio.placed(specimen) || ""}</td>`}
        <td class="number">${specimen.extent ? specimen.extent.toLocaleString("en", { maximumSignificantDigits: 3 }) : ""}</td>
        <td class="number">${specimen.triangles ? specimen.triangles.toLocaleString("en") : ""}</td>
        <td>${scans.map((one) => html`<${Studio.ShowScan} key=${one.id} specimen=${one} />`)}</td>
        <td class="findings">${scans.map((one) => html`<${Studio.Findings} key=${one.id} specimen=${one} />`)}</td>
      </tr>`, [scans.length, ...scans, row, columns, names, views, selected, onselect, onblock]);
  }

  function AddColumn() {
    const [name, setName] = useState(null);
    const ref = useRef(null);
    useEffect(() => { if (ref.current) ref.current.focus(); }, [name === null]);
    const add = async (event) => {
      event.preventDefault();
      if (!(await Studio.edit({ what: "add-column", column: name.trim() }))) return;
      setName(null);
      document.querySelector(`input[data-row="0"][data-column="${Studio.state.project.columns.length}"]`)?.focus(); // its first cell
    };
    if (name === null) return html`<${Button} edits testid="add-column" onclick=${() => setName("")}>${S.addColumn}<//>`;
    return html`
      <form class="row inline" onsubmit=${add}>
        <input ref=${ref} aria-label=${S.columnName} placeholder=${S.columnName} required data-testid="column-name" value=${name} oninput=${(event) => setName(event.target.value)}
          onkeydown=${(event) => { if (event.key === "Escape") setName(null); }} />
        <button class="small" data-testid="column-add">${S.add}</button>
      </form>`;
  }

  Studio.AddColumn = AddColumn;

  /** The specimens and cells of a pasted block, before it is pasted. */
  function Preview({ match, onclose }) {
    const columns = [...new Set(Object.values(match.cells).flatMap(Object.keys))], rows = Object.entries(match.cells);
    const paste = async () => { if (await Studio.edit({ what: "block", columns: match.columns, cells: match.cells, seen: match.seen })) onclose(); };
    return html`
      <${Dialog} title=${S.paste.title(rows.length)} testid="paste" onclose=${onclose} wide>
        <p>${match.by_name ? S.paste.byName : S.paste.byPosition}</p>
        ${match.columns.length > 0 && html`<p>${S.paste.columns(match.columns)}</p>`}
        ${match.notes.length > 0 && html`<ul data-testid="paste-notes">${match.notes.map((note) => html`<li>${note}</li>`)}</ul>`}
        <div class="table-box preview" role="region" aria-label=${S.paste.title(rows.length)} tabindex="0"><table class="plain">
          <thead><tr><th scope="col">${S.columns.id}</th>${columns.map((name) => html`<th scope="col">${name}</th>`)}</tr></thead>
          <tbody>${rows.slice(0, MOST_PREVIEWED).map(([id, cells]) => html`<tr key=${id}><th scope="row">${id}</th>${columns.map((name) => html`<td>${cells[name]}</td>`)}</tr>`)}</tbody></table></div>
        ${rows.length > MOST_PREVIEWED && html`<p class="hint">${S.more(rows.length - MOST_PREVIEWED)}</p>`}
        <div class="row end"><${Button} testid="paste-cancel" onclick=${onclose}>${T.cancel}<//>
          <${Button} strong testid="paste-yes" disabled=${!rows.length} onclick=${paste}>${S.paste.action}<//></div>
      <//>`;
  }

  /** Widths of the columns that are edited, after the longest of their texts. */
  function widths(listed, columns) {
    const longest = [["", 12, 40], ...columns.map((name) => [name, 6, 22])].map(([name, least, most]) => Math.min(most, Math.max(least, ...listed.map((one) => (name ? one.cells[name] || "" : one.id).length))));
    return Object.fromEntries(longest.map((letters, k) => [`--width-${k}`, `${letters + 2}ch`]));
  }

  /** A table of `listed`; pasted blocks go on to specimens that are not shown yet. */
  Studio.Table = function Table({ listed, shown, columns, selection, onselect, onselectall }) {
    const { point_names: names, views } = Studio.state.project;
    const [removing, setRemoving] = useState(null);
    const [pasting, setPasting] = useState(null);
    const order = useRef(listed);
    order.current = listed;
    const onblock = useMemo(() => Viewer.guarded(async (id, column, rows) => {
      const from = order.current.findIndex((one) => one.id === id);
      const match = await Studio.post("/api/paste", { rows, column, order: order.current.slice(from).map((one) => one.id) });
      if (match.certain) await Studio.edit({ what: "block", columns: match.columns, cells: match.cells });
      else setPasting(match);
    }), []);
    const all = listed.length > 0 && listed.every((one) => selection.has(one.id));
    return html`
      ${!Studio.state.read_only && html`<p class="hint">${S.pasteHint}</p>`}
      <div class="table-box" role="region" aria-label=${S.tableLabel} tabindex="0">
        <table data-testid="table" style=${widths(listed, columns)}>
          <caption class="hidden">${S.tableLabel}</caption>
          <thead><tr>
            <th scope="col"><input type="checkbox" checked=${all} aria-label=${S.selectAll} data-testid="select-all" onclick=${onselectall} /></th>
            <th scope="col">${S.columns.use}</th><th scope="col" class="name">${S.columns.id}</th>
            ${columns.map((name) => html`<th scope="col" key=${name}><span class="head">${name}
              <${Button} edits small class="quiet" aria-label=${S.removeColumn(name)} testid=${`remove-column-${name}`} onclick=${() => setRemoving(name)}>×<//></span></th>`)}
            <th scope="col">${S.columns.set}</th><th scope="col">${S.columns.unit}</th><th scope="col">${S.columns.mirror}</th>
            ${names.length > 0 && html`<th scope="col" class="number">${S.marks.title}</th>`}<th scope="col" class="number">${S.columns.extent}</th><th scope="col" class="number">${S.columns.size}</th><th scope="col">${S.scan.open}</th><th scope="col">${S.columns.findings}</th>
          </tr></thead>
          <tbody>${shown.map((specimen, row) => html`<${Row} key=${specimen.id} specimen=${specimen} row=${row} columns=${columns} names=${names} views=${views} selected=${selection.has(specimen.id)} onselect=${onselect} onblock=${onblock} />`)}</tbody>
        </table>
      </div>
      ${pasting !== null && html`<${Preview} match=${pasting} onclose=${() => setPasting(null)} />`}
      ${removing !== null && html`<${Confirm} title=${S.removeColumnTitle(removing)} text=${S.removeColumnText} action=${S.remove} onclose=${() => setRemoving(null)}
        onyes=${() => Studio.edit({ what: "remove-column", column: removing })} />`}`;
  };
})();
