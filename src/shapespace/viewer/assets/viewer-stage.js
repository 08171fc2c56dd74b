/* The stage of a model or its fits: one or two linked views, captions, colour bar and legend. */
(function () {
  "use strict";

  const Viewer = window.ShapespaceViewer;
  const { h } = Viewer;

  class Stage {
    /** page: {$, model}, see `Viewer.openModel`. */
    constructor(page) {
      this.page = page;
      this.a = new Shapespace.View(page.$("view-a"), { label: "The shape in 3-D", embedded: false });
      this.b = null;
      this.holds = null;
    }

    split(two) {
      if (two && !this.b) {
        this.b = new Shapespace.View(this.page.$("view-b"), { label: "The model in 3-D", embedded: false });
        this.a.link(this.b);
      }
      this.page.$("pane-b").hidden = !two;
    }

    /** The picture as PNG; two views are side by side. */
    async picture() {
      const views = this.page.$("pane-b").hidden ? [this.a] : [this.a, this.b];
      const blobs = await Promise.all(views.map((view) => view.png()));
      if (blobs.length === 1) return blobs[0];
      const images = await Promise.all(blobs.map((blob) => createImageBitmap(blob)));
      const canvas = h("canvas", { width: images[0].width + images[1].width, height: Math.max(images[0].height, images[1].height) });
      const context = canvas.getContext("2d");
      images.forEach((image, k) => context.drawImage(image, k * images[0].width, 0));
      return new Promise((resolve) => canvas.toBlob(resolve, "image/png"));
    }

    captions(a, b) {
      this.page.$("caption-a").textContent = a || "";
      this.page.$("caption-b").textContent = b || "";
    }

    bar(options) {
      this.page.$("bar").hidden = !options;
      const wanted = options ? [options.title, ...options.range, ...(options.keys || []).map(([text]) => text)].join(" ") : "";
      if (options && this._bar !== wanted) Shapespace.colourBar(this.page.$("bar"), options);
      this._bar = wanted;
    }

    legend(items, note) {
      this.page.$("legend").hidden = !items;
      if (!items) return;
      const rgb = (c) => `rgb(${c.map((v) => Math.round(255 * v)).join(",")})`;
      this.page.$("legend").replaceChildren(...items.map(([text, colour]) => {
        const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
        const spot = document.createElementNS("http://www.w3.org/2000/svg", "circle");
        for (const [key, value] of [["cx", 6], ["cy", 6], ["r", 6], ["fill", rgb(colour)]]) spot.setAttribute(key, value);
        svg.setAttribute("viewBox", "0 0 12 12");
        svg.append(spot);
        return h("li", {}, svg, text);
      }), ...(note ? [h("li", {}, note)] : []));
    }

    clear() {
      this.page.$("empty").hidden = true;
      for (const view of [this.a, this.b]) {
        if (view) for (const id of ["model", "scan", "landmarks"]) view.remove(id);
      }
      this.bar(null);
      this.legend(null);
      this.captions("", "");
      this.holds = null;
    }

    /** Show no surface, with the reason. */
    nothing(text) {
      this.clear();
      this.split(false);
      this.page.$("empty").textContent = text;
      this.page.$("empty").hidden = false;
    }

    dispose() {
      for (const view of [this.a, this.b]) if (view) view.dispose();
    }

    /** Nothing to show yet: the mean, faint. */
    faintMean() {
      const { model } = this.page;
      this.a.setSurface("model", { positions: model.mean, faces: model.faces, colour: Shapespace.colours.clay, opacity: 0.35 });
      this.holds = "empty";
      this.a.frame(["model"]);
    }
  }

  /** The next round number at or above a positive one. */
  function nice(value) {
    const power = 10 ** Math.floor(Math.log10(Math.max(value, 1e-3)));
    return [1, 1.5, 2, 3, 4, 5, 6, 8, 10].map((step) => step * power).find((step) => step >= value * 0.9999) || 10 * power;
  }

  /** The q-quantile of the absolute finite values. */
  function quantile(values, q) {
    const sorted = Float32Array.from(values).filter(Number.isFinite).map(Math.abs).sort();
    return sorted.length ? sorted[Math.min(sorted.length - 1, Math.floor(q * sorted.length))] : 0;
  }

  /** Position of a landmark on a surface: `at` has the vertices of its triangle and their barycentric weights. */
  function onSurface(positions, at) {
    return [0, 1, 2].map((axis) => at.vertices.reduce((sum, v, k) => sum + at.weights[k] * positions[3 * v + axis], 0));
  }

  const LEFT_RED = [0.83, 0.25, 0.15];

  Object.assign(Viewer, { Stage, nice, quantile, onSurface, LEFT_RED });
})();
