"""Common parts of all figures: width, type sizes, rows of panels, charts, scales, legends, WebP.

A figure is 960 pixels wide, and its smallest type stays legible when a phone shows it 340 wide.
"""

from __future__ import annotations

import base64
import io
import re
import textwrap
import warnings
from bisect import bisect_left
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from html import unescape
from importlib import import_module
from pathlib import Path
from typing import Any, cast

import matplotlib
import numpy as np
from matplotlib import font_manager
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg, RendererAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.image import BboxImage
from matplotlib.transforms import Bbox, IdentityTransform, TransformedBbox

from shapespace.errors import InputError
from shapespace.io.files import write_bytes
from shapespace.report.blocks.wording import counted as counted
from shapespace.report.blocks.wording import mm as mm
from shapespace.report.blocks.wording import percent as percent
from shapespace.report.blocks.wording import printable
from shapespace.report.inputs.saved_fits import StagedFit, measured_mm
from shapespace.report.render.palette import DIVERGING, SCAN_COLOUR, SEQUENTIAL, Colour
from shapespace.report.render.renderer import Camera, Image, Layer, point_spacing
from shapespace.report.render.thumbnails import Still, encoded
from shapespace.types import FloatArray, Mesh

STAGE_WORDS = {
    "before": "before",
    "initial": "after phase 1: pose",
    "final": "after phase 2: pose and shape",
    "dense": "dense",
}
"""Stages of a fit whose surfaces are saved, in order, and their names in words."""

SIGNED = "distance (mm): scan inside (−) or outside (+) of the model"
UNSIGNED = "distance to the points (mm), which have no inside or outside"
NOT_SHOWN = "not shown by the scan"
"""Labels of signed distances, of distances to a point cloud, and of vertices without a distance, in all figures."""

INK, GREY, RULE = "#1d1f22", "#5c6068", "#e4e5e8"
FORWARD, BACKWARD, BARS = "#0072B2", "#D55E00", "#a9c9e2"
WIDTH, DPI = 960, 160  # layout: pixels of the column, dots per inch
TITLE, TEXT, SMALL = 12.0, 11.0, 9.5  # layout: type sizes, points
MOST_PANELS = 48  # limit on the size of a figure
FEWEST_BINNED = 10
"""Smallest number of values of a histogram; fewer are drawn as dots."""
_GAP, _EDGE, _MOST_LINES = 8, 4, 4  # layout: pixels, and lines of a caption
_LEGEND_MARK = 3.6  # layout: width of an entry of a legend without its name, in sizes of its type
# steps between tick labels, and how many labels fit next to each other
_STEPS, _MOST_NUMBERS = (1, 5, 10, 20, 50, 100, 200, 500), 22


MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")  # in the order of those of widget-morphospace-drawing.js


@dataclass(frozen=True)
class Layout:
    """Size and style of figures: for a page, or for print.

    Args:
        chart_width: width of charts, pixels of `DPI`.
        row_width: width of rows of pictures, pixels of `DPI`.
        scale: factor of type sizes, line widths, marker sizes, and heights of charts.
        panel_scale: pixels of a rendered picture for one pixel of `DPI`.
        has_titles: whether figures have a title; in print it is in the caption.
    """

    chart_width: int = WIDTH
    row_width: int = WIDTH
    scale: float = 1.0
    panel_scale: float = 1.0
    has_titles: bool = True


PAGE = Layout()
LAYOUT: ContextVar[Layout] = ContextVar("layout", default=PAGE)
"""The current layout; `publication.publication_style` sets that for print."""


def type_size(size: float) -> float:
    """Return a type size of a page (points) in the current layout."""
    return size * LAYOUT.get().scale


def axis_label(text: str, share: float = 0.8) -> str:
    """Return the label of an axis, wrapped to a share of the width of a chart."""
    return escaped(wrap(text, share * LAYOUT.get().chart_width, type_size(TEXT)))


