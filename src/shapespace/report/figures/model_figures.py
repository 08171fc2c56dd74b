"""Figures of a shape model: mean, modes, spectrum and quality."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TypeAlias

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from PIL import Image as PillowImage
from PIL import ImageDraw, ImageFont

from shapespace.errors import FileFormatError, InputError
from shapespace.model.shape_model import ShapeModel
from shapespace.report.figures.draw import (
    BACKWARD,
    BARS,
    FORWARD,
    INK,
    TEXT,
    Row,
    Scale,
    chart,
    charts,
    counted,
    equal_views,
    finish,
    grid,
    legend,
    legend_above,
    mm,
    number_axis,
    percent,
    type_size,
    view,
)
from shapespace.report.inputs.saved_fits import nice_ceiling
from shapespace.report.inputs.subject_parts import Parts
from shapespace.report.render.palette import PARTS, SEQUENTIAL, Colour
from shapespace.report.render.renderer import Image, Layer, part_layer, render
from shapespace.schemas import BySize, Measured, Quality, read
from shapespace.types import FloatArray, Mesh

SHARES = (0.90, 0.95, 0.98, 0.99)
"""Shares of the variance for which the number of modes is labelled."""

_LANDMARK = (0.78, 0.20, 0.14)  # red, sRGB from 0 to 1
_QUALITY = {
    "compactness": ("Compactness: share of the variance", "share of the variance (%)"),
    "generalisation": ("Generalisation: error on held-out shapes", "mean error (mm)"),
    "specificity": ("Specificity: distance of random shapes from real ones", "mean distance (mm)"),
    "reconstruction": ("Reconstruction: error on unseen shapes that were given", "mean error (mm)"),
}
_LONGEST_NAME = 26  # layout: characters
_BY_SHAPES = "Generalisation with all modes, by the number of training shapes"
_COLOURS, _BANDS = (FORWARD, BACKWARD), (BARS, "#f2c6a5")


def mean_figure(model: ShapeModel, *, title: str = "") -> Figure:
    """Draw the mean shape from three sides, with the model's landmarks if it has any.

    Args:
        model: the shape space.
        title: text above the figure; by default the number of shapes of the mean.
    """
    marks = f", with {counted(len(model.landmarks), 'landmark')}" if model.landmarks else ""
    return parts_figure(
        model.mesh(), Parts.of(model), title=title or f"The mean of {counted(model.n_training, 'shape')}{marks}"
    )


def parts_figure(mesh: Mesh, parts: Parts | None, *, title: str) -> Figure:
    """Draw a mesh from three sides, in the colours of its parts if it has several, with its landmarks."""
    layers = [part_layer(mesh, parts and parts.labels)]
    if mesh.landmarks:
        size = 0.008 * float(np.ptp(mesh.vertices, axis=0).max())
        layers.append(Layer(Mesh(np.array(list(mesh.landmarks.values()))), _LANDMARK, point_radius_mm=size))
    sides = (("front", 0.0), ("three-quarter", 40.0), ("side", 90.0))
    cameras, size = equal_views([(mesh.vertices, yaw) for _, yaw in sides], len(sides))
    panels = [render(*layers, camera=camera, size=size) for camera in cameras]
    return grid([Row(panels, [name for name, _ in sides])], title=title, keys=part_keys(parts))


def part_keys(parts: Parts | None) -> list[tuple[str, Colour]]:
    """Return the names of parts with their colours, for a key; empty if there is one structure."""
    return [(name, PARTS[k % len(PARTS)]) for k, name in enumerate(parts.names if parts else ())]


def modes_figure(model: ShapeModel, modes: int = 5, deviations: float = 3.0, *, title: str = "") -> Figure:
    """Draw the first modes (the paper's figures 2 and 3).

    Each row shows one mode: the mean minus and plus `deviations` standard deviations, and the displacement of each
    vertex. All rows share one camera and one scale.

    Args:
        model: the shape space.
        modes: largest number of modes.
        deviations: standard deviations to each side.
        title: text above the figure.

    Raises:
        InputError: fewer than one mode, or deviations that are not positive.
    """
    if modes < 1 or not deviations > 0:
        raise InputError(f"There is nothing to draw of {modes} modes at {deviations} standard deviations.")
    n_shown = min(modes, model.n_modes)
    mean, parts = model.mesh(), Parts.of(model)
    labels = parts and parts.labels
    ends = [[model.mesh(b).vertices for b in (-own, own)] for own in np.diag(deviations * model.stddev)[:n_shown]]
    camera_view = view(np.concatenate([end for both in ends for end in both]), 4)
    lengths = [np.linalg.norm(high - mean.vertices, axis=1) for _, high in ends]
    top = nice_ceiling(max(float(length.max()) for length in lengths))
    middle = render(part_layer(mean, labels), camera=camera_view.camera, size=camera_view.size)
    rows: list[Row] = []
    for k, (both, length) in enumerate(zip(ends, lengths, strict=True)):
        low, high = (
            render(part_layer(mean.with_vertices(end), labels), camera=camera_view.camera, size=camera_view.size)
            for end in both
        )
        displacement = render(
            Layer(mean, scalars=length, colormap=SEQUENTIAL, vmax=top), camera=camera_view.camera, size=camera_view.size
        )
        share = float(model.stddev[k] ** 2 / model.total_variance)
        rows.append(
            Row(
                [low, middle, high, displacement],
                [f"−{deviations:g} sd", "mean", f"+{deviations:g} sd", "movement"] if k == 0 else [],
                f"Mode {k + 1}: {percent(share)} of the variance, moves up to {mm(float(length.max()))}",
            )
        )
    of_each = f"{deviations:g} standard deviation{'s' * (deviations != 1)}"
    return grid(
        rows,
        title=title or f"Effect of {_name_modes(n_shown, model.n_modes)} on the mean",
        scale=Scale(f"how far a point moves at {of_each} (mm)", SEQUENTIAL, 0.0, top),
        keys=part_keys(parts),
    )


def _name_modes(n_shown: int, count: int) -> str:
    if count == 1:
        return "the one mode"
    if n_shown == count:
        return f"each of the {count} modes"
    return f"the first of {count} modes" if n_shown == 1 else f"the first {n_shown} of {count} modes"


def mode_displacement(model: ShapeModel, mode: int, deviations: float = 1.0) -> FloatArray:
    """Return the displacement of each vertex, (V, 3) mm, for coefficient `mode` (from 0) at `deviations` sd.

    Raises:
        InputError: the model has no such mode.
    """
    if not 0 <= mode < model.n_modes:
        raise InputError(f"The model has {counted(model.n_modes, 'mode')}, so there is no mode with index {mode}.")
    b = np.zeros(model.n_modes)
    b[mode] = deviations * model.stddev[mode]
    return model.reconstruct(b) - model.mean_vertices


def mode_animation(
    model: ShapeModel,
    mode: int = 0,
    *,
    deviations: float = 3.0,
    frames: int = 24,
    width: int = 320,
    yaw_deg: float = 25.0,
    milliseconds: int = 80,
) -> bytes:
    """Return a looping animated WebP of the mean moving along one mode and back.

        Path("mode1.webp").write_bytes(mode_animation(model, 0))

    Args:
        model: the shape space.
        mode: index of the mode, from 0.
        deviations: standard deviations to each side.
        frames: number of frames of one period, at least 4.
        width: width of the picture in pixels.
        yaw_deg: rotation of the shape from the front, degrees.
        milliseconds: duration of a frame, ms.

    Raises:
        InputError: the model has no such mode, or there are too few frames.
    """
    if frames < 4 or milliseconds < 1:
        raise InputError(f"An animation needs 4 frames or more of 1 ms or more, not {frames} of {milliseconds} ms.")
    ends = [mode_displacement(model, mode, sign * deviations) + model.mean_vertices for sign in (-1, 1)]
    parts = Parts.of(model)
    camera_view = view(np.concatenate(ends), 1, yaw_deg=yaw_deg, width=width)
    forth = [
        _draw_label(
            render(
                part_layer(
                    Mesh(model.mean_vertices + mode_displacement(model, mode, z), model.faces), parts and parts.labels
                ),
                camera=camera_view.camera,
                size=camera_view.size,
            ),
            f"mode {mode + 1}",
            z,
            deviations,
        )
        for z in (deviations * np.sin(np.linspace(-np.pi / 2, np.pi / 2, (frames // 2) + 1))).tolist()
    ]
    cycle = forth + forth[-2:0:-1]
    stream = io.BytesIO()
    cycle[0].save(
        stream,
        format="WEBP",
        save_all=True,
        append_images=cycle[1:],
        duration=milliseconds,
        loop=0,
        quality=72,
        method=2,
    )
    return stream.getvalue()


def _draw_label(image: Image, name: str, z: float, deviations: float) -> PillowImage.Image:
    """Draw the mode number and a position marker below an image."""
    height, width = image.shape[:2]
    type_size = max(11, round(width / 19))
    strip = round(2.1 * type_size)
    picture = PillowImage.new("RGB", (width, height + strip), "white")
    picture.paste(PillowImage.fromarray(image), (0, 0))
    draw = ImageDraw.Draw(picture)
    font = ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"), type_size)
    middle = height + strip // 2
    draw.text((4, middle), name, fill=INK, font=font, anchor="lm")
    draw.text((width - 4, middle), f"{z:+.1f} sd".replace("-", "−"), fill=INK, font=font, anchor="rm")
    left, right = round(0.34 * width), round(0.66 * width)
    draw.line([(left, middle), (right, middle)], fill="#b9bcc2", width=2)
    draw.line([((left + right) // 2, middle - 4), ((left + right) // 2, middle + 4)], fill="#b9bcc2", width=2)
    column = round(left + (right - left) * (z + deviations) / (2 * deviations))
    radius = max(4, type_size // 3)
    draw.ellipse((column - radius, middle - radius, column + radius, middle + radius), fill=FORWARD)
    return picture


def spectrum_figure(model: ShapeModel, *, shares: Sequence[float] = SHARES, title: str = "") -> Figure:
    """Draw the cumulative variance of the modes, and the number of modes needed for each of `shares`."""
    cumulative = model.cumulative_variance
    modes_needed = {share: model.modes_for_variance(share) for share in shares}
    reached = [count for count in modes_needed.values() if count is not None]
    n_shown = min(
        len(cumulative), max(8, (max(reached) if len(reached) == len(modes_needed) else len(cumulative)) + 3), 120
    )
    count = np.arange(1, n_shown + 1)
    shapes = counted(model.n_training, "shape")
    figure, axes = chart(
        title
        or (
            f"Number of modes for the variance of {shapes}"
            if len(cumulative) > 1
            else f"Share of the variance of {shapes} in the one mode"
        ),
        height=3.3,
    )
    axes.bar(count, 100 * np.diff(cumulative[:n_shown], prepend=0.0), color=BARS, label="each mode")
    axes.plot(
        count,
        100 * cumulative[:n_shown],
        color=FORWARD,
        lw=2,
        marker="o" if n_shown < 40 else "",
        ms=4,
        label="all up to it",
    )
    lines: list[str] = []
    for share, modes in modes_needed.items():
        if modes is None:
            lines.append(f"{100 * share:g} %: more than {counted(len(cumulative), 'mode')}")
            continue
        lines.append(f"{100 * share:g} %: {counted(modes, 'mode')}")
        if modes <= n_shown:
            axes.plot([modes], [100 * cumulative[modes - 1]], "o", ms=9, mfc="none", mec=INK, mew=1.4, zorder=5)
    axes.plot([], [], "o", ms=9, mfc="none", mec=INK, mew=1.4, ls="", label="\n".join(lines))
    axes.set(xlabel="number of modes", ylabel="share of the variance (%)", ylim=(0, 104))
    number_axis(axes, n_shown)
    legend(axes, loc="center right", bbox_to_anchor=(1.0, 0.42), labelspacing=0.6)
    return finish(figure)


def quality_figure(quality: Quality | Mapping[str, object], *, title: str = "") -> Figure:
    """Draw compactness, generalisation, specificity and other measures present against the number of modes.

    Args:
        quality: a `Quality`, or a mapping from `compactness` (shares of the variance, 0 to 1), `generalisation`,
            `specificity` and `reconstruction` (mm) to a list with one number for 1, 2, 3 and so on modes, or to a
            mapping of `modes`, `mean` and, if known, `stddev` or `low` and `high`; `others` are drawn for comparison.
        title: text above the figure; by default a description of its content.

    Raises:
        InputError: no measure is present, or a measure is not such a list.
    """
    if not isinstance(quality, Quality):
        try:
            quality = read(Quality, quality, "The quality of a model", "give lists of numbers")
        except FileFormatError as error:
            raise InputError(str(error)) from error
    qualities = [quality, *quality.others]
    measures = [key for key in _QUALITY if any(getattr(item, key) is not None for item in qualities)]
    sizes = [item.generalisation_by_shapes for item in qualities]
    if not measures:
        raise InputError(f"There is nothing to draw: give at least one of {', '.join(_QUALITY)}.")
    curves_by_measure = {key: [_measure_lines(key, item) for item in qualities] for key in measures}
    largest_mode_count = int(
        max(modes.max() for curves in curves_by_measure.values() for lines in curves for modes, *_ in lines.values())
    )
    by_default = (
        f"How good the shape space is, {'by its number of modes' if largest_mode_count > 1 else 'with its one mode'}"
    )
    extra_heights = [2.5] if any(sizes) else []
    figure, plots = charts(title or by_default, [2.5] * len(measures) + extra_heights)
    names = [_short(item.name) for item in qualities] if len(qualities) > 1 else [""]
    for axes, (key, curves) in zip(plots, curves_by_measure.items(), strict=False):
        for name, lines, colour, band in zip(names, curves, _COLOURS, _BANDS, strict=False):
            _draw_lines(axes, key, name, lines, colour, band)
        heading, unit = _QUALITY[key]
        axes.set_title(heading, fontsize=type_size(TEXT), color=INK, loc="left")
        axes.set(ylabel=unit, ylim=(0, 104 if key == "compactness" else None))
        number_axis(axes, largest_mode_count)
        _legend_above(axes)
    plots[len(measures) - 1].set_xlabel("number of modes")
    if extra_heights:
        _draw_sizes(plots[-1], names, sizes)
    return finish(figure, h_pad=1.2)


_Line: TypeAlias = tuple[FloatArray, FloatArray, FloatArray | None, FloatArray | None]


def _measure_lines(key: str, quality: Quality) -> dict[str, _Line]:
    """Return the curves of a measure that are present: by surface or unnamed, and by vertices."""
    by_surface, by_vertices = getattr(quality, key), getattr(quality, f"{key}_vertices", None)
    out: dict[str, _Line] = {}
    if by_surface is not None:
        out["surface" if by_vertices is not None else ""] = _measured_line(key, by_surface)
    if by_vertices is not None:
        out["vertices"] = _measured_line(key, by_vertices)
    return out


def _draw_lines(axes: Axes, key: str, name: str, lines: Mapping[str, _Line], colour: str, band: str) -> None:
    scale = 100.0 if key == "compactness" else 1.0
    for kind, (modes, mean, low, high) in lines.items():
        axes.plot(
            modes,
            scale * mean,
            color=colour,
            lw=2,
            ls=("--" if kind == "vertices" else "-"),
            marker=("o" if len(modes) < 40 else ""),
            ms=4,
            label=", ".join(part for part in (name, kind) if part) or None,
        )
        if low is not None and high is not None:
            axes.fill_between(modes, scale * low, scale * high, color=band, alpha=0.5, lw=0)


def _draw_sizes(axes: Axes, names: Sequence[str], sizes: Sequence[BySize | None]) -> None:
    for name, size, colour, band in zip(names, sizes, _COLOURS, _BANDS, strict=False):
        if size is not None:
            axes.plot(size.shapes, size.mean, color=colour, lw=2, ls="--", marker="o", ms=4, label=name or None)
            axes.fill_between(size.shapes, size.low, size.high, color=band, alpha=0.5, lw=0)
    axes.set_title(_BY_SHAPES, fontsize=type_size(TEXT), color=INK, loc="left")
    axes.set(xlabel="number of training shapes", ylabel="mean error (mm)", ylim=(0, None))
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    _legend_above(axes)


def _short(name: str) -> str:
    return name if len(name) <= _LONGEST_NAME else "…" + name[-_LONGEST_NAME:]


def _legend_above(axes: Axes) -> None:
    """Add a legend, if there are entries, above the curves, with enough room for it."""
    count = len(axes.get_legend_handles_labels()[1])
    if count:
        legend_above(axes, 0.2 * -(-count // 2), loc="upper right", ncols=2)


def _measured_line(key: str, value: Measured | tuple[float, ...]) -> _Line:
    """Return numbers of modes, the measure for each, and where its band begins and ends if known, (n,) each."""
    measured = value if isinstance(value, Measured) else Measured(mean=value)
    mean = np.array(measured.mean)
    modes = np.arange(1.0, len(mean) + 1) if measured.modes is None else np.array(measured.modes, dtype=np.float64)
    low, high = (None if band is None else np.array(band) for band in (measured.low, measured.high))
    if measured.stddev is not None and len(measured.stddev) == len(mean):
        low, high = mean - np.array(measured.stddev), mean + np.array(measured.stddev)
    curves = (modes, *(band for band in (low, high, measured.stddev) if band is not None))
    if not len(mean) or any(len(part) != len(mean) for part in curves):
        raise InputError(f"The {key} of a model must be a list of numbers, one per number of modes.")
    return modes, mean, low, high
