/* Sliders that move a shape model along its modes, or from one shape to another. */
(function () {
  "use strict";

  const Shapespace = window.Shapespace;
  const parts = Shapespace.widgetParts;
  const { make, signed, percent, slider, button, animation, swing, tick, choice, niceCeiling, quantile, displacementScale, staged } = parts;

  const REACH = 3; // standard deviations
  const SHOWN_AT_FIRST = 12; // modes

  /** A number from the standard normal distribution, by Box and Muller. */
  const normal = () => Math.sqrt(-2 * Math.log(1 - Math.random())) * Math.cos(2 * Math.PI * Math.random());
  parts.randomShape = (count) => Array.from({ length: count }, () => Math.max(-REACH, Math.min(REACH, normal())));

  /** Position of a landmark: `at` has the vertices of its triangle and their barycentric weights. */
  const onSurface = (positions, at) => [0, 1, 2].map((axis) => at.vertices.reduce((sum, v, k) => sum + at.weights[k] * positions[3 * v + axis], 0));

  const MOVES = { both: "Shape and pose", shape: "Shape only", pose: "Pose only" };

  /** Sliders that move `model` along its modes; z: the coefficients, standard deviations; onchange(): they were changed by hand. */
  parts.modes = function ({ facts, arrays }, { stage, controls, model, z, onchange = () => {} }) {
    let positions, top = 0, moves = "both";
    const on = { map: false, landmarks: false };
    const draw = () => {
      positions = model.vertices(z, positions, moves);
      stage.show(draw, { positions, faces: model.faces, parts: model.parts });
      stage.captions(!z.some((value) => value) ? "The mean shape" : moves === "both" ? "" : MOVES[moves]);
      const moved = on.map ? model.displacement(z, [], moves) : null, most = moved ? quantile(moved, 0.98) : 0;
      if (moved && (most > top || most < top / 4)) top = niceCeiling(most);
      stage.paint(moved, displacementScale(model, top, "from the mean"));
      const marks = on.landmarks ? Object.entries(facts.landmarks) : [];
      const placed = stage.a.placed("model", positions);
      stage.a.marks("landmarks", marks.map(([label, at]) => ({ position: onSurface(placed, at), label })).filter(({ position }) => position.every(Number.isFinite)));
    };
    const act = (change) => () => {
      stop();
      change();
      draw();
      onchange();
    };

    const ticks = [];
    const rows = Array.from({ length: model.K }, (_, k) => {
      const number = k + 1, share = arrays.share[k];
      const row = slider({
        label: `${number} `, name: `Mode ${number}, standard deviations`, note: Number.isFinite(share) ? percent(share) : "", testid: `mode-${number}`,
        min: -REACH, max: REACH, step: 0.05, value: z[k], origin: 0, show: (value) => signed(value, 2),
        input: (value) => act(() => set(k, value))(),
      });
      row.undo = button("\u00d7", act(() => set(k, 0)), { class: "ss-undo", "aria-label": `Set mode ${number} back to zero`, title: "Back to zero", "data-testid": `reset-${number}` });
      row.output.dataset.testid = `value-${number}`;
      ticks.push(make("input", {
        type: "checkbox", "aria-label": `Animate mode ${number}`, title: `Animate mode ${number}`, "data-testid": `animate-${number}`,
        onchange: () => { toggle.disabled = !ticks.some((box) => box.checked); },
      }));
      row.row.classList.add("ss-mode");
      row.row.prepend(ticks[k]);
      row.row.append(row.undo);
      row.row.hidden = k >= SHOWN_AT_FIRST;
      return row;
    });
    ticks[0].checked = true;
    const set = (k, value) => {
      z[k] = value;
      rows[k].put(value);
      rows[k].undo.disabled = value === 0;
    };
    const setShape = (values) => {
      for (let k = 0; k < z.length; k++) z[k] = values[k] || 0;
      rows.forEach((_, k) => set(k, z[k]));
    };
    const { toggle, stop } = animation(controls, () => {
      const chosen = ticks.flatMap((box, k) => (box.checked ? [k] : []));
      // One mode swings all the way; several together stay where shapes are likely.
      const reach = chosen.length === 1 ? REACH : Math.max(1, REACH / Math.sqrt(chosen.length));
      const swings = chosen.map((k, j) => swing(z[k], reach, 4 + 0.7 * j));
      return (seconds) => {
        chosen.forEach((k, j) => set(k, swings[j](seconds)));
        draw();
      };
    }, "Animate", "animate");
    const option = (key, text) => tick(text, false, (checked) => {
      on[key] = checked;
      draw();
    }, key);
    const rest = model.K - SHOWN_AT_FIRST;
    const more = rest > 0 ? button(`Show ${rest} more modes`, () => {
      rows.forEach(({ row }) => { row.hidden = false; });
      more.remove();
      rows[SHOWN_AT_FIRST].range.focus();
    }, { "data-testid": "more-modes" }) : null;
    controls.append(
      make("div", { class: "ss-buttons" },
        button("Mean shape", act(() => setShape([])), { "data-testid": "reset-all" }),
        button("Random shape", act(() => setShape(parts.randomShape(z.length))), { "data-testid": "random" }), toggle),
      model.articulation ? choice("Modes move", Object.entries(MOVES), moves, (key) => {
        moves = key;
        draw();
      }, "moves").row : "",
      make("p", { class: "ss-hint", text: "Each slider is one mode with its share of the variance, in standard deviations. Animate swings the modes that are ticked." }),
      make("div", { class: "ss-buttons" }, option("map", "Colour by distance from the mean"), Object.keys(facts.landmarks).length ? option("landmarks", "Landmarks") : null),
      make("div", { class: "ss-sliders", role: "group", "aria-label": "Modes, in standard deviations", "data-testid": "sliders" }, ...rows.map(({ row }) => row), more)
    );
    setShape(z);
    return { z, draw, stop, setShape };
  };

  Shapespace.widgets.modes = staged((unpacked, options) => {
    const model = new Shapespace.Model(unpacked), made = parts.modes(unpacked, { ...options, model, z: new Float64Array(model.K) });
    options.stage.a.label = "The shape at the coefficients of the sliders";
    made.draw();
    options.stage.a.frame();
    return made;
  });

  /**
   * A slider from one shape to another. at(value): the coefficients at a value from -1 to 1, words(value): its name;
   * ends: texts of the buttons of both ends, label: of the slider.
   */
  parts.morph = function (model, { stage, controls, at, words, ends, label }) {
    let now = -1, positions, change = null, isColoured = false;
    /** Draw the shape; isNew: from other ends. */
    const draw = (isNew) => {
      positions = model.vertices(at(now), positions);
      stage.show(draw, { positions, faces: model.faces, parts: model.parts });
      stage.captions(words(now));
      if (isNew) {
        change = null;
        row.put(now);
      }
      if (isColoured && !change) change = model.displacement(at(1), at(-1));
      const top = change ? niceCeiling(quantile(change, 0.98)) : 0;
      stage.paint(isColoured ? change : null, displacementScale(model, top, "from one end to the other"));
    };
    const move = (value) => {
      now = value;
      row.put(value);
      draw();
    };
    const put = (value) => {
      stop();
      move(value);
    };
    const row = slider({ label, min: -1, max: 1, step: 0.01, value: -1, show: words, testid: "walk", input: put });
    row.row.classList.add("ss-wide");
    const { toggle, stop } = animation(controls, () => {
      const way = swing(now, 1);
      return (seconds) => move(way(seconds));
    }, "Animate", "walk-play");
    controls.append(
      make("div", { class: "ss-sliders", role: "group", "aria-label": "Between the two shapes" }, row.row),
      make("div", { class: "ss-buttons" }, ...ends.map((text, k) => button(text, () => put(2 * k - 1))), toggle),
      tick("Colour by how far it moves", false, (on) => {
        isColoured = on;
        draw();
      }, "difference")
    );
    return { draw, stop, now: () => at(now) };
  };

  /** A slider that moves one shape to another, along a line or a path. */
  Shapespace.widgets.morph = staged((unpacked, options) => {
    const model = new Shapespace.Model(unpacked), { low, high, weights, variable, range } = unpacked.facts;
    const at = (value) => {
      const place = (value + 1) / 2 * (weights.length - 1), before = Math.min(Math.floor(place), weights.length - 2);
      return weights[before].map((weight, k) => weight + (place - before) * (weights[before + 1][k] - weight));
    };
    const words = (value) => {
      if (variable) return `${variable} ${Number((range[0] + (value + 1) / 2 * (range[1] - range[0])).toPrecision(3))}`;
      return value <= -1 ? low : value >= 1 ? high : `${Math.round(50 + 50 * value)} % of the way`;
    };
    const made = parts.morph(model, { ...options, at, words, ends: [low, high], label: `${low} to ${high}` });
    options.stage.a.label = `A shape between ${low} and ${high}, at the value of the slider`;
    made.draw();
    options.stage.a.frame();
    return made;
  });
})();
