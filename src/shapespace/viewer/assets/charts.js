/* Small charts as SVG: RMS by iteration, and coefficients in standard deviations with their uncertainty. */
(function () {
  "use strict";

  const Viewer = (window.ShapespaceViewer = window.ShapespaceViewer || {});
  const SVG = "http://www.w3.org/2000/svg";

  function draw(name, attributes, text) {
    const element = document.createElementNS(SVG, name);
    for (const key of Object.keys(attributes)) element.setAttribute(key, attributes[key]);
    if (text !== undefined) element.textContent = text;
    return element;
  }

  function canvas(element, width, height, label) {
    const svg = draw("svg", { viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": label });
    element.replaceChildren(svg);
    return svg;
  }

  const sign = (value, digits = 2) => (value > 0 ? "+" : "") + value.toFixed(digits).replace("-", "\u2212");
  Viewer.sign = sign;

  /** RMS (mm) of each iteration, phases apart; `now` marks one of them. */
  Viewer.rmsChart = function (element, rms, phases, now) {
    const W = 350, H = 116, left = 40, right = 8, top = 22, bottom = 20;
    const known = rms.filter(Number.isFinite);
    if (known.length < 1) { element.replaceChildren(); return; }
    const svg = canvas(element, W, H, `RMS distance by iteration, from ${known[0].toFixed(2)} to ${known[known.length - 1].toFixed(2)} mm`);
    const most = Math.max(...known) * 1.05 || 1;
    const x = (i) => left + ((W - left - right) * i) / Math.max(rms.length - 1, 1);
    const y = (v) => H - bottom - ((H - top - bottom) * v) / most;
    svg.append(draw("text", { x: 0, y: 11, class: "title" }, "RMS distance by iteration (mm)"));
    for (const share of [0, 0.5, 1]) {
      const value = (most / 1.05) * share;
      svg.append(draw("line", { x1: left, x2: W - right, y1: y(value), y2: y(value), class: "grid" }));
      svg.append(draw("text", { x: left - 6, y: y(value) + 4, "text-anchor": "end" }, value.toFixed(value < 10 ? 1 : 0)));
    }
    const second = phases.indexOf(2);
    if (second > 0) {
      svg.append(draw("rect", { x: x(second), y: top, width: Math.max(W - right - x(second), 0), height: H - top - bottom, class: "band" }));
    }
    if (second > rms.length * 0.12 || second < 0) svg.append(draw("text", { x: left, y: H - 5 }, "pose"));
    if (second >= 0) svg.append(draw("text", { x: Math.max(x(second), left), y: H - 5 }, "pose and shape"));
    svg.append(draw("text", { x: W - right, y: H - 5, "text-anchor": "end" }, `${rms.length} states`));
    svg.append(draw("polyline", { points: rms.map((v, i) => `${x(i).toFixed(1)},${y(Number.isFinite(v) ? v : 0).toFixed(1)}`).join(" "), class: "line" }));
    const at = now === null || now === undefined ? rms.length - 1 : now;
    svg.append(draw("circle", { cx: x(at), cy: y(Number.isFinite(rms[at]) ? rms[at] : 0), r: 5, class: "now" }));
  };

  /** Coefficients of the first modes, [{z, error, name}] at most two; the band is one standard deviation of the model. */
  Viewer.coefficientChart = function (element, series, modes) {
    const K = Math.min(modes, 20, Math.max(...series.map((one) => one.z.length)));
    const W = 350, H = 150, left = 28, right = 4, top = 24, bottom = 20;
    const reach = Math.max(3, ...series.map((one) => Math.max(...Array.from(one.z).slice(0, K).map((v) => Math.ceil(Math.abs(v))))));
    const names = series.map((one) => one.name).filter(Boolean).join(" and ");
    const svg = canvas(element, W, H, `Coefficients in standard deviations${names ? `, ${names}` : ""}`);
    const x = (k) => left + ((W - left - right) * (k + 0.5)) / K;
    const y = (v) => top + ((H - top - bottom) * (reach - Math.max(-reach, Math.min(reach, v)))) / (2 * reach);
    svg.append(draw("text", { x: 0, y: 11, class: "title" }, `Coefficients${names ? "" : " (standard deviations)"}${modes > K ? `, first ${K}` : ""}`));
    svg.append(draw("rect", { x: left, y: y(1), width: W - left - right, height: y(-1) - y(1), class: "band" }));
    for (const value of [-reach, 0, reach]) {
      svg.append(draw("line", { x1: left, x2: W - right, y1: y(value), y2: y(value), class: "grid" }));
      svg.append(draw("text", { x: left - 5, y: y(value) + 4, "text-anchor": "end" }, value === 0 ? "0" : sign(value, 0)));
    }
    for (let k = 0; k < K; k++) {
      if (K <= 12 || k % 5 === 4 || k === 0) svg.append(draw("text", { x: x(k), y: H - 5, "text-anchor": "middle" }, String(k + 1)));
    }
    series.forEach((one, s) => {
      if (one.name) {
        const key = draw("g", { class: s ? "b" : "a" });
        key.append(draw("circle", { cx: W - 92 + 52 * s, cy: 7, r: 4, class: s ? "hollow" : "" }));
        svg.append(key, draw("text", { x: W - 84 + 52 * s, y: 11 }, one.name));
      }
      const shift = series.length > 1 ? (s - 0.5) * Math.min(7, (W / K) * 0.35) : 0;
      for (let k = 0; k < Math.min(K, one.z.length); k++) {
        const group = draw("g", { class: s ? "b" : "a" });
        const error = one.error && Number.isFinite(one.error[k]) ? one.error[k] : 0;
        const told = `mode ${k + 1}: ${sign(one.z[k])}${error ? ` \u00b1 ${error.toFixed(2)}` : ""}${one.name ? ` (${one.name})` : ""}`;
        group.append(draw("title", {}, told));
        if (error) group.append(draw("line", { x1: x(k) + shift, x2: x(k) + shift, y1: y(one.z[k] - error), y2: y(one.z[k] + error), class: "error" }));
        group.append(draw("circle", { cx: x(k) + shift, cy: y(one.z[k]), r: K > 12 ? 3 : 4, class: s ? "hollow" : "" }));
        svg.append(group);
      }
    });
  };
})();
