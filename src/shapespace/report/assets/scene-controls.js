/* Mouse, touch and keys of a view, and the surface under the pointer. */
(function () {
  "use strict";

  const parts = window.Shapespace.sceneParts;

  /** What is under a point of the window: {id, point, vertex}, or null. */
  function pick(view, clientX, clientY, ids) {
    if (!view.works) return null;
    const box = view.canvas.getBoundingClientRect();
    if (!box.width || !box.height) return null;
    const x = clientX - box.left, y = clientY - box.top;
    view._camera.aim(view._eye, box.width, box.height);
    const ray = new THREE.Raycaster();
    ray.setFromCamera(new THREE.Vector2((2 * x) / box.width - 1, 1 - (2 * y) / box.height), view._eye);
    let best = null, nearest = Infinity;
    for (const thing of view._things.values()) {
      if (thing.isLines || (ids ? !ids.includes(thing.id) : !thing.visible)) continue;
      const p = thing.object.geometry.attributes.position.array;
      if (!thing.isPoints) {
        const hit = ray.intersectObject(thing.object, false)[0];
        if (!hit || hit.distance >= nearest) continue;
        const point = hit.point.toArray();
        let vertex = hit.face.a, least = Infinity;
        for (const v of [hit.face.a, hit.face.b, hit.face.c]) {
          const far = Math.hypot(p[3 * v] - point[0], p[3 * v + 1] - point[1], p[3 * v + 2] - point[2]);
          if (far < least) { least = far; vertex = v; }
        }
        nearest = hit.distance;
        best = { id: thing.id, point, vertex };
        continue;
      }
      const distance = view._camera.distance();
      for (let v = 0; v < p.length / 3; v++) {
        if (thing.bad?.has(v)) continue;
        const point = [p[3 * v], p[3 * v + 1], p[3 * v + 2]];
        const [px, py, depth] = view.project(point);
        const reach = thing.isMarks ? 12 : 9;
        if ((px - x) ** 2 + (py - y) ** 2 > reach * reach) continue;
        // Marks win over the surface below them.
        const far = distance + depth - (thing.isMarks ? 0.02 * distance : 0) + Math.hypot(px - x, py - y) * 1e-3;
        if (far < nearest) { nearest = far; best = { id: thing.id, point, vertex: v }; }
      }
    }
    return best;
  }

  function hover(view, event) {
    const crowded = Array.from(view._marks).filter(([, marks]) => marks.length > 12).map(([id]) => id);
    if (crowded.length) {
      const before = view._hovered;
      view._hovered = pick(view, event.clientX, event.clientY, crowded);
      if (before || view._hovered) parts.writeNames(view);
    }
    view._emit("hover", event);
  }

  /** Turn, move and zoom a view by mouse, touch and keys. */
  function listen(view) {
    const canvas = view.canvas;
    const moveCamera = (act, ...by) => {
      view._camera[act](...by);
      view._moved();
    };
    const down = new Map();
    let travelled = 0;
    canvas.addEventListener("pointerdown", (event) => {
      down.set(event.pointerId, [event.clientX, event.clientY]);
      if (down.size === 1) travelled = 0;
      try { canvas.setPointerCapture(event.pointerId); } catch (error) { /* the pointer is gone already */ }
      canvas.style.cursor = "grabbing";
    });
    canvas.addEventListener("pointermove", (event) => {
      const last = down.get(event.pointerId);
      if (!last) {
        hover(view, event);
        return;
      }
      const dx = event.clientX - last[0], dy = event.clientY - last[1];
      travelled += Math.abs(dx) + Math.abs(dy);
      if (down.size === 1) {
        down.set(event.pointerId, [event.clientX, event.clientY]);
        if (event.buttons & 6 || event.shiftKey) moveCamera("pan", dx, dy);
        else moveCamera("turn", -dx * 0.008, dy * 0.008);
        return;
      }
      const others = Array.from(down.entries()).filter(([key]) => key !== event.pointerId);
      const other = others[0][1];
      const before = Math.hypot(last[0] - other[0], last[1] - other[1]);
      const after = Math.hypot(event.clientX - other[0], event.clientY - other[1]);
      down.set(event.pointerId, [event.clientX, event.clientY]);
      if (before > 0 && after > 0) moveCamera("zoom", before / after);
      moveCamera("pan", dx / 2, dy / 2);
    });
    const up = (event) => {
      const had = down.delete(event.pointerId);
      if (!down.size) canvas.style.cursor = "grab";
      if (had && event.type === "pointerup" && !down.size && travelled < 5 && event.button === 0) {
        view._emit("click", event);
      }
    };
    canvas.addEventListener("pointerup", up);
    canvas.addEventListener("pointercancel", up);
    canvas.addEventListener("pointerleave", (event) => hover(view, event));
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("dblclick", () => view.reset());
    canvas.addEventListener("wheel", (event) => {
      if (view._embedded && !event.ctrlKey && document.activeElement !== canvas) return;
      event.preventDefault();
      const lines = event.deltaMode === 1 ? 16 : 1;
      moveCamera("zoom", Math.exp(Math.max(-80, Math.min(80, event.deltaY * lines)) * 0.002));
    }, { passive: false });
    canvas.addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey) return;
      const step = Math.PI / 24;
      const keys = {
        ArrowLeft: () => moveCamera("turn", -step, 0), ArrowRight: () => moveCamera("turn", step, 0),
        ArrowUp: () => moveCamera("turn", 0, step), ArrowDown: () => moveCamera("turn", 0, -step),
        "+": () => moveCamera("zoom", 1 / 1.12), "=": () => moveCamera("zoom", 1 / 1.12),
        "-": () => moveCamera("zoom", 1.12), Home: () => view.reset(),
      };
      const act = keys[event.key];
      if (!act) return;
      event.preventDefault();
      act();
    });
  }

  Object.assign(parts, { pick, listen });
})();
