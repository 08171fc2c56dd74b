/* Coefficients as points in three dimensions. */
(function () {
  "use strict";

  const Shapespace = window.Shapespace;
  const { colours, make, signed, select, swatches, staged } = Shapespace.widgetParts;

  /** Coefficients as points in three dimensions, coloured by label. */
  Shapespace.widgets.scatter =
    staged((unpacked, { stage, controls }) => {
      const { facts, arrays } = unpacked;
      const [n, K] = arrays.points.shape;
      const view = stage.a, plate = view.element;
      view.label = `${n} points in the space of coefficients`;
      const tip = make("div", { class: "ss-tip", hidden: true });
      plate.append(tip);
      const axes = [0, 1, 2].map((k) => Math.min(k, K - 1));
      const colourOf = (v) => colours().categories[arrays.labels[v] % colours().categories.length];
      const value = (v, axis) => arrays.points[v * K + axes[axis]];
      let size = 1;

      function place() {
        const positions = new Float32Array(3 * n);
        let most = 1e-6;
        for (let v = 0; v < n; v++) {
          for (let axis = 0; axis < 3; axis++) {
            const at = axis < K ? value(v, axis) : 0;
            positions[3 * v + axis] = at;
            if (Number.isFinite(at)) most = Math.max(most, Math.abs(at));
          }
        }
        size = 1.08 * most;
        view.setSurface("points", { positions, faces: null, size: 0.055 * size });
        view.paint("points", arrays.labels, { categories: [...new Set(arrays.labels)].length ? palette() : [] });
        const s = size, axisNames = axes.map((k) => facts.axes[k] || `b${k + 1}`);
        const on = (axis, at, aside = 0) => [0, 1, 2].map((k) => (k === axis ? at : k === (axis === 1 ? 0 : 1) ? aside : 0));
        const step = tickStep(most), digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
        const segments = [], texts = axisNames.map((label, axis) => ({ position: on(axis, s), label }));
        for (const axis of [0, 1, 2]) {
          segments.push(on(axis, -s), on(axis, s));
          for (let k = 1; k * step < 0.93 * s; k++) {
            for (const at of [-k * step, k * step]) {
              segments.push(on(axis, at, -0.018 * s), on(axis, at, 0.018 * s));
              texts.push({ position: on(axis, at, -0.018 * s), label: signed(at, digits).replace("+", ""), small: true, left: axis === 1 });
            }
          }
        }
        view.lines("axes", segments, [0.55, 0.55, 0.55]);
        view.texts("axes", texts);
        ticks = texts.filter((text) => text.small).map((text) => text.label);
        if (!framed) view.frame(["axes"]), (view.camera = { yaw: 0.55, pitch: 0.35 });
        framed = true;
        show(null);
      }
      let framed = false, ticks = [];
      const palette = () => facts.labels.map((_, k) => colours().categories[k % colours().categories.length]);

      function show(v, at) {
        tip.hidden = v === null;
        view.remove("chosen");
        if (v === null) return;
        const label = facts.labels[arrays.labels[v]];
        tip.textContent = label && label !== facts.names[v] ? `${facts.names[v]}: ${label}` : facts.names[v];
        const point = [0, 1, 2].map((axis) => (axis < K ? value(v, axis) : 0));
        view.marks("chosen", [{ position: point, label: "", colour: colourOf(v) }]);
        const [x, y] = at || view.project(point);
        tip.style.left = `${Math.max(4, Math.min(x + 12, plate.clientWidth - tip.offsetWidth - 4))}px`;
        tip.style.top = `${Math.max(4, Math.min(y - tip.offsetHeight - 8, plate.clientHeight - tip.offsetHeight - 4))}px`;
      }

      const names = select("Point", [["", "none chosen"], ...facts.names.map((name, v) => [String(v), name])], "", (key) =>
        show(key === "" ? null : Number(key))
      );
      let over = null;
      const under = (event) => {
        const hit = view.pick(event.clientX, event.clientY, ["points"]);
        return hit ? hit.vertex : null;
      };
      view.on("hover", (event) => {
        const v = under(event);
        if (v === over) return;
        over = v;
        show(v === null && names.list.value !== "" ? Number(names.list.value) : v);
      });
      view.on("click", (event) => {
        const v = under(event);
        names.list.value = v === null ? "" : String(v);
        show(v);
      });
      view.on("camera", () => {
        if (names.list.value !== "" && !tip.hidden) show(Number(names.list.value));
        else if (!tip.hidden) show(null);
      });
      const choices = facts.axes.map((name, k) => [String(k), name]);
      ["Across", "Up", "Deep"].slice(0, Math.min(3, K)).forEach((name, axis) => {
        controls.append(select(name, choices, String(axes[axis]), (key) => {
          axes[axis] = Number(key);
          place();
        }).row);
      });
      controls.append(
        names.row,
        swatches(facts.labels.map((label, k) => [label, palette()[k]])),
        make("p", { class: "ss-hint", text: facts.unit ? `Axes in ${facts.unit}.` : "" })
      );
      place();
      return { axes, ticks: () => ticks };
    });

  /** A round step of which two or three fit below `most`. */
  function tickStep(most) {
    const power = 10 ** Math.floor(Math.log10(most / 2));
    return [5, 2, 1].map((factor) => factor * power).find((step) => 2 * step <= most * 1.0001) || power;
  }
})();
