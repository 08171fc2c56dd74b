"""The paper's figures: arrays and meshes in, matplotlib figures out.

Pictures of one row share camera and light, one figure has one scale, and the maps can be told apart by colour-blind
readers. Importing this module needs the extra `report`.
"""

from __future__ import annotations

import io
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar, cast

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from PIL import Image as PillowImage

from shapespace.errors import InputError
from shapespace.report.render import (
    CLAY,
    Camera,
    Colour,
    Image,
    Layer,
    render,
    render_layers,
    render_maps,
    render_series,
)
from shapespace.types import FloatArray, IntArray, Mesh

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SCAN_COLOUR: Colour = (0.93, 0.66, 0.36)
MODEL_COLOUR: Colour = (0.36, 0.58, 0.80)
STAGE_TITLES: Mapping[str, str] = {
    "before": "before",
    "initial": "after phase 1 (pose)",
    "final": "after phase 2 (pose and shape)",
}
"""The moments of a fit whose surfaces are kept, in order, and what they are called."""

THRESHOLDS_MM = (2.0, 4.0, 6.0, 8.0, 10.0)
_INK = "#222222"
_GREY = "#6b6b6b"
_FORWARD, _BACKWARD = "#0072B2", "#D55E00"
# Okabe and Ito's colours, told apart with every common kind of colour blindness.
_CATEGORIES = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#B8A800")
_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
_DPI = 160
_FONT = 8.5
_LONGEST_LABEL = 120
_Item = TypeVar("_Item")


@dataclass(frozen=True, eq=False)
class StagedFit:
    """A fit as pictures need it, with scan and model in the model's frame in mm.

    Args:
        name: what to call it.
        scan: the raw surface or points.
        surfaces: the model at each moment of `STAGE_TITLES`.
        model_to_scan_mm: by moment, (M,) closest distances from model vertices.
        scan_to_model_mm: by moment, (S,) closest distances from scan points.
    """

    name: str
    scan: Mesh
    surfaces: Mapping[str, Mesh]
    model_to_scan_mm: Mapping[str, FloatArray]
    scan_to_model_mm: Mapping[str, FloatArray]

    def camera(self, *, yaw_deg: float = 0.0, aspect: float = 0.85) -> Camera:
        """Return the camera that frames the final surface."""
        return Camera.framing(self.surfaces["final"].vertices, yaw_deg=yaw_deg, aspect=aspect, margin=0.09)


@dataclass(frozen=True, eq=False)
class Coefficients:
    """The coefficients of one scan.

    Args:
        name: of the scan.
        expression: its label.
        intensity: 0 for neutral to 1.
        b: (K,) mm.
        z: (K,) in standard deviations of the model.
    """

    name: str
    expression: str
    intensity: float
    b: FloatArray
    z: FloatArray


def faces_grid(
    meshes: Sequence[Mesh],
    labels: Sequence[str],
    *,
    title: str,
    columns: int = 4,
    size: tuple[int, int] = (280, 360),
    colour: Colour = CLAY,
) -> Figure:
    """Draw `meshes` in one light and at one scale, each under its label (figures 1 and 8)."""
    if not meshes or len(meshes) != len(labels):
        raise InputError(f"{title}: {len(meshes)} meshes do not go with {len(labels)} labels.")
    camera = Camera.framing(np.concatenate([m.vertices for m in meshes]), aspect=size[0] / size[1], margin=0.03)
    images = [render(mesh, camera=camera, size=size, colour=colour) for mesh in meshes]
    return _grid(_rows(images, columns), titles=_rows(list(labels), columns), heading=title)


