/* Small components of several screens: dialogs, file buttons, drop zones, the folder browser, upload progress. */
(function () {
  "use strict";

  const { html, useState, useEffect, useRef } = window.Preact;
  const Viewer = window.ShapespaceViewer;
  const Studio = window.ShapespaceStudio;
  const T = window.ShapespaceTexts;

  /** A button; properties as of the element. One that `edits` the project is not there where it is only shown. */
  const Button = ({ strong, small, testid, edits, children, class: extra = "", ...rest }) => edits && Studio.state.read_only ? null : html`
    <button type="button" class=${`${strong ? "strong" : ""} ${small ? "small" : ""} ${extra}`} data-testid=${testid} ...${rest}>${children}</button>`;

  /** A modal dialog; Escape closes it. The focus goes back to the button that opened it. */
  function Dialog({ title, testid, onclose, children, wide }) {
    const ref = useRef(null);
    useEffect(() => {
      const opener = document.activeElement;
      ref.current.showModal();
      return () => opener.focus({ preventScroll: true });
    }, []);
    return html`<dialog ref=${ref} class=${wide ? "wide" : ""} aria-label=${title} data-testid=${testid} onclose=${onclose}><h2>${title}</h2>${children}</dialog>`;
  }

  /** A question before something is removed. */
  const Confirm = ({ title, text, action, onyes, onclose }) => html`
    <${Dialog} title=${title} testid="confirm" onclose=${onclose}>
      <p>${text}</p>
      <div class="row end">
        <${Button} testid="confirm-cancel" onclick=${onclose}>${T.cancel}<//>
        <${Button} strong testid="confirm-yes" onclick=${() => { onclose(); onyes(); }}>${action}<//>
      </div>
    <//>`;

  /** A button that opens the system's file dialog. */
  function FileButton({ label, testid, onfiles, folder, accept, strong }) {
    const ref = useRef(null);
    useEffect(() => { if (folder) ref.current.webkitdirectory = true; }, [folder]);
    const chosen = (event) => { onfiles(Array.from(event.target.files)); event.target.value = ""; };
    return html`
      <${Button} strong=${strong} testid=${testid} onclick=${() => ref.current.click()}>${label}<//>
      <input ref=${ref} type="file" multiple=${!accept} accept=${accept} hidden data-testid=${`${testid}-input`} aria-label=${label} onchange=${chosen} />`;
  }

  /** Its content, which takes dropped files and folders. */
  function DropZone({ onfiles, testid, class: extra = "", children }) {
    if (Studio.state.read_only) return html`<div class=${extra} data-testid=${testid}>${children}</div>`;
    return html`<${Droppable} onfiles=${onfiles} testid=${testid} class=${extra}>${children}<//>`;
  }

  function Droppable({ onfiles, testid, class: extra, children }) {
    const [over, setOver] = useState(0);
    const hasFiles = (event) => Array.from(event.dataTransfer.types).includes("Files");
    const drop = Viewer.guarded(async (event) => { onfiles(await Studio.filesOfDrop(event.dataTransfer)); });
    return html`
      <div class=${`drop-zone ${over > 0 ? "over" : ""} ${extra}`} data-testid=${testid}
        ondragenter=${(event) => { if (hasFiles(event)) { event.preventDefault(); setOver((depth) => depth + 1); } }}
        ondragover=${(event) => { if (hasFiles(event)) event.preventDefault(); }}
        ondragleave=${(event) => { if (hasFiles(event)) setOver((depth) => depth - 1); }}
        ondrop=${(event) => { event.preventDefault(); setOver(0); drop(event); }}>${children}</div>`;
  }

  /** What is being added, and what was not. */
  function UploadStatus() {
    const { total, done, added, notes } = Studio.uploads;
    if (!total || (!Studio.uploading() && !added && !notes.length && !Studio.volumes.length)) return null; // volumes became specimens
    return html`
      <div class="uploads" data-testid="uploads">
        <p role="status">${Studio.uploading() ? T.uploads.progress(done, total) : added || notes.length ? T.uploads.finished(added) : ""}</p>
        ${Studio.uploading() && html`<progress class="upload-bar" max=${total} value=${done} aria-label=${T.uploads.progress(done, total)}></progress>`}
        ${notes.length > 0 && html`<details open=${notes.length <= 3}><summary>${T.count(notes.length, "note")}</summary>
          <ul data-testid="upload-notes">${notes.slice(0, 200).map((note) => html`<li>${note}</li>`)}</ul></details>`}
        ${!Studio.uploading() && Studio.volumes.length > 0 && html`<${Studio.VolumeLabels} volumes=${Studio.volumes} />`}
        ${!Studio.uploading() && html`<${Button} small testid="uploads-close" onclick=${() => { Studio.clearUploads(); Studio.changed(); }}>${T.close}<//>`}
      </div>`;
  }

  /** Folders of this machine; `children` gets the listing and returns the dialog's own controls. */
  function FolderBrowser({ title, onclose, children }) {
    const [listing, setListing] = useState(null);
    const [typed, setTyped] = useState("");
    const [error, setError] = useState("");
    const go = async (path) => {
      try {
        const answer = await Studio.json(`/api/folders?path=${encodeURIComponent(path)}`);
        setListing(answer);
        setTyped(answer.path);
        setError("");
      } catch (problem) {
        setError(problem.message);
      }
    };
    useEffect(() => { go(""); }, []);
    const join = (name) => `${listing.path.replace(/[\\/]$/, "")}${listing.path.includes("\\") ? "\\" : "/"}${name}`;
    return html`
      <${Dialog} title=${title} testid="folder-browser" onclose=${onclose} wide>
        <div class="row path">
          <label for="folder-path">${T.folders.path}</label>
          <input id="folder-path" data-testid="folder-path" value=${typed} oninput=${(event) => setTyped(event.target.value)}
            onkeydown=${(event) => { if (event.key === "Enter" && !event.isComposing) go(typed); }} />
          <${Button} testid="folder-go" onclick=${() => go(typed)}>${T.folders.go}<//>
        </div>
        ${error && html`<p class="problem" role="alert">${error}</p>`}
        ${listing && html`
          <ul class="folders" aria-label=${T.folders.label}>
            ${listing.parent !== null && html`<li><button type="button" data-testid="folder-up" onclick=${() => go(listing.parent)}>${T.folders.up}</button></li>`}
            ${listing.folders.map((name) => html`<li key=${name}><button type="button" data-testid=${`folder-${name}`} onclick=${() => go(join(name))}>${name}</button></li>`)}
          </ul>
          ${!listing.folders.length && html`<p class="hint">${T.folders.empty}</p>`}
          <p class="hint" role="status" data-testid="folder-about">${listing.is_project ? T.folders.isProject : T.folders.scans(listing.scans)}</p>
          ${children(listing, join)}`}
      <//>`;
  }

  /** A button that copies a text; browsers without a clipboard get it selected in a field. */
  function CopyButton({ text, label, testid, strong }) {
    const [copied, setCopied] = useState(false);
    const copy = Viewer.guarded(async () => {
      await navigator.clipboard.writeText(typeof text === "function" ? await text() : text);
      setCopied(true);
      setTimeout(() => setCopied(false), 2000);
    });
    return html`<${Button} small=${!strong} strong=${strong} testid=${testid} onclick=${copy}><span aria-live="polite">${copied ? T.jobs.copied : label}</span><//>`;
  }

  /** Arrow keys, Home and End move along buttons of a group. */
  function moveFocus(event) {
    const keys = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1, Home: -Infinity, End: Infinity };
    if (!(event.key in keys)) return;
    const all = Array.from(event.currentTarget.querySelectorAll("[role=tab]"));
    const step = keys[event.key], at = all.indexOf(document.activeElement);
    const next = Number.isFinite(step) ? (at + step + all.length) % all.length : step > 0 ? all.length - 1 : 0;
    event.preventDefault();
    all[next].focus();
  }

  Object.assign(Studio, { Button, Dialog, Confirm, FileButton, DropZone, UploadStatus, FolderBrowser, CopyButton, moveFocus });
})();
