/* The start screen: new, open and recent projects. */
(function () {
  "use strict";

  const { html, useState } = window.Preact;
  const { Studio, T } = { Studio: window.ShapespaceStudio, T: window.ShapespaceTexts };
  const { Button, FolderBrowser } = Studio;

  function NewProject({ onclose }) {
    const [name, setName] = useState("shapes");
    return html`
      <${FolderBrowser} title=${T.start.newTitle} onclose=${onclose}>
        ${(listing, join) => html`
          <form class="row end" onsubmit=${(event) => { event.preventDefault(); Studio.act("/api/open", { folder: join(name.trim()), create: true }); }}>
            <label for="new-name">${T.start.newName}</label>
            <input id="new-name" data-testid="new-name" required value=${name} oninput=${(event) => setName(event.target.value)} />
            <${Button} testid="folder-cancel" onclick=${onclose}>${T.cancel}<//>
            <button class="strong" data-testid="create" disabled=${!name.trim()}>${T.start.create}</button>
          </form>`}
      <//>`;
  }

  const OpenProject = ({ onclose }) => html`
    <${FolderBrowser} title=${T.start.openTitle} onclose=${onclose}>
      ${(listing) => html`
        <div class="row end">
          <${Button} testid="folder-cancel" onclick=${onclose}>${T.cancel}<//>
          <${Button} strong testid="open-this" disabled=${!listing.is_project} onclick=${() => Studio.act("/api/open", { folder: listing.path, create: false })}>${T.start.openThis}<//>
        </div>`}
    <//>`;

  Studio.Start = function Start({ recent }) {
    const [dialog, setDialog] = useState(null);
    const close = () => setDialog(null);
    return html`
      <main id="screen" class="start" tabindex="-1" data-testid="start">
        <h2>${T.start.title}</h2>
        <p class="hint">${T.start.intro}</p>
        <div class="row">
          <${Button} strong testid="new-project" onclick=${() => setDialog("new")}>${T.start.new}<//>
          <${Button} testid="open-project" onclick=${() => setDialog("open")}>${T.start.open}<//>
        </div>
        <h3>${T.start.recent}</h3>
        ${recent.length === 0 && html`<p class="hint">${T.start.none}</p>`}
        <ul class="recent">
          ${recent.map((one) => html`<li key=${one.folder}>
            <button type="button" data-testid=${`recent-${one.name}`} disabled=${!one.exists} onclick=${() => Studio.act("/api/open", { folder: one.folder, create: false })}>
              <strong>${one.name}</strong><span class="hint">${one.folder}${one.exists ? "" : ` (${T.start.moved})`}</span>
            </button></li>`)}
        </ul>
        ${dialog === "new" && html`<${NewProject} onclose=${close} />`}
        ${dialog === "open" && html`<${OpenProject} onclose=${close} />`}
      </main>`;
  };
})();
