"""Figures of an ordination: shapes as points in the plane of two axes, and the shapes at the ends of these axes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from scipy import stats
from scipy.spatial import ConvexHull, QhullError

from shapespace.errors import ShapespaceError
from shapespace.geometry.thin_plate_spline import ThinPlateSpline
from shapespace.report.figures.analysis_figures import upright_views
from shapespace.report.figures.deformation_figures import draw_links, grid_lines
from shapespace.report.figures.draw import (
    GREY,
    INK,
    RULE,
    SMALL,
    axis_label,
    charts,
    escaped,
    finish,
    legend,
    short,
    type_size,
    view,
)
from shapespace.report.render.palette import CATEGORIES
from shapespace.report.render.renderer import Layer, render
from shapespace.schemas import MorphospacePart
from shapespace.types import FloatArray, IntArray, Mesh

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")  # in the order of those of widgets.js
_ELLIPSE = 0.95  # probability
_SPARSE = 5  # of the points of a grid line, this one alone is kept, so that the page is small
_MOST_GRID = 400
"""Landmarks above which no deformation grid is drawn: they hide it."""
_MOST_IN_LEGEND, _MOST_DOTS_BIG = 24, 200  # entries of the legend; dots drawn at full size


@dataclass(frozen=True, eq=False, kw_only=True)
class Morphospace:
    """The plot of a `MorphospacePart` with its arrays, and planar landmarks with a deformation grid.

    Args:
        part: names, axes and groups.
        scores: (N, A).
        mean: (V, 3), upright.
        shape_axes: (A, V, 3) change of shape per unit of score, in the same frame.
        faces: (F, 3); None for landmarks.
        codes: (N,) number of the group of each shape; 0 without groups.
        cross_validated: (N, A) leave-one-out scores; None without.
        nodes: (M, A) scores of internal nodes of a phylogeny; none without.
        edges: (E, 2) its branches.
        grid: number of lines of a deformation grid and of points of each, which follow the landmarks in `mean` and
            `shape_axes`; None for none.
    """

    part: MorphospacePart
    scores: FloatArray
    mean: FloatArray
    shape_axes: FloatArray
    faces: IntArray | None
    codes: npt.NDArray[np.int64]
    cross_validated: FloatArray | None
    nodes: FloatArray
    edges: IntArray
    grid: tuple[int, int] | None = None

    @staticmethod
    def of(
        part: MorphospacePart, arrays: Mapping[str, npt.NDArray[Any]], damaged: Callable[[str], ShapespaceError]
    ) -> Morphospace:
        """Return the plot of a part and the arrays of its file; `damaged` makes the error of arrays that do not fit.

        Raises:
            ShapespaceError: an array is absent, has another shape or is not finite.
        """
        n, n_axes = len(part.names), len(part.axes)

        def array(name: str, *shape: int, optional: bool = False) -> FloatArray:
            values = arrays.get(name, np.zeros((0, *shape[1:])) if optional else np.zeros(0))
            fits = values.ndim == len(shape) and values.dtype.kind in "iuf" and bool(np.isfinite(values).all())
            if not fits or any(want not in (-1, got) for want, got in zip(shape, values.shape, strict=True)):
                raise damaged(f"the array {name!r} of a morphospace does not fit its names and axes")
            return values.astype(np.float64)

        scores, mean = array("scores", n, n_axes), array("mean", -1, 3)
        shape_axes, faces = array("shape_axes", n_axes, len(mean), 3), array("faces", -1, 3)
        nodes, edges = array("nodes", -1, n_axes, optional=True), array("edges", -1, 2, optional=True)
        codes = array("groups", n) if part.groups else np.zeros(n)
        validated = array("cross_validated", n, n_axes) if "cross_validated" in arrays else None
        limits = ((edges, n + len(nodes)), (codes, max(len(part.groups), 1)), (faces, len(mean)))
        outside = any(values.size and not 0 <= values.min() <= values.max() < count for values, count in limits)
        if outside or len(part.shares) != n_axes or not all(0 <= k < n_axes for k in part.first):
            raise damaged("a morphospace has groups, branches, triangles or axes that do not exist")
        turn, _ = upright_views(Mesh(mean, faces.astype(np.int32) if faces.size else None))
        space = Morphospace(
            part=part, scores=scores, mean=mean @ turn.T, shape_axes=shape_axes @ turn.T,
            faces=faces.astype(np.int32) if faces.size else None, codes=codes.astype(np.int64),
            cross_validated=validated, nodes=nodes, edges=edges.astype(np.int32),
        )  # fmt: skip
        return _with_grid(space) if space.is_planar and 3 < len(mean) <= _MOST_GRID else space

    @cached_property
    def is_planar(self) -> bool:
        """Whether z is the same everywhere."""
        flat = np.abs(self.mean[:, 2] - self.mean[0, 2]).max() + np.abs(self.shape_axes[:, :, 2]).max()
        return self.faces is None and bool(flat <= 1e-9 * np.ptp(self.mean))

    @property
    def n_landmarks(self) -> int:
        """Number of vertices without those of the grid."""
        return len(self.mean) - (self.grid[0] * self.grid[1] if self.grid else 0)

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the axes with their share of the variance."""
        unit = f", {self.part.unit}" if self.part.unit else ""
        names = zip(self.part.axes, self.part.shares, strict=True)
        return tuple(f"{name}{unit} ({100 * share:.1f} %)" for name, share in names)

    @property
    def radii(self) -> FloatArray:
        """(G,) Mahalanobis radius of the 95 % ellipse of each group; NaN with fewer than three shapes."""
        # M18
        counts = np.bincount(self.codes, minlength=max(len(self.part.groups), 1)).astype(np.float64)
        return np.where(counts > 2, np.sqrt(2 * stats.f.ppf(_ELLIPSE, 2, np.maximum(counts - 1, 1))), np.nan)

    def shape(self, place: Mapping[int, float]) -> FloatArray:
        """Return the vertices at scores by the number of their axis, 0 on the others."""
        return self.mean + sum(score * self.shape_axes[axis] for axis, score in place.items())


