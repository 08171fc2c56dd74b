/* Views with their controls, for report and viewer. Needs scene.js and Shapespace.colours before it. */
(function () {
  "use strict";

  const Shapespace = window.Shapespace;
  const colours = () => Shapespace.colours;
  let counted = 0;

  // Pieces ----------------------------------------------------------------------------------------------------------

  function make(tag, attributes, ...children) {
    const element = document.createElement(tag);
    for (const [name, value] of Object.entries(attributes || {})) {
      if (name === "text") element.textContent = value;
      else if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
      else if (value === true) element.setAttribute(name, "");
      else if (value !== false && value !== null && value !== undefined) element.setAttribute(name, value);
    }
    element.append(...children);
    return element;
  }

  const signed = (value, digits) => (value > 0 ? "+" : value < 0 ? "\u2212" : "") + Math.abs(value).toFixed(digits);

  /** A named range input with its value beside it. */
  function slider({ label, note = "", min, max, step, value, show, input }) {
    const id = `ss-${++counted}`;
    const output = make("output", { for: id, text: show(value) });
    const range = make("input", { type: "range", id, min, max, step, value, "aria-valuetext": show(value) });
    const told = () => {
      output.textContent = show(Number(range.value));
      range.setAttribute("aria-valuetext", output.textContent);
    };
    range.addEventListener("input", () => {
      told();
      input(Number(range.value));
    });
    const name = make("label", { for: id, text: label });
    if (note) name.append(make("small", { text: note }));
    const row = make("div", { class: "ss-slider" }, name, range, output);
    return {
      row,
      get: () => Number(range.value),
      put: (to) => {
        range.value = to;
        told();
      },
      limit: (to) => {
        range.max = to;
        told();
      },
    };
  }

  function button(text, click, attributes) {
    return make("button", { type: "button", class: "ss-button", text, onclick: click, ...attributes });
  }

  function tick(text, checked, change) {
    const box = make("input", { type: "checkbox" });
    box.checked = checked;
    box.addEventListener("change", () => change(box.checked));
    return make("label", { class: "ss-tick" }, box, make("span", { text }));
  }

  function select(label, options, value, change) {
    const id = `ss-${++counted}`;
    const list = make("select", { id });
    for (const [key, text] of options) list.append(make("option", { value: key, text }));
    list.value = value;
    list.addEventListener("change", () => change(list.value));
    return { row: make("div", { class: "ss-select" }, make("label", { for: id, text: label }), list), list };
  }

  /** One of a few: radio buttons that look like one bar. */
  function choice(legend, options, value, change) {
    const name = `ss-${++counted}`;
    const set = make("fieldset", { class: "ss-choice" }, make("legend", { text: legend }));
    for (const [key, text] of options) {
      const radio = make("input", { type: "radio", name, value: key });
      radio.checked = key === value;
      radio.addEventListener("change", () => change(key));
      set.append(make("label", {}, radio, make("span", { text })));
    }
    return set;
  }

  function swatches(entries) {
    const list = make("ul", { class: "ss-swatches" });
    for (const [text, colour] of entries) {
      const dot = make("span", { class: "ss-dot", "aria-hidden": "true" });
      dot.style.background = `rgb(${colour.map((c) => Math.round(255 * c)).join(",")})`;
      list.append(make("li", {}, dot, make("span", { text })));
    }
    return list;
  }

  /** The next round number that is not below value. */
  function niceCeiling(value) {
    if (!(value > 0)) return 1;
    const power = 10 ** Math.floor(Math.log10(value));
    for (const factor of [1, 1.5, 2, 3, 4, 5, 6, 8, 10]) if (factor * power >= value * 0.999) return factor * power;
    return 10 * power;
  }

  /** What share of known values lies below, in order of size: quantile(values, 0.98). */
  function quantile(values, share) {
    const known = Float32Array.from(values).filter(Number.isFinite).map(Math.abs).sort();
    return known.length ? known[Math.min(known.length - 1, Math.floor(share * known.length))] : NaN;
  }

  /** The unpacked arrays of a payload: an id or element with base64 inside, bytes, or what is unpacked already. */
  Shapespace.load = async function (source) {
    if (source && source.arrays) return source;
    if (source instanceof ArrayBuffer) return Shapespace.unpack(source);
    const element = typeof source === "string" ? document.getElementById(source) : source;
    if (!element) throw new Error("The data of this picture are not in the page.");
    let bytes = Shapespace.fromBase64(element.textContent);
    if (element.dataset.coding === "deflate") {
      if (typeof DecompressionStream !== "function") {
        throw new Error("This browser is too old for the pictures that turn; the still pictures show the same.");
      }
      const plain = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
      bytes = await new Response(plain).arrayBuffer();
    }
    return Shapespace.unpack(bytes);
  };

  /** Build when the element comes near the screen; what goes wrong is said in its place. */
  function lazily(element, payload, build) {
    element.classList.add("ss-widget");
    return new Promise((resolve) => {
      const start = async () => {
        try {
          const unpacked = await Shapespace.load(payload);
          element.replaceChildren();
          resolve(build(unpacked));
        } catch (error) {
          element.replaceChildren(make("p", { class: "shapespace-note", role: "note", text: error.message }));
          resolve(null);
        }
      };
      const observer = new IntersectionObserver((entries) => {
        if (!entries.some((entry) => entry.isIntersecting)) return;
        observer.disconnect();
        start();
      }, { rootMargin: "300px" });
      observer.observe(element);
    });
  }

  function stage(element, label) {
    const plate = make("div", { class: "ss-plate" });
    const controls = make("div", { class: "ss-controls" });
    element.append(plate, controls);
    return { view: new Shapespace.View(plate, { label }), plate, controls };
  }

  Shapespace.widgets = {};

  // Modes -----------------------------------------------------------------------------------------------------------

  /** Sliders that move a shape model along its modes. */
  Shapespace.widgets.modes = (element, payload, options) =>
    lazily(element, payload, (unpacked) => {
      const { most = 8, reach = 3 } = options || {};
      const model = new Shapespace.Model(unpacked);
      const { view, controls } = stage(element, "The shape model, as the sliders say");
      const K = Math.min(most, model.K);
      const z = new Float32Array(model.K), positions = new Float32Array(3 * model.V);
      view.setSurface("shape", { positions: model.vertices(z), faces: model.faces, colour: colours().clay });
      view.frame();

      let coloured = false, playing = 0, top = 0;
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
      const which = select("Mode to animate", rows.map((_, k) => [String(k), `Mode ${k + 1}`]), "0", () => {
        if (playing) stop(), play();
      });
      which.row.classList.add("ss-inline");
      const toggle = button("Animate", () => (playing ? stop() : play()), { "aria-pressed": "false" });
      function play() {
        const k = Number(which.list.value), start = performance.now(), phase = Math.asin(Math.max(-1, Math.min(1, z[k] / reach)));
        toggle.textContent = "Pause";
        toggle.setAttribute("aria-pressed", "true");
        const step = (now) => {
          if (!element.isConnected) return;
          playing = requestAnimationFrame(step);
          z[k] = reach * Math.sin(phase + Math.max(now - start, 0) * 0.0016);
          rows[k].put(z[k]);
          draw();
        };
        playing = requestAnimationFrame(step);
      }
      function stop() {
        cancelAnimationFrame(playing);
        playing = 0;
        toggle.textContent = "Animate";
        toggle.setAttribute("aria-pressed", "false");
      }

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

  // Two shapes ------------------------------------------------------------------------------------------------------

  /** A slider that moves one shape to another. */
  Shapespace.widgets.morph = (element, payload) =>
    lazily(element, payload, (unpacked) => {
      const model = new Shapespace.Model(unpacked), { low, high } = unpacked.facts;
      const { view, controls } = stage(element, `A shape between ${low} and ${high}, as the slider says`);
      const at = new Float32Array([-1]), positions = new Float32Array(3 * model.V);
      view.setSurface("shape", { positions: model.vertices(at), faces: model.faces, colour: colours().clay });
      view.frame();
      const bar = make("div", { class: "ss-bar", hidden: true });
      const draw = () => view.move("shape", model.vertices(at, positions));
      const words = (value) => (value <= -1 ? low : value >= 1 ? high : `${Math.round(50 + 50 * value)} % of the way`);
      const row = slider({
        label: `${low} to ${high}`, min: -1, max: 1, step: 0.02, value: -1, show: words,
        input: (value) => {
          stop();
          at[0] = value;
          draw();
        },
      });
      row.row.classList.add("ss-wide");
      let playing = 0;
      const toggle = button("Animate", () => (playing ? stop() : play()), { "aria-pressed": "false" });
      function play() {
        const start = performance.now(), phase = Math.asin(at[0]);
        toggle.textContent = "Pause";
        toggle.setAttribute("aria-pressed", "true");
        const step = (now) => {
          if (!element.isConnected) return;
          playing = requestAnimationFrame(step);
          at[0] = Math.sin(phase + Math.max(now - start, 0) * 0.0016);
          row.put(at[0]);
          draw();
        };
        playing = requestAnimationFrame(step);
      }
      function stop() {
        cancelAnimationFrame(playing);
        playing = 0;
        toggle.textContent = "Animate";
        toggle.setAttribute("aria-pressed", "false");
      }
      const map = model.faces ? colours().diverging : colours().sequential;
      let change = null, top = 0;
      const put = (value) => {
        stop();
        at[0] = value;
        row.put(value);
        draw();
      };
      controls.append(
        make("div", { class: "ss-sliders", role: "group", "aria-label": "Between the two shapes" }, row.row),
        make("div", { class: "ss-buttons" }, button(low, () => put(-1)), button(high, () => put(1)), toggle),
        tick("Colour by how far it moves", false, (on) => {
          if (on && !change) {
            change = model.displacement([1]).map((value) => 2 * value);
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

  // One fit ---------------------------------------------------------------------------------------------------------

  const STAGES = { before: "Before", initial: "Phase 1", final: "Phase 2", dense: "Dense" };
  const REGIONS = ["followed", "rejected", "border", "unseen"];
  const REGION_WORDS = {
    followed: "follows the scan", rejected: "does not match", border: "at the scan\u2019s border", unseen: "not shown by the scan",
  };

  /** A scan and the model that was fitted to it: stages, opacity, distances, regions. */
  Shapespace.widgets.fit = (element, payload) =>
    lazily(element, payload, (unpacked) => {
      const { facts, arrays } = unpacked;
      const { view, controls } = stage(element, `Scan and fitted model of ${facts.label || facts.name}`);
      const stages = facts.stages;
      // How far the fit lies from the scan is what one looks for first.
      const state = { stage: "final", map: arrays.scan ? "model" : "none", threshold: null };
      if (arrays.scan) {
        const scanShown = { positions: arrays.scan, faces: arrays.scan_faces || null, colour: colours().scan };
        view.setSurface("scan", { ...scanShown, opacity: 0.5, visible: false });
      }
      view.setSurface("model", {
        positions: arrays[`surface_${state.stage}`], faces: arrays.faces || null, colour: colours().model,
      });
      view.frame(["model"], 1.12);

      const bar = make("div", { class: "ss-bar" }), legend = make("div", { class: "ss-bar" });
      legend.append(swatches(REGIONS.map((name) => [REGION_WORDS[name], colours().regions[name]])));
      const said = make("p", { class: "ss-said", "aria-live": "polite" });

      const values = () =>
        state.map === "model" ? arrays[`model_to_scan_${state.stage}`]
          : state.map === "scan" ? arrays[`scan_to_model_${state.stage}`] : null;

      function paint() {
        const distances = state.map === "model" || state.map === "scan";
        const scale = distances ? Shapespace.distanceScale(facts, values(), state.map === "model", colours()) : {};
        const { signal, unknown } = colours();
        const map = { map: scale.map, range: scale.range, threshold: state.threshold, signal, unknown };
        if (distances) {
          const beyond = state.threshold === null ? [] : [[`beyond ${state.threshold.toFixed(1)} mm`, signal]];
          Shapespace.colourBar(bar, { ...scale, keys: [...beyond, ...scale.keys] });
        }
        if (arrays.scan) view.paint("scan", state.map === "scan" ? values() : null, map);
        if (state.map === "colour") {
          view.paint("scan", arrays.scan_colours, { rgb: true });
          view.paint("model", arrays[`colours_${state.stage}`] || arrays.colours_final, { rgb: true });
        } else if (state.map === "regions") {
          view.paint("model", arrays.regions, { categories: REGIONS.map((name) => colours().regions[name]) });
        } else {
          view.paint("model", state.map === "model" ? values() : null, map);
        }
        bar.hidden = limit.hidden = !distances;
        beyond.row.hidden = !distances || state.threshold === null;
        legend.hidden = state.map !== "regions";
        said.textContent = distances ? sentence() : state.map === "regions" ? regions() : state.map === "colour" ? "Grey: vertices where the fit does not follow the scan." : facts.without_scan ? facts.without_scan : "Where scan and model overlap, the nearer one is shown.";
        said.hidden = !said.textContent;
      }

      // Figures are of all vertices, also where fewer are drawn.
      function sentence() {
        const known = facts.mean_mm[state.stage][state.map];
        if (known === null) return "No distance is known here.";
        const mean = `Mean distance ${known.toFixed(2)} mm.`;
        if (state.threshold === null) return mean;
        const share = 100 * arrays[`beyond_${state.map}_${state.stage}`][Math.round(10 * state.threshold)];
        return `${mean} ${share.toFixed(share < 9.95 ? 1 : 0)} % lie beyond ${state.threshold.toFixed(1)} mm.`;
      }

      function regions() {
        const words = REGIONS.map((name, k) => `${REGION_WORDS[name]}: ${Math.round(100 * facts.region_shares[k])} %`);
        return `${words.join("; ")}.`;
      }

      const beyond = slider({
        label: "Threshold", min: 0.2, max: 10, step: 0.1, value: Math.min(2, facts.scale_mm),
        show: (value) => `${value.toFixed(1)} mm`,
        input: (value) => {
          state.threshold = value;
          paint();
        },
      });
      const limit = tick("Mark what lies beyond a threshold", false, (on) => {
        state.threshold = on ? beyond.get() : null;
        paint();
      });
      const layer = (id, name, opacity) => {
        const row = slider({
          label: name, min: 0, max: 100, step: 5, value: opacity, show: (value) => `${value} %`,
          input: (value) => {
            box.checked = value > 0;
            view.set(id, { opacity: value / 100, visible: value > 0 });
          },
        });
        const box = make("input", { type: "checkbox", "aria-label": `Show ${name.toLowerCase()}` });
        box.checked = opacity > 0;
        box.addEventListener("change", () => {
          if (box.checked && row.get() === 0) row.put(100);
          view.set(id, { visible: box.checked, opacity: row.get() / 100 });
        });
        const dot = make("span", { class: "ss-dot", "aria-hidden": "true" });
        dot.style.background = `rgb(${colours()[id].map((c) => Math.round(255 * c)).join(",")})`;
        row.row.classList.add("ss-layer");
        row.row.prepend(box, dot);
        return { row: row.row, show: (percent) => {
          row.put(percent);
          box.checked = percent > 0;
          view.set(id, { visible: percent > 0, opacity: percent / 100 });
        } };
      };
      const scan = arrays.scan ? layer("scan", "Scan", 0) : null, model = layer("model", "Model", 100);
      const maps = [["none", "plain"]];
      if (arrays.scan) maps.push(["model", "distance, model to scan"], ["scan", "distance, scan to model"]);
      if (arrays.regions) maps.push(["regions", "what the fit used"]);
      if (arrays.colours_final && arrays.scan_colours) maps.push(["colour", "colour of the scan"]);
      const called = (name) => (name === "final" && !stages.includes("initial") ? "Fitted" : STAGES[name] || name);
      if (stages.length > 1) {
        controls.append(choice("Stage", stages.map((name) => [name, called(name)]), state.stage, (name) => {
          state.stage = name;
          view.move("model", arrays[`surface_${name}`]);
          paint();
        }));
      }
      controls.append(
        make("div", { class: "ss-sliders", role: "group", "aria-label": "Visibility and opacity" }, ...[scan && scan.row, model.row].filter(Boolean)),
        select("Colour", maps, state.map, (key) => {
          state.map = key;
          // The coloured surface is seen alone; the sliders bring the other one back.
          if (scan) scan.show(key === "scan" || key === "none" ? 100 : 0);
          model.show(key === "scan" ? 0 : 100);
          paint();
        }).row,
        bar, legend, limit, beyond.row, said
      );
      if (facts.thinned) {
        controls.append(make("p", { class: "ss-hint", text: "Drawn with fewer triangles than there are; the numbers are of all." }));
      }
      paint();
      return { view, state };
    });

  /** A round step of which two or three fit below `most`. */
  function tickStep(most) {
    const power = 10 ** Math.floor(Math.log10(most / 2));
    return [5, 2, 1].map((factor) => factor * power).find((step) => 2 * step <= most * 1.0001) || power;
  }

  // Scatter ---------------------------------------------------------------------------------------------------------

  /** Coefficients as points in three dimensions, coloured by label. */
  Shapespace.widgets.scatter = (element, payload) =>
    lazily(element, payload, (unpacked) => {
      const { facts, arrays } = unpacked;
      const [n, K] = arrays.points.shape;
      const { view, plate, controls } = stage(element, `${n} points in the space of coefficients`);
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
      return { view, axes, ticks: () => ticks };
    });

  // Morphospace -----------------------------------------------------------------------------------------------------

  // Circle, square, triangle, diamond, triangle, plus, cross, star: as MARKERS of morphospace_figures.py.
  const MARKERS = [
    "M-1 0A1 1 0 1 0 1 0A1 1 0 1 0-1 0Z", "M-.9-.9H.9V.9H-.9Z", "M0-1.2L1.1.8H-1.1Z", "M0-1.3L1.1 0 0 1.3-1.1 0Z",
    "M0 1.2L1.1-.8H-1.1Z", "M-.4-1.2H.4V-.4H1.2V.4H.4V1.2H-.4V.4H-1.2V-.4H-.4Z",
    "M-1.2-.7L-.7-1.2 0-.5.7-1.2 1.2-.7.5 0 1.2.7.7 1.2 0 .5-.7 1.2-1.2.7-.5 0Z",
    "M0-1.4L.4-.5 1.4-.4.65.25.85 1.2 0 .7-.85 1.2-.65.25-1.4-.4-.4-.5Z",
  ];
  const css = (colour, alpha = 1) => `rgb(${colour.map((c) => Math.round(255 * c)).join(" ")} / ${alpha})`;

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

  /** Shapes as points in the plane of two axes of an ordination; the shape at the marker is drawn next to the mean. */
  Shapespace.widgets.morphospace = (element, payload) =>
    lazily(element, payload, (unpacked) => {
      const { facts, arrays } = unpacked, { names, groups, labels } = facts, n = names.length, K = facts.axes.length;
      const model = new Shapespace.Model(unpacked), positions = new Float32Array(model.mean.length);
      const axes = Array.from(facts.first), place = new Float32Array(K), hidden = new Set();
      const shown = { hulls: groups.length > 0, ellipses: groups.length > 0, phylogeny: true, validated: false, coloured: false };
      const canvas = make("canvas", { tabindex: 0, role: "application" }), tip = make("div", { class: "ss-tip", hidden: true });
      const marker = make("span", { class: "ss-marker" }), ring = make("span", { class: "ss-ring", hidden: true });
      const plot = make("div", { class: "ss-plate ss-plot" }, canvas, ring, marker, tip), shapes = make("div", { class: "ss-shapes" });
      const said = make("p", { class: "ss-said", "aria-live": "polite" }), bar = make("div", { class: "ss-bar", hidden: true });
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
        const ellipses = members.map((points, g) => (shown.ellipses && points.length > 2 ? ellipseOf(points, facts.radii[g]) : []));
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
        // The least round step whose labels, 52 pixels wide, stand apart.
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
        const scale = { map: model.faces ? colours().diverging : colours().sequential, range: [model.faces ? -end : 0, end] };
        picture.view.paint("shape", moved, scale);
        Shapespace.colourBar(bar, { ...scale, unit: facts.unit, open: true, title: model.faces ? "Inwards (\u2212) or outwards (+) from the mean" : "Moved from the mean" });
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
          said.textContent = `Marker at ${values.join(", ")}${v === null ? "" : `, the place of ${title(v)}`}.`;
        }, 150);
        request({ shape: true });
      };
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
        point(event);
      });
      canvas.addEventListener("pointermove", point);
      for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, () => { drags = false; });
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
        tick(text, shown[key], (on) => { shown[key] = on; redraw(); }))), bar, make("div", { class: "ss-choices" }, ...choices, specimens), said);
      document.addEventListener("shapespace:theme", redraw);
      new ResizeObserver(redraw).observe(plot);
      drawPlot();
      moveTo(0, 0);
      return { view: { works: true } }; // without WebGL too, where the pictures say so
    });
})();