class DisplayedFigure(Figure):
    """A figure that a notebook displays once as the value of a cell, also without pyplot."""

    def _repr_png_(self) -> bytes:
        stream = io.BytesIO()
        with without_glyph_warnings():
            FigureCanvasAgg(self).print_png(stream)
        return stream.getvalue()


@dataclass(frozen=True, eq=False)
class View:
    """A camera, and the size of its panels in pixels."""

    camera: Camera
    size: tuple[int, int]


@dataclass(frozen=True, eq=False)
class Row:
    """A row of panels of one size.

    Args:
        panels: (H, W, 3) pictures.
        captions: one above each panel; empty for none.
        heading: text above the row.
    """

    panels: Sequence[Image]
    captions: Sequence[str] = ()
    heading: str = ""


@dataclass(frozen=True, eq=False)
class Scale:
    """A colour bar.

    Args:
        label: name and unit of the values.
        colours: (N, 3).
        low: value of the first colour.
        high: value of the last one.
        open_ends: whether values beyond are drawn in the outermost colours: `low`, `high`, `both` or neither.
    """

    label: str
    colours: FloatArray
    low: float
    high: float
    open_ends: str = "neither"


def view(points: FloatArray, columns: int, *, yaw_deg: float = 0.0, width: int = 0, margin: float = 0.04) -> View:
    """Return a camera that contains all `points` (N, 3), in panels of which `columns` fill the figure."""
    layout = LAYOUT.get()
    across = int(((width or layout.row_width) - (columns - 1) * _GAP) // columns * layout.panel_scale)
    flat = Camera.framing(points, yaw_deg=yaw_deg, aspect=1e-3, margin=0.0, perspective=False)
    tall = Camera.framing(points, yaw_deg=yaw_deg, aspect=1e3, margin=0.0, perspective=False)
    aspect = min(max(1e-3 * flat.height_mm / tall.height_mm, 0.68), 1.5)
    size = (across, round(across / aspect))
    return View(Camera.framing(points, yaw_deg=yaw_deg, aspect=size[0] / size[1], margin=margin), size)


def equal_views(sides: Sequence[tuple[FloatArray, float]], columns: int) -> tuple[list[Camera], tuple[int, int]]:
    """Return cameras of one scale that contain points (N, 3) turned by a yaw in degrees, and the size of their panels.

    Args:
        sides: points and yaw of each view.
        columns: number of panels that fill the figure.
    """
    views = [view(points, columns, yaw_deg=yaw) for points, yaw in sides]
    width, height = views[0].size
    tall = max(item.camera.height_mm for item in views)
    across = max(item.camera.height_mm * item.size[0] / item.size[1] for item in views)
    height = min(max(round(width * tall / across), round(width / 3)), round(width * 1.5))
    return [replace(item.camera, height_mm=max(tall, across * height / width)) for item in views], (width, height)


def surroundings(fit: StagedFit) -> FloatArray:
    """Return the points (N, 3) that a picture of `fit` frames: its surface, and the scan near it."""
    surface = fit.surfaces["final"].vertices
    low, high = surface.min(axis=0), surface.max(axis=0)
    room = 0.16 * float((high - low).max())
    scan = fit.scan.vertices
    is_near = ((scan > low - room) & (scan < high + room)).all(axis=1)
    # Shreds that float near a scan are seen where they are, but do not make the rest small.
    cropped = scan[is_near]
    if len(cropped) > 100:
        inner, outer = np.percentile(cropped, [0.3, 99.7], axis=0)
        cropped = cropped[((cropped >= inner) & (cropped <= outer)).all(axis=1)]
    return np.concatenate([surface, cropped])


def grid(
    rows: Sequence[Row],
    *,
    title: str | None,
    note: str = "",
    scale: Scale | None = None,
    keys: Sequence[tuple[str, Colour]] = (),
) -> Figure:
    """Lay out pictures pixel for pixel in rows, with a key or a scale and a `note` below them.

    Args:
        rows: rows of pictures.
        title: text above the rows; None if the page has the title already.
        note: text below all rows.
        scale: colour bar, or None.
        keys: entries of the legend, each a name and a colour.

    Raises:
        InputError: there are no pictures.
    """
    if not rows or not rows[0].panels:
        raise InputError(f"{plain(title or 'The figure')}: there is nothing to draw.")
    layout = LAYOUT.get()
    columns = max(len(row.panels) for row in rows)
    total_w = max(
        layout.row_width,
        int(columns * (max(row.panels[0].shape[1] for row in rows) / layout.panel_scale) + (columns - 1) * _GAP),
    )
    texts: list[tuple[float, float, str, dict[str, Any]]] = []
    pictures: list[tuple[float, float, Image]] = []
    y = 6.0

    def write(x: float, text: str, width: float, size: float, **style: Any) -> float:
        """Put wrapped `text` at the height `y` and return the height that it takes."""
        size = type_size(size)
        wrapped = wrap(text, width, size, bold=style.get("fontweight") == "bold")
        for k, line in enumerate(wrapped.split("\n")):
            texts.append((x, y + baseline(k, size), line, {"fontsize": size, "va": "baseline", **style}))
        return height_of(wrapped, size)

    if title is not None and layout.has_titles:
        y += write(_EDGE, title, total_w - 2 * _EDGE, TITLE, fontweight="bold", color=INK) + 8
    for r, row in enumerate(rows):
        y += 10 if r and any(row.captions) and not row.heading else 0
        panels = without_empty_rows(row.panels)
        high, wide = (side / layout.panel_scale for side in panels[0].shape[:2])
        left = (total_w - len(row.panels) * wide - (len(row.panels) - 1) * _GAP) // 2 if len(rows) == 1 else 0
        if row.heading:
            y += 8 + write(_EDGE, row.heading, total_w - 2 * _EDGE, TEXT, fontweight="bold", color=INK)
        centres = [left + k * (wide + _GAP) + wide / 2 for k in range(len(row.panels))]
        if any(row.captions):
            y += 2 + max(
                write(x, text, wide, TEXT, ha="center", color=INK)
                for x, text in zip(centres, row.captions, strict=True)
            )
        pictures += [(left + k * (wide + _GAP), y, panel) for k, panel in enumerate(panels)]
        y += high + _GAP
    if keys:
        y += 4
        y += _place_keys(texts, keys, y, total_w)
    bar_at = y + 10
    if scale is not None:
        y = bar_at + bar_height()
    if note:
        y += 4 + write(_EDGE, note, total_w - 2 * _EDGE, SMALL, color=GREY)
    total_h = int(np.ceil(y + 6))
    figure = _compose(pictures, texts, total_w, total_h)
    if scale is not None:
        colour_bar(figure, scale, bar_at, total_h)
    return figure


class _Panel(BboxImage):
    """A picture in a figure; where one of its pixels is one of the figure, it is not resampled, which takes longer."""

    def make_image(self, renderer: Any, magnification: float = 1.0, unsampled: bool = False) -> Any:
        """As `BboxImage.make_image`: pixels from the bottom upwards with opacity, and the place of the lowest row."""
        picture: Image = cast(Any, self)._A
        place = self.get_window_extent(renderer)
        if magnification != 1 or (round(place.height), round(place.width)) != picture.shape[:2]:
            return super().make_image(renderer, magnification, unsampled)
        pixels = np.full((*picture.shape[:2], 4), 255, dtype=np.uint8)
        pixels[:, :, :3] = picture[::-1]
        return pixels, place.x0, place.y0, IdentityTransform()


def _compose(
    pictures: Sequence[tuple[float, float, Image]],
    texts: Sequence[tuple[float, float, str, dict[str, Any]]],
    total_w: int,
    total_h: int,
) -> Figure:
    """Return a figure of this size in pixels with pictures and lines of text at their places, from the upper left."""
    figure = DisplayedFigure(figsize=(total_w / DPI, total_h / DPI), dpi=DPI, facecolor="white")
    figure.suppressComposite = True  # a vector file keeps each picture
    for x, top, image in pictures:
        high, wide = (side / LAYOUT.get().panel_scale for side in image.shape[:2])
        place = Bbox.from_bounds(x / total_w, 1 - (round(top) + high) / total_h, wide / total_w, high / total_h)
        # Axes, with their ticks, would take several times as long.
        panel = _Panel(TransformedBbox(place, figure.transFigure), interpolation="nearest")
        panel.set_data(image)
        figure.add_artist(panel)
    for x, top, text, style in texts:
        figure.text(x / total_w, 1 - top / total_h, escaped(text), **style)
    return figure


def _place_keys(
    texts: list[tuple[float, float, str, dict[str, Any]]], keys: Sequence[tuple[str, Colour]], y: float, total_w: int
) -> float:
    """Draw legend entries in centred lines, and return their height."""
    size = type_size(TEXT)
    square, between = measured("■ ", size + 2), 28.0
    lines: list[list[tuple[str, Colour, float]]] = [[]]
    for name, colour in keys:
        width = square + measured(name, size) + between
        if lines[-1] and sum(item[2] for item in lines[-1]) + width > total_w:
            lines.append([])
        lines[-1].append((name, colour, width))
    step = 1.25 * line_height(size)
    for k, line in enumerate(lines):
        x = (total_w - sum(item[2] for item in line) + between) / 2
        middle = y + (k + 0.5) * step
        for name, colour, width in line:
            texts.append((x, middle, "■", {"color": colour, "fontsize": size + 2, "va": "center_baseline"}))
            texts.append((x + square, middle, name, {"color": INK, "fontsize": size, "va": "center_baseline"}))
            x += width
    return step * len(lines)


def bar_height() -> float:
    """Return the height of a colour bar with its label in pixels."""
    return 24 + 2.5 * line_height(type_size(TEXT))


def colour_bar(figure: Figure, scale: Scale, top: float, total_h: float) -> None:
    """Draw a colour bar at a height in pixels from the top of a figure that is `total_h` pixels high."""
    bar = figure.colorbar(
        ScalarMappable(Normalize(scale.low, scale.high), ListedColormap(scale.colours)),
        cax=figure.add_axes((0.18, 1 - (top + 18) / total_h, 0.64, 18 / total_h)),
        orientation="horizontal",
        extend={"low": "min", "high": "max", "both": "both"}.get(scale.open_ends, "neither"),
        extendfrac=0.04,
    )
    bar.ax.tick_params(labelsize=type_size(SMALL), colors=INK, length=3, pad=2)
    bar.ax.xaxis.set_major_formatter(lambda value, _: f"{value:g}".replace("-", "−"))
    cast(Any, bar).outline.set_visible(False)
    up = 1 - (top + 24 + 1.05 * line_height(type_size(SMALL)) + baseline(0, type_size(TEXT))) / total_h
    figure.text(0.5, up, escaped(scale.label), ha="center", va="baseline", fontsize=type_size(TEXT), color=INK)


def without_empty_rows(panels: Sequence[Image]) -> list[Image]:
    """Return images of one row without the rows of white pixels at the top and bottom that all images share."""
    used_rows = np.flatnonzero(np.any([(panel < 255).any(axis=(1, 2)) for panel in panels], axis=0))
    if not len(used_rows):
        return list(panels)
    return [panel[max(used_rows[0] - _EDGE, 0) : used_rows[-1] + 1 + _EDGE] for panel in panels]


def chart(title: str, *, height: float, note: str = "") -> tuple[Figure, Axes]:
    """Return a figure with one plot `height` inches high below its wrapped `title`, and the plot."""
    figure, (axes,) = charts(title, [height], note=note)
    return figure, axes


def charts(title: str, heights: Sequence[float], *, note: str = "", columns: int = 1) -> tuple[Figure, list[Axes]]:
    """Return a figure with rows of plots of `heights` in inches, and the plots row by row."""
    layout, small = LAYOUT.get(), type_size(SMALL)
    width = layout.chart_width if columns == 1 else layout.row_width
    wrapped = wrap(title, width - 2 * _EDGE, TITLE, bold=True) if layout.has_titles else ""
    note_lines = wrap(note, width - 2 * _EDGE, small) if note else ""
    top = (height_of(wrapped, TITLE) + 14) / DPI if wrapped else 0.03
    bottom = (height_of(note_lines, small) + 12) / DPI if note_lines else 0.03
    total = layout.scale * sum(heights) + top + bottom
    figure = DisplayedFigure(figsize=(width / DPI, total), dpi=DPI, facecolor="white")
    places = figure.add_gridspec(len(heights), columns, height_ratios=list(heights))
    axes = [figure.add_subplot(places[r, c]) for r in range(len(heights)) for c in range(columns)]
    for text, first, size, text_style in (
        (wrapped, 6.0, TITLE, {"color": INK, "fontweight": "bold"}),
        (note_lines, (total * DPI - height_of(note_lines, small) - 2), small, {"color": GREY}),
    ):
        for k, line in enumerate(text.split("\n")):
            figure.text(
                _EDGE / width,
                (1 - (first + baseline(k, size)) / DPI / total),
                escaped(line),
                in_layout=False,
                fontsize=size,
                **cast(Any, text_style),
            )
    # The area of the plots, for `finish`.
    cast(Any, figure).plots_within = (0.0, bottom / total, 1.0, 1 - top / total)
    return figure, axes


def finish(figure: Figure, **spaces: float) -> Figure:
    """Style the plots of a chart, and place them so that nothing is cut off."""
    for axes in figure.axes:
        if axes.name != "3d" and axes.axison:
            style(axes)
        _scale_marks(axes, LAYOUT.get().scale)
        # The layout asks twice for the same extent, which takes most of its time.
        cast(Any, axes).get_tightbbox = cache(axes.get_tightbbox)
    with without_glyph_warnings():
        figure.tight_layout(rect=cast(Any, figure).plots_within, pad=0.4, **spaces)
    for axes in figure.axes:
        del cast(Any, axes).get_tightbbox
    return figure


def _scale_marks(axes: Axes, factor: float) -> None:
    """Scale the widths of lines and the sizes of markers of a plot and of its legend."""
    legend: Any = axes.get_legend()
    marks: list[Any] = [*axes.lines, *axes.collections, *axes.patches, *(legend.legend_handles if legend else ())]
    for mark in marks if factor != 1 else ():
        mark.set_linewidth(np.multiply(mark.get_linewidth(), factor))
        if hasattr(mark, "set_markersize"):
            mark.set_markersize(factor * mark.get_markersize())
        if hasattr(mark, "set_sizes"):
            mark.set_sizes(factor**2 * np.asarray(mark.get_sizes()))


def style(axes: Axes) -> None:
    """Set the type sizes and pale lines that all plots share."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color("#9a9da3")
    axes.tick_params(which="both", colors=INK, labelsize=type_size(SMALL), color="#9a9da3")
    axes.xaxis.label.set(fontsize=type_size(TEXT), color=INK)
    axes.yaxis.label.set(fontsize=type_size(TEXT), color=INK)
    axes.grid(True, color=RULE, lw=0.8)
    axes.set_axisbelow(True)


def legend(axes: Axes, **options: Any) -> None:
    """Add the legend of a plot, in fewer columns than `ncols` if these are wider than the figure."""
    names = [str(handle.get_label()) for handle in options["handles"]] if "handles" in options else None
    names = axes.get_legend_handles_labels()[1] if names is None else names
    options["ncols"] = legend_columns(names, options.get("ncols", 1))
    cast(Any, axes).legend(
        **{"fontsize": type_size(SMALL), "labelcolor": INK, "framealpha": 0.9, "handlelength": 1.5, **options}
    ).get_frame().set_linewidth(0.0)


def legend_columns(names: Sequence[str], most: int = 5) -> int:
    """Return the number of columns, up to `most`, with which a legend is not wider than a chart."""
    widths = np.array([max(measured(line, type_size(SMALL)) for line in name.split("\n")) for name in names])
    mark = _LEGEND_MARK * type_size(SMALL) * DPI / 72
    for columns in range(min(len(names), most), 1, -1):
        if sum(float(part.max()) + mark for part in np.array_split(widths, columns)) < LAYOUT.get().chart_width:
            return columns
    return 1


def legend_above(axes: Axes, room: float, **options: Any) -> None:
    """Add the legend of a plot above its curves, in a share `room` of their height that is added there."""
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + room * (high - low))
    legend(axes, **options)


@contextmanager
def without_glyph_warnings() -> Generator[None]:
    """Return a context that suppresses warnings about glyphs that the font lacks."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing from", category=UserWarning)
        yield


