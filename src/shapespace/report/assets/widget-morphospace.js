/* Shapes as points in the plane of two axes of an ordination. */
(function () {
  "use strict";

  const Shapespace = window.Shapespace;
  const {
    colours, make, signed, css, button, tick, select, niceCeiling, quantile, displacementScale, widget,
    MARKERS, hullOf, ellipseOf, isInside, cleared, shapePicture,
  } = Shapespace.widgetParts;

  /** Shapes as points in the plane of two axes of an ordination; the shape at the marker is drawn next to the mean. */
  Shapespace.widgets.morphospace =
    widget((unpacked, element) => {
      const { facts, arrays } = unpacked, { names, groups, labels } = facts, n = names.length, K = facts.axes.length;
      const model = new Shapespace.Model(unpacked), positions = new Float32Array(model.mean.length);
      const axes = Array.from(facts.first), place = new Float32Array(K), hidden = new Set();
      const shown = { hulls: groups.length > 0, ellipses: groups.length > 0, phylogeny: true, validated: false, coloured: false };
      const canvas = make("canvas", { tabindex: 0, role: "application" }), tip = make("div", { class: "ss-tip", hidden: true });
      const marker = make("span", { class: "ss-marker" }), ring = make("span", { class: "ss-ring", hidden: true });
      const plot = make("div", { class: "ss-plate ss-plot" }, canvas, ring, marker, tip), shapes = make("div", { class: "ss-shapes" });
      const announcement = make("p", { class: "ss-said", "aria-live": "polite" }), bar = make("div", { class: "ss-bar", hidden: true });
      const controls = make("div", { class: "ss-controls" });
      element.classList.add("ss-morphospace");
      element.append(plot, shapes, controls);
      const [picture, average] = ["Shape at the marker", "Mean shape"].map((label) => {
        const plate = make("div", { class: "ss-plate" });
        shapes.append(make("figure", {}, plate, make("figcaption", { text: label })));
        return shapePicture(plate, label, model, facts);
      });
      if (picture.view) picture.view.link(average.view);

      // The plot: scores of shapes from 0, and of internal nodes of the phylogeny from n.
      const score = (v, axis) => (v >= n ? arrays.nodes[(v - n) * K + axes[axis]]
        : (shown.validated ? arrays.cross_validated : arrays.scores)[v * K + axes[axis]]);
      const colourOf = (g) => {
        const colour = colours().categories[g % colours().categories.length];
        return getComputedStyle(element).colorScheme === "dark" && Math.max(...colour) < 0.6 ? colour.map((c) => 0.55 + 0.4 * c) : colour;
      };
      const markerOf = (g) => MARKERS[(g + Math.floor(g / colours().categories.length)) % MARKERS.length];
      let scale = 1, x0 = 0, y0 = 0, over = null, frame = 0, later = 0, stale = {};
      const pixels = ([x, y]) => [x0 + x * scale, y0 - y * scale], at = (v) => [score(v, 0), score(v, 1)];

      function drawPlot() {
        const { context, width, height, line } = cleared(canvas), style = getComputedStyle(element);
        const [left, right, above, below] = [56, width - 14, 12, height - 44], [soft, rule] = ["--soft", "--line"].map((name) => style.getPropertyValue(name));
        const members = Array.from({ length: Math.max(groups.length, 1) }, () => []);
        for (let v = 0; v < n; v++) members[arrays.groups[v]].push(at(v));
        const ellipses = members.map((points, g) => (shown.ellipses && facts.radii[g] ? ellipseOf(points, facts.radii[g]) : []));
        const all = Array.from({ length: n + arrays.nodes.length / K }, (_, v) => at(v)).concat(...ellipses);
        const ends = [0, 1].map((axis) => all.reduce(([low, high], p) => [Math.min(low, p[axis]), Math.max(high, p[axis])], [Infinity, -Infinity]));
        const [[low, high], [bottom, top]] = ends;
        scale = 0.94 * Math.min((right - left) / (high - low || 1e-9), (below - above) / (top - bottom || 1e-9));
        x0 = (left + right - (low + high) * scale) / 2;
        y0 = (above + below + (bottom + top) * scale) / 2;
        const write = (text, x, y, align, font, colour) => {
          Object.assign(context, { font: `${font} ${style.fontFamily}`, fillStyle: colour, textAlign: align, textBaseline: "middle" });
          context.fillText(text, x, y);
        };
        // The least round step whose labels, 52 pixels wide, do not overlap.
        const power = 10 ** Math.floor(Math.log10(52 / scale)), step = [1, 2, 5, 10].map((f) => f * power).find((one) => one * scale >= 51.9);
        const label = (k) => signed(k * step, Math.max(0, -Math.floor(Math.log10(step) + 1e-9))).replace("+", "");
        for (let k = Math.ceil((left - x0) / scale / step), x; (x = x0 + k * step * scale) <= right; k++) {
          line([[x, above], [x, below]], rule, k ? 0.5 : 1.5);
          write(label(k), x, below + 12, "center", "12px", soft);
        }
        for (let k = Math.ceil((y0 - below) / scale / step), y; (y = y0 - k * step * scale) >= above; k++) {
          line([[left, y], [right, y]], rule, k ? 0.5 : 1.5);
          write(label(k), left - 6, y, "right", "12px", soft);
        }
        write(labels[axes[0]], (left + right) / 2, height - 14, "center", "600 13px", style.color);
        context.rotate(-Math.PI / 2);
        write(labels[axes[1]], -(above + below) / 2, 11, "center", "600 13px", style.color);
        context.rotate(Math.PI / 2);
        if (shown.phylogeny) for (let e = 0; e < arrays.edges.length; e += 2) line([0, 1].map((k) => pixels(at(arrays.edges[e + k]))), soft);
        members.forEach((points, g) => {
          if (hidden.has(g) || points.length < 3) return;
          if (shown.hulls) line(hullOf(points).map(pixels), css(colourOf(g), 0.75), 1, css(colourOf(g), 0.1));
          context.setLineDash([6, 4]);
          line(ellipses[g].map(pixels), css(colourOf(g), 0.75));
          context.setLineDash([]);
        });
        const radius = n > 600 ? 3.2 : 5;
        members.forEach((points, g) => {
          const sign = new Path2D(markerOf(g)), path = new Path2D();
          for (const point of hidden.has(g) ? [] : points) path.addPath(sign, new DOMMatrix([radius, 0, 0, radius, ...pixels(point)]));
          Object.assign(context, { fillStyle: css(colourOf(g)), strokeStyle: style.getPropertyValue("--card"), lineWidth: 0.8 });
          context.fill(path);
          context.stroke(path);
        });
        for (const v of selected) {
          context.beginPath();
          context.arc(...pixels(at(v)), radius + 4, 0, 7);
          Object.assign(context, { strokeStyle: style.color, lineWidth: 2 });
          context.stroke();
        }
        if (lasso.length) line(lasso, style.color, 1.5, css(colours().unknown, 0.2));
      }
      const request = (changed) => {
        Object.assign(stale, changed);
        frame = frame || requestAnimationFrame(draw);
      };
      function draw() {
        const { plot: points, shape } = stale;
        [frame, stale] = [0, {}];
        if (points) drawPlot();
        const put = (mark, [x, y]) => { mark.style.transform = `translate(${x}px, ${y}px)`; };
        put(marker, pixels(axes.map((k) => place[k])));
        ring.hidden = tip.hidden = over === null;
        if (over !== null) {
          const [x, y] = pixels(at(over));
          put(ring, [x, y]);
          tip.textContent = title(over);
          tip.style.left = `${Math.max(4, Math.min(x + 12, plot.clientWidth - tip.offsetWidth - 4))}px`;
          tip.style.top = `${Math.max(4, y - tip.offsetHeight - 10)}px`;
        }
        if (!shape) return;
        picture.show(model.vertices(place, positions));
        if (facts.planar) average.show(model.mean);
        else paint();
      }
      function paint() {
        bar.hidden = !shown.coloured;
        if (!shown.coloured) return picture.view.paint("shape", null);
        const moved = model.displacement(place), end = niceCeiling(quantile(moved, 0.98));
        const scale = displacementScale(model, end, "from the mean", facts.unit);
        picture.view.paint("shape", moved, { map: scale.map, range: scale.range });
        Shapespace.colourBar(bar, scale);
      }

      // The marker
      const title = (v) => (groups.length ? `${names[v]}: ${groups[arrays.groups[v]]}` : names[v]);
      const moveTo = (x, y, v = null) => {
        place.fill(0);
        [place[axes[0]], place[axes[1]]] = [x, y];
        // What rests is announced: words that change with each frame would be read aloud, and cost half of its time.
        clearTimeout(later);
        later = setTimeout(() => {
          const digits = Math.max(0, Math.ceil(Math.log10(scale))), values = [x, y].map((value, k) => `${facts.axes[axes[k]]} ${signed(value, digits)}`);
          list.value = v === null ? "" : String(v);
          announcement.textContent = `Marker at ${values.join(", ")}${v === null ? "" : `, the place of ${title(v)}`}.`;
        }, 150);
        request({ shape: true });
      };
      // The selection: by a line around points, or from the list.
      const selected = new Set(), chosen = make("span", { role: "status" });
      let lasso = [], selects = false;
      function changeSelection() {
        const marked = Array.from(selected, (v) => names[v]);
        chosen.textContent = marked.length ? `${marked.length} selected: ${marked.slice(0, 6).join(", ")}${marked.length > 6 ? " \u2026" : ""}` : "";
        for (const one of [copy, clear]) one.hidden = !marked.length;
        request({ plot: true });
        // The studio offers to exclude or to group them.
        element.dispatchEvent(new CustomEvent("shapespace:selected", { bubbles: true, composed: true, detail: marked }));
      }
      const selector = button("Select", () => {
        selects = !selects;
        selector.setAttribute("aria-pressed", String(selects));
      }, { "aria-pressed": "false", title: "Draw a line around shapes to select them; with Shift, add to the selection" });
      const copy = button("Copy names", () => {
        const marked = Array.from(selected, (v) => names[v]);
        // Without access to the clipboard the names are shown to be copied by hand.
        navigator.clipboard.writeText(marked.join("\n")).catch(() => { chosen.textContent = marked.join(", "); });
      }, { hidden: true });
      const clear = button("Clear selection", () => { selected.clear(); changeSelection(); }, { hidden: true });
      const selectOne = button("Select this shape", () => { if (list.value !== "") { selected.add(Number(list.value)); changeSelection(); } });
      function endLasso(event) {
        if (!event.shiftKey) selected.clear();
        for (let v = 0; v < n; v++) if (!hidden.has(arrays.groups[v]) && isInside(pixels(at(v)), lasso)) selected.add(v);
        lasso = [];
        changeSelection();
      }
      let drags = false;
      const point = (event) => {
        let least = event.pointerType === "touch" ? 256 : 81; // square of the distance within which a shape is meant, pixels
        over = null;
        for (let v = 0; v < n; v++) {
          const [x, y] = pixels(at(v)), far = (x - event.offsetX) ** 2 + (y - event.offsetY) ** 2;
          if (far < least && !hidden.has(arrays.groups[v])) [least, over] = [far, v];
        }
        if (!drags) request({});
        else if (over !== null) moveTo(...at(over), over);
        else moveTo((event.offsetX - x0) / scale, (y0 - event.offsetY) / scale);
      };
      canvas.addEventListener("pointerdown", (event) => {
        drags = event.button === 0;
        if (drags) canvas.setPointerCapture(event.pointerId);
        if (drags && selects) lasso = [[event.offsetX, event.offsetY]];
        else point(event);
      });
      canvas.addEventListener("pointermove", (event) => {
        if (!lasso.length) return point(event);
        lasso.push([event.offsetX, event.offsetY]);
        request({ plot: true });
      });
      for (const name of ["pointerup", "pointercancel"]) {
        canvas.addEventListener(name, (event) => {
          drags = false;
          if (lasso.length) endLasso(event);
        });
      }
      canvas.addEventListener("pointerleave", () => { over = null; request({}); });
      canvas.addEventListener("keydown", (event) => {
        const step = ((event.shiftKey ? 0.1 : 0.02) * canvas.clientWidth) / scale;
        const by = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1], Home: [0, 0] }[event.key];
        if (!by || event.ctrlKey || event.metaKey || event.altKey) return;
        event.preventDefault();
        moveTo(...by.map((one, axis) => (event.key === "Home" ? 0 : place[axes[axis]] + one * step)));
      });

      // Controls
      const { row: specimens, list } = select("Shape", [["", "none chosen"], ...names.map((name, v) => [String(v), name])], "", (key) =>
        key === "" ? moveTo(0, 0) : moveTo(...at(Number(key)), Number(key)));
      const legend = make("div", { class: "ss-buttons", role: "group", "aria-label": `Groups of ${facts.variable}` });
      groups.forEach((name, g) => {
        const toggle = button(name, () => {
          if (!hidden.delete(g)) hidden.add(g);
          toggle.setAttribute("aria-pressed", String(!hidden.has(g)));
          request({ plot: true });
        }, { class: "ss-group", "aria-pressed": "true" });
        toggle.insertAdjacentHTML("afterbegin", `<svg viewBox="-1.5 -1.5 3 3" aria-hidden="true"><path d="${markerOf(g)}"/></svg>`);
        legend.append(toggle);
      });
      const redraw = () => {
        legend.querySelectorAll("path").forEach((path, g) => path.setAttribute("fill", css(colourOf(g))));
        canvas.setAttribute("aria-label", `${n} shapes on ${labels[axes[0]]} and ${labels[axes[1]]}. Click, or press the arrow keys, to move the marker; Home goes to the mean.`);
        request({ plot: true, shape: true });
      };
      const choices = ["Across", "Up"].map((name, axis) => select(name, labels.map((label, k) => [String(k), label]), String(axes[axis]), (key) => {
        axes[axis] = Number(key);
        moveTo(place[axes[0]], place[axes[1]]);
        redraw();
      }).row);
      const ticks = [["Convex hulls", "hulls", groups.length], ["95 % ellipses", "ellipses", groups.length], ["Phylogeny", "phylogeny", arrays.edges.length],
        ["Leave-one-out scores", "validated", arrays.cross_validated], ["Colour by distance from the mean", "coloured", !facts.planar]];
      controls.append(legend, make("div", { class: "ss-buttons" }, ...ticks.filter((one) => one[2]).map(([text, key]) =>
        tick(text, shown[key], (on) => { shown[key] = on; redraw(); }))), bar, make("div", { class: "ss-choices" }, ...choices, specimens),
        make("div", { class: "ss-buttons" }, selector, selectOne, copy, clear, chosen), announcement);
      document.addEventListener("shapespace:theme", redraw);
      new ResizeObserver(redraw).observe(plot);
      drawPlot();
      moveTo(0, 0);
      return { view: { works: true } }; // without WebGL too, which the pictures state
    });
})();
