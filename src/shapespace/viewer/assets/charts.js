/* Small charts, drawn by uPlot: RMS by iteration, and coefficients in standard deviations with their uncertainty. */
(function () {
  "use strict";

  const Viewer = (window.ShapespaceViewer = window.ShapespaceViewer || {});
  const WIDTH = 350; // px, of a chart in a tab that is not shown
  const TEXT = 11; // px

  const sign = (value, digits = 2) => (value > 0 ? "+" : "") + value.toFixed(digits).replace("-", "\u2212");
  Viewer.sign = sign;

  /** A colour of the style sheet, looked up at each drawing because the theme may have changed. */
  const colour = (name) => () => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const [ACCENT, WARN, SOFT, LINE, CARD, SHADE] = ["--accent", "--warn", "--soft", "--line", "--card", "--shade"].map(colour);
  const font = (size) => `${size}px ${getComputedStyle(document.body).fontFamily}`;

  // Drawing ---------------------------------------------------------------------------------------------------------

  const drawn = new Map(); // element of each chart -> its uPlot
  const resizes = new ResizeObserver((entries) => {
    for (const { target } of entries) {
      const plot = drawn.get(target), width = target.clientWidth;
      if (plot && width && width !== plot.width) plot.setSize({ width, height: plot.height });
    }
  });
  const redraw = () => drawn.forEach((plot) => plot.redraw());
  new MutationObserver(redraw).observe(document.documentElement, { attributeFilter: ["data-theme"] });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);

  /** Draw a chart into `element` in place of the one there; `facts` become data attributes. Return its uPlot. */
  function draw(element, label, facts, options, data) {
    const width = element.clientWidth || WIDTH;
    const before = Array.from(element.children);
    const plot = new uPlot({ width, ...options, scales: { ...options.scales, x: { time: false, ...options.scales.x } } }, data, element);
    before.forEach((child) => child.remove());
    for (const [root, old] of drawn) {
      if (root.isConnected) continue;
      resizes.unobserve(root);
      old.destroy();
      drawn.delete(root);
    }
    plot.root.setAttribute("role", "img");
    plot.root.setAttribute("aria-label", label);
    Object.assign(plot.root.dataset, facts);
    drawn.set(plot.root, plot);
    resizes.observe(plot.root);
    return plot;
  }

  const axis = (size, splits, texts, more) => ({
    size, gap: 6, font: font(TEXT), stroke: SOFT, splits: () => splits, values: () => texts, ticks: { show: false }, grid: { stroke: LINE, width: 1 }, ...more,
  });

  /** Fill a rectangle of the plot, given in values of x and y. */
  function fillBand(plot, x0, x1, y0, y1) {
    const [left, right] = [x0, x1].map((x) => plot.valToPos(x, "x", true)), [top, bottom] = [y1, y0].map((y) => plot.valToPos(y, "y", true));
    plot.ctx.fillStyle = SHADE();
    plot.ctx.fillRect(left, top, right - left, bottom - top);
  }

  /** Write below the plot, aligned at a value of x. */
  function writeBelow(plot, text, x, align) {
    const { ctx } = plot;
    Object.assign(ctx, { font: font(TEXT * uPlot.pxRatio), fillStyle: SOFT(), textAlign: align, textBaseline: "alphabetic" });
    ctx.fillText(text, plot.valToPos(x, "x", true), ctx.canvas.height - 5 * uPlot.pxRatio);
  }

  // Charts ----------------------------------------------------------------------------------------------------------

  /** RMS (mm) of each iteration, phases apart; `now` marks one of them. */
  Viewer.rmsChart = function (element, rms, phases, now) {
    const known = rms.filter(Number.isFinite);
    if (known.length < 1) { element.replaceChildren(); return; }
    const n = rms.length, last = Math.max(n - 1, 1), second = phases.indexOf(2);
    const top = Math.max(...known), limit = top * 1.05 || 1;
    const at = now === null || now === undefined ? n - 1 : now;
    const values = rms.map((value) => (Number.isFinite(value) ? value : 0));
    const splits = [0, top / 2, top];
    draw(element, `RMS distance by iteration, from ${known[0].toFixed(2)} to ${known[known.length - 1].toFixed(2)} mm`, { points: n, now: at }, {
      title: "RMS distance by iteration (mm)",
      height: 100,
      padding: [6, 8, 20, 0],
      scales: { x: { range: [0, last] }, y: { range: [0, limit] } },
      axes: [{ show: false }, axis(40, splits, splits.map((value) => value.toFixed(value < 10 ? 1 : 0)))],
      series: [
        {},
        { stroke: ACCENT, width: 1.8, pxAlign: 0, points: { show: false } },
        { paths: () => null, pxAlign: 0, points: { show: true, size: 12, width: 2, fill: ACCENT, stroke: CARD } },
      ],
      legend: { show: false },
      cursor: { show: false },
      hooks: {
        drawClear: [(plot) => { if (second > 0) fillBand(plot, second, last, 0, limit); }],
        draw: [(plot) => {
          if (second > n * 0.12 || second < 0) writeBelow(plot, "pose", 0, "left");
          if (second >= 0) writeBelow(plot, "pose and shape", second, "left");
          writeBelow(plot, `${n} states`, last, "right");
        }],
      },
    }, [rms.map((_, i) => i), values, values.map((value, i) => (i === at ? value : null))]);
  };

  /** Coefficients of the first modes, [{z, error, name}] at most two; the band is one standard deviation of the model. */
  Viewer.coefficientChart = function (element, series, modes) {
    const K = Math.min(modes, 20, Math.max(...series.map((one) => one.z.length))), count = series.length;
    const reach = Math.max(3, ...series.map((one) => Math.max(...Array.from(one.z).slice(0, K).map((v) => Math.ceil(Math.abs(v))))));
    const names = series.map((one) => one.name).filter(Boolean).join(" and ");
    // The points of all series take turns along x, each series a little aside of the number of the mode.
    const aside = count > 1 ? Math.min(K / 45, 0.385) : 0;
    const points = Array.from({ length: K * count }, (_, i) => {
      const k = Math.floor(i / count), s = i % count, { z, error, name } = series[s];
      const x = k + 1 + (s - 0.5 * (count - 1)) * aside;
      return { s, x, mode: k + 1, name, value: k < z.length ? z[k] : null, error: error && Number.isFinite(error[k]) ? error[k] : 0 };
    });
    const bars = (plot, row) => {
      const stroke = new Path2D();
      for (const { s, x, value, error } of points) {
        if (s !== row - 1 || value === null || !error) continue;
        const left = plot.valToPos(x, "x", true);
        stroke.moveTo(left, plot.valToPos(value - error, "y", true));
        stroke.lineTo(left, plot.valToPos(value + error, "y", true));
      }
      return { stroke };
    };
    const marks = Array.from({ length: K }, (_, k) => k + 1).filter((mode) => K <= 12 || mode % 5 === 0 || mode === 1);
    const tip = Viewer.h("div", { class: "tip", hidden: true });
    const plot = draw(element, `Coefficients in standard deviations${names ? `, ${names}` : ""}`, { points: points.filter(({ value }) => value !== null).length }, {
      title: `Coefficients${names ? "" : " (standard deviations)"}${modes > K ? `, first ${K}` : ""}`,
      height: 132,
      padding: [6, 4, 0, 0],
      scales: { x: { range: [0.5, K + 0.5] }, y: { range: [-reach, reach] } },
      axes: [
        axis(20, marks, marks.map(String), { grid: { show: false } }),
        axis(28, [-reach, 0, reach], [-reach, 0, reach].map((value) => (value === 0 ? "0" : sign(value, 0)))),
      ],
      series: [{}, ...series.map((one, s) => {
        const stroke = s ? WARN : ACCENT, size = K > 12 ? 7 : 9;
        const hollow = { show: true, size: size + 1, width: 1.8, fill: CARD, stroke }, filled = { show: true, size, width: 0, fill: stroke };
        return { label: one.name, class: s ? "b" : "a", stroke, width: 1.4, pxAlign: 0, paths: bars, points: s ? hollow : filled };
      })],
      legend: { show: names !== "", live: false, markers: { width: () => 0, fill: () => "" } },
      cursor: { x: false, y: false, drag: { x: false, y: false }, points: { show: false } },
      hooks: {
        drawClear: [(plot) => fillBand(plot, 0.5, K + 0.5, -1, 1)],
        setCursor: [(plot) => {
          const point = points[plot.cursor.idx];
          tip.hidden = !point || point.value === null;
          if (tip.hidden) return;
          const { x, mode, name, value, error } = point, left = plot.valToPos(x, "x");
          tip.textContent = `mode ${mode}: ${sign(value)}${error ? ` \u00b1 ${error.toFixed(2)}` : ""}${name ? ` (${name})` : ""}`;
          tip.style.left = `${left}px`;
          tip.style.transform = `translateX(${(-100 * left) / plot.over.clientWidth}%)`;
        }],
      },
    }, [points.map(({ x }) => x), ...series.map((_, row) => points.map(({ s, value }) => (s === row ? value : null)))]);
    plot.over.append(tip);
  };
})();