def encode_webp(figure: Figure, *, lossless: bool = False) -> Still:
    """Return `figure` as WebP bytes and its size in pixels; flat charts are smaller lossless, stills are not."""
    with without_glyph_warnings():
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
    return encoded(
        np.asarray(canvas.buffer_rgba())[:, :, :3],
        lossless=lossless,
        quality=20 if lossless else 78,
        effort=1 if lossless else 2,
    )


@lru_cache(maxsize=1)
def _renderer() -> RendererAgg:
    return RendererAgg(1, 1, DPI)


@lru_cache(maxsize=4096)
def measured(text: str, size: float, *, bold: bool = False) -> float:
    """Return the width of one line of `text` in pixels at `size` points."""
    with without_glyph_warnings():
        width, _, _ = _renderer().get_text_width_height_descent(
            text, FontProperties(size=size, weight="bold" if bold else "normal"), False
        )
    return float(width)


def line_height(size: float) -> float:
    """Return the height in pixels of a line of type of `size` points."""
    return 1.3 * size * DPI / 72


def baseline(line: int, size: float) -> float:
    """Return the distance of line number `line` (from 0) of a text from its top, in pixels."""
    return 0.97 * size * DPI / 72 + line * line_height(size)


def height_of(text: str, size: float) -> float:
    """Return the height of lines of `text` in pixels, 0 for none."""
    return line_height(size) * (1 + text.count("\n")) if text else 0.0


