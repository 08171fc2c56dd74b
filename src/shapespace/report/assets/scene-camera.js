/* The camera of a view: an orbit around a target. */
(function () {
  "use strict";

  const parts = window.Shapespace.sceneParts;
  const FIELD = (20 * Math.PI) / 180; // vertical field of view, radians

  /** An orbit around state.target that shows a box of state.extent, mm. */
  parts.OrbitCamera = class {
    /** frame: the element that the picture fills. */
    constructor(frame) {
      this._frame = frame;
      this.state = { yaw: 0, pitch: 0, roll: 0, zoom: 1, target: [0, 0, 0], extent: [100, 100, 100] };
      this.home = null; // the state that a reset goes back to
    }

    /** Turn by angles across and along the picture, which the roll rotates. */
    turn(across, along) {
      const { pitch, roll } = this.state;
      this.state.yaw += Math.cos(roll) * across - Math.sin(roll) * along;
      this.state.pitch = Math.min(Math.max(pitch + Math.sin(roll) * across + Math.cos(roll) * along, -Math.PI / 2), Math.PI / 2);
    }

    zoom(factor) {
      this.state.zoom = Math.min(Math.max(this.state.zoom * factor, 0.05), 5);
    }

    pan(dx, dy) {
      const { right, up } = this.axes();
      const perPixel = (2 * this.distance() * Math.tan(FIELD / 2)) / Math.max(this._frame.clientHeight, 1);
      this.state.target = this.state.target.map((t, i) => t + (-dx * right[i] + dy * up[i]) * perPixel);
    }

    axes() {
      const { yaw, pitch, roll } = this.state;
      const cy = Math.cos(yaw), sy = Math.sin(yaw), cp = Math.cos(pitch), sp = Math.sin(pitch);
      const back = [sy * cp, sp, cy * cp];
      const flatRight = [cy, 0, -sy], flatUp = [-sy * sp, cp, -cy * sp];
      const cr = Math.cos(roll), sr = Math.sin(roll);
      return {
        back,
        right: flatRight.map((r, i) => cr * r + sr * flatUp[i]),
        up: flatUp.map((u, i) => cr * u - sr * flatRight[i]),
      };
    }

    /** Distance from the target, mm. */
    distance() {
      const [w, h, d] = this.state.extent;
      const aspect = Math.max(this._frame.clientWidth, 1) / Math.max(this._frame.clientHeight, 1);
      const half = 0.5 * Math.max(h, Math.max(w, 0.7 * d) / aspect) * 1.08;
      return (half / Math.tan(FIELD / 2) + 0.2 * d) * this.state.zoom;
    }

    /** Move a camera of three.js to this orbit, for a picture of this size. */
    aim(eye, width, height) {
      const { right, up, back } = this.axes();
      const distance = this.distance();
      const t = this.state.target, extent = this.state.extent;
      const at = t.map((value, i) => value + back[i] * distance);
      const reach = Math.hypot(...extent) * 1.5 + Math.hypot(t[0] - (this.home ? this.home.target[0] : t[0]), 0);
      eye.aspect = width / height;
      eye.near = Math.max(distance - reach, distance * 0.02);
      eye.far = distance + reach;
      eye.updateProjectionMatrix();
      eye.matrix.set(
        right[0], up[0], back[0], at[0], right[1], up[1], back[1], at[1], right[2], up[2], back[2], at[2], 0, 0, 0, 1
      );
      eye.matrixWorldNeedsUpdate = true;
      eye.updateMatrixWorld(true);
    }

    /** Return CSS pixels of a point in the frame, and its depth behind the target, mm. */
    project(point) {
      const { right, up, back } = this.axes();
      const distance = this.distance();
      const d = point.map((value, i) => value - this.state.target[i]);
      const dot = (axis) => d[0] * axis[0] + d[1] * axis[1] + d[2] * axis[2];
      const depth = -dot(back);
      const scale = this._frame.clientHeight / (2 * Math.tan(FIELD / 2) * Math.max(distance + depth, 1e-6));
      return [this._frame.clientWidth / 2 + dot(right) * scale, this._frame.clientHeight / 2 - dot(up) * scale, depth];
    }
  };

  parts.copyCamera = (state) => ({ ...state, target: Array.from(state.target), extent: Array.from(state.extent) });
  parts.FIELD = FIELD;
})();