def modes_figure(
    mean: FloatArray, faces: IntArray, modes: FloatArray, *, title: str, deviations: float = 3.0
) -> Figure:
    """Draw what the first modes do (figures 2 and 3): minus, mean, plus, and a map of the displacement.

    Args:
        mean: (V, 3) mm.
        faces: (F, 3).
        modes: (m, V, 3) displacement of one standard deviation of each mode, mm.
        title: heading.
        deviations: how many standard deviations to each side.
    """
    size = (270, 345)
    moved = np.concatenate([mean + sign * deviations * mode for mode in modes for sign in (-1, 1)])
    camera = Camera.framing(moved, aspect=size[0] / size[1], margin=0.03)
    length = deviations * np.linalg.norm(modes, axis=2)
    top = _nice_ceiling(float(length.max()))
    table = _table("viridis")
    middle = render(Mesh(mean, faces), camera=camera, size=size)
    rows: list[list[Image]] = []
    captions: list[list[str]] = []
    for mode, far in zip(modes, length, strict=True):
        low, high = (render(Mesh(mean + sign * deviations * mode, faces), camera=camera, size=size) for sign in (-1, 1))
        seen = render(Mesh(mean, faces), camera=camera, size=size, scalars=far, colormap=table, vmax=top)
        rows.append([low, middle, high, seen])
        captions.append([f"−{deviations:g} sd", "mean", f"+{deviations:g} sd", f"moves up to {far.max():.1f} mm"])
    return _grid(
        rows,
        titles=captions,
        row_labels=[f"mode {k + 1}" for k in range(len(modes))],
        heading=title,
        scale=_Scale(f"displacement at {deviations:g} sd (mm)", "viridis", 0.0, top),
    )


def spectrum_figure(
    cumulative: FloatArray, *, title: str, shares: Sequence[float] = (0.90, 0.95, 0.98, 0.985, 0.99)
) -> Figure:
    """Draw how much variance the first modes hold, and how many it takes for each of `shares`."""
    cumulative = np.asarray(cumulative, dtype=np.float64)
    figure, axes = _chart(title, height=3.3)
    count = np.arange(1, len(cumulative) + 1)
    own = np.diff(cumulative, prepend=0.0)
    reached = [int(np.searchsorted(cumulative, share)) + 1 for share in shares if cumulative[-1] >= share]
    shown = min(len(count), max(10, (max(reached) if reached else len(count)) + 3))
    axes.bar(count[:shown], 100 * own[:shown], color="#9ecae1", label="this mode")
    axes.plot(count[:shown], 100 * cumulative[:shown], "o-", color=_FORWARD, ms=3.5, lw=1.4, label="up to this mode")
    notes = [
        f"{100 * share:g} %: {int(np.searchsorted(cumulative, share)) + 1} modes"
        if cumulative[-1] >= share
        else f"{100 * share:g} %: more than {len(cumulative)} modes"
        for share in shares
    ]
    axes.text(
        0.97, 0.30, "\n".join(notes), transform=axes.transAxes, ha="right", va="center", fontsize=_FONT, color=_INK
    )
    axes.set_xlabel("number of modes")
    axes.set_ylabel("share of the variance (%)")
    axes.set_ylim(0, 104)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    _legend(axes, loc="center right", bbox_to_anchor=(1.0, 0.66))
    return _finish(figure, axes)


def overlay_figure(fit: StagedFit, *, title: str) -> Figure:
    """Draw scan and model over each other at the three moments, from two sides (figures 4 to 7)."""
    size = (370, 460)
    scan = Layer(fit.scan, SCAN_COLOUR)
    rows = [
        render_series(
            [[scan, Layer(fit.surfaces[stage], MODEL_COLOUR)] for stage in STAGE_TITLES],
            camera=fit.camera(yaw_deg=yaw, aspect=size[0] / size[1]),
            size=size,
        )
        for yaw in (0.0, 50.0)
    ]
    means = [
        f"{STAGE_TITLES[stage]}\nmodel to scan: mean {_mm(fit.model_to_scan_mm[stage].mean())}"
        for stage in STAGE_TITLES
    ]
    return _grid(
        rows,
        titles=[means, ["", "", ""]],
        heading=title,
        keys=[("scan", SCAN_COLOUR), ("model", MODEL_COLOUR)],
    )