def wrap(text: str, width: float, size: float, *, bold: bool = False, max_lines: int = _MOST_LINES) -> str:
    """Wrap `text` to at most `max_lines` lines of similar length, none wider than `width` pixels.

    Text that is cut off ends in `…`.
    """
    parts = plain(text).split("\n")

    def in_lines(letters: int) -> list[str]:
        wrapper = textwrap.TextWrapper(letters, break_on_hyphens=False)
        return [line for part in parts for line in wrapper.wrap(part) or [""]]

    def wide(line: str) -> bool:
        return measured(line, size, bold=bold) > width

    longest = range(1, max(map(len, parts)) + 1)
    letters = max(bisect_left(longest, True, key=lambda n: any(map(wide, in_lines(n)))), 1)
    lines = in_lines(letters)
    if len(lines) <= max_lines:
        return "\n".join(
            in_lines(1 + bisect_left(longest[:letters], True, key=lambda n: len(in_lines(n)) <= len(lines)))
        )
    last = lines[max_lines - 1]
    while last and wide(last + "…"):
        last = last[:-1].rstrip()
    return "\n".join([*lines[: max_lines - 1], last + "…"])


_LONGEST = 400  # characters of a name from a file


def plain(text: str) -> str:
    """Return user text without unprintable characters, cut to the length of a caption."""
    printable_text = re.sub(r"[^\S\n]", " ", printable(str(text)[: _LONGEST + 1]))
    return printable_text if len(printable_text) <= _LONGEST else printable_text[: _LONGEST - 1] + "…"


