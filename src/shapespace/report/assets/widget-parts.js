/* Controls of widgets. The first of the scripts of widgets; needs those of scenes and Shapespace.colours before it. */
(function () {
  "use strict";

  const Shapespace = window.Shapespace;
  let counted = 0;

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

  /** A labelled range input and its value. */
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

  /** A button that moves a value to and fro between -reach and reach; begin() returns its {value, put} at each start. */
  function animation(element, reach, begin) {
    let playing = 0;
    const toggle = button("Animate", () => (playing ? stop() : play()), { "aria-pressed": "false" });
    function play() {
      const { value, put } = begin(), start = performance.now(), phase = Math.asin(Math.max(-1, Math.min(1, value / reach)));
      toggle.textContent = "Pause";
      toggle.setAttribute("aria-pressed", "true");
      const step = (now) => {
        if (!element.isConnected) return;
        playing = requestAnimationFrame(step);
        put(reach * Math.sin(phase + Math.max(now - start, 0) * 0.0016));
      };
      playing = requestAnimationFrame(step);
    }
    function stop() {
      cancelAnimationFrame(playing);
      playing = 0;
      toggle.textContent = "Animate";
      toggle.setAttribute("aria-pressed", "false");
    }
    const restart = () => {
      if (playing) stop(), play();
    };
    return { toggle, stop, restart };
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
  Shapespace.widgetParts = {
    colours: () => Shapespace.colours, make, signed, slider, button, animation, tick, select, choice, swatches,
    niceCeiling, quantile, lazily, stage,
  };
})();
