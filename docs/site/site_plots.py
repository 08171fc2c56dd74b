"""Plots of the tables in the documents, drawn when the site is built: no number is typed twice."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sphinx.application import Sphinx

FOLDER = "build/site-plots"
INK = {"light": "#24292f", "dark": "#cfd3d7"}
OURS, PAPER, OTHERS, SECOND = "#2a7ab8", "#c2593b", "#8b949e", "#c9a227"


@dataclass(frozen=True)
class Plot:
    """A picture of a table.

    Args:
        name: of its files.
        document: that has the table, without `.md`.
        heading: above the table.
        alt: what it shows, for those who do not see it.
        draw: draws on the axes what the rows of the table say, its head among them.
        shown_in: documents and headings that show it, below the first table or at the end of the section.
    """

    name: str
    document: str
    heading: str
    alt: str
    draw: Callable[[list[list[str]], Any], None]
    shown_in: tuple[tuple[str, str], ...]


def section(text: str, heading: str) -> re.Match[str]:
    """Return the part of a document below `heading`, up to the next one."""
    found = re.search(rf"(?<=^#) *#* *{re.escape(heading)}$(.*?)(?=^#+ |\Z)", text, re.MULTILINE | re.DOTALL)
    if not found:
        raise ValueError(f"There is no heading {heading!r} for a plot; see docs/site/site_plots.py.")
    return found


def table(text: str, heading: str) -> list[list[str]]:
    """Return the cells of the first table below `heading`, its head first, without marks of code and emphasis."""
    lines = re.search(r"(?:^\|.*\n)+", section(text, heading)[0], re.MULTILINE)
    if not lines:
        raise ValueError(f"There is no table below {heading!r} for a plot; see docs/site/site_plots.py.")
    cells = [[re.sub(r"[`*]", "", cell).strip() for cell in line[1:-1].split("|")] for line in lines[0].splitlines()]
    return [cells[0], *cells[2:]]


def number(cell: str) -> float:
    """Return the first number of a cell, not-a-number where it has none."""
    found = re.match(r"-?[\d.]+", cell)
    return float(found[0]) if found else float("nan")


def column(rows: list[list[str]], head: str) -> list[float]:
    """Return the numbers below a head."""
    place = rows[0].index(head)
    return [number(row[place]) for row in rows[1:]]


def _wrapped(names: list[str]) -> list[str]:
    return [textwrap.fill(name, 30) for name in names]


def _bars(axes: Any, names: list[str], values: list[float], unit: str, *, ours: str) -> None:
    places = range(len(names))[::-1]
    colours = [OURS if ours in name else PAPER if "paper" in name or "NumPy" in name else OTHERS for name in names]
    axes.barh(places, values, color=colours, height=0.7)
    for place, value in zip(places, values, strict=True):
        axes.text(value, place, f" {value:g}", va="center", fontsize=8)
    axes.set_yticks(places, _wrapped(names))
    axes.set_xscale("log")
    axes.set_xlabel(unit)
    axes.margins(x=0.12)


def _legend(axes: Any) -> None:
    axes.figure.legend(frameon=False, loc="outside upper left", ncols=3)


def _errors(rows: list[list[str]], axes: Any) -> None:
    names = [row[0] for row in rows[1:]]
    complete, holes = column(rows, "complete: true vertices, mm"), column(rows, "holes: true vertices, mm")
    for place, (a, b) in enumerate(zip(complete[::-1], holes[::-1], strict=True)):
        axes.plot([a, b], [place, place], color=OTHERS, linewidth=1.5, zorder=1)
    places = range(len(names))[::-1]
    axes.scatter(complete, places, color=OURS, s=42, label="complete scan", zorder=2)
    axes.scatter(holes, places, color=PAPER, s=42, marker="D", label="cut, with a hole and extra neck", zorder=2)
    axes.set_yticks(places, _wrapped(names))
    axes.set_xscale("log")
    axes.set_xticks([0.5, 1, 2, 5, 10, 20], ["0.5", "1", "2", "5", "10", "20"])
    axes.set_xlabel("distance of the vertices from their true places, mm")
    _legend(axes)


def _times(rows: list[list[str]], axes: Any) -> None:
    names: list[str] = []
    values: list[float] = []
    for row, least in zip(rows[1:], column(rows, "CPU s, least"), strict=True):
        both = row[0].split(" / "), row[1].split(" / ")  # two peers may share a line
        names += both[0] if len(both[1]) == 2 else [row[0]]
        values += map(float, both[1]) if len(both[1]) == 2 else [least]
    _bars(axes, names, values, "CPU seconds of one fit", ours="robust")


def _cases(rows: list[list[str]], axes: Any) -> None:
    kept = [
        rows[0],
        *(row for row in rows[1:] if row[1] == "50" or "outside" in row[0] or row[0].startswith("the same")),
    ]
    names = [row[0] for row in kept[1:]]
    places = range(len(names))[::-1]
    axes.scatter(column(kept, "paper, mm"), places, color=PAPER, marker="D", s=36, label="the paper's method")
    axes.scatter(column(kept, "robust, mm"), places, color=OURS, s=42, label="robust")
    axes.scatter(
        column(kept, "floor, mm"), places, color=SECOND, marker="|", s=130, label="the best that the model can do"
    )
    axes.set_yticks(places, _wrapped(names))
    axes.set_xscale("log")
    axes.set_xticks([0.5, 1, 2, 5, 10, 20, 50], ["0.5", "1", "2", "5", "10", "20", "50"])
    axes.set_xlabel("distance of the vertices from their true places, mm")
    _legend(axes)


def _organs(rows: list[list[str]], axes: Any) -> None:
    names, place = [row[0] for row in rows[1:]], range(len(rows) - 1)[::-1]
    for head, colour, marker in (("generalisation, mm", OURS, "o"), ("specificity, mm", PAPER, "D")):
        at = rows[0].index(head)
        found = [[float(n) for n in re.findall(r"\d+\.\d+", row[at])] for row in rows[1:]]
        for y, (value, low, high) in zip(place, found, strict=True):
            axes.plot([low, high], [y, y], color=colour, linewidth=2)
            axes.scatter(
                [value], [y], color=colour, marker=marker, s=36, label=head.removesuffix(", mm") if y == 0 else None
            )
    axes.set_yticks(place, _wrapped(names))
    axes.set_xlabel("mm, with 95 % intervals; less is better")
    _legend(axes)


BENCHMARKS = "docs/benchmarks"
PLOTS = (
    Plot(
        "accuracy", BENCHMARKS, "Accuracy",
        "Dots on a logarithmic scale: in every case the robust method lies on the floor or close to it; the paper's "
        "lies near 1 mm where scans are complete and far to the right where they are not",
        _cases, ((BENCHMARKS, "Accuracy"),),
    ),
    Plot(
        "peers", BENCHMARKS, "Comparison with other tools",
        "Two dots for each method, a complete scan and one with a cut, a hole and extra neck: of shapespace both lie "
        "at the same place, of most others the second lies far off",
        _errors, ((BENCHMARKS, "Comparison with other tools"), ("docs/other-tools", "Measured comparisons")),
    ),
    Plot(
        "speed", BENCHMARKS, "Speed",
        "Bars on a logarithmic scale: CPU seconds of one fit by each method, the robust one a fraction of a second",
        _times, ((BENCHMARKS, "Speed"),),
    ),
    Plot(
        "organs", BENCHMARKS, "Correspondence of real organs, with other tools",
        "Generalisation and specificity of spleens put into correspondence by shapespace, meshmonk and rustcpd, with "
        "their intervals: those of shapespace and meshmonk overlap, those of rustcpd are larger",
        _organs, ((BENCHMARKS, "Correspondence of real organs, with other tools"),),
    ),
)  # fmt: skip


def draw_all(app: Sphinx) -> None:
    """Draw every plot, for light pages and for dark ones."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    root = Path(app.srcdir)
    (root / FOLDER).mkdir(parents=True, exist_ok=True)
    for plot in PLOTS:
        rows = table((root / f"{plot.document}.md").read_text("utf-8"), plot.heading)
        for scheme, ink in INK.items():
            colours = {f"{part}color": ink for part in ("text.", "axes.label", "axes.edge", "xtick.", "ytick.")}
            with mpl.rc_context({**colours, "font.size": 9, "svg.hashsalt": plot.name}):
                figure = Figure(layout="constrained")
                axes = figure.add_subplot()
                axes.spines[["top", "right"]].set_visible(False)
                plot.draw(rows, axes)
                figure.set_size_inches(5.8, 1.2 + 0.3 * len(axes.get_yticks()))
                figure.savefig(root / FOLDER / f"{plot.name}-{scheme}.svg", transparent=True, metadata={"Date": None})


def add(document: str, text: str) -> str:
    """Return the text of a document with its plots below the first table of their sections."""
    for plot in PLOTS:
        for page, heading in plot.shown_in:
            if page == document:
                part = section(text, heading)
                below = re.search(r"(?:^\|.*\n)+", part[0], re.MULTILINE)
                place = part.start() + below.end() if below else part.end()
                text = text[:place] + "\n" + _shown(plot) + "\n" + text[place:]
    return text


def _shown(plot: Plot) -> str:
    return "\n".join(
        f"```{{image}} /{FOLDER}/{plot.name}-{scheme}.svg\n:alt: {plot.alt}\n:class: only-{scheme}\n```\n"
        for scheme in INK
    )