def escaped(text: str) -> str:
    """Return `text` so that matplotlib does not read dollars as mathematics."""
    return text.replace("$", r"\$")


def short(text: str, max_length: int = 28) -> str:
    """Return one line of at most `max_length` characters."""
    line = " ".join(plain(text).split())
    return line if len(line) <= max_length else line[: max_length - 1] + "…"


def in_rows(panels: Sequence[Image], captions: Sequence[str], columns: int) -> list[Row]:
    """Return rows of at most `columns` panels with their captions."""
    return [Row(panels[k : k + columns], captions[k : k + columns]) for k in range(0, len(panels), columns)]


def plain_decades(axis: Axis) -> None:
    """Label 1, 2 and 5 of each decade of a logarithmic axis in plain notation."""
    axis.set_major_formatter(lambda value, _: f"{value:g}")
    axis.set_minor_formatter(lambda value, _: f"{value:g}" if f"{value:.0e}"[0] in "25" else "")


def empty_chart(title: str, text: str) -> Figure:
    """Return an empty chart with the reason as its text."""
    figure, axes = chart(title, height=1.2)
    axes.text(
        0.5,
        0.5,
        text,
        transform=axes.transAxes,
        **cast(Any, {"ha": "center", "va": "center", "fontsize": type_size(TEXT), "color": GREY}),
    )
    axes.set_axis_off()
    return finish(figure)


