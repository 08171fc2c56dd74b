// The theme of a report that is a page of its own.
function startReportTheme() {
  "use strict";
  const root = document.documentElement;
  const system = window.matchMedia("(prefers-color-scheme: dark)");

  // Theme: the system's, unless the reader chose the other one.
  const button = document.getElementById("theme");
  const shown = () => root.dataset.theme || (system.matches ? "dark" : "light");
  function nameButton() {
    button.textContent = shown() === "dark" ? "Light colours" : "Dark colours";
  }
  function remember(theme) {
    try {
      if (theme) window.localStorage.setItem("shapespace-theme", theme);
      else window.localStorage.removeItem("shapespace-theme");
    } catch (refused) {
      // A page from file:// may have no storage; the choice then lasts as long as the page.
    }
  }
  function tellTheme() {
    nameButton();
    document.dispatchEvent(new CustomEvent("shapespace:theme", { detail: shown() }));
  }
  button.addEventListener("click", () => {
    const wanted = shown() === "dark" ? "light" : "dark";
    if (wanted === (system.matches ? "dark" : "light")) delete root.dataset.theme;
    else root.dataset.theme = wanted;
    remember(root.dataset.theme);
    tellTheme();
  });
  system.addEventListener("change", tellTheme);
  nameButton();
  button.hidden = false;
}

/**
 * What a report does beyond being read: tables that sort, pictures that turn, links within it.
 * root: the document, or the root of a report within another page; scroller: what scrolls it, the window or an element;
 * signal: of an AbortController that ends it.
 */
