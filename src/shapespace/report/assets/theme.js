// Runs before the page is painted: the reader's choice of colours, where the browser lets a local file remember one.
(function () {
  "use strict";
  let kept = null;
  try { kept = window.localStorage.getItem("shapespace-theme"); } catch (refused) { kept = null; }
  if (kept === "light" || kept === "dark") document.documentElement.dataset.theme = kept;
})();
