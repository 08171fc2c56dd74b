/* What all parts of the page share: elements, messages, talking to the server, the theme, components in their own roots. */
(function () {
  "use strict";

  const Viewer = (window.ShapespaceViewer = window.ShapespaceViewer || {});
  const $ = (id) => document.getElementById(id);

  const create = (tag, properties) => Object.assign(document.createElement(tag), properties);

  Viewer.save = function (blob, name) {
    const link = create("a", { href: URL.createObjectURL(blob), download: name });
    document.body.append(link);
    link.click();
    link.remove();
    setTimeout(() => URL.revokeObjectURL(link.href), 10000);
  };

  // Messages --------------------------------------------------------------------------------------------------------

  let alerts = 0; // told so far
  let running = 0; // actions that may still fail

  function alertUser(sentence) {
    alerts += 1;
    const close = create("button", { type: "button", className: "small quiet", textContent: "Close", onclick: quiet });
    close.dataset.testid = "message-close";
    $("message").replaceChildren(create("span", { textContent: sentence }), close);
    $("message").hidden = false;
  }

  function quiet() {
    $("message").hidden = true;
  }

  /** An older message goes when what was done after it went well; what the server is asked for decides by itself. */
  function startMessages() {
    const control = "button, input, select, [role=option]";
    for (const kind of ["click", "input", "change"]) {
      addEventListener(kind, (event) => {
        const before = alerts;
        const [target] = event.composedPath(); // also inside a component
        if (target.closest && target.closest(control)) setTimeout(() => { if (alerts === before && !running) quiet(); }, 0);
      }, true);
    }
    addEventListener("keydown", (event) => { if (event.key === "Escape") quiet(); });
  }

  const UNREACHABLE = "The server does not answer; see whether shapespace still runs, then reload the page.";

  /** fetch, with the server's own sentence as the error. */
  async function ask(path, options) {
    let answer;
    try {
      answer = await fetch(path, options);
    } catch (error) {
      throw new Error(UNREACHABLE);
    }
    if (answer.ok) return answer;
    let told = null;
    try { told = (await answer.json()).error; } catch (error) { /* not one of our answers */ }
    throw new Error(told || `The server answered with the error ${answer.status}; reload the page.`);
  }

  /** `action` with what goes wrong told to the user. */
  const telling = (action) => async (...given) => {
    try {
      return await action(...given);
    } catch (error) {
      alertUser(error.message);
      return undefined;
    }
  };

  /** The same of what the user does, where success ends an older message. */
  const guarded = (action) => async (...given) => {
    const before = alerts;
    running += 1;
    try {
      return await telling(action)(...given);
    } finally {
      running -= 1;
      if (alerts === before) quiet();
    }
  };

  const json = async (path, options) => (await ask(path, options)).json();
  const binary = async (path) => Shapespace.unpack(await (await ask(path)).arrayBuffer());
  const post = (content) => ({ method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(content) });

  // Components ------------------------------------------------------------------------------------------------------

  const loaded = new Map(); // name of a script -> when it has run

  /** Load scripts one after the other, each once. */
  function load(...names) {
    return names.reduce((before, name) => before.then(() => {
      if (!loaded.has(name)) loaded.set(name, new Promise((resolve, reject) => {
        document.head.append(create("script", { src: `/assets/${name}.js`, onload: resolve, onerror: () => { loaded.delete(name); reject(new Error(UNREACHABLE)); } }));
      }));
      return loaded.get(name);
    }), Promise.resolve());
  }

  /** Return an element's own root with style sheets and `content`, once these have loaded; names and styles in it are its own. */
  async function mount(element, styles, content) {
    const root = element.shadowRoot || element.attachShadow({ mode: "open" });
    const links = styles.map((name) => create("link", { rel: "stylesheet", href: `/assets/${name}.css` }));
    const ready = links.map((link) => new Promise((resolve) => { link.onload = link.onerror = resolve; }));
    root.replaceChildren(...links);
    await Promise.all(ready);
    root.append(content);
    return root;
  }

  const round = (value) => Number(value.toFixed(4));

  const numbersOf = (state) => [state.yaw, state.pitch, state.roll, state.zoom, ...state.target, ...state.extent].map(round);

  /** Return the camera of a view as text of an address: yaw, pitch, roll, zoom, target and extent; empty at home. */
  function cameraOf(view) {
    const { home, state } = view._camera;
    const text = numbersOf(state).join();
    return home && numbersOf(home).join() === text ? "" : text;
  }

  function setCamera(view, text) {
    const [yaw, pitch, roll, zoom, ...rest] = (text || "").split(",").map(Number);
    if (rest.length !== 6 || ![yaw, pitch, roll, zoom, ...rest].every(Number.isFinite) || !(Math.min(zoom, ...rest.slice(3)) > 0)) return;
    view.camera = { yaw, pitch, roll, zoom, target: rest.slice(0, 3), extent: rest.slice(3) };
  }

  const template = (name) => document.getElementById(name).content.cloneNode(true);

  // The rest --------------------------------------------------------------------------------------------------------

  /** The button that switches colours; `changed` is called after. */
  function startTheme(changed) {
    $("theme").addEventListener("click", () => {
      const dark = matchMedia("(prefers-color-scheme: dark)").matches;
      const now = document.documentElement.dataset.theme || (dark ? "dark" : "light");
      const next = now === "dark" ? "light" : "dark";
      document.documentElement.dataset.theme = next;
      try { localStorage.setItem("shapespace-theme", next); } catch (refused) { /* the choice is not stored */ }
      changed();
    });
  }

  Object.assign(Viewer, { $, alertUser, ask, telling, guarded, json, binary, post, startMessages, startTheme, load, mount, template, cameraOf, setCamera });
})();
