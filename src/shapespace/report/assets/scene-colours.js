/* Colour bars, and the meaning of the colours of a fit's distances. */
(function () {
  "use strict";

  const Shapespace = window.Shapespace;

  /** Fill `element` with a bar of `map` from range[0] to range[1], its title and unit; open: values may lie beyond; keys: [text, colour] below it. */
  Shapespace.colourBar = function (element, { map, range, unit = "mm", title = "", open = false, keys = [], labels = null }) {
    const css = map.map((c) => `rgb(${c.map((v) => Math.round(255 * v)).join(",")})`);
    const middle = (range[0] + range[1]) / 2;
    element.replaceChildren();
    element.classList.add("shapespace-bar");
    element.setAttribute("role", "img");
    const others = keys.map(([text]) => `; apart from the scale: ${text}`).join("");
    element.setAttribute("aria-label", `${title}, from ${number(range[0])} to ${number(range[1])} ${unit}${others}`);
    const heading = document.createElement("span");
    heading.className = "shapespace-bar-title";
    heading.textContent = unit ? `${title} (${unit})` : title;
    const bar = document.createElement("span");
    bar.className = "shapespace-bar-colours";
    bar.style.background = `linear-gradient(to right, ${css.join(",")})`;
    const ticks = document.createElement("span");
    ticks.className = "shapespace-bar-ticks";
    for (const value of [range[0], middle, range[1]]) {
      const tick = document.createElement("span");
      const beyond = !open || value === middle || (value === range[0] && value === 0) ? "" : value < middle ? "\u2264 " : "\u2265 ";
      tick.textContent = labels ? labels[ticks.childElementCount] : beyond + number(value);
      ticks.appendChild(tick);
    }
    element.append(heading, bar, ticks);
    for (const [text, colour] of keys) {
      const key = document.createElement("span"), dot = document.createElement("span");
      key.className = "shapespace-bar-key";
      dot.className = "shapespace-bar-dot";
      dot.style.background = `rgb(${colour.map((v) => Math.round(255 * v)).join(",")})`;
      key.append(dot, text);
      element.append(key);
    }
  };

  function number(value) {
    const digits = Math.abs(value) >= 10 || Number.isInteger(value) ? 0 : Math.abs(value) >= 1 ? 1 : 2;
    return value.toFixed(digits).replace("-", "\u2212");
  }
  Shapespace.number = number;

  /**
   * What the colours of a fit's distances mean, for report and viewer: {title, range, map, keys} of `colourBar`.
   * onModel: painted on the model, else on the scan; colours: {diverging, sequential, unknown}.
   */
  Shapespace.distanceScale = function (facts, values, onModel, colours) {
    const top = facts.scale_mm > 0 ? facts.scale_mm : 1, signed = facts.signed !== false;
    const unsigned = onModel ? "Distance to the points" : "Distance of the points to the model";
    const grey = onModel ? "not shown by the scan" : "beyond the model\u2019s rim, not counted";
    return {
      title: signed ? "Scan inside (\u2212) or outside (+) of the model" : unsigned,
      range: [signed ? -top : 0, top],
      map: signed ? colours.diverging : colours.sequential,
      keys: values.some(Number.isNaN) ? [[grey, colours.unknown]] : [],
      unit: "mm",
      open: true,
    };
  };
})();
