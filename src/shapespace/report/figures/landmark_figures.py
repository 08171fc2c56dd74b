"""Figures of landmarks: specimens superimposed around their mean."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from shapespace.geometry.landmark_alignment import AlignedLandmarks
from shapespace.report.figures.draw import BACKWARD, DPI, FORWARD, INK, LAYOUT, SMALL, charts, finish, type_size

_MOST_NUMBERS = 150
"""Landmarks with a number; more of them overlap."""
_MARGIN, _LEAST_HEIGHT, _MOST_HEIGHT = 0.7, 1.5, 6.0  # layout: inches for the numbers of an axis, and of panels


def superimposed_landmarks(aligned: AlignedLandmarks, links: Sequence[tuple[int, int]] = ()) -> Figure:
    """Return a figure of all specimens around their mean; 3-D landmarks are seen along z and along y.

    Args:
        aligned: landmarks of N specimens.
        links: pairs of landmarks, from 0, that lines connect on the mean.
    """
    planes = [(0, 1), (0, 2)] if aligned.dimensions == 3 else [(0, 1)]
    observed, estimates = aligned.coords[~aligned.estimated], aligned.coords[aligned.estimated]
    mean, extent = aligned.mean, np.ptp(aligned.coords, axis=(0, 1))
    layout = LAYOUT.get()
    width = (layout.chart_width if len(planes) == 1 else layout.row_width / 2) / DPI
    ratio = max(extent[up] / extent[across] for across, up in planes)
    height = float(np.clip((width - _MARGIN) * ratio + _MARGIN, _LEAST_HEIGHT, _MOST_HEIGHT))
    note = "blue: specimens; black: their mean" + ("; orange: missing landmarks, estimated" if len(estimates) else "")
    title = f"{len(aligned)} specimens, superimposed"
    figure, panels = charts(title, [height / layout.scale], columns=len(planes), note=note)
    for axes, (across, up) in zip(panels, planes, strict=True):
        for one, two in links:
            axes.plot(mean[[one, two], across], mean[[one, two], up], color=INK, linewidth=1.0, zorder=2)
        axes.scatter(observed[:, across], observed[:, up], s=5, color=FORWARD, alpha=0.5, linewidths=0, zorder=1)
        if len(estimates):
            axes.scatter(estimates[:, across], estimates[:, up], s=14, facecolors="none", edgecolors=BACKWARD,
                         linewidths=0.8, zorder=5)  # fmt: skip
        axes.scatter(mean[:, across], mean[:, up], s=12, color=INK, linewidths=0, zorder=4)
        if len(mean) <= _MOST_NUMBERS:
            for number, point in enumerate(mean, 1):
                axes.annotate(str(number), (point[across], point[up]), xytext=(2, 2), textcoords="offset points",
                              fontsize=type_size(SMALL), color=INK)  # fmt: skip
        axes.set(xlabel="xyz"[across], ylabel="xyz"[up], aspect="equal")
    return finish(figure)
