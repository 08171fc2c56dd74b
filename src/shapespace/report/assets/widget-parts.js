/* Controls of widgets. The first of the scripts of widgets; needs those of scenes and Shapespace.colours before it. */
(function () {
  "use strict";

  const Shapespace = window.Shapespace;
  let counted = 0;

  /** An element: make("button", {type: "button", onclick, text}, child, ...). */
  function make(tag, attributes, ...children) {
    const element = document.createElement(tag);
    for (const [name, value] of Object.entries(attributes || {})) {
      if (name === "text") element.textContent = value;
      else if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
      else if (value === true) element.setAttribute(name, "");
      else if (value !== false && value !== null && value !== undefined) element.setAttribute(name, value);
    }
    element.append(...children.filter((child) => child !== null && child !== undefined));
    return element;
  }

  const signed = (value, digits) => (value > 0 ? "+" : value < 0 ? "\u2212" : "") + Math.abs(value).toFixed(digits);
  const percent = (share) => `${(100 * share).toFixed(share < 0.0995 ? 1 : 0)} %`;
  const css = (colour, alpha = 1) => `rgb(${colour.map((c) => Math.round(255 * c)).join(" ")} / ${alpha})`;

  function dot(colour) {
    const element = make("span", { class: "ss-dot", "aria-hidden": "true" });
    element.style.background = css(colour);
    return element;
  }

  /** A labelled range input and its value; its track is filled from `origin`; name: for screen readers. */
  function slider({ label, name = null, note = "", min, max, step, value, origin = min, show, input, testid = null }) {
    const id = `ss-${++counted}`;
    const output = make("output", { for: id });
    const range = make("input", { type: "range", id, min, max, step, value, "aria-label": name, "data-testid": testid });
    const share = (at) => `${((100 * (at - range.min)) / (range.max - range.min || 1)).toFixed(2)}%`;
    const update = (to = Number(range.value)) => {
      const now = Number(range.value); // in steps, from min to max
      output.textContent = show(to);
      range.setAttribute("aria-valuetext", output.textContent);
      range.style.setProperty("--from", share(Math.min(now, origin)));
      range.style.setProperty("--to", share(Math.max(now, origin)));
    };
    range.addEventListener("input", () => {
      update();
      input(Number(range.value));
    });
    update();
    const row = make("div", { class: "ss-slider" }, make("label", { for: id, text: label }, note ? make("small", { text: note }) : null), range, output);
    return {
      row,
      range,
      output,
      get: () => Number(range.value),
      put: (to) => {
        range.value = to;
        update(to);
      },
    };
  }

  function button(text, click, attributes) {
    return make("button", { type: "button", class: "ss-button", text, onclick: click, ...attributes });
  }

  /** A button that plays a movement: begin() returns the function that draws it, s after its start; it ends when true is returned. */
  function animation(element, begin, text = "Animate", testid = null) {
    let playing = 0;
    const toggle = button(text, () => (playing ? stop() : play()), { "aria-pressed": "false", "data-testid": testid });
    const press = (on) => {
      toggle.textContent = on ? "Pause" : text;
      toggle.setAttribute("aria-pressed", String(on));
    };
    function play() {
      const put = begin(), start = performance.now();
      press(true);
      const step = (now) => {
        if (!element.isConnected) return;
        playing = requestAnimationFrame(step);
        if (put(Math.max(now - start, 0) / 1000)) stop();
      };
      playing = requestAnimationFrame(step);
    }
    function stop() {
      cancelAnimationFrame(playing);
      playing = 0;
      press(false);
    }
    return { toggle, stop };
  }

  /** The function of s of a value that swings from where it is between -reach and reach. */
  function swing(value, reach, period = 3.9) {
    const phase = Math.asin(Math.max(-1, Math.min(1, value / reach)));
    return (seconds) => reach * Math.sin(phase + (2 * Math.PI * seconds) / period);
  }

  function tick(text, checked, change, testid = null) {
    const box = make("input", { type: "checkbox", "data-testid": testid });
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

  /** One of a few: radio buttons that look like one bar; put(null) chooses none. */
  function choice(legend, options, value, change, testid = null) {
    const name = `ss-${++counted}`;
    const radios = options.map(([key]) => make("input", { type: "radio", name, value: key, onchange: () => change(key) }));
    const put = (chosen) => radios.forEach((radio) => { radio.checked = radio.value === chosen; });
    const row = make("fieldset", { class: "ss-choice", "data-testid": testid }, make("legend", { text: legend }),
      ...options.map(([key, text], k) => make("label", { "data-value": key }, radios[k], make("span", { text }))));
    put(value);
    return { row, put };
  }

  /** Parts in their colours, to be shown, hidden and moved apart in views(); changed(): called after. */
  function partControls(names, views, changed) {
    const arrangement = { hidden: new Set(), apart: 0 };
    const arrange = () => {
      views().forEach((view) => view.arrange(arrangement));
      changed();
    };
    const boxes = names.map((name, part) => {
      const row = tick(name, true, (isShown) => {
        arrangement.hidden[isShown ? "delete" : "add"](part);
        arrange();
      }, `part-${name}`);
      row.children[0].after(dot(Shapespace.colours.parts[part % Shapespace.colours.parts.length]));
      return row;
    });
    const apart = slider({ label: "Exploded", min: 0, max: 100, step: 5, value: 0, show: (value) => `${value} %`, testid: "exploded", input: (value) => {
      arrangement.apart = value / 100;
      arrange();
    } });
    return { element: make("div", { class: "ss-parts", role: "group", "aria-label": "Parts", "data-testid": "parts" }, ...boxes, apart.row), arrangement };
  }

  const swatches = (entries) => make("ul", { class: "ss-swatches" }, ...entries.map(([text, colour]) => make("li", {}, dot(colour), make("span", { text }))));

  /** The next round number that is not below value. */
  function niceCeiling(value) {
    if (!(value > 0)) return 1;
    const power = 10 ** Math.floor(Math.log10(value));
    return [1, 1.5, 2, 3, 4, 5, 6, 8, 10].find((factor) => factor * power >= value * 0.999) * power;
  }

  /** What share of known values lies below, in order of size: quantile(values, 0.98). */
  function quantile(values, share) {
    const known = Float32Array.from(values).filter(Number.isFinite).map(Math.abs).sort();
    return known.length ? known[Math.min(known.length - 1, Math.floor(share * known.length))] : NaN;
  }

  /** What the colours of displacements up to `top` mean: options of `colourBar` and `paint`. */
  function displacementScale(model, top, from, unit = "mm") {
    const { diverging, sequential } = Shapespace.colours;
    const scale = model.faces ? { map: diverging, range: [-top, top], title: `Inwards (\u2212) or outwards (+) ${from}` } : { map: sequential, range: [0, top], title: `Moved ${from}` };
    return { ...scale, unit, open: true };
  }

  /** The unpacked arrays of a payload: an id or element with base64 inside, bytes, or data that are already unpacked. */
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

  /** A widget: `build` with its data and element once the element comes near the screen; errors are shown in its place. */
  const widget = (build) => (element, payload) => {
    element.classList.add("ss-widget");
    return new Promise((resolve) => {
      const start = async () => {
        try {
          const unpacked = await Shapespace.load(payload);
          element.replaceChildren();
          resolve(build(unpacked, element));
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
  };

  Shapespace.widgets = {};
  Shapespace.widgetParts = {
    colours: () => Shapespace.colours, make, signed, percent, css, dot, slider, button, animation, swing, tick, select, choice, swatches, partControls,
    niceCeiling, quantile, displacementScale, widget,
  };
})();
