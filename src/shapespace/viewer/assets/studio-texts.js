/* Texts of the studio's page; the labels of actions and options are in cli/forms.py and come with the forms. */
(function () {
  "use strict";

  const count = (number, one, many) => `${number.toLocaleString("en")} ${number === 1 ? one : many || `${one}s`}`;

  window.ShapespaceTexts = {
    count,
    offline: "The studio's server does not answer; check that shapespace studio still runs. This page continues when it is back.",
    unreachable: "The studio's server does not answer; see whether shapespace studio still runs, then do it again.",
    unauthorised: "This page is no longer signed in; open the address that shapespace studio printed.",
    serverError: (status) => `The server answered with the error ${status}; reload the page.`,
    close: "Close", cancel: "Cancel", closeProject: "Close project", loading: "Reading the project", readOnly: " (read only)", done: "done", running: "running",
    screens: {
      specimens: "Specimens", correspondence: "Correspondence", model: "Model", fit: "Fit", questions: "Questions", export: "Export", history: "History",
    },
    screensLabel: "Screens",
    next: { specimens: "Next: correspondence", correspondence: "Next: model", model: "Next: questions", fit: "Next: questions", questions: "Next: export" },
    fitNext: "Fit new scans",

    start: {
      title: "Projects", intro: "A project is a folder on this machine with its scans, its table and all results. Nothing is uploaded elsewhere.",
      new: "New project", open: "Open a project", recent: "Recent projects", none: "No project was opened yet.", moved: "not found",
      newTitle: "Choose where to create the project", openTitle: "Choose the folder of a project",
      newName: "Name of the new project", create: "Create", openThis: "Open this folder",
    },
    folders: {
      label: "Folders", path: "Folder", go: "Go", up: "Up one folder", empty: "No folders in here.",
      scans: (number) => number ? `${count(number, "scan")} in this folder` : "No scans directly in this folder",
      isProject: "This folder is a project.",
    },

    specimens: {
      dropTitle: "Drop scans or folders here", dropHint: (formats) => `Mesh and point cloud files (${formats}), label volumes (NIfTI, NRRD), a table (CSV or XLSX) with their data, and files of landmarks.`,
      chooseFiles: "Choose files", chooseFolder: "Choose a folder", addHere: "Add from this machine", importTable: "Import a table", importLandmarks: "Import landmarks",
      addTitle: "Add scans from this machine", byReference: "Refer to the files where they are", byCopy: "Copy the files into the project",
      addFolder: "Add this folder", added: (number) => `${count(number, "scan")} added.`,
      cards: "Cards", table: "Table", layout: "Layout", filter: "Filter", filterHint: "name, class or finding",
      undo: "Undo", redo: "Redo", undoOf: (text) => `Undo: ${text}`, redoOf: (text) => `Redo: ${text}`,
      included: "Included", includeOne: (id) => `Include ${id}`, selectOne: (id) => `Select ${id}`, selectAll: "Select all that are listed", select: "Select",
      selected: (number) => `${number} selected`, include: "Include", exclude: "Exclude", remove: "Remove", clear: "Clear selection",
      toNew: "Use as new scans", toTraining: "Use for training",
      removeTitle: (number) => `Remove ${count(number, "specimen")} from the project?`, removeText: "No file is deleted, and you can undo this.",
      addColumn: "Add a column", columnName: "Name of the column", add: "Add", removeColumn: (name) => `Remove the column ${name}`,
      removeColumnTitle: (name) => `Remove the column ${name} with its cells?`, removeColumnText: "You can undo this.",
      columns: { id: "Specimen", use: "Use", set: "Set", unit: "Unit", mirror: "Mirror", extent: "Extent", size: "Triangles", findings: "Findings" },
      unit: (name) => ({ "": "as it is", um: "\u00b5m" })[name] || name, unitOf: (id) => `Unit of ${id}`, setUnit: "Set the unit", mirrorOne: (id) => `Use the mirror image of ${id}`,
      group: "Make a group", groupIn: "Column", groupName: "Group", groupColumn: "group",
      parts: {
        open: "Join parts", join: "Join", names: "Parts, by the ends of the names",
        hint: "Scans such as anna_femur and anna_tibia become one specimen, anna. Relative poses are those to the first part.",
      },
      mirror: "Mirror", unmirror: "Do not mirror", mirrored: "mirrored",
      cell: (column, id) => `${column} of ${id}`, rename: (id) => `Name of ${id}`, tableLabel: "Table of specimens",
      pasteHint: "Click a cell to edit it; Enter and the arrow keys move. Paste a sheet of a spreadsheet with its names into the first cell, or a block of values into the cell where it begins.",
      scan: {
        show: (id) => `Show ${id} in 3-D`, open: "3-D", label: (id) => `The scan ${id} in 3-D`, reading: "Reading the scan", failed: "The 3-D view cannot be loaded; reload the page.", sides: "Sides",
        front: "Front", back: "Back", left: "Left", right: "Right", top: "Top", bottom: "Bottom", units: "units of the file",
        axes: "The axes are those of the file: front looks along -z, with y up. Drag to turn, scroll to zoom.", borders: "Red: borders of holes.",
      },
      marks: {
        title: "Landmarks", manage: "Landmarks", placed: (number, all) => `${number} of ${all} landmarks`, of: (number, all) => `${number} of ${all} placed`, missing: "missing", isPlaced: "placed",
        hint: (name) => `Click ${name} on the scan, or type its coordinates. Drag a landmark to move it.`, done: "All landmarks are placed. Drag one to move it.", none: "Name a landmark, then click its place on the scan.",
        name: "New landmark or curve", points: "Points of a curve", pointsOf: "Points of a curve", add: "Add", closed: "closed", curve: (name) => `${name} (curve)`, pair: "Mirrors", noPair: "(none)", pairOf: (name) => `Mirrored pair of ${name}`, countOf: (name) => `Number of points of ${name}`, closedOf: (name) => `${name} is closed`,
        along: (curve) => `Click the points of ${curve} in their order along it. Another number of points, under Landmarks above the cards, spaces them evenly on all scans.`,
        coordinates: (name) => `Coordinates of ${name}`, axis: (axis, name) => `${axis} of ${name}`, file: "In the unit and axes of the file; arrow keys move it in small steps.",
        remove: "Remove from this scan", removeOf: (name) => `Remove ${name} from this scan`, removeAll: (name) => `Remove the landmark ${name} from all scans`, specimens: "Specimens",
        intro: "Correspondence, and fits by a model with the same landmarks, use the landmarks of scans. An export has them in the unit and axes of each scan. Questions can be about them without a correspondence. Points of curves then slide; another number spaces them evenly on all scans. Asymmetry needs the pairs that mirror each other, which names such as left arch and right arch show.", download: "Download",
      },
      odd: { title: "These specimens differ from the others", setUnit: (unit) => `Set its unit to ${unit}`, link: (number) => `${count(number, "specimen differs", "specimens differ")} from the others: look at ${number === 1 ? "it" : "them"} first`, more: (number) => `${count(number, "more specimen")}` },
      groom: {
        open: "Groom", done: "groomed", title: "Groom", largest: "Keep the largest piece", outer: "Remove inner surfaces", holes: "Fill holes with border edges up to",
        hint: "The part that remains keeps its coordinates and its unit. The file of the scan stays as it is.", apply: "Groom", original: "Use the original scan", running: "Being groomed",
        sphere: "Crop by a sphere", plane: "Crop by a plane", radius: "Radius", keep: "Keep", sides: { inside: "the part inside", outside: "the part outside", behind: "the part behind it", front: "the part in front of it" },
        click: { sphere: "Click the centre of the sphere on the scan, or type its coordinates.", plane: "Turn the scan, then click a point on it, or type its coordinates: the plane passes through this point and faces you." },
        point: { sphere: "Centre of the sphere", plane: "Point of the plane" }, axis: (axis, tool) => `${axis} of the ${tool === "sphere" ? "centre" : "point"}`, face: "Turn the plane to the front",
        keeps: (percent) => `${percent} % of the points that are drawn remain.`, clear: "No crop",
      },
      volumes: {
        title: (number) => `Surfaces of ${count(number, "label volume")}`, reading: (done, total) => `Reading the labels of volume ${done} of ${total}`, which: "Labels that form the object",
        label: (name, voxels, number, total) => `${name}: ${voxels.toLocaleString("en")} voxels${number < total ? `, in ${number} of ${total} volumes` : ""}`,
        together: "Several labels become one object.", lacks: (name) => `${name} lacks a chosen label; it becomes no specimen.`, make: "Make surfaces",
        specimens: (number) => `${count(number, "surface")} will be added as ${number === 1 ? "a specimen" : "specimens"}, in mm.`,
      },
      paste: {
        title: (number) => `Paste the cells of ${count(number, "specimen")}?`, action: "Paste",
        byName: "Each row goes to the specimen that it names.",
        byPosition: "The rows do not name their specimens. They go to the specimens in the order of this table, which may differ from that of the spreadsheet: check each row.",
        columns: (names) => `New ${names.length === 1 ? "column" : "columns"}: ${names.join(", ")}.`,
      },
      states: { waiting: "being checked", ready: "ready", unusable: "cannot be used" }, new: "new", training: "training",
      summary: (all, included, unusable) => `${count(all, "specimen")}, ${included} included${unusable ? `, ${unusable} cannot be used` : ""}`,
      notes: "Look at the table", classes: "Classes", noClass: "(empty)", more: (number) => `Show ${number} more`,
      found: (repairs, notes) => [repairs && count(repairs, "repair"), notes && count(notes, "note")].filter(Boolean).join(", "),
      fixed: "Repaired: ", refused: "Cannot be used: ", note: "", nothing: "No specimen matches the filter.",
    },
    views: {
      title: "Named views", first: "Name this view", edit: "Edit views", name: "Name of this view", names: ["dorsal", "ventral", "lateral", "medial", "anterior", "posterior"], roll: "Rotate",
      save: "Save", rename: (name) => `Name of the view ${name}`, remove: (name) => `Remove the view ${name}`, take: (output) => `Use the views of ${output}`,
      hint: "Turn the object, then name its view. The views are offered on these surfaces and their models.", scans: "Turn the scan, then name its view. The views are offered on all scans, and are right where their files have the same axes.",
    },
    uploads: {
      progress: (done, total) => `Adding file ${Math.min(done + 1, total)} of ${total}`, finished: (added) => `${count(added, "file")} added.`,
      leftOut: (number) => `${count(number, "file")} not added`, tooLarge: (name, limit) => `${name} is larger than ${limit} MB; add it from this machine instead.`, volumeTooLarge: (name, limit) => `${name} is larger than ${limit} MB; crop it to the object, for example in 3D Slicer.`,
      format: (name) => `${name} is not a scan in a format that can be read.`, same: (name, other) => `${name} has the same content as ${other}.`,
      landmarks: (name, number, matched) => `${name}: ${count(number, "landmark")} of ${count(matched, "specimen")} read.`,
      table: (name, matched) => `${name}: cells of ${count(matched, "specimen")} read.`, dismiss: "Close the list",
    },

    jobs: {
      kinds: { redo: "Correct one scan" },
      statuses: { waiting: "waiting", running: "running", done: "done", failed: "failed", cancelled: "cancelled", interrupted: "interrupted" },
      settings: "Settings, and run again", run: "Run", runAgain: "Run again", runOf: { correspond: "Bring into correspondence", build: "Build the model", fit: "Fit the scans" },
      more: (number) => `${count(number, "more option")}`, cancel: "Cancel", continue: "Continue", log: "Log", command: "Command", copy: "Copy", copied: "Copied",
      noLog: "The log is empty.", result: "Result", noResult: "Results appear here.", required: "required", yes: "yes", none: "(none)", default: "(default)",
      title: (number, name) => `${number}: ${name}`,
      sameSettings: "Run again with the same settings", isOutdated: "outdated",
      outdated: {
        specimens: "Made before specimens were changed, excluded or included, or a scan was replaced.", table: "Made before the table was changed.", landmarks: "Made before the landmarks were changed.",
        redone: "Made before a scan was registered again.", source: "Made from a result that is outdated; run that one again first.",
      }, source: "Made from", newest: "newest result", placed: "Landmarks on the scans", newerRuns: (action, number, waits) => `${action} ${number} is not finished. This run ${waits ? "waits for it" : "uses an earlier result"}.`, wait: "Wait for its end, and use its result",
      progress: ({ doing, done, total }) => total ? `${doing} (${done} of ${total})` : doing, progressLabel: (kind) => `Progress of: ${kind}`,
      took: (time) => `took ${time}`, left: (time) => `about ${time} left in this step`,
      seconds: (value) => `${value} s`, minutes: (value) => `${value} min`, hours: (value) => `${value} h`,
      shown: (kind, output) => `${kind}: ${output}`, noReport: "This report cannot be shown here; open it in a tab of its own.", openReport: "Open the report", full: "Open in a tab of its own", views: { surfaces: "Surfaces", model: "3-D view", report: "Report" }, view: "View",
    },
    correspondence: {
      title: "Correspondence", intro: (number) => `${count(number, "included specimen")} for training. Each gets the same vertices, so that shapes can be compared.`,
      redoTitle: "Correct one scan", redoHint: "Does one surface not match its scan? Redo only that one; all others stay as they are.", redoWhich: "Scan", redo: "Redo this one",
      landmarksTitle: "Landmarks", landmarksHint: "Click a place on any surface to mark the same vertex on all, then name it. Drag a landmark on one surface to move it on all. Analyses use the names.",
      landmark: "Name", vertex: "Vertex", landmarksElsewhere: (output) => `The landmarks of this project were placed on ${output}, whose vertices are others; those that you add here replace them.`, vertexOf: (name) => `Vertex of ${name}`, addLandmark: "Add", removeLandmark: (name) => `Remove the landmark ${name}`, noLandmarks: "None yet.",
      none: "Add specimens first; correspondence needs at least two.", empty: "After the run, all surfaces turn here together: check that the checkerboard lies the same way on each.",
    },
    model: { title: "Model", intro: "Mean shape and modes of variation of the surfaces in correspondence.", empty: "After the run, the model with a slider per mode is shown here.", none: "Bring the specimens into correspondence first." },
    fit: {
      title: "Fit", intro: "Fit the model to scans that it was not built from.", drop: "Drop new scans here", scans: (number) => `${count(number, "new scan")} to fit`,
      empty: "After the run, each fit is shown here with its status, distances and position among the training set.", none: "Build a model first.", report: "Write report of the fits",
    },
    questions: {
      title: "What do you want to know?", all: "All questions", earlier: "Earlier results", columns: "Columns", formula: "Formula", size: "size of the shapes", noColumns: "The table has no columns yet; add some under Specimens.",
      checks: "Checks before the run", levels: { ok: "OK", warning: "Warning", problem: "Problem" }, checking: "Checking",
      paper: "Text for the paper", copyPaper: "Copy the text", findings: "Result", figures: "Figures (SVG, PDF, PNG)", none: "Place or import landmarks on the scans, bring the specimens into correspondence, or fit new scans first.",
      hints: {
        compare: "Test whether shape is associated with sex, age, treatment or any other column.", change: "Measure the change between visits of the same subjects in millimetres.",
        asymmetry: "Compare left with right: a score for each subject, and a map.", regress: "Predict a number, such as age, from shape, or the mean shape along such a number.",
        score: "Compare each shape with a class, such as the controls: a percentile, and a map.", identify: "Find the subject of a scan among the enrolled ones.",
      },
      empty: "After the run, the answer in words, the figures and the text for the paper are shown here.",
    },
    export: {
      title: "Export", intro: "Download results, or write one report of the study that opens in any browser: specimens, correspondence, model, morphospace and each answer.", report: "Write report of the study", reportOf: "Write report of this", none: "There are no results yet.",
      files: "Files", size: "Size", zip: "Download all (ZIP)", outdated: (number) => `${count(number, "result is", "results are")} outdated: made before later edits. Run them again before you use them.`, figures: "Figures in SVG, PDF and PNG", convert: "Model in another format", noFiles: "No files.", show: "Files",
      result: "Result", actions: "Downloads", download: (path) => `Download ${path}`,
    },
    history: {
      title: "History", intro: "Every action is a command. The file history.sh reproduces the project from its inputs.", copy: "Copy commands", download: "Download history.sh",
      number: "No.", action: "Action", status: "Status", time: "Time", command: "Command", none: "Nothing was run yet.",
    },
  };
})();