def portrait_figure(fits: Sequence[StagedFit], labels: Sequence[str], *, title: str, yaw_deg: float = 25.0) -> Figure:
    """Draw for each fit: the scan, the model fitted to it, both together, and how far the model lies from the scan."""
    size = (285, 360)
    finals = np.concatenate([fit.model_to_scan_mm["final"] for fit in fits])
    top = _nice_ceiling(float(np.percentile(finals, 98)))
    table = _table("viridis")
    rows: list[list[Image]] = []
    titles: list[list[str]] = []
    for fit in fits:
        camera = fit.camera(yaw_deg=yaw_deg, aspect=size[0] / size[1])
        final, far = fit.surfaces["final"], fit.model_to_scan_mm["final"]
        scan, model = Layer(fit.scan, SCAN_COLOUR), Layer(final, MODEL_COLOUR)
        mapped = Layer(final, scalars=far, colormap=table, vmax=top)
        rows.append(render_series([[scan], [model], [scan, model], [mapped]], camera=camera, size=size))
        titles.append(["scan", "model, fitted", "both, the nearer one shown", f"distance: mean {_mm(far.mean())}"])
    return _grid(
        rows,
        titles=titles,
        row_labels=list(labels),
        heading=title,
        scale=_Scale("model to scan (mm)", "viridis", 0.0, top),
    )


def aligned_grid(fits: Sequence[StagedFit], *, title: str, columns: int = 4) -> Figure:
    """Draw scan and fitted model over each other for many fits."""
    size = (280, 360)
    images = [
        render_layers(
            [Layer(fit.scan, SCAN_COLOUR), Layer(fit.surfaces["final"], MODEL_COLOUR)],
            camera=fit.camera(aspect=size[0] / size[1]),
            size=size,
        )
        for fit in fits
    ]
    keys = [("scan", SCAN_COLOUR), ("model", MODEL_COLOUR)]
    return _grid(_rows(images, columns), titles=_rows(_means(fits), columns), heading=title, keys=keys)


def _means(fits: Sequence[StagedFit]) -> list[str]:
    return [f"{fit.name}: mean {_mm(fit.model_to_scan_mm['final'].mean())}" for fit in fits]


def distance_histograms(fit: StagedFit, *, title: str, bins: int = 50) -> Figure:
    """Draw the closest distances of both directions at the three moments (figures 5 to 7)."""
    figure = Figure(figsize=(7.6, 3.0), dpi=_DPI, facecolor="white")
    for k, stage in enumerate(STAGE_TITLES):
        axes = figure.add_subplot(1, 3, k + 1)
        both = (fit.model_to_scan_mm[stage], fit.scan_to_model_mm[stage])
        far = max(float(values.max()) for values in both if len(values))
        edges = np.linspace(0, far if far > 0 else 1.0, bins + 1)
        lines: list[str] = []
        for values, colour, name, filled in zip(
            both, (_FORWARD, _BACKWARD), ("model to scan", "scan to model"), (True, False), strict=True
        ):
            if not len(values):
                lines.append(f"{name}: no point counted")
                continue
            height = 100.0 * np.histogram(values, edges)[0] / len(values)
            axes.stairs(height, edges, color=colour, fill=filled, alpha=0.35 if filled else 1.0, lw=1.2)
            if filled:
                axes.stairs(height, edges, color=colour, lw=1.0)
            axes.plot([], [], color=colour, lw=3 if filled else 1.2, label=name)
            lines.append(f"{name}: mean {_mm(values.mean())}, max {_mm(values.max())}")
        axes.set_title(STAGE_TITLES[stage], fontsize=_FONT, color=_INK, fontweight="bold", pad=22)
        axes.text(0.5, 1.02, "\n".join(lines), transform=axes.transAxes, ha="center", fontsize=_FONT - 2.2, color=_GREY)
        axes.set_xlabel("closest distance (mm)")
        if k == 0:
            axes.set_ylabel("share of the points (%)")
        if k == 2:
            _legend(axes, loc="upper right")
        _style(axes)
    _heading(figure, title)
    figure.tight_layout(rect=(0, 0, 1, 0.91), w_pad=0.6)
    return figure


def history_figure(history: Sequence[tuple[int, int, float]], *, title: str) -> Figure:
    """Draw RMS distance by iteration; `history` holds (phase, iteration, RMS in mm) in order."""
    figure, axes = _chart(title, height=2.9)
    for phase, colour, name in ((1, _BACKWARD, "phase 1: pose"), (2, _FORWARD, "phase 2: pose and shape")):
        at = [k for k, row in enumerate(history) if row[0] == phase]
        if at:
            axes.plot(at, [history[k][2] for k in at], color=colour, lw=1.6, marker="o", ms=2.2, label=name)
            axes.annotate(
                _mm(history[at[-1]][2]), (at[-1], history[at[-1]][2]), xytext=(-2, 6), textcoords="offset points",
                ha="right", fontsize=_FONT - 1, color=colour,
            )  # fmt: skip
    axes.set_yscale("log")
    axes.set_xlabel("iteration")
    axes.set_ylabel("RMS closest distance (mm)")
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter("{x:g}")
    axes.tick_params(which="minor", labelsize=_FONT - 2.5)
    _legend(axes, loc="upper right")
    return _finish(figure, axes)


