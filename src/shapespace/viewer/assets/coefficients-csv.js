/* Tables of coefficients as CSV: written as coefficients.csv of shapespace fit, and read again. */
(function () {
  "use strict";

  const Viewer = window.ShapespaceViewer;

  /** Coefficients of a model of K modes as CSV in the columns of coefficients.csv: rows of {name, status, b, z, sd}. */
  Viewer.coefficientsCsv = function (rows, K) {
    const whole = (values) => Array.from({ length: K }, (_, k) => (k < values.length ? values[k] : ""));
    const each = (letter, end = "") => Array.from({ length: K }, (_, k) => `${letter}${k + 1}${end}`);
    const withError = rows.some((row) => row.sd);
    const lines = [["scan", "status", ...each("b"), ...each("z"), ...(withError ? each("b", "_stddev") : [])].join(",")];
    // A spreadsheet would run a name that starts like a formula.
    const cell = (text) => `"${(/^[=+\-@\t\r]/.test(text) ? "'" : "") + String(text).replace(/"/g, '""')}"`;
    for (const row of rows) lines.push([cell(row.name), cell(row.status || ""), ...whole(row.b), ...whole(row.z), ...(row.sd ? whole(row.sd) : [])].join(","));
    return new Blob([lines.join("\n") + "\n"], { type: "text/csv" });
  };

  /** Rows of a CSV text: quotes, doubled quotes and line breaks in quotes are understood. */
  Viewer.csvRows = function (text) {
    const lines = [[""]];
    let quoted = false;
    for (let i = 0; i < text.length; i++) {
      const c = text[i], line = lines[lines.length - 1];
      if (quoted && c === '"' && text[i + 1] === '"') { line[line.length - 1] += '"'; i += 1; }
      else if (c === '"') quoted = !quoted;
      else if (!quoted && c === ",") line.push("");
      else if (!quoted && c === "\n") lines.push([""]);
      else if (quoted || c !== "\r") line[line.length - 1] += c;
    }
    return lines.filter((line) => line.length > 1 || line[0]);
  };
})();
