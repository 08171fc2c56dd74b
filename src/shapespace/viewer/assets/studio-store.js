/* The studio's state: the copy of the server's, its refreshes, edits in order, and uploads. */
(function () {
  "use strict";

  const Viewer = window.ShapespaceViewer;
  const T = window.ShapespaceTexts;
  const UPLOADS_AT_ONCE = 3;
  const RECONNECT_AFTER = 3000; // ms
  const ATTEMPTS = 5; // of an edit while uploads change the revision
  const TABLES = [".csv", ".tsv", ".xlsx"];

  const Studio = (window.ShapespaceStudio = {
    state: null, // of /api/project
    forms: {}, // of /api/forms
    volumes: [], // uploaded label volumes whose labels are not chosen yet: {file, name, set}
    uploads: null, // of the last drop
    pane: null, // the result that is drawn: {result, oriented()}, see Viewer.openSurfaces
    changed: () => {}, // draws the page
  });

  // Requests --------------------------------------------------------------------------------------------------------

  /** fetch, with the server's sentence as the error; after a conflict the state is read again. */
  async function ask(path, options) {
    let answer;
    try {
      answer = await fetch(path, options);
    } catch (error) {
      throw new Error(T.unreachable);
    }
    if (answer.ok) return answer;
    let sentence = answer.status === 401 ? T.unauthorised : null;
    try { sentence = sentence || (await answer.json()).error; } catch (error) { /* not JSON */ }
    const error = new Error(sentence || T.serverError(answer.status));
    error.status = answer.status;
    if (answer.status === 409) await refresh();
    throw error;
  }

  const json = async (path, options) => (await ask(path, options)).json();
  const post = (path, content) => json(path, Viewer.post(content));

  // State -----------------------------------------------------------------------------------------------------------

  const byName = new Intl.Collator("en", { numeric: true }).compare;
  let reading = null; // the request in flight
  let again = null; // the one that follows it

  /** Read the state; at most one request is in flight, and one more waits for it. */
  function refresh() {
    if (!reading) {
      reading = read().finally(() => { reading = null; });
      return reading;
    }
    if (!again) again = reading.catch(() => {}).then(() => { again = null; return refresh(); });
    return again;
  }

  async function read() {
    const state = await json("/api/project");
    if (state.project) state.project.specimens.sort((a, b) => byName(a.id, b.id));
    reuse(state);
    if (state.project) state.project.rows = state.project.specimens.filter((one) => !one.subject);
    Studio.state = state;
    Studio.changed();
  }

  /** Unchanged specimens stay the same objects, so that their rows and cards are not drawn again. */
  function reuse(state) {
    const before = Studio.state && Studio.state.project;
    if (!before || !state.project) return;
    const known = new Map(before.specimens.map((specimen) => [specimen.id, specimen]));
    state.project.specimens = state.project.specimens.map((specimen) => {
      const old = known.get(specimen.id);
      return old && JSON.stringify(old) === JSON.stringify(specimen) ? old : specimen;
    });
    for (const key of ["columns", "point_names", "views"]) if (JSON.stringify(before[key]) === JSON.stringify(state.project[key])) state.project[key] = before[key];
  }

  // Scans may have been replaced in another program, which sends no event.
  addEventListener("focus", () => { if (Studio.state) refresh().catch(() => {}); });

  function listen() {
    const events = new EventSource("/api/events");
    const offline = document.getElementById("offline");
    events.onopen = () => { offline.hidden = true; refresh().catch(() => {}); };
    events.onmessage = () => refresh().catch(() => {});
    events.onerror = () => {
      const show = (sentence) => { offline.textContent = sentence; offline.hidden = false; };
      show(T.offline);
      if (events.readyState !== EventSource.CLOSED) return;
      // After an answer that is no stream, such as 401, the browser does not connect again.
      refresh().catch((error) => { if (error.status === 401) show(error.message); });
      setTimeout(listen, RECONNECT_AFTER);
    };
  }

  /** Do an action and read the state. */
  const act = Viewer.guarded(async (path, content = {}) => {
    const answer = await post(path, content);
    await refresh();
    return answer;
  });

  // Edits are sent one after another, each with the revision that the one before it made. Where one is refused, those that
  // wait were made on a state that never was, and are dropped: an undo would take back another edit.
  let edits = Promise.resolve();
  let refusals = 0;

  const inOrder = (path, content) => {
    const before = refusals;
    const next = edits.then(async () => {
      if (refusals !== before) return false;
      for (let attempt = 1; ; attempt++) {
        try {
          await post(path, { ...content, revision: Studio.state.project.revision });
          break;
        } catch (error) {
          if (error.status === 409 && uploading() && attempt < ATTEMPTS) continue;
          refusals += 1;
          throw error;
        }
      }
      await refresh();
      return true;
    });
    edits = next.catch(() => {});
    return next;
  };
  const edit = Viewer.guarded((content) => inOrder("/api/edit", content));
  /** An edit by a control, which shows again what it showed before where the edit is refused. */
  const editBy = async (content, restore) => { if (!(await edit(content))) restore(); };
  /** The figures of an answer for print. */
  const runFigures = (job) => runJob("figures", { "--format": "svg,pdf,png" }, job.number);
  const undo = Viewer.guarded(() => inOrder("/api/undo", {}));
  const redo = Viewer.guarded(() => inOrder("/api/redo", {}));

  const runJob = Viewer.guarded(async (kind, options = {}, on = null) => {
    const { number } = await post("/api/jobs", { kind, options, on });
    await refresh();
    return number;
  });

  // Uploads ---------------------------------------------------------------------------------------------------------

  const ending = (name, endings) => endings.some((one) => name.toLowerCase().endsWith(one));
  const uploading = () => workers > 0;

  /** All files of a drop, with those in folders; its entries must be taken before the event ends. */
  async function filesOfDrop(transfer) {
    const entries = Array.from(transfer.items || []).map((item) => item.webkitGetAsEntry && item.webkitGetAsEntry()).filter(Boolean);
    if (!entries.length) return Array.from(transfer.files);
    const files = [];
    const visit = async (entry) => {
      if (entry.name.startsWith(".")) return;
      if (entry.isFile) { files.push(await new Promise((resolve, reject) => entry.file(resolve, reject))); return; }
      const reader = entry.createReader();
      for (;;) {
        // A reader returns at most 100 entries at a time.
        const part = await new Promise((resolve, reject) => reader.readEntries(resolve, reject));
        if (!part.length) return;
        for (const child of part) await visit(child);
      }
    };
    for (const entry of entries) await visit(entry);
    return files;
  }

  const waiting = [];
  let workers = 0;

  /** Forget the uploads that have ended, and their notes. */
  function clearUploads() { Studio.uploads = { total: 0, done: 0, added: 0, notes: [] }; }
  clearUploads();

  /** Add scans, three at a time; tables and landmarks follow, as they name the scans. `only`: the kind of all files. */
  function upload(files, set, only) {
    if (!uploading()) clearUploads();
    files.sort((a, b) => byName(a.name, b.name));
    const { formats, landmark_formats: ofLandmarks, volume_formats: ofVolumes } = Studio.state;
    const kindOf = ({ name }) => only || (ending(name, TABLES) ? "table" : ending(name, ofVolumes) ? "volume" : !ending(name, formats) && ending(name, ofLandmarks) ? "landmarks" : "");
    const comesLater = (kind) => kind === "table" || kind === "landmarks"; // as their rows name the scans
    const all = files.map((file) => [file, set, kindOf(file)]);
    waiting.push(...all.filter(([, , kind]) => !comesLater(kind)), ...all.filter(([, , kind]) => comesLater(kind)));
    Studio.uploads.total += files.length;
    Studio.changed();
    for (let k = workers; k < UPLOADS_AT_ONCE && waiting.length; k++) work();
  }

  async function work() {
    workers += 1;
    while (waiting.length && !(["table", "landmarks"].includes(waiting[0][2]) && workers > 1)) {
      const [file, set, kind] = waiting.shift();
      try {
        if (kind === "volume") await uploadVolume(file, set);
        else if (kind) await importTable(file, kind);
        else await uploadScan(file, set);
      } catch (error) {
        Studio.uploads.notes.push(error.message.includes(file.name) ? error.message : `${file.name}: ${error.message}`);
      }
      Studio.uploads.done += 1;
      Studio.changed();
      // Uploads have ended when the page knows the revision that they made.
      if (!waiting.length && workers === 1) await refresh().catch(() => {});
    }
    workers -= 1;
    Studio.changed();
  }

  function checkSize(file, tooLarge) {
    const most = Studio.state.upload_bytes;
    if (file.size > most) throw new Error(tooLarge(file.name, Math.round(most / 2 ** 20)));
  }

  /** Add a label volume; its labels are asked for when all files of the drop are there. */
  async function uploadVolume(file, set) {
    checkSize(file, T.uploads.volumeTooLarge);
    const { file: stored, same_as: same } = await json(`/api/volumes?name=${encodeURIComponent(file.name)}`, { method: "PUT", body: file });
    if (same) Studio.uploads.notes.push(T.uploads.same(file.name, same));
    if (Studio.volumes.some((volume) => volume.file === stored)) return;
    Studio.volumes.push({ file: stored, name: file.name, set });
    Studio.volumes.sort((a, b) => byName(a.name, b.name));
  }

  async function uploadScan(file, set) {
    if (!ending(file.name, Studio.state.formats)) throw new Error(T.uploads.format(file.name));
    checkSize(file, T.uploads.tooLarge);
    const answer = await json(`/api/specimens?name=${encodeURIComponent(file.name)}&set=${set}`, { method: "PUT", body: file });
    if (answer.same_as) Studio.uploads.notes.push(T.uploads.same(file.name, answer.same_as));
    else Studio.uploads.added += 1;
  }

  async function importTable(file, kind) {
    const { matched, landmarks, notes } = await json(`/api/table?name=${encodeURIComponent(file.name)}&kind=${kind}`, { method: "POST", body: file });
    Studio.uploads.notes.push(landmarks ? T.uploads.landmarks(file.name, landmarks, matched) : T.uploads.table(file.name, matched), ...notes);
  }

  // What the screens ask of the state -------------------------------------------------------------------------------

  const jobsOf = (kinds) => Studio.state.project.jobs.filter((job) => kinds.includes(job.kind)).sort((a, b) => b.number - a.number);
  const newest = (...kinds) => jobsOf(kinds).find((job) => job.status === "done");
  /** Of jobs with the same settings, the newest first, the newest. */
  const newestOfEach = (jobs) => Array.from(new Map([...jobs].reverse().map((job) => [JSON.stringify([job.kind, job.on, job.options]), job])).values()).reverse();
  const isActive = (job) => job.status === "running" || job.status === "waiting";

  Object.assign(Studio, { clearUploads, ask, json, post, refresh, listen, act, edit, editBy, runFigures, undo, redo, runJob, upload, uploading, filesOfDrop, jobsOf, newest, newestOfEach, isActive });
})();