def coefficients_figure(
    z: FloatArray, *, title: str, population: FloatArray | None = None, b_stddev_z: FloatArray | None = None
) -> Figure:
    """Draw the coefficients of one fit in standard deviations, over the spread of the training set.

    Args:
        z: (K,).
        title: heading.
        population: (N, K) of the training set.
        b_stddev_z: (K,) uncertainty of z.
    """
    shown = min(len(z), 30)
    figure, axes = _chart(title, height=2.8)
    at = np.arange(1, shown + 1)
    if population is not None and len(population):
        low, high = np.percentile(population[:, :shown], [5, 95], axis=0)
        axes.bar(at, high - low, bottom=low, width=0.86, color="#e6e6e6", label="90 % of the training set")
    else:
        axes.axhspan(-2, 2, color="#eeeeee", label="±2 sd", lw=0)
    error = None if b_stddev_z is None else b_stddev_z[:shown]
    axes.bar(at, z[:shown], width=0.5, color=_FORWARD, yerr=error, ecolor=_INK, error_kw={"lw": 0.8}, label="this scan")
    axes.axhline(0, color=_INK, lw=0.7)
    limit = max(3.0, 1.15 * float(np.abs(z[:shown]).max()))
    axes.set_ylim(-limit, limit)
    axes.set_xlabel("mode" if shown == len(z) else f"mode (first {shown} of {len(z)})")
    axes.set_ylabel("z = b / sd")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    _legend(axes, loc="upper right", ncols=2)
    return _finish(figure, axes)


def b_plane(
    scans: Sequence[Coefficients], *, title: str, neutral_b: FloatArray | None, neutral_z: FloatArray | None
) -> Figure:
    """Draw b1 against b2 (figure 9), one colour an expression, larger for stronger, with lines through neutral."""
    figure, axes = _chart(title, height=4.6)
    for name, style, own in _by_expression(scans):
        points = np.stack([scan.b[:2] for scan in own])
        axes.scatter(points[:, 0], points[:, 1], s=_sizes(own), **style, edgecolors="white", linewidths=0.6, zorder=3)
        axes.plot([], [], ls="", ms=6, **style, label=_plain(name))
        line = _line(own, neutral_b, neutral_z)
        if line is not None:
            axes.plot(line[:, 0], line[:, 1], color=style["color"], lw=1.2, alpha=0.8, zorder=2)
    if neutral_b is not None:
        axes.plot(neutral_b[0], neutral_b[1], marker="+", ms=12, mew=2, color=_INK, ls="", label="neutral", zorder=4)
    axes.set_xlabel("b1 (mm)")
    axes.set_ylabel("b2 (mm)")
    axes.margins(0.08)
    _legend(axes, loc="best")
    return _finish(figure, axes)