def scan_over(mesh: Mesh) -> Layer:
    """Return the layer of a scan that lies over a model: points are drawn so small that the model is seen between."""
    return Layer(mesh, SCAN_COLOUR, point_radius_mm=None if mesh.faces is not None else 0.3 * point_spacing(mesh))


def mean_words(fits: Sequence[StagedFit]) -> str:
    """Return the caption for the mean distances of `fits`."""
    cloud = " That to a point cloud is to its points." if any(fit.scan.faces is None for fit in fits) else ""
    return f"In mm: mean distance to the scan of the vertices that the scan shows.{cloud}"


def unknown(values: FloatArray) -> float:
    """Return the share of `values` that were not measured."""
    return 1 - len(measured_mm(values)) / max(len(values), 1)


def distance_scale(limit_mm: float, *, signed: bool) -> Scale:
    """Return the scale of the layers that `distance_layer` makes."""
    if signed:
        return Scale(SIGNED, DIVERGING, -limit_mm, limit_mm, "both")
    return Scale(UNSIGNED, SEQUENTIAL, 0.0, limit_mm, "high")


def number_axis(axes: Axes, count: int, *, room: float = 0.7) -> None:
    """Set the ticks of a plot over the integers 1 to `count` at some of the integers, and nowhere else."""
    # One bar as wide as the plot would look like a background.
    aside = room + max(0.0, (5 - count) / 2)
    axes.set_xlim(1 - aside, count + aside)
    step = next((step for step in _STEPS if count <= _MOST_NUMBERS * step), count)
    axes.set_xticks([1, *range(max(step, 2), count + 1, step)])


