/* The address of the page, and the part of it that shows one result: surfaces, a model with its fits, or a report. */
(function () {
  "use strict";

  const { html, useEffect, useRef } = window.Preact;
  const Viewer = window.ShapespaceViewer;
  const Studio = window.ShapespaceStudio;
  const T = window.ShapespaceTexts;
  // Scripts and style sheets, in this order, which are loaded when they are first needed.
  const SCRIPTS = {
    surfaces: ["scene", "surfaces"],
    model: ["scene", "charts", "coefficients-csv", "viewer-compare", "viewer-fits", "viewer"],
    report: ["scene", "report"],
  };
  const STYLES = { surfaces: ["widgets", "viewer"], model: ["widgets", "viewer"], report: ["report", "widgets"] };
  // Elements of a report that could act in the page; reports are read from files.
  const NOT_SHOWN = "script:not([type='application/octet-stream']), style, link, meta, base, iframe, frame, object, embed, form";

  /** The navigation and the sections of a report; of an answer first maps and charts that turn, as its sentences are above it already. */
  function contentOf(page, isAnswer) {
    const shown = document.createElement("div");
    const list = page.querySelector("nav ul"), main = page.getElementById("content");
    if (!list || !main) throw new Error(T.jobs.noReport);
    if (isAnswer) {
      shown.className = "answer";
      const sectionOf = (item) => page.getElementById(item.firstElementChild.hash.slice(1)).parentElement;
      const rank = (item) => (sectionOf(item).querySelector("[data-widget=morph], [data-widget=modes]") ? 0 : sectionOf(item).querySelector(".turning") ? 1 : 2);
      for (const item of Array.from(list.children).sort((a, b) => rank(a) - rank(b))) {
        sectionOf(item).classList.toggle("turns", rank(item) < 2);
        list.append(item);
        main.append(sectionOf(item));
      }
    }
    shown.append(list.parentElement, main, ...page.querySelectorAll("script[type='application/octet-stream']"));
    for (const element of shown.querySelectorAll(NOT_SHOWN)) element.remove();
    for (const element of shown.querySelectorAll("*")) {
      for (const name of element.getAttributeNames()) if (/^(on.*|style|ping|formaction|action)$/i.test(name)) element.removeAttribute(name);
    }
    for (const link of shown.querySelectorAll("a[href]:not([href^='#'])")) Object.assign(link, { target: "_blank", rel: "noopener noreferrer" });
    return shown;
  }

  // The address: the screen, and what is shown on it ---------------------------------------------------------------

  /** Return {screen, place: {name: text}} of the address, such as #correspondence?result=3&vertices=12. */
  Studio.place = () => {
    const [screen, query = ""] = location.hash.slice(1).split("?");
    return { screen, place: Object.fromEntries(new URLSearchParams(query)) };
  };

  const addressOf = (screen, place) => {
    const query = new URLSearchParams(Object.entries(place).filter(([, text]) => text !== "" && text !== undefined && text !== null)).toString();
    return `#${screen}${query && `?${query.replace(/%2C/g, ",").replace(/%3A/g, ":")}`}`;
  };

  /** Write the view into the address, without a new entry in the history of the browser. */
  Studio.keepPlace = (values) => {
    const { screen, place } = Studio.place();
    history.replaceState(null, "", addressOf(screen, { question: place.question, ...values }));
  };

  /** Go to a screen, with a new entry in the history of the browser. */
  Studio.goTo = (screen, values = {}) => { location.hash = addressOf(screen, values); };

  // Panes -----------------------------------------------------------------------------------------------------------

  const OPEN = {
    surfaces: async (element, address, options) => {
      const root = await Viewer.mount(element, STYLES.surfaces, Viewer.template("surfaces"));
      return Viewer.openSurfaces(root, address, options);
    },
    model: async (element, address, options) => {
      const root = await Viewer.mount(element, STYLES.model, Viewer.template("model"));
      return Viewer.openModel(root, address, options);
    },
    report: async (element, address, options) => {
      const text = await (await Studio.ask(address)).text();
      const content = contentOf(new DOMParser().parseFromString(text.slice(Math.max(0, text.indexOf("<body"))), "text/html"), options.isAnswer); // without its style
      const root = await Viewer.mount(element, STYLES.report, content);
      const end = new AbortController();
      element.addEventListener("shapespace:selected", (event) => options.onselected?.(event.detail), { signal: end.signal });
      window.startShapespaceReport(root, element, end.signal);
      options.onready?.();
      return {
        dispose() {
          end.abort();
          for (const view of Array.from(Shapespace.sceneParts.views)) if (root.contains(view.element)) view.dispose();
        },
        place: () => ({}),
      };
    },
  };

  /**
   * The view {kind, href} of the result with this number; name: for screen readers. The address has what it shows.
   * on: {landmarks, onvertex, onlandmark, onselected, isAnswer}, see `Viewer.openSurfaces`.
   */
  Studio.Pane = function Pane({ view, result, name, on = {} }) {
    const box = useRef(null), shown = useRef(null), latest = useRef(on);
    latest.current = on;
    useEffect(() => {
      const element = box.current;
      let ended = false, timer = 0, kept = location.hash;
      const keep = () => {
        if (ended || !shown.current || location.hash !== kept) return; // another address was opened, of which the event is still to come
        Studio.keepPlace({ result, view: view.kind, ...shown.current.place() });
        kept = location.hash;
      };
      const later = () => { clearTimeout(timer); timer = setTimeout(keep, 250); };
      Viewer.guarded(async () => {
        await Viewer.load(...SCRIPTS[view.kind]);
        if (ended) return;
        const { place } = Studio.place(), isMine = (place.view || view.kind) === view.kind && String(place.result || result) === String(result);
        const opened = await OPEN[view.kind](element, view.href, {
          ...latest.current, place: isMine ? place : {}, onplace: later,
          onvertex: (vertex) => latest.current.onvertex?.(vertex), onlandmark: (...moved) => latest.current.onlandmark?.(...moved),
          onselected: (names) => latest.current.onselected?.(names),
          onready: () => {
            element.dataset.ready = "true";
            Studio.pane = { result, oriented: shown.current?.oriented };
            Studio.changed();
          },
        });
        if (ended) { opened.dispose(); return; }
        shown.current = opened;
        opened.setLandmarks?.(latest.current.landmarks || []);
      })();
      return () => {
        ended = true;
        clearTimeout(timer);
        Studio.pane = null;
        if (shown.current) shown.current.dispose();
        shown.current = null;
      };
    }, [view.href]);
    useEffect(() => { shown.current?.setLandmarks?.(on.landmarks || []); }, [JSON.stringify(on.landmarks)]);
    return html`<div key=${view.href} ref=${box} class=${`pane-root ${view.kind}`} role="region" aria-label=${name} tabindex=${view.kind === "report" ? 0 : undefined} data-testid="pane"></div>`;
  };
})();
