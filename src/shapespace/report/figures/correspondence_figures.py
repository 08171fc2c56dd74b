"""Figures of a correspondence: checkerboards, missing vertices, distances, and convergence."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axis import Axis
from matplotlib.figure import Figure

from shapespace.errors import InputError
from shapespace.report.figures.draw import (
    INK,
    MOST_PANELS,
    Row,
    Scale,
    chart,
    finish,
    grid,
    in_rows,
    legend,
    number_axis,
    short,
    view,
)
from shapespace.report.render.palette import SEQUENTIAL
from shapespace.report.render.renderer import Camera, Image, Layer, render
from shapespace.report.render.thumbnails import checker_layer, checker_places
from shapespace.types import FloatArray, Mesh

SIDE_DEG = 65.0  # degrees, between three quarters and profile
_LONGEST = 16  # layout: characters above a panel
_LINES = ("#9cc3e0", "#0072B2", "#D55E00", "#6b140f")


def checkerboard_figure(
    mean: Mesh, surfaces: Sequence[FloatArray], labels: Sequence[str], *, yaw_deg: float = 0.0, title: str = ""
) -> Figure:
    """Draw one checkerboard on the mean shape and on each scan: the same square has the same vertices.

    Args:
        mean: the mean shape, upright.
        surfaces: (V, 3) each, moved onto the mean shape; not-a-number where missing.
        labels: one a surface.
        yaw_deg: from where.
        title: above the figure.

    Raises:
        InputError: no surfaces, too many for one figure, or another number of labels.
    """
    if not 0 < len(surfaces) < MOST_PANELS or len(surfaces) != len(labels):
        raise InputError(f"{len(surfaces)} surfaces with {len(labels)} labels cannot be drawn in one figure.")
    places = checker_places(mean, yaw_deg)
    columns = 4
    shapes = (mean.vertices, *surfaces)
    drawn = np.concatenate([shape[np.isfinite(shape).all(axis=1)] for shape in shapes])
    panel = view(drawn, columns, yaw_deg=yaw_deg)
    images = [
        render(checker_layer(mean.with_vertices(shape), places), camera=panel.camera, size=panel.size)
        for shape in shapes
    ]
    names = ["mean shape", *_distinct_labels(labels)]
    rows = [Row(i, t) for i, t in zip(in_rows(images, columns), in_rows(names, columns), strict=True)]
    return grid(rows, title=title or "The same squares on every scan")


def _distinct_labels(labels: Sequence[str]) -> list[str]:
    """Return labels that fit above a panel; if two become equal when cut, their common beginning is removed."""
    cut = [short(label, _LONGEST) for label in labels]
    if len(set(cut)) == len(cut):
        return cut
    alike = next((k for k, letters in enumerate(zip(*labels, strict=False)) if len(set(letters)) > 1), 0)
    return [short(f"…{label[alike:]}", _LONGEST) for label in labels]


def missing_figure(mean: Mesh, missing_share: FloatArray, *, title: str = "") -> Figure:
    """Draw the share of scans with each vertex missing, on the mean shape from four sides.

    Args:
        mean: the mean shape, upright.
        missing_share: (V,) 0 to 1.
        title: above the figure.
    """
    largest_share = float(missing_share.max(initial=0.0))
    top = next(limit for limit in (0.05, 0.1, 0.25, 0.5, 1.0) if largest_share <= limit)
    scale = Scale("scans that do not show the vertex (%)", SEQUENTIAL, 0.0, 100 * top)
    return _from_four_sides(mean, 100 * missing_share, scale, title or "Where vertices are missing")


def position_std_figure(mean: Mesh, position_std: FloatArray, limit: float, *, title: str = "") -> Figure:
    """Draw the standard deviation of the position of each vertex along the surface, on the mean shape from four sides.

    Args:
        mean: the mean shape, upright.
        position_std: (V,) shares of the size.
        limit: end of the scale, percent.
        title: above the figure.
    """
    scale = Scale("standard deviation along the surface (% of the size)", SEQUENTIAL, 0.0, limit, "high")
    return _from_four_sides(mean, 100 * position_std, scale, title or "How sure the position of each vertex is")


def _from_four_sides(mean: Mesh, values: FloatArray, scale: Scale, title: str) -> Figure:
    """Draw `values` (V,) on the mean shape from four sides."""
    sides = (("front", 0.0), ("one side", 90.0), ("back", 180.0), ("other side", 270.0))
    layer = Layer(mean, scalars=values, colormap=SEQUENTIAL, vmax=scale.high)
    front = view(mean.vertices, len(sides))
    height = max(view(mean.vertices, len(sides), yaw_deg=yaw).camera.height_mm for _, yaw in sides)
    panels: list[Image] = []
    for _, yaw in sides:
        view_camera = view(mean.vertices, len(sides), yaw_deg=yaw).camera
        camera = Camera(view_camera.centre, height, yaw, 0.0, view_camera.distance_mm)
        panels.append(render(layer, camera=camera, size=front.size))
    return grid([Row(panels, [name for name, _ in sides])], title=title, scale=scale)


def nearness_figure(distances: FloatArray, *, title: str = "") -> Figure:
    """Draw how many scans have distances up to each length.

    Args:
        distances: (N, 4) mean, 95 %, 99 % and largest distance of each scan, as shares of its size.
        title: above the figure.

    Raises:
        InputError: there are none.
    """
    known = 100 * distances[np.isfinite(distances).all(axis=1)]
    if not len(known):
        raise InputError("No scan has distances to draw.")
    figure, axes = chart(title or "How near the surfaces lie to their scans", height=3.0)
    known = np.maximum(known, 1e-4)
    low, high = 0.7 * float(known.min()), 1.4 * float(known.max())
    names = ("mean", "95 % of the points", "99 %", "farthest point")
    for column, (name, colour) in enumerate(zip(names, _LINES, strict=True)):
        sorted_values = np.sort(known[:, column])
        share = 100 * np.arange(len(sorted_values) + 1) / len(sorted_values)
        axes.plot(
            [low, *sorted_values, high], [*share, 100.0], drawstyle="steps-post", color=colour, lw=2.0, label=name
        )
    axes.set_xscale("log")
    _plain_decades(axes.xaxis)
    axes.set(xlabel="distance, % of the object's size", ylabel="scans up to there (%)")
    axes.set(xlim=(low, high), ylim=(0, 102))
    legend(axes, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncol=4)
    return finish(figure)


def movement_figure(
    rounds: Sequence[float], scans: Sequence[Sequence[float]], settled_mm: float, *, title: str = ""
) -> Figure:
    """Draw by how much vertices moved in each round: all together, and each scan.

    Args:
        rounds: RMS of each round, shares of the size.
        scans: the same of each scan; those that missed a round are left out.
        settled_mm: below which the rounds end.
        title: above the figure.

    Raises:
        InputError: there are no rounds.
    """
    if not rounds:
        raise InputError("There are no rounds to draw.")
    figure, axes = chart(title or "How far vertices moved in each round", height=3.0)
    round_numbers = np.arange(1, len(rounds) + 1)
    for k, series in enumerate([series for series in scans if len(series) == len(rounds)]):
        values = np.maximum(100 * np.array(series), 1e-3)
        axes.plot(round_numbers, values, color=_LINES[0], lw=1.0, alpha=float(np.clip(20 / len(scans), 0.15, 0.8)),
                  marker="o", ms=2.5, label="a scan" if k == 0 else None)  # fmt: skip
    axes.plot(
        round_numbers, np.maximum(100 * np.array(rounds), 1e-3), color=INK, lw=2.6, marker="o", label="all together"
    )
    axes.axhline(100 * settled_mm, color=_LINES[2], lw=1.2, ls="--", label="settled below")
    axes.set_yscale("log")
    _plain_decades(axes.yaxis)
    axes.set(xlabel="round", ylabel="moved (RMS), % of the size")
    number_axis(axes, len(rounds), room=0.3)
    legend(axes, loc="upper right")
    return finish(figure)


def _plain_decades(axis: Axis) -> None:
    """Label 1, 2 and 5 of each decade of a logarithmic axis in plain notation."""
    axis.set_major_formatter(lambda value, _: f"{value:g}")
    axis.set_minor_formatter(lambda value, _: f"{value:g}" if f"{value:.0e}"[0] in "25" else "")