def b_space(
    scans: Sequence[Coefficients], *, title: str, neutral_b: FloatArray | None, neutral_z: FloatArray | None
) -> Figure:
    """Draw b1, b2 and b3 (figure 10) from two sides, as `b_plane` does."""
    figure = Figure(figsize=(7.6, 3.9), dpi=_DPI, facecolor="white")
    every = np.stack([scan.b[:3] for scan in scans])
    if neutral_b is not None:
        every = np.concatenate([every, neutral_b[None, :3]])
    low, high = every.min(axis=0), every.max(axis=0)
    room = 0.05 * np.maximum(high - low, 1e-9)
    for k, azimuth in enumerate((-60, 25)):
        # matplotlib's 3-D axes have no usable types.
        axes = cast(Any, figure.add_subplot(1, 2, k + 1, projection="3d"))
        for name, style, own in _by_expression(scans):
            points = np.stack([scan.b[:3] for scan in own])
            axes.scatter(*points.T, s=_sizes(own), **style, edgecolors="white", linewidths=0.5, depthshade=False)
            axes.plot([], [], [], ls="", ms=5, **style, label=_plain(name))
            line = _line(own, neutral_b, neutral_z)
            if line is not None:
                axes.plot(*line[:, :3].T, color=style["color"], lw=1.1, alpha=0.8)
            # Drop lines to the floor, without which a cloud of points has no depth.
            for point in points:
                axes.plot([point[0]] * 2, [point[1]] * 2, [low[2] - room[2], point[2]], color="#c8c8c8", lw=0.5)
        if neutral_b is not None:
            axes.plot(*neutral_b[:3, None], marker="+", ms=11, mew=2, color=_INK, ls="", label="neutral")
        for axis, at in zip("xyz", range(3), strict=True):
            getattr(axes, f"set_{axis}label")(f"b{at + 1} (mm)", fontsize=_FONT - 1, color=_INK, labelpad=0)
            getattr(axes, f"set_{axis}lim")(low[at] - room[at], high[at] + room[at])
        axes.tick_params(labelsize=_FONT - 2.5, colors=_GREY, pad=-1)
        axes.view_init(elev=22, azim=azimuth)
        axes.set_box_aspect((1, 1, 0.85), zoom=0.92)
        if k == 0:
            handles, names = axes.get_legend_handles_labels()
            figure.legend(
                handles, names, loc="lower center", ncols=min(6, len(names)), fontsize=_FONT - 0.5, frameon=False
            )
    _heading(figure, title)
    figure.subplots_adjust(left=0.0, right=0.96, bottom=0.11, top=0.94, wspace=0.06)
    return figure


def threshold_figure(fits: Sequence[StagedFit], *, title: str) -> Figure:
    """Draw where the model lies within 2, 4, 6, 8 and 10 mm of the scan (figure 11), a row a fit."""
    size = (218, 280)
    table = np.array([[0.16, 0.50, 0.73], [0.93, 0.55, 0.18]])
    rows: list[list[Image]] = []
    titles: list[list[str]] = []
    for fit in fits:
        far, camera = fit.model_to_scan_mm["final"], fit.camera(aspect=size[0] / size[1])
        rows.append(
            render_maps(
                fit.surfaces["final"],
                far,
                [(limit - 1e-3, limit + 1e-3) for limit in THRESHOLDS_MM],
                colormap=table,
                camera=camera,
                size=size,
            )
        )
        titles.append([f"≤ {limit:g} mm: {_percent(float((far <= limit).mean()))}" for limit in THRESHOLDS_MM])
    return _grid(
        rows,
        titles=titles,
        row_labels=[fit.name for fit in fits],
        heading=title,
        keys=[("within the limit", (0.16, 0.50, 0.73)), ("farther away", (0.93, 0.55, 0.18))],
    )


def distance_maps(fits: Sequence[StagedFit], *, title: str, columns: int = 4) -> Figure:
    """Draw the distance from each fitted model to its scan, on one scale up to the 99th percentile of all."""
    size = (280, 360)
    top = _nice_ceiling(float(np.percentile(np.concatenate([f.model_to_scan_mm["final"] for f in fits]), 99)))
    table = _table("viridis")
    images = [
        render(
            fit.surfaces["final"],
            camera=fit.camera(aspect=size[0] / size[1]),
            size=size,
            scalars=fit.model_to_scan_mm["final"],
            colormap=table,
            vmax=top,
        )
        for fit in fits
    ]
    scale = _Scale("model to scan (mm)", "viridis", 0.0, top)
    return _grid(_rows(images, columns), titles=_rows(_means(fits), columns), heading=title, scale=scale)


def encode_webp(figure: Figure, *, lossless: bool = False) -> tuple[bytes, tuple[int, int]]:
    """Return `figure` as WebP bytes and its size in pixels; flat charts are smaller lossless, stills are not."""
    with warnings.catch_warnings():
        # A label in a script that the font lacks is drawn as boxes, and stays readable beside the picture.
        warnings.filterwarnings("ignore", message="Glyph .* missing from", category=UserWarning)
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
    pixels = np.asarray(canvas.buffer_rgba())[:, :, :3]
    stream = io.BytesIO()
    PillowImage.fromarray(np.ascontiguousarray(pixels)).save(
        stream, format="WEBP", lossless=lossless, quality=20 if lossless else 86, method=1 if lossless else 2
    )
    return stream.getvalue(), (pixels.shape[1], pixels.shape[0])