FORMATS = ("svg", "pdf", "png")
"""Formats of figures for papers."""
ONE_COLUMN_MM, TWO_COLUMNS_MM = 85.0, 174.0
"""Widths of charts, and of rows of pictures, mm: the columns of most journals (Elsevier 90 and 190, Nature 89 and 183,
PLOS 83 and 173)."""
_PRINT_SCALE = 0.72  # type of 6.8 to 8 points instead of 9.5 to 11, above the 6 that journals ask for
_LEAST_DPI, _MOST_DPI = 72, 1200  # limits: legible, and memory of a rendered panel


@contextmanager
def publication_style(dpi: int = 300) -> Generator[None]:
    """Return a context in which figures have the size and type of print, and no title.

    Args:
        dpi: resolution of rendered surfaces, pixels per inch.

    Raises:
        InputError: a resolution below 72 or above 1200.
    """
    if not _LEAST_DPI <= dpi <= _MOST_DPI:
        raise InputError(f"The resolution of a figure is {_LEAST_DPI} to {_MOST_DPI} dpi, not {dpi}.")
    one_column, two_columns = (round(width / 25.4 * DPI) for width in (ONE_COLUMN_MM, TWO_COLUMNS_MM))
    token = LAYOUT.set(Layout(one_column, two_columns, _PRINT_SCALE, dpi / DPI, has_titles=False))
    try:
        yield
    finally:
        LAYOUT.reset(token)


