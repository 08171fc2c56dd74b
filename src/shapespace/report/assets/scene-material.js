/* Light and colour of surfaces and points: their shaders, materials and colour maps. */
(function () {
  "use strict";

  const Shapespace = window.Shapespace;

  // One light for all: a soft key from the camera's upper left, and more from the sky than from the ground. Squares and
  // roots stand for the sRGB curve, as powers cost a third of the frame where the processor draws.
  const LIGHT = `
    vec3 lit(vec3 colour, vec3 n, float back, float painted) {
      vec3 base = colour * colour;
      base = mix(base, base * vec3(0.42, 0.45, 0.52), back);
      float key = clamp(dot(n, vec3(-0.412, 0.514, 0.752)) * 0.92 + 0.08, 0.0, 1.0);
      float sky = 0.5 + 0.5 * n.y;
      vec3 light = key * vec3(0.80, 0.785, 0.76) + mix(vec3(0.17, 0.165, 0.17), vec3(0.33, 0.35, 0.38), sky);
      float edge = 1.0 - clamp(n.z, 0.0, 1.0);
      light += 0.10 * edge * edge * edge;
      light = mix(light, 0.55 + 0.45 * light, painted);
      return sqrt(min(base * light, 1.0));
    }`;

  const COLOUR = `
    uniform vec3 colour; uniform vec3 signal; uniform vec3 unknown; uniform sampler2D map;
    uniform vec2 range; uniform float threshold; uniform int paint; uniform float squares;
    vec3 painted(vec2 value, vec3 own) {
      if (paint == 0) return colour;
      if (paint == 2 || paint == 4) return own; // 4: the colour of the part, lit as a plain one
      if (paint == 3) {
        // As render.squares: every other one is paper, the others take turns so that near ones differ.
        vec2 at = floor(value);
        float turn = mod(at.x + at.y, 2.0) > 0.5 ? 0.0 : 1.0 + mod(floor((3.0 * at.x - at.y) / 2.0), squares - 1.0);
        return texture2D(map, vec2((turn + 0.5) / squares, 0.5)).rgb;
      }
      if (value.y < 0.999) return unknown;
      if (abs(value.x) > threshold) return signal;
      return texture2D(map, vec2(clamp((value.x - range.x) / (range.y - range.x), 0.0, 1.0), 0.5)).rgb;
    }`;

  const SURFACE_VERTEX = `
    attribute vec2 value; attribute vec3 own;
    uniform float nearer;
    varying vec3 vNormal; varying vec2 vValue; varying vec3 vOwn;
    void main() {
      vNormal = normalMatrix * normal; vValue = value; vOwn = own;
      vec4 seen = modelViewMatrix * vec4(position, 1.0);
      seen.xyz *= 1.0 - nearer;
      gl_Position = projectionMatrix * seen;
    }`;
  const SURFACE_FRAGMENT = LIGHT + COLOUR + `
    uniform float opacity;
    varying vec3 vNormal; varying vec2 vValue; varying vec3 vOwn;
    void main() {
      vec3 n = normalize(vNormal);
      float back = gl_FrontFacing ? 0.0 : 1.0;
      if (back > 0.5) n = -n;
      gl_FragColor = vec4(lit(painted(vValue, vOwn), n, back, paint == 0 || paint == 4 ? 0.0 : paint == 3 ? 0.4 : 1.0), opacity);
    }`;

  const POINT_VERTEX = `
    attribute vec2 value; attribute vec3 own;
    uniform float size; uniform float pixels; uniform float inPixels; uniform float nearer;
    varying vec2 vValue; varying vec3 vOwn;
    void main() {
      vValue = value; vOwn = own;
      vec4 seen = modelViewMatrix * vec4(position, 1.0);
      seen.xyz *= 1.0 - nearer;
      gl_Position = projectionMatrix * seen;
      gl_PointSize = clamp(inPixels > 0.5 ? size : size * pixels / -seen.z, 1.5, 64.0);
    }`;
  const POINT_FRAGMENT = LIGHT + COLOUR + `
    uniform float opacity; uniform float rim;
    varying vec2 vValue; varying vec3 vOwn;
    void main() {
      vec2 at = (gl_PointCoord - 0.5) * vec2(2.0, -2.0);
      float r = dot(at, at);
      if (r > 1.0) discard;
      vec3 n = vec3(at, sqrt(1.0 - r));
      vec3 seen = lit(painted(vValue, vOwn), n, 0.0, paint == 1 ? 1.0 : 0.5);
      if (rim > 0.5 && r > 0.62) seen = vec3(1.0);
      gl_FragColor = vec4(seen, opacity);
    }`;

  function useMap(thing, colours) {
    if (thing.texture) thing.texture.dispose();
    thing.texture = thing.material.uniforms.map.value = texture(colours);
  }

  function texture(map) {
    const data = new Uint8Array(4 * map.length);
    map.forEach((colour, k) => data.set([255 * colour[0], 255 * colour[1], 255 * colour[2], 255].map(Math.round), 4 * k));
    const out = new THREE.DataTexture(data, map.length, 1);
    out.minFilter = out.magFilter = THREE.LinearFilter;
    out.needsUpdate = true;
    return out;
  }

  function material(isPoints) {
    const uniforms = {
      colour: { value: new THREE.Vector3() }, signal: { value: new THREE.Vector3() },
      unknown: { value: new THREE.Vector3() }, map: { value: null }, range: { value: new THREE.Vector2(0, 1) },
      threshold: { value: 1e30 }, paint: { value: 0 }, squares: { value: 2 }, opacity: { value: 1 }, nearer: { value: 0 },
    };
    if (isPoints) {
      Object.assign(uniforms, {
        size: { value: 1 }, pixels: { value: 1 }, inPixels: { value: 0 }, rim: { value: 0 },
      });
    }
    return new THREE.ShaderMaterial({
      uniforms,
      vertexShader: isPoints ? POINT_VERTEX : SURFACE_VERTEX,
      fragmentShader: isPoints ? POINT_FRAGMENT : SURFACE_FRAGMENT,
      side: THREE.DoubleSide,
    });
  }

  Object.assign(Shapespace.sceneParts, { material, useMap });
})();
