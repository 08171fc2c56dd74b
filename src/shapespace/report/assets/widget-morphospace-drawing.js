/* Drawing of a morphospace: markers, convex hulls, ellipses, and planar landmarks with their grid. */
(function () {
  "use strict";

  const Shapespace = window.Shapespace;
  const { colours, make, css } = Shapespace.widgetParts;

  // Circle, square, triangle, diamond, triangle, plus, cross, star: as MARKERS of morphospace_figures.py.
  const MARKERS = [
    "M-1 0A1 1 0 1 0 1 0A1 1 0 1 0-1 0Z", "M-.9-.9H.9V.9H-.9Z", "M0-1.2L1.1.8H-1.1Z", "M0-1.3L1.1 0 0 1.3-1.1 0Z",
    "M0 1.2L1.1-.8H-1.1Z", "M-.4-1.2H.4V-.4H1.2V.4H.4V1.2H-.4V.4H-1.2V-.4H-.4Z",
    "M-1.2-.7L-.7-1.2 0-.5.7-1.2 1.2-.7.5 0 1.2.7.7 1.2 0 .5-.7 1.2-1.2.7-.5 0Z",
    "M0-1.4L.4-.5 1.4-.4.65.25.85 1.2 0 .7-.85 1.2-.65.25-1.4-.4-.4-.5Z",
  ];

  /** Corners of the convex hull of points [[x, y], ...], by Andrew's monotone chain. */
  function hullOf(points) {
    const chain = (list) => list.reduce((out, p) => {
      const left = ([a, b]) => (b[0] - a[0]) * (p[1] - a[1]) - (b[1] - a[1]) * (p[0] - a[0]) > 0;
      while (out.length > 1 && !left(out.slice(-2))) out.pop();
      return out.push(p), out;
    }, []).slice(0, -1);
    const sorted = points.slice().sort((a, b) => a[0] - b[0] || a[1] - b[1]);
    return chain(sorted).concat(chain(sorted.reverse()));
  }

  /** Points of the ellipse of a Mahalanobis radius about the mean of points, by the Cholesky factor of their covariance. */
  function ellipseOf(points, radius) {
    const mean = (of) => points.reduce((sum, p) => sum + of(p), 0) / points.length, mx = mean((p) => p[0]), my = mean((p) => p[1]);
    const unbiased = points.length / (points.length - 1), cross = (i, j) => unbiased * mean((p) => (p[i] - [mx, my][i]) * (p[j] - [mx, my][j]));
    const a = Math.sqrt(cross(0, 0)) || 1e-12, b = cross(0, 1) / a, c = Math.sqrt(Math.max(cross(1, 1) - b * b, 0));
    return Array.from({ length: 73 }, (_, k) => [Math.cos((k * Math.PI) / 36) * radius, Math.sin((k * Math.PI) / 36) * radius])
      .map(([u, v]) => [mx + a * u, my + b * u + c * v]);
  }

  /** Whether a point lies in a polygon, by the parity of its crossings to the right. */
  const isInside = ([x, y], corners) => corners.reduce((inside, [x1, y1], k) => {
    const [x2, y2] = corners[(k + 1) % corners.length];
    return y1 > y !== y2 > y && x < x1 + ((y - y1) * (x2 - x1)) / (y2 - y1) ? !inside : inside;
  }, false);

  /** An empty canvas of the size of its element: its context and sizes in CSS pixels, and a function that draws a line. */
  function cleared(canvas) {
    const ratio = Math.min(window.devicePixelRatio || 1, 2), { clientWidth: width, clientHeight: height } = canvas;
    const context = canvas.getContext("2d");
    canvas.width = Math.round(width * ratio); // which empties it
    canvas.height = Math.round(height * ratio);
    context.scale(ratio, ratio);
    const line = (points, colour, size = 1, fill = null) => {
      context.beginPath();
      points.forEach((point) => context.lineTo(...point));
      Object.assign(context, { strokeStyle: colour, lineWidth: size, fillStyle: fill });
      if (fill) context.closePath(), context.fill();
      context.stroke();
    };
    return { context, width, height, line };
  }

  /** A picture of planar landmarks with their grid, or a view of other shapes: {show(positions)}. */
  function shapePicture(element, label, model, facts) {
    const { mean, faces } = model, [lines, size] = facts.grid, L = facts.landmarks;
    const range = (count, of) => Array.from({ length: count }, (_, k) => of(k));
    if (!facts.planar) {
      const view = new Shapespace.View(element, { label }), at = (p, v) => [p[3 * v], p[3 * v + 1], p[3 * v + 2]];
      view.setSurface("shape", { positions: mean, faces, colour: faces ? colours().clay : colours().model });
      view.frame(["shape"], faces ? 1.1 : 1.3);
      // Landmarks are small, so that the vectors from those of the mean are seen.
      if (!faces && L <= 500) view.setSurface("shape", { positions: mean, colour: colours().model, size: 0.035 * Math.max(...view.camera.extent) });
      return { view, show: (positions) => {
        view.move("shape", positions);
        if (facts.links.length) view.lines("links", facts.links.flat().map((v) => at(positions, v)), colours().unknown);
        if (!faces) view.lines("vectors", range(2 * L, (k) => at(k % 2 ? positions : mean, k >> 1)), colours().signal);
      } };
    }
    const canvas = make("canvas", { role: "img", "aria-label": label });
    element.append(canvas);
    const ends = [0, 1].map((k) => range(mean.length / 3, (v) => mean[3 * v + k])).map((all) => [Math.min(...all), Math.max(...all)]);
    const [[left, right], [low, high]] = ends;
    return { show: (positions) => {
      const { context, width, height, line } = cleared(canvas), style = getComputedStyle(element);
      const scale = 0.84 * Math.min(width / (right - left), height / (high - low));
      const at = (p, v) => [width / 2 + (p[3 * v] - (left + right) / 2) * scale, height / 2 - (p[3 * v + 1] - (low + high) / 2) * scale];
      for (let k = 0; k < lines; k++) line(range(size, (j) => at(positions, L + k * size + j)), style.getPropertyValue("--line"));
      for (const pair of facts.links) line(pair.map((v) => at(positions, v)), style.color, 1.5);
      for (let v = 0; v < L; v++) line([at(mean, v), at(positions, v)], css(colours().signal), 2);
      context.fillStyle = style.color;
      for (let v = 0; v < L; v++) context.beginPath(), context.arc(...at(positions, v), 2.6, 0, 7), context.fill();
    } };
  }

  Object.assign(Shapespace.widgetParts, { MARKERS, hullOf, ellipseOf, isInside, cleared, shapePicture });
})();