def save_figure(
    figure: Figure, path: Path, formats: Sequence[str] = ("pdf",), dpi: float | None = None
) -> tuple[Path, ...]:
    """Write a figure in one or more formats, each file completely or not at all, and return their paths.

    Fonts are embedded: as TrueType in PDF, as a subset in SVG, whose text can be searched and edited.

    Args:
        figure: figure to write.
        path: path of the files, without an extension.
        formats: names from `FORMATS`.
        dpi: resolution of PNG and of pictures inside the others; None for that of the figure.

    Raises:
        FileError: the folder cannot be written, or the disk is full.
        InputError: another format.
    """
    unknown = [kind for kind in formats if kind not in FORMATS]
    if unknown:
        raise InputError(f"Figures cannot be written as {unknown[0]!r}; choose from {', '.join(FORMATS)}.")
    paths: list[Path] = []
    # Neither date nor random names: the same figure is the same file.
    undated: dict[str, dict[str, None]] = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}
    for kind in formats:
        stream = io.BytesIO()
        with (
            matplotlib.rc_context({"svg.hashsalt": "shapespace", "svg.fonttype": "none", "pdf.fonttype": 42}),
            without_glyph_warnings(),
        ):
            figure.savefig(stream, format=kind, metadata=undated.get(kind, {}), dpi=dpi or "figure")
        data = stream.getvalue()
        paths.append(path.with_name(f"{path.name}.{kind}"))
        write_bytes(paths[-1], _with_fonts(data) if kind == "svg" else data)
    return tuple(paths)


def _with_fonts(svg: bytes) -> bytes:
    """Return an SVG with the letters that it uses as embedded fonts."""
    text = svg.decode("utf-8")
    letters = "".join(
        sorted(set(unescape(re.sub("<[^>]*>", "", "".join(re.findall(r"<text[^>]*>(.*?)</text>", text, re.DOTALL))))))
    )
    rules = [
        f"@font-face{{font-family:'DejaVu Sans';font-weight:{weight};src:url(data:font/woff;base64,"
        f"{base64.b64encode(_subset(weight, letters)).decode()}) format('woff')}}"
        for weight in ((400, 700) if re.search(r"<text[^>]*\b(700|bold)\b", text) else (400,))
    ]
    return text.replace("<defs>", f"<defs>\n  <style>{''.join(rules)}</style>", 1).encode()


def _subset(weight: int, letters: str) -> bytes:
    """Return the font of all figures as WOFF, reduced to the characters in `letters`."""
    subset: Any = import_module("fontTools.subset")
    options = subset.Options(flavor="woff", recalc_timestamp=False, layout_features=[], notdef_outline=True)
    options.drop_tables += ["FFTM"]
    font: Any = subset.load_font(
        font_manager.findfont(font_manager.FontProperties(family="DejaVu Sans", weight=weight)), options
    )
    subsetter: Any = subset.Subsetter(options)
    subsetter.populate(text=letters)
    subsetter.subset(font)
    stream = io.BytesIO()
    subset.save_font(font, stream, options)
    font.close()
    return stream.getvalue()
