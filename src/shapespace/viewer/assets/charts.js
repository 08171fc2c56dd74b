/* Small charts in SVG: RMS by iteration, and coefficients in standard deviations with their uncertainty. */
(function () {
  "use strict";

  const Viewer = window.ShapespaceViewer;
  const { make, signed } = Shapespace.widgetParts;
  const WIDTH = 352, RIGHT = 8, TOP = 7, BELOW = 18; // px of the chart and the margins of its plot

  function svg(tag, attributes, ...children) {
    const element = document.createElementNS("http://www.w3.org/2000/svg", tag);
    for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
    element.append(...children);
    return element;
  }

  /**
   * Draw a chart into `element`, in place of the one there. x, y: ranges [low, high]; bands: rectangles [x0, x1, y0, y1];
   * rules: [[y, text], ...] of the grid; line: [[x, y], ...]; points: [{x, y, error, series, text}], whose text is shown
   * under the pointer; notes: [[x, text, anchor], ...] below the plot; legend: names of the series; radius: of the points; facts: data attributes.
   */
  function draw(element, { label, title, facts, height, left, x, y, bands, rules, line = [], points, notes, legend = [], radius = 4 }) {
    const across = (value) => left + ((value - x[0]) / (x[1] - x[0])) * (WIDTH - left - RIGHT), up = (value) => TOP + ((y[1] - value) / (y[1] - y[0])) * (height - TOP - BELOW);
    const write = (text, at, level, anchor) => svg("text", { x: at, y: level, "text-anchor": anchor }, text);
    const segment = (name, x0, y0, x1, y1) => svg("line", { class: name, x1: x0, y1: y0, x2: x1, y2: y1 });
    const drawing = svg("svg", { viewBox: `0 0 ${WIDTH} ${height}` },
      ...bands.map(([x0, x1, y0, y1]) => svg("rect", { class: "band", x: across(x0), y: up(y1), width: across(x1) - across(x0), height: up(y0) - up(y1) })),
      ...rules.flatMap(([value, text]) => [segment("rule", left, up(value), WIDTH - RIGHT, up(value)), write(text, left - 6, up(value) + 4, "end")]),
      svg("polyline", { points: line.map(([at, value]) => `${across(at)},${up(value)}`).join(" ") }),
      ...points.flatMap((point) => [...(point.error ? [segment(point.series, across(point.x), up(point.y - point.error), across(point.x), up(point.y + point.error))] : []),
        svg("circle", { class: point.series, cx: across(point.x), cy: up(point.y), r: radius })]),
      ...notes.map(([at, text, anchor]) => write(text, across(at), height - 4, anchor)));
    const tip = make("div", { class: "tip", hidden: true });
    const plot = make("div", { class: "plot" }, drawing, tip);
    plot.addEventListener("pointermove", (event) => {
      const box = drawing.getBoundingClientRect(), at = ((event.clientX - box.left) / box.width) * WIDTH;
      const point = points.reduce((best, one) => (!best || Math.abs(across(one.x) - at) < Math.abs(across(best.x) - at) ? one : best), null);
      tip.hidden = !point?.text;
      if (tip.hidden) return;
      const share = (100 * across(point.x)) / WIDTH;
      tip.textContent = point.text;
      tip.style.left = `${share}%`;
      tip.style.transform = `translateX(${-share}%)`;
    });
    plot.addEventListener("pointerleave", () => { tip.hidden = true; });
    const names = legend.map((name, k) => make("span", { class: "ab"[k], text: name }));
    const chart = make("div", { class: "chart", role: "img", "aria-label": label }, make("div", { class: "title" }, make("span", { text: title }), ...names), plot);
    Object.assign(chart.dataset, facts);
    element.replaceChildren(chart);
  }

  /** RMS (mm) of each iteration, phases apart; `now` marks one of them. */
  Viewer.rmsChart = function (element, rms, phases, now) {
    const known = rms.filter(Number.isFinite), n = rms.length, second = phases.indexOf(2), last = Math.max(n - 1, 1);
    if (!known.length) return;
    const top = Math.max(...known) || 1, value = (i) => (Number.isFinite(rms[i]) ? rms[i] : 0);
    draw(element, {
      label: `RMS distance by iteration, from ${known[0].toFixed(2)} to ${known[known.length - 1].toFixed(2)} mm`, title: "RMS distance by iteration (mm)",
      facts: { points: n, now }, height: 108, left: 40, x: [0, last], y: [0, 1.05 * top],
      bands: second > 0 ? [[second, last, 0, 1.05 * top]] : [],
      rules: [0, top / 2, top].map((level) => [level, level.toFixed(level < 10 ? 1 : 0)]),
      line: rms.map((_, i) => [i, value(i)]), points: [{ x: now, y: value(now), series: "a" }],
      notes: [...(second > n * 0.12 || second < 0 ? [[0, "pose", "start"]] : []), ...(second >= 0 ? [[second, "pose and shape", "start"]] : []), [last, `${n} states`, "end"]],
    });
  };

  /** Coefficients of the first modes, [{z, error, name}] at most two; the band is one standard deviation of the model. */
  Viewer.coefficientChart = function (element, series, modes) {
    const K = Math.min(modes, 20, Math.max(...series.map(({ z }) => z.length))), count = series.length;
    const reach = Math.max(3, ...series.flatMap(({ z }) => Array.from(z).slice(0, K).map((value) => Math.ceil(Math.abs(value)))));
    const names = series.map(({ name }) => name).filter(Boolean);
    const points = series.flatMap(({ z, error, name }, s) => Array.from(z).slice(0, K).map((value, k) => {
      const sd = error && Number.isFinite(error[k]) ? error[k] : 0;
      // Two series are a little aside of the number of the mode.
      const x = k + 1 + (s - 0.5 * (count - 1)) * Math.min(K / 45, 0.385);
      return { x, y: value, error: sd, series: "ab"[s], text: `mode ${k + 1}: ${signed(value, 2)}${sd ? ` \u00b1 ${sd.toFixed(2)}` : ""}${name ? ` (${name})` : ""}` };
    }));
    draw(element, {
      label: `Coefficients in standard deviations${names.length ? `, ${names.join(" and ")}` : ""}`, title: `Coefficients${names.length ? "" : " (standard deviations)"}${modes > K ? `, first ${K}` : ""}`,
      facts: { points: points.length }, height: 140, left: 28, x: [0.5, K + 0.5], y: [-reach, reach], bands: [[0.5, K + 0.5, -1, 1]],
      rules: [-reach, 0, reach].map((value) => [value, signed(value, 0)]), points, legend: names, radius: K > 12 ? 3 : 4,
      notes: Array.from({ length: K }, (_, k) => k + 1).filter((mode) => K <= 12 || mode % 5 === 0 || mode === 1).map((mode) => [mode, String(mode), "middle"]),
    });
  };
})();
