/* Label volumes that were dropped: which labels form the object, and the smoothing of its surface. */
(function () {
  "use strict";

  const { html, useState, useEffect } = window.Preact;
  const Viewer = window.ShapespaceViewer;
  const Studio = window.ShapespaceStudio;
  const T = window.ShapespaceTexts;
  const V = T.specimens.volumes;
  const { Button, Dialog } = Studio;

  /** The labels of all volumes, each with its number of voxels and of volumes. */
  function together(found) {
    const labels = new Map();
    for (const { choice, name, voxels } of found.flatMap((volume) => volume.labels)) {
      const known = labels.get(choice) || { choice, name, voxels: 0, volumes: 0 };
      labels.set(choice, { ...known, voxels: known.voxels + voxels, volumes: known.volumes + 1 });
    }
    return [...labels.values()];
  }

  /** Asks once for all volumes of a drop. */
  Studio.VolumeLabels = function VolumeLabels({ volumes }) {
    const smoothing = Studio.forms.surface.options.find((option) => option.flag === "--smooth");
    const [found, setFound] = useState([]); // volumes with their labels, or with an error
    const [ticked, setTicked] = useState(null); // labels that the user chose
    const [smooth, setSmooth] = useState("");
    useEffect(() => {
      let ended = false;
      const read = async () => {
        for (const volume of volumes) {
          let labels = [], error = "";
          try { labels = await Studio.post("/api/labels", { file: volume.file }); } catch (problem) { error = problem.message; }
          if (ended) return;
          setFound((before) => [...before, { ...volume, labels, error }]);
        }
      };
      read();
      return () => { ended = true; };
    }, []);
    const labels = together(found), readable = found.filter((volume) => !volume.error), isRead = found.length === volumes.length;
    const chosen = ticked || (labels.length === 1 ? [labels[0].choice] : []);
    const has = (volume) => chosen.every((choice) => volume.labels.some((label) => label.choice === choice));
    const usable = chosen.length ? readable.filter(has) : [];
    const lacking = chosen.length ? readable.filter((volume) => !has(volume)) : [];
    const close = async (used) => {
      const files = volumes.map((volume) => volume.file).filter((file) => !used.includes(file));
      Studio.volumes = [];
      Studio.changed();
      if (files.length) await Studio.json("/api/volumes", { ...Viewer.post({ files }), method: "DELETE" });
    };
    const make = Viewer.guarded(async () => {
      const files = usable.map((volume) => volume.file), options = { files, set: usable[0].set, "--label": chosen.join(",") };
      if (smooth.trim()) options["--smooth"] = smooth.trim();
      if (await Studio.runJob("surface", options)) await close(files);
    });
    const toggle = ({ choice }) => setTicked(chosen.includes(choice) ? chosen.filter((other) => other !== choice) : [...chosen, choice]);
    return html`
      <${Dialog} title=${V.title(volumes.length)} testid="volumes" onclose=${Viewer.guarded(() => Studio.volumes === volumes && close([]))} wide>
        ${!isRead && html`<p class="hint" role="status">${V.reading(found.length + 1, volumes.length)}</p><progress max=${volumes.length} value=${found.length} aria-label=${V.reading(found.length + 1, volumes.length)}></progress>`}
        ${found.filter((volume) => volume.error).map((volume) => html`<p class="problem" role="alert">${volume.error}</p>`)}
        ${labels.length > 0 && html`
          <fieldset class="choices labels"><legend>${V.which}</legend>
            ${labels.map((label) => html`<label class="check" key=${label.choice}><input type="checkbox" data-testid=${`label-${label.choice}`} checked=${chosen.includes(label.choice)} onchange=${() => toggle(label)} />${V.label(label.name, label.voxels, label.volumes, readable.length)}</label>`)}
          </fieldset>
          <p class="hint">${V.together}</p>
          <label>${smoothing.label} <input inputmode="decimal" size="5" data-testid="volumes-smooth" placeholder=${T.jobs.default} value=${smooth} oninput=${(event) => setSmooth(event.target.value)} /></label> <span class="hint">${smoothing.help}</span>
          ${isRead && lacking.map((volume) => html`<p class="problem">${V.lacks(volume.name)}</p>`)}
          ${isRead && usable.length > 0 && html`<p role="status" data-testid="volumes-usable">${V.specimens(usable.length)}</p>`}`}
        <div class="row end"><${Button} testid="volumes-cancel" onclick=${Viewer.guarded(() => close([]))}>${T.cancel}<//>
          <${Button} strong testid="volumes-make" disabled=${!isRead || !usable.length} onclick=${make}>${V.make}<//></div>
      <//>`;
  };
})();
