/* The stage of a widget: one or two linked views, captions, and a key of the colours. */
(function () {
  "use strict";

  const Shapespace = window.Shapespace;
  const { make, dot, partControls, widget } = Shapespace.widgetParts;

  /** Pictures in `element`, which it fills; embedded: see `Shapespace.View`. Views and surfaces belong to the owner that `show` was last called by. */
  class Stage {
    constructor(element, embedded = true) {
      this._embedded = embedded;
      this._owner = null;
      this.panes = make("div", { class: "ss-panes" });
      this._bar = make("div", { class: "ss-bar", "data-testid": "colour-bar", hidden: true });
      this._legend = make("ul", { class: "ss-legend", "data-testid": "legend", hidden: true });
      this._empty = make("p", { class: "ss-empty", "data-testid": "empty", hidden: true });
      this.element = make("div", { class: "ss-stage" }, this.panes, this._bar, this._legend, this._empty);
      element.append(this.element);
      this._captions = [];
      this._arrangement = null;
      this.b = null;
      this.a = this._view("view");
    }

    _view(testid) {
      const plate = make("div", { class: "ss-plate", "data-testid": testid }), caption = make("p", { class: "ss-caption" });
      this._captions.push(caption);
      this.panes.append(make("div", { class: "ss-pane" }, plate, caption));
      const view = new Shapespace.View(plate, { label: "The shape in 3-D", embedded: this._embedded });
      if (this._arrangement) view.arrange(this._arrangement);
      return view;
    }

    /** Add controls of the parts of all surfaces, by their names; none if there are no parts. */
    setParts(names) {
      if (!names) return;
      const { element, arrangement } = partControls(names, () => [this.a, this.b].filter(Boolean), () => this._owner?.());
      this._arrangement = arrangement;
      this.element.prepend(element);
    }

    /** Whether there are two views; the second one is made when it is first needed. */
    split(two) {
      if (two && !this.b) {
        this.b = this._view("view-b");
        this.a.link(this.b);
      }
      if (this.b) this.b.element.parentElement.hidden = !two;
    }

    get views() {
      return this.b && !this.b.element.parentElement.hidden ? [this.a, this.b] : [this.a];
    }

    captions(...texts) {
      this._captions.forEach((caption, k) => { caption.textContent = texts[k] || ""; });
    }

    /** Show a colour bar, see `Shapespace.colourBar`; null: none. */
    bar(options) {
      this._bar.hidden = !options;
      const wanted = JSON.stringify(options);
      if (options && this._drawn !== wanted) Shapespace.colourBar(this._bar, options);
      this._drawn = wanted;
    }

    /** Show a legend [[text, colour], ...] with a note; null: none. */
    legend(items, note = "") {
      this._legend.hidden = !items;
      this._legend.replaceChildren(...(items || []).map(([text, colour]) => make("li", {}, dot(colour), text)), ...(note ? [make("li", { text: note })] : []));
    }

    /** Whether `owner` has to show all its surfaces, as those on the stage are of another one. */
    take(owner) {
      if (this._owner === owner) return false;
      for (const view of [this.a, this.b]) if (view) for (const id of ["model", "scan", "landmarks"]) view.remove(id);
      this._empty.hidden = true;
      this.bar(null);
      this.legend(null);
      this.captions();
      this._owner = owner;
      return true;
    }

    /** Show the only surface of `owner`, or move it. */
    show(owner, surface) {
      if (this.take(owner)) {
        this.split(false);
        this.a.setSurface("model", { colour: Shapespace.colours.clay, ...surface });
      } else {
        this.a.move("model", surface.positions);
      }
    }

    /** Paint the surface by displacements and show their scale; null: plain. */
    paint(values, scale) {
      this.a.paint("model", values, values ? { map: scale.map, range: scale.range, changed: true } : undefined);
      this.bar(values ? scale : null);
    }

    /** Show no surface, with the reason. */
    nothing(text) {
      this.take(null);
      this.split(false);
      this._empty.textContent = text;
      this._empty.hidden = false;
    }

    dispose() {
      for (const view of [this.a, this.b]) if (view) view.dispose();
    }
  }

  /** A widget with a stage and controls: build(unpacked, {stage, controls}). */
  const staged = (build) => widget((unpacked, element) => {
    const stage = new Stage(element), controls = make("div", { class: "ss-controls" });
    element.append(controls);
    stage.setParts(unpacked.facts.parts);
    return { view: stage.a, ...build(unpacked, { stage, controls }) };
  });

  Object.assign(Shapespace.widgetParts, { Stage, staged });
})();
