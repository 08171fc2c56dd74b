/* Sliders that move a shape model along its modes, or from one shape to another. */
(function () {
  "use strict";

  const Shapespace = window.Shapespace;
  const {
    colours, make, signed, slider, button, animation, tick, select, niceCeiling, quantile, lazily, stage,
  } = Shapespace.widgetParts;

  /** Sliders that move a shape model along its modes. */
  Shapespace.widgets.modes = (element, payload, options) =>
    lazily(element, payload, (unpacked) => {
      const { most = 8, reach = 3 } = options || {};
      const model = new Shapespace.Model(unpacked);
      const { view, controls } = stage(element, "The shape at the coefficients of the sliders");
      const K = Math.min(most, model.K);
      const z = new Float32Array(model.K), positions = new Float32Array(3 * model.V);
      view.setSurface("shape", { positions: model.vertices(z), faces: model.faces, colour: colours().clay });
      view.frame();

      let coloured = false, top = 0;
      const bar = make("div", { class: "ss-bar", hidden: true });
      const draw = () => {
        view.move("shape", model.vertices(z, positions));
        if (coloured) paint();
      };
      const paint = () =>
        view.paint("shape", model.displacement(z), { map: model.faces ? colours().diverging : colours().sequential,
          range: [model.faces ? -top : 0, top] });

      const share = unpacked.arrays.share;
      const rows = [];
      for (let k = 0; k < K; k++) {
        const percent = share ? 100 * share[k] : NaN;
        rows.push(slider({
          label: `Mode ${k + 1}`, min: -reach, max: reach, step: 0.1, value: 0,
          note: Number.isFinite(percent) ? `${percent.toFixed(percent < 9.95 ? 1 : 0)} %` : "",
          show: (value) => `${signed(value, 1)} sd`,
          input: (value) => {
            stop();
            z[k] = value;
            draw();
          },
        }));
      }
      const put = (values) => {
        for (let k = 0; k < z.length; k++) z[k] = values(k);
        rows.forEach((row, k) => row.put(z[k]));
        draw();
      };
      const which = select("Mode to animate", rows.map((_, k) => [String(k), `Mode ${k + 1}`]), "0", () => restart());
      which.row.classList.add("ss-inline");
      const { toggle, stop, restart } = animation(element, reach, () => {
        const k = Number(which.list.value);
        return { value: z[k], put: (value) => {
          z[k] = value;
          rows[k].put(z[k]);
          draw();
        } };
      });

      controls.append(
        make("div", { class: "ss-sliders", role: "group", "aria-label": "Modes, in standard deviations" },
          ...rows.map((row) => row.row)),
        make("div", { class: "ss-buttons" },
          button("Reset", () => { stop(); put(() => 0); }),
          button("Random", () => { stop(); put(() => Math.max(-reach, Math.min(reach, normal()))); })),
        make("div", { class: "ss-buttons" }, toggle, which.row),
        tick("Colour by distance from the mean", false, (on) => {
          coloured = on;
          if (on && !top) {
            const one = new Float32Array(model.K);
            let most = 0;
            for (let k = 0; k < Math.min(3, model.K); k++) {
              one.fill(0);
              one[k] = reach;
              most = Math.max(most, quantile(model.displacement(one), 0.95) || 0);
            }
            top = niceCeiling(most);
            Shapespace.colourBar(bar, {
              map: model.faces ? colours().diverging : colours().sequential, range: [model.faces ? -top : 0, top],
              unit: "mm", title: model.faces ? "Moved inwards (\u2212) or outwards (+)" : "Moved", open: true,
            });
          }
          bar.hidden = !on;
          if (on) paint();
          else view.paint("shape", null);
        }),
        bar
      );
      return { view, model, z, draw };
    });

  /** A slider that moves one shape to another. */
  Shapespace.widgets.morph = (element, payload) =>
    lazily(element, payload, (unpacked) => {
      const model = new Shapespace.Model(unpacked), { low, high, weights, variable, range } = unpacked.facts;
      const { view, controls } = stage(element, `A shape between ${low} and ${high}, at the value of the slider`);
      const at = new Float32Array(weights[0]), positions = new Float32Array(3 * model.V);
      let now = -1;
      /** Sets the shape at a value from -1 to 1. */
      const move = (value) => {
        now = value;
        const place = (value + 1) / 2 * (weights.length - 1), before = Math.min(Math.floor(place), weights.length - 2);
        for (let k = 0; k < at.length; k++) {
          at[k] = weights[before][k] + (place - before) * (weights[before + 1][k] - weights[before][k]);
        }
        draw();
      };
      view.setSurface("shape", { positions: model.vertices(at), faces: model.faces, colour: colours().clay });
      view.frame();
      const bar = make("div", { class: "ss-bar", hidden: true });
      const draw = () => view.move("shape", model.vertices(at, positions));
      const words = (value) => {
        if (variable) return `${variable} ${Number((range[0] + (value + 1) / 2 * (range[1] - range[0])).toPrecision(3))}`;
        return value <= -1 ? low : value >= 1 ? high : `${Math.round(50 + 50 * value)} % of the way`;
      };
      const row = slider({
        label: `${low} to ${high}`, min: -1, max: 1, step: 0.02, value: -1, show: words,
        input: (value) => {
          stop();
          move(value);
        },
      });
      row.row.classList.add("ss-wide");
      const { toggle, stop } = animation(element, 1, () => ({ value: now, put: (value) => {
        row.put(value);
        move(value);
      } }));
      const map = model.faces ? colours().diverging : colours().sequential;
      let change = null, top = 0;
      const put = (value) => {
        stop();
        row.put(value);
        move(value);
      };
      controls.append(
        make("div", { class: "ss-sliders", role: "group", "aria-label": "Between the two shapes" }, row.row),
        make("div", { class: "ss-buttons" }, button(low, () => put(-1)), button(high, () => put(1)), toggle),
        tick("Colour by how far it moves", false, (on) => {
          if (on && !change) {
            change = model.displacement(weights[weights.length - 1].map((value, k) => value - weights[0][k]));
            top = niceCeiling(quantile(change, 0.98));
            Shapespace.colourBar(bar, {
              map, range: [model.faces ? -top : 0, top], unit: "mm", open: true,
              title: model.faces ? "Inwards (\u2212) or outwards (+), from one end to the other" : "Moved",
            });
          }
          bar.hidden = !on;
          view.paint("shape", on ? change : null, { map, range: [model.faces ? -top : 0, top] });
        }),
        bar
      );
      return { view, model, at, draw };
    });

  /** A number from the standard normal distribution. */
  function normal() {
    return Math.sqrt(-2 * Math.log(1 - Math.random())) * Math.cos(2 * Math.PI * Math.random());
  }
})();