@dataclass(frozen=True)
class _Scale:
    label: str
    colormap: str
    low: float
    high: float


def _grid(
    images: Sequence[Sequence[Image]],
    *,
    heading: str,
    titles: Sequence[Sequence[str]],
    row_labels: Sequence[str] = (),
    scale: _Scale | None = None,
    keys: Sequence[tuple[str, Colour]] = (),
) -> Figure:
    """Lay out pictures pixel for pixel in rows, with a caption above each and one scale or key below all."""
    height, width = images[0][0].shape[:2]
    columns = max(len(row) for row in images)
    gap, line = 8, round(_FONT * _DPI / 72 * 1.25)
    left = round(1.6 * line) if row_labels else 0
    above = [line * max((1 + text.count("\n") if text else 0) for text in [*row, ""]) + 4 for row in titles]
    top = round(1.7 * line)
    bottom = round(3.1 * line) if scale is not None else round(1.9 * line) if keys else 4
    total_w = left + columns * width + (columns - 1) * gap
    total_h = top + sum(above) + len(images) * height + (len(images) - 1) * gap + bottom
    figure = Figure(figsize=(total_w / _DPI, total_h / _DPI), dpi=_DPI, facecolor="white")
    _heading(figure, heading, y=1 - 0.35 * line / total_h)
    y = top
    for r, row in enumerate(images):
        y += above[r]
        for c, image in enumerate(row):
            x = left + c * (width + gap)
            axes = figure.add_axes(
                (x / total_w, 1 - (y + height) / total_h, width / total_w, height / total_h), frameon=False
            )
            axes.imshow(image, interpolation="nearest", aspect="auto")
            axes.set_axis_off()
            if titles[r][c]:
                figure.text(
                    (x + width / 2) / total_w, 1 - (y - 3) / total_h, _plain(titles[r][c]), ha="center", va="bottom",
                    fontsize=_FONT - 1, color=_INK, linespacing=1.15,
                )  # fmt: skip
        if row_labels:
            figure.text(
                0.75 * line / total_w, 1 - (y + height / 2) / total_h, _plain(row_labels[r]), rotation=90, ha="center",
                va="center", fontsize=_FONT, color=_INK, fontweight="bold",
            )  # fmt: skip
        y += height + gap
    if scale is not None:
        _colourbar(figure, scale, line / total_h)
    elif keys:
        share = 1.0 / len(keys)
        for k, (name, colour) in enumerate(keys):
            at = 0.5 + (k - (len(keys) - 1) / 2) * min(share, 0.22)
            figure.text(at, 0.85 * line / total_h, "■ ", color=colour, ha="right", va="center", fontsize=_FONT + 3)
            figure.text(at, 0.85 * line / total_h, name, color=_INK, ha="left", va="center", fontsize=_FONT)
    return figure


def _colourbar(figure: Figure, scale: _Scale, line: float) -> None:
    axes = figure.add_axes((0.3, 2.1 * line, 0.4, 0.5 * line))
    bar = figure.colorbar(
        ScalarMappable(Normalize(scale.low, scale.high), scale.colormap), cax=axes, orientation="horizontal"
    )
    bar.set_label(scale.label, fontsize=_FONT - 0.5, color=_INK, labelpad=1)
    bar.ax.tick_params(labelsize=_FONT - 1.5, colors=_INK, length=2, pad=1.5)
    bar.outline.set_visible(False)  # pyright: ignore[reportCallIssue, reportUnknownMemberType]  # stub lacks it


def _chart(title: str, *, height: float) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(5.6, height), dpi=_DPI, facecolor="white")
    axes = figure.add_subplot()
    _heading(figure, title)
    return figure, axes


def _finish(figure: Figure, axes: Axes) -> Figure:
    _style(axes)
    figure.tight_layout(rect=(0, 0, 1, 1 - 0.3 / float(figure.get_figheight())))
    return figure


