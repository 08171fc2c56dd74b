// Runs before the page is painted: the reader's choice of colours, where the browser lets a local file remember one.
(function () {
  "use strict";
  let kept = null;
  try { kept = window.localStorage.getItem("shapespace-theme"); } catch (refused) { kept = null; }
  // In the studio, which shows title and theme itself, and of an answer the sentences.
  const place = window.parent === window ? null : /^#in-studio-(light|dark)(-answer)?$/.exec(window.location.hash);
  if (place) {
    kept = place[1];
    document.documentElement.classList.add("in-studio");
    document.documentElement.classList.toggle("answer", Boolean(place[2]));
  }
  if (kept === "light" || kept === "dark") document.documentElement.dataset.theme = kept;
})();
