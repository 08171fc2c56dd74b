/* Drawing of views: the WebGL context that all of a page share, the frames of the browser, surfaces and texts. */
(function () {
  "use strict";

  const Shapespace = window.Shapespace;
  const { FIELD } = Shapespace.sceneParts;

  // Browsers allow some 8 to 16 contexts, so all views share one and keep a plain canvas each.
  let shared;
  const views = new Set();

  /** Return {canvas, context, renderer, bySoftware, lost} of the page, or null without WebGL. */
  function gpu() {
    if (shared !== undefined) return shared;
    shared = null;
    if (!window.THREE) return shared;
    try {
      const aside = typeof OffscreenCanvas === "function" && new OffscreenCanvas(8, 8);
      const probe = aside && aside.getContext("webgl2");
      if (!aside || !probe) return shared;
      const info = probe.getExtension("WEBGL_debug_renderer_info");
      const name = String(probe.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : probe.RENDERER));
      lose(probe);
      const bySoftware = /swiftshader|llvmpipe|softpipe|software|basic render/i.test(name);
      const canvas = new OffscreenCanvas(8, 8);
      canvas.style = {};
      const options = { alpha: true, antialias: !bySoftware, depth: true, stencil: false, premultipliedAlpha: true };
      const context = canvas.getContext("webgl2", options);
      if (!context) return shared;
      const renderer = new THREE.WebGLRenderer({ canvas, context, ...options });
      renderer.autoClear = false;
      renderer.setClearColor(0x000000, 0);
      renderer.debug.checkShaderErrors = false;
      shared = { canvas, context, renderer, bySoftware, lost: false };
      canvas.addEventListener("webglcontextlost", (event) => {
        event.preventDefault();
        shared.lost = true;
      });
      canvas.addEventListener("webglcontextrestored", () => {
        shared.lost = false;
        views.forEach((view) => view.request());
      });
    } catch (error) {
      shared = null;
    }
    return shared;
  }

  function lose(context) {
    const extension = context.getExtension("WEBGL_lose_context");
    if (extension) extension.loseContext();
  }

  /** Take the drawing context away for a moment, as a driver may do at any time; to try out what happens then. */
  Shapespace.loseContext = function () {
    const extension = gpu() && gpu().context.getExtension("WEBGL_lose_context");
    if (!extension) return;
    extension.loseContext();
    setTimeout(() => extension.restoreContext(), 50);
  };

  const waiting = new Set(); // views to be redrawn with the next frame
  let scheduled = 0;
  function requestRedraw(view) {
    waiting.add(view);
    if (!scheduled) scheduled = requestAnimationFrame(flush);
  }

  function flush() {
    scheduled = 0;
    const now = Array.from(waiting);
    waiting.clear();
    now.forEach((view) => view._draw(now.length));
  }

  // Another resolution of the screen, or another theme behind the names.
  const redrawAll = () => views.forEach((view) => view.request());
  window.addEventListener("resize", redrawAll);
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redrawAll);
  new MutationObserver(redrawAll).observe(document.documentElement, { attributes: true });

  /** Draw the surfaces of a view; height: of the picture in pixels, ratio: pixels per CSS pixel, isDraft: coarse ones. */
  function drawSurfaces(view, renderer, height, ratio, isDraft) {
    const all = Array.from(view._things.values());
    const coarse = isDraft ? all.filter((thing) => thing.draft) : [];
    const swap = () => {
      for (const thing of coarse) {
        const { geometry } = thing.object, { index } = geometry;
        geometry.setIndex(thing.draft);
        thing.draft = index;
      }
    };
    const shown = all.filter((thing) => thing.visible && thing.opacity > 0.004);
    const solid = shown.filter((thing) => thing.opacity > 0.996 || thing.isMarks);
    const clear = shown.filter((thing) => !solid.includes(thing));
    // A clear surface comes nearer by a little, or it would dapple a solid one that it nearly coincides with.
    const nearer = (0.008 * Math.hypot(...view._camera.state.extent)) / view._camera.distance();
    const pass = (things, colour, blend) => {
      if (!things.length) return;
      for (const thing of all) thing.object.visible = things.includes(thing);
      for (const thing of things) {
        thing.material.colorWrite = colour;
        thing.material.transparent = blend;
        if (!thing.isMarks && !thing.isLines) thing.material.uniforms.nearer.value = clear.includes(thing) ? nearer : 0;
        if (thing.isPoints) {
          const uniforms = thing.material.uniforms;
          uniforms.inPixels.value = thing.isMarks ? 1 : 0;
          uniforms.size.value = thing.isMarks ? 13 * ratio : thing.size;
          uniforms.pixels.value = height / (2 * Math.tan(FIELD / 2));
        }
      }
      renderer.render(view._scene, view._eye);
    };
    swap();
    renderer.clear(true, true, false);
    pass(solid, true, false);
    // Of a clear surface only the nearest layer is seen: its depth first, on top of that of the solid ones.
    clear.forEach((thing, k) => {
      if (k > 0) {
        renderer.clearDepth();
        pass(solid, false, false);
      }
      pass([thing], false, false);
      pass([thing], true, true);
    });
    swap(); // picks meet the fine triangles
  }

  /** Write the names of marks and the texts of a view on the canvas over its picture. */
  function writeNames(view) {
    const names = view._names, some = view._marks.size + view._texts.size > 0;
    names.style.display = some ? "block" : "none";
    if (!some) return;
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    names.width = Math.round(view._frame.clientWidth * ratio);
    names.height = Math.round(view._frame.clientHeight * ratio);
    const context = names.getContext("2d"), style = getComputedStyle(view.element);
    const page = view._background || backgroundOf(view.element), ink = style.color;
    context.font = `${12 * ratio}px ${style.fontFamily || "sans-serif"}`;
    context.textBaseline = "middle";
    context.lineJoin = "round";
    context.lineWidth = 3.5 * ratio;
    const write = (label, x, y) => {
      context.strokeStyle = page;
      context.strokeText(label, x * ratio, y * ratio);
      context.fillStyle = ink;
      context.fillText(label, x * ratio, y * ratio);
    };
    for (const [id, marks] of view._marks) {
      const thing = view._things.get(id);
      if (!thing || !thing.visible) continue;
      marks.forEach((mark, k) => {
        const named = marks.length <= 12 || (view._hovered && view._hovered.id === id && view._hovered.vertex === k);
        const [x, y, depth] = view.project(mark.position);
        // What is well behind the middle is on the far side of the surface.
        if (!mark.label || !named || depth >= 0.02 * Math.hypot(...view._camera.state.extent)) return;
        const width = context.measureText(mark.label).width / ratio;
        write(mark.label, x + 10 + width > view._frame.clientWidth ? x - 10 - width : x + 10, y);
      });
    }
    const taken = [], font = context.font;
    for (const { position, label, small, left } of Array.from(view._texts.values()).flat()) {
      context.font = small ? font.replace(/^[\d.]+px/, `${10.5 * ratio}px`) : font;
      const [x, y] = view.project(position), width = context.measureText(label).width / ratio;
      const at = !small ? [x + 4, y] : left ? [x - width - 5, y] : [x - width / 2, y + 9];
      const place = [at[0] - 3, at[1] - 6, at[0] + width + 3, at[1] + 6];
      // Small ones give way where an axis is seen from its end.
      if (small && taken.some((t) => t[0] < place[2] && place[0] < t[2] && t[1] < place[3] && place[1] < t[3])) continue;
      taken.push(place);
      write(label, ...at);
    }
    context.font = font;
  }

  /** Return the CSS colour behind an element. */
  function backgroundOf(element) {
    for (let e = element; e; e = e.parentElement || e.getRootNode().host) {
      const colour = getComputedStyle(e).backgroundColor;
      if (colour && colour !== "transparent" && colour !== "rgba(0, 0, 0, 0)") return colour;
    }
    return "#ffffff";
  }

  Object.assign(Shapespace.sceneParts, { gpu, views, waiting, requestRedraw, drawSurfaces, writeNames, backgroundOf });
})();