def _heading(figure: Figure, title: str, y: float = 0.985) -> None:
    # Not a suptitle, for which the layout would make room twice.
    figure.text(
        0.01,
        y,
        _plain(title),
        ha="left",
        va="top",
        fontsize=_FONT + 0.5,
        fontweight="bold",
        color=_INK,
        in_layout=False,
    )


def _style(axes: Axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color("#9a9a9a")
    axes.tick_params(labelsize=_FONT - 1, colors=_INK)
    axes.xaxis.label.set(fontsize=_FONT, color=_INK)
    axes.yaxis.label.set(fontsize=_FONT, color=_INK)
    axes.grid(True, color="#ececec", lw=0.7)
    axes.set_axisbelow(True)


def _legend(axes: Axes, **options: Any) -> None:
    legend = axes.legend(fontsize=_FONT - 1, labelcolor=_INK, framealpha=0.85, **options)
    legend.get_frame().set_linewidth(0.0)


def _by_expression(scans: Sequence[Coefficients]) -> list[tuple[str, dict[str, Any], list[Coefficients]]]:
    """Group the scans that are not neutral, in the order of their first appearance, each with its own style."""
    names = list(dict.fromkeys(scan.expression for scan in scans if scan.intensity > 0))
    return [
        (
            name,
            {"color": _CATEGORIES[k % len(_CATEGORIES)], "marker": _MARKERS[k % len(_MARKERS)]},
            [scan for scan in scans if scan.expression == name and scan.intensity > 0],
        )
        for k, name in enumerate(names)
    ]


def _sizes(scans: Sequence[Coefficients]) -> FloatArray:
    return np.array([20.0 + 80.0 * float(np.clip(scan.intensity, 0, 1)) for scan in scans])


def _line(
    scans: Sequence[Coefficients], neutral_b: FloatArray | None, neutral_z: FloatArray | None
) -> FloatArray | None:
    """Return two points (2, K), in mm, of the line through neutral that fits the scans best in units of sd."""
    if neutral_b is None or neutral_z is None or len(scans) < 2:
        return None
    v = np.stack([scan.z - neutral_z for scan in scans])
    direction = np.linalg.svd(v, full_matrices=False)[2][0]
    along = v @ direction
    if along.sum() < 0:
        direction, along = -direction, -along
    # Every scan of a model has b = z * sd, so their sizes give the sd of each mode.
    size_b, size_z = (np.abs(np.stack(rows)).sum(axis=0) for rows in ([s.b for s in scans], [s.z for s in scans]))
    stddev = np.divide(size_b, size_z, out=np.zeros_like(size_b), where=size_z > 0)
    ends = np.array([min(0.0, along.min()), 1.08 * max(0.0, along.max())])
    return neutral_b + ends[:, None] * (direction * stddev)


def _rows(items: Sequence[_Item], columns: int) -> list[list[_Item]]:
    return [list(items[k : k + columns]) for k in range(0, len(items), columns)]


def _table(name: str) -> FloatArray:
    return np.asarray(matplotlib.colormaps[name](np.linspace(0, 1, 256)), dtype=np.float64)[:, :3]


def _nice_ceiling(value: float) -> float:
    """Return a round number at or a little above `value`."""
    if not value > 0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(value))
    steps = np.array([1, 1.2, 1.4, 1.6, 1.8, 2, 2.5, 3, 3.5, 4, 5, 6, 7, 8, 9, 10])
    return float(power * steps[np.searchsorted(steps, value / power - 1e-9)])


def _mm(value: float) -> str:
    return f"{value:.0f} mm" if value >= 100 else f"{value:.1f} mm" if value >= 10 else f"{value:.2f} mm"


def _percent(share: float) -> str:
    """Return a percentage that says 100 only when it is all."""
    if share == 1.0:
        return "100 %"
    return f"{min(100 * share, 99.9):.1f} %" if share > 0.99 else f"{100 * share:.0f} %"


def _plain(text: str) -> str:
    """Keep a label from being read as mathematics, and to a length that fits."""
    lines = [line if len(line) <= _LONGEST_LABEL else line[: _LONGEST_LABEL - 1] + "…" for line in text.split("\n")]
    return "\n".join(lines).replace("$", r"\$")
