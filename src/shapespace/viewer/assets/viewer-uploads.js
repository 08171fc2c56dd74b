/* Dropped files: which of them are scans, sending them, and following their fits on the server. */
(function () {
  "use strict";

  const Viewer = window.ShapespaceViewer;
  const { $, page, ask, telling, guarded, json, post, compareTab, scanTab } = Viewer;
  const { look, say, drop, drawPreview, showState, showVerdict, list: listScans } = scanTab;
  const POLL_MS = 100;

  let sending = false;

  const fresh = () => ({ states: [], preview: null, previewed: false, said: null, verdict: null, helped: false, placing: null, frame: null, scheduled: 0, run: 0 });

  function suits(name) {
    const ending = (/\.[^.]+$/.exec(name.toLowerCase()) || [""])[0];
    return page.about.formats.includes(ending);
  }

  const maxMegabytes = () => Math.round(page.about.upload_bytes / 2 ** 20);

  const dropFiles = guarded(async (files) => {
    const { about } = page;
    Viewer.show("scan");
    const refused = [], taken = [];
    for (const file of files) {
      if (/\.csv$/i.test(file.name)) await compareTab.readCsv(file);
      else if (!suits(file.name)) refused.push(`${file.name} is not a scan that can be read; drop ${about.formats.join(", ")}.`);
      else if (file.size > about.upload_bytes) {
        refused.push(`${file.name} is larger than the ${maxMegabytes()} MB that this viewer takes; thin it${window.parent === window ? ", or start the viewer with a larger --max-upload-mb" : ""}.`);
      } else if (taken.length < about.kept) taken.push(file);
      else refused.push(`${file.name} is not sent, because at most ${about.kept} scans are kept; drop fewer at a time.`);
    }
    const records = taken.map((file) => ({ id: null, name: file.name, file, dense: $("dense").checked, ...fresh() }));
    page.dropped.push(...records);
    for (const mine of records) say(mine, "Waits to be sent", null);
    if (records.length) look(records[0]);
    sendNext();
    if (refused.length) throw new Error(refused.length > 2 ? `${refused[0]} So are ${refused.length - 1} others.` : refused.join(" "));
  });

  const unfinished = () => page.dropped.filter((one) => one.id && !one.done).length;

  /** Send what waits, one after another, as many as may be fitted at once; the end of a fit calls again. */
  const sendNext = telling(async () => {
    if (sending) return;
    sending = true;
    try {
      for (;;) {
        const mine = page.dropped.find((one) => one.file);
        if (!mine || unfinished() >= page.about.unfinished) return;
        const { file } = mine;
        try {
          const facts = await upload(mine, file);
          Object.assign(mine, { id: facts.id, name: facts.name, file: null });
        } catch (error) {
          drop(mine);
          throw error;
        }
        // The oldest goes where there are too many, and the server decides which.
        const kept = new Set((await json("api/scans")).map((scan) => scan.id));
        page.dropped.filter((one) => one.id && !kept.has(one.id)).forEach(drop);
        if (page.dropped.includes(mine)) follow(mine);
      }
    } finally {
      sending = false;
      listScans();
    }
  });

  /** PUT with progress, which fetch does not report. */
  function upload(mine, file) {
    return new Promise((resolve, reject) => {
      const request = new XMLHttpRequest();
      request.open("PUT", `api/scans?name=${encodeURIComponent(file.name)}&dense=${mine.dense ? 1 : 0}`);
      request.responseType = "json";
      request.upload.onprogress = (event) => { if (event.lengthComputable) say(mine, `Sending ${file.name}`, event.loaded / event.total); };
      request.onerror = () => reject(new Error(`${file.name} could not be sent; see whether shapespace view still runs, and try again.`));
      request.onload = () => {
        const told = request.response || {};
        if (request.status === 201) resolve(told);
        else reject(new Error(told.error || `The server answered with the error ${request.status}; reload the page.`));
      };
      say(mine, `Sending ${file.name}`, 0);
      request.send(file);
    });
  }

  /** Ask the server for the progress of a fit until it is done or removed. */
  const follow = telling(async (mine) => {
    const { run } = mine;
    mine.done = false;
    for (let after = 0; page.dropped.includes(mine) && mine.run === run;) {
      const progress = await json(`api/scans/${mine.id}/progress?after=${after}`);
      after += progress.events.length;
      if (progress.state === "waiting") say(mine, progress.position > 1 ? `Waiting: ${progress.position - 1} before it` : "Waiting for a free place", null);
      else if (!after) say(mine, "Reading the scan", null);
      for (const event of progress.events) await telling(handleEvent)(mine, event);
      if (progress.state === "done") {
        Object.assign(mine, { done: true, helped: progress.can_place_landmarks });
        if (page.own === mine) {
          $("progress").hidden = true;
          if (mine.helped && !mine.placing) Viewer.landmarks.offer(mine);
        }
        sendNext();
        return;
      }
      await new Promise((resolve) => setTimeout(resolve, POLL_MS));
    }
  });

  async function handleEvent(mine, event) {
    if (event.event === "scan") {
      Object.assign(mine, { origin: event.origin, unit: event.mm_per_scan_unit, previewed: true });
      say(mine, `${event.vertices.toLocaleString("en")} vertices; looking for a place to start`, null);
      if (page.own === mine) await drawPreview(mine);
    } else if (event.event === "state") {
      mine.states.push(event);
      if (!mine.scheduled) mine.scheduled = requestAnimationFrame(() => { mine.scheduled = 0; if (!mine.verdict) showState(mine); });
    } else if (event.event === "verdict") {
      mine.verdict = event;
      if (event.b) {
        page.shapes.set(`scan ${mine.id}`, { name: mine.name, z: event.z });
        compareTab.fillChoices();
      }
      listScans();
      if (page.own === mine) await showVerdict(mine);
    }
  }

  async function start() {
    const { about } = page;
    const formats = about.formats.map((ending) => ending.slice(1).toUpperCase()).join(", ");
    $("zone-hint").textContent = `${formats}, up to ${maxMegabytes()} MB. It is fitted on the machine where the viewer runs, and the file is removed after the fit.`;
    $("file").accept = about.formats.join(",");
    $("choose").addEventListener("click", () => $("file").click());
    $("file").addEventListener("change", () => { dropFiles(Array.from($("file").files)); $("file").value = ""; });
    $("stop").addEventListener("click", guarded(async () => { if (page.own && page.own.id) await ask(`api/scans/${page.own.id}/cancel`, post({})); }));
    let depth = 0;
    const withFiles = (event) => event.dataTransfer && Array.from(event.dataTransfer.types).includes("Files");
    addEventListener("dragenter", (event) => { if (withFiles(event)) { event.preventDefault(); depth += 1; $("cover").hidden = false; } });
    addEventListener("dragover", (event) => { if (withFiles(event)) event.preventDefault(); });
    addEventListener("dragleave", (event) => { if (withFiles(event)) { depth = Math.max(0, depth - 1); $("cover").hidden = depth === 0; } });
    addEventListener("drop", (event) => {
      if (!withFiles(event)) return;
      event.preventDefault();
      depth = 0;
      $("cover").hidden = true;
      dropFiles(Array.from(event.dataTransfer.files));
    });
    const earlier = await json("api/scans");
    for (const { id, name, dense } of earlier) {
      const mine = { id, name, dense, ...fresh() };
      page.dropped.push(mine);
      follow(mine);
    }
    if (page.dropped.length) {
      Viewer.show("scan");
      look(page.dropped[page.dropped.length - 1]);
    }
  }

  Viewer.uploads = { start, fresh, follow };
})();