def _with_grid(space: Morphospace) -> Morphospace:
    """Return the plot with the lines of a deformation grid after the landmarks.

    The thin-plate spline is linear in the landmarks that it warps the mean to, so that the grid moves along axes as
    they do.
    """
    flat = space.mean[:, :2]
    lines = grid_lines(flat)[:, ::_SPARSE]
    points = lines.reshape(-1, 2)
    depth = np.zeros((len(points), 1))
    moved = [np.hstack([ThinPlateSpline.fit(flat, axis[:, :2]).apply(points), depth]) for axis in space.shape_axes]
    return replace(
        space, mean=np.vstack([space.mean, np.hstack([points, depth])]),
        shape_axes=np.concatenate([space.shape_axes, np.stack(moved)], axis=1), grid=lines.shape[:2],
    )  # fmt: skip


def hull(points: FloatArray) -> FloatArray:
    """Return the corners of the convex hull of points (n, 2), or the points where they have no area."""
    try:
        return points[ConvexHull(points).vertices]
    except (QhullError, ValueError):
        return points


def ellipse(points: FloatArray, radius: float) -> FloatArray:
    """Return points (m, 2) of the ellipse of this Mahalanobis radius about the mean of points (n, 2)."""
    turns = np.linspace(0, 2 * np.pi, 73)
    values, vectors = np.linalg.eigh(np.cov(points.T))
    spread = vectors * np.sqrt(np.maximum(values, 0))
    return points.mean(axis=0) + radius * np.stack([np.cos(turns), np.sin(turns)], axis=1) @ spread.T


def morphospace_figure(space: Morphospace) -> Figure:
    """Draw shapes in the plane of the first two axes of a plot, and below it the shapes at the ends of both axes.

    Args:
        space: the plot.
    """
    across, up = space.part.first
    figure, (axes, row) = charts("", [4.3, 1.3])
    plane = space.scores[:, [across, up]]
    tree = np.vstack([plane, space.nodes[:, [across, up]]])[space.edges]
    axes.axhline(0, color=RULE, lw=1.0)
    axes.axvline(0, color=RULE, lw=1.0)
    for branch in tree:
        axes.plot(*branch.T, color=GREY, lw=0.8, zorder=1.5)
    for g, radius in enumerate(space.radii):
        points, colour = plane[space.codes == g], CATEGORIES[g % len(CATEGORIES)]
        label = escaped(short(space.part.groups[g], 30)) if space.part.groups else None
        if len(points) > 2 and space.part.groups:
            axes.fill(*hull(points).T, facecolor=(*colour, 0.10), edgecolor=(*colour, 0.7), lw=0.9, zorder=1.2)
            axes.plot(*ellipse(points, radius).T, color=colour, lw=1.0, ls=(0, (4, 2)), zorder=1.3)
        axes.scatter(
            *points.T, s=22 if len(plane) <= _MOST_DOTS_BIG else 8, color=colour, label=label, edgecolors="white",
            marker=MARKERS[(g + g // len(CATEGORIES)) % len(MARKERS)], linewidths=0.4, zorder=2,
        )  # fmt: skip
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.06)
    axes.set(xlabel=axis_label(space.labels[across]), ylabel=axis_label(space.labels[up], 0.6))
    if 1 < len(space.part.groups) <= _MOST_IN_LEGEND:
        legend(axes, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=min(len(space.part.groups), 4))
    _draw_shapes(row, space, across, up)
    # The limits of equal scales depend on the layout, and their ticks on the limits.
    figure.tight_layout()
    axes.apply_aspect()
    return finish(figure)


def _draw_shapes(row: Axes, space: Morphospace, across: int, up: int) -> None:
    """Draw the mean between the shapes at the ends of two axes, side by side in one scale."""
    row.set_axis_off()
    places: list[tuple[str, dict[int, float]]] = [("mean", {})]
    for axis in (across, up):
        low, high = float(space.scores[:, axis].min()), float(space.scores[:, axis].max())
        ends = [(f"{space.part.axes[axis]}\n{end:.3g}".replace("-", "−"), {axis: end}) for end in (low, high)]
        places = [ends[0], *places, ends[1]]
    shapes = [space.shape(place) for _, place in places]
    seen = view(np.concatenate(shapes), len(places))
    low, high = np.concatenate(shapes).min(axis=0), np.concatenate(shapes).max(axis=0)
    for k, ((name, _), vertices) in enumerate(zip(places, shapes, strict=True)):
        panel = row.inset_axes(((k + 0.02) / len(places), 0.0, 0.96 / len(places), 0.76))
        panel.set_axis_off()
        panel.set_title(escaped(name), fontsize=type_size(SMALL), color=INK, pad=2)
        if not space.is_planar:
            panel.imshow(render(Layer(Mesh(vertices, space.faces)), camera=seen.camera, size=seen.size))
            continue
        landmarks = vertices[: space.n_landmarks, :2]
        grid = vertices[space.n_landmarks :, :2].reshape(*(space.grid or (0, 0)), 2)
        panel.add_collection(LineCollection(list(grid), colors="#b9bcc2", linewidths=type_size(0.5)))
        draw_links(panel, landmarks, INK, type_size(0.9))
        panel.scatter(*landmarks.T, s=type_size(6), color=INK, linewidths=0, zorder=3)
        panel.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