window.startShapespaceReport = function (root, scroller, signal) {
  "use strict";
  const byAddress = (hash) => root.getElementById(decodeURIComponent(hash.slice(1)));

  // Tables: numbers by their value, texts as people order them; rows without a number stay last.
  const collator = new Intl.Collator(undefined, { numeric: true, sensitivity: "base" });
  function key(row, column) {
    const cell = row.cells[column];
    if (!cell.hasAttribute("data-value")) return cell.textContent.trim();
    return cell.dataset.value === "" ? NaN : Number(cell.dataset.value);
  }
  function compare(a, b, sign) {
    if (typeof a === "number" && typeof b === "number") {
      if (Number.isNaN(a) || Number.isNaN(b)) return Number.isNaN(a) - Number.isNaN(b);
      return sign * (a - b);
    }
    return sign * collator.compare(String(a), String(b));
  }
  function sort(table, column, sign) {
    const body = table.tBodies[0];
    const rows = Array.from(body.rows, (row) => ({ row, key: key(row, column) }));
    rows.sort((a, b) => compare(a.key, b.key, sign));
    body.append(...rows.map((entry) => entry.row));
  }
  for (const table of root.querySelectorAll("table.sortable")) {
    const heads = Array.from(table.tHead.rows[0].cells);
    heads.forEach((head, column) => {
      const sorter = document.createElement("button");
      sorter.type = "button";
      sorter.append(...head.childNodes);
      head.append(sorter);
      head.setAttribute("aria-sort", "none");
      sorter.addEventListener("click", () => {
        const up = head.getAttribute("aria-sort") !== "ascending";
        heads.forEach((other) => other.setAttribute("aria-sort", "none"));
        head.setAttribute("aria-sort", up ? "ascending" : "descending");
        sort(table, column, up ? 1 : -1);
      });
    });
  }

  // Pictures: on a narrow page their words get too small to read, so they open at full size and scroll.
  const wide = 1.25;
  function offer(figure) {
    const plate = figure.querySelector(".plate");
    const image = plate && plate.querySelector("img");
    const narrow = image && image.clientWidth > 0 && Number(image.getAttribute("width")) > wide * image.clientWidth;
    let opener = figure.querySelector("button.full");
    if (plate && plate.classList.contains("full")) return;
    if (opener) opener.hidden = !narrow;
    if (opener || !narrow) return;
    opener = document.createElement("button");
    opener.type = "button";
    opener.className = "full";
    opener.setAttribute("aria-pressed", "false");
    opener.textContent = "Full size";
    opener.addEventListener("click", () => {
      const full = plate.classList.toggle("full");
      opener.setAttribute("aria-pressed", String(full));
      opener.textContent = full ? "Fit to the page" : "Full size";
      if (full) plate.tabIndex = 0;
      else plate.removeAttribute("tabindex");
    });
    figure.insertBefore(opener, plate.nextSibling);
  }
  const narrowPage = window.matchMedia("(max-width: 640px)");
  function offerAll() {
    if (narrowPage.matches) root.querySelectorAll("figure.drawing, figure.plain, figure.chart").forEach(offer);
  }
  narrowPage.addEventListener("change", offerAll, { signal });

  // Tables wider than the page have a note.
  function tellWide() {
    for (const holder of root.querySelectorAll(".table")) {
      holder.classList.toggle("wide", holder.scrollWidth > holder.clientWidth + 4);
    }
  }
  // Sizes of pictures and tables are known once all has loaded.
  const measure = () => { offerAll(); tellWide(); };
  if (document.readyState === "complete") measure();
  else window.addEventListener("load", measure, { signal });
  window.addEventListener("resize", tellWide, { signal });
  root.addEventListener("toggle", tellWide, true);

  // What an address or a link leads to is opened where it is folded away.
  function unfold(hash) {
    const target = byAddress(hash);
    for (let part = target; part; part = part.parentElement) if (part.tagName === "DETAILS") part.open = true;
    if (target && (root !== document || target.closest("details"))) target.scrollIntoView();
  }
  window.addEventListener("hashchange", () => { if (root === document) unfold(window.location.hash); }, { signal });
  root.addEventListener("click", (event) => {
    const link = event.target.closest && event.target.closest("a[href^='#']");
    if (!link) return;
    if (root !== document) event.preventDefault(); // the address is that of the page around the report
    if (root !== document || link.getAttribute("href") === window.location.hash) unfold(link.hash);
  });
  if (root === document) unfold(window.location.hash);

  // The navigation marks the part that is read.
  const links = Array.from(root.querySelectorAll("nav a"));
  function tellWhere() {
    const height = links.length ? links[0].closest("nav").offsetHeight : 0;
    const box = scroller === window ? document.documentElement : scroller, top = scroller === window ? 0 : box.getBoundingClientRect().top;
    box.style.scrollPaddingTop = `${height + 14}px`;
    const below = links.findIndex((link) => byAddress(link.hash).getBoundingClientRect().top > top + height + 74);
    const end = box.scrollTop + box.clientHeight >= box.scrollHeight - 4;
    const at = end || below < 0 ? links.length - 1 : Math.max(0, below - 1);
    links.forEach((link, k) => {
      if ((k === at) === link.hasAttribute("aria-current")) return;
      link.toggleAttribute("aria-current", k === at);
      if (k !== at) return;
      const list = link.closest("ul");
      list.scrollLeft += link.getBoundingClientRect().left - list.getBoundingClientRect().left - 60;
      list.scrollTop += link.getBoundingClientRect().top - list.getBoundingClientRect().top - 46; // of two rows
    });
  }
  scroller.addEventListener("scroll", tellWhere, { passive: true, signal });
  tellWhere();

  // Paper has no folds.
  let folded = [];
  window.addEventListener("beforeprint", () => {
    folded = Array.from(root.querySelectorAll("details:not([open])"));
    folded.forEach((part) => { part.open = true; });
  }, { signal });
  window.addEventListener("afterprint", () => folded.forEach((part) => { part.open = false; }), { signal });

  // What turns builds itself when it comes near the window; the still stays where that fails, and for paper.
  for (const widget of root.querySelectorAll(".widget")) {
    const parent = widget.parentElement;
    window.Shapespace.widgets[widget.dataset.widget](widget, root.getElementById(widget.dataset.payload)).then((made) => {
      if (made && made.view.works) return parent.classList.add("running");
      const note = document.createElement("p");
      note.className = "soft";
      note.textContent = "It does not turn in this browser, which has no WebGL; the still shows the same.";
      if (made) widget.replaceChildren(note);
      parent.classList.add("refused");
    });
  }
};

// Within the report's own file.
if (!document.currentScript.src) {
  startReportTheme();
  window.startShapespaceReport(document, window);
}
