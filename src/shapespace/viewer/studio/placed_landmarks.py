"""The landmarks on scans as the data of questions: the specimens that have them, and the files of `align`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

from shapespace.cohort.orientation import LINKS
from shapespace.io.landmarks.configuration_io import CURVE_SLIDERS
from shapespace.io.tables.table_io import table_text
from shapespace.viewer.studio.project import Point, Project, ScanCurve, Specimen, State, points_text

PLACED = 0
"""Job number of questions about the landmarks on scans, which no job made."""
MISSING_LANDMARKS = "missing-landmarks"
"""Option of questions about the landmarks on scans, with one of `MISSING_CHOICES`; no command has it."""
EXCLUDE_LANDMARKS = "exclude-landmarks"
_ESTIMATES: Mapping[str, str] = {"estimate-by-spline": "tps", "estimate-by-regression": "regression"}
MISSING_CHOICES = ("exclude-specimens", EXCLUDE_LANDMARKS, *_ESTIMATES)
"""Treatments of missing landmarks: exclusion of incomplete specimens, exclusion of incomplete landmarks, or an estimate
by one of two methods."""


@dataclass(frozen=True)
class PlacedLandmarks:
    """Landmarks on scans, in mm if the scan has a unit, and reflected if it is mirrored.

    Args:
        names: names of the landmarks that are used.
        points: id -> name -> landmark, of the specimens that are used.
        lacking: id -> number of landmarks that the specimen lacks, of all specimens.
        curves: curves whose points are among the landmarks.
        estimate: method of `align` that estimates missing landmarks; empty if none are missing.
    """

    names: tuple[str, ...]
    points: Mapping[str, Mapping[str, Point]]
    lacking: Mapping[str, int]
    curves: Mapping[str, ScanCurve]
    estimate: str

    def files(self, folder: str) -> dict[str, str]:
        """Return path -> content of the files that `align` reads, in a folder of the project."""
        files = {f"{folder}/landmarks.csv": self._table}
        names = [(curve.names(name), curve.closed) for name, curve in self.curves.items()]
        rings = [(*points, *points[:1]) if closed else points for points, closed in names]
        if rings:
            rows = [row for ring in rings for row in zip(ring, ring[1:], ring[2:], strict=False)]
            files[f"{folder}/{CURVE_SLIDERS}"] = table_text(("before", "slide", "after"), rows)
            files[f"{folder}/{LINKS}"] = table_text(("from", "to"), [link for ring in rings for link in pairwise(ring)])
        return files

    @cached_property
    def _table(self) -> str:
        return points_text(self.points, self.names)

    def command(self, folder: str) -> tuple[str, ...]:
        """Return the arguments of the command that aligns the landmarks in `files`."""
        sliders = ("--sliders", f"{folder}/{CURVE_SLIDERS}") if self.curves else ()
        estimate = (f"--missing={self.estimate}",) if self.estimate else ()
        return ("align", f"{folder}/landmarks.csv", "-o", f"{folder}/aligned", *sliders, *estimate, "--quiet")


def placed_landmarks(project: Project, options: Mapping[str, Any]) -> PlacedLandmarks:
    """Return the landmarks on the included scans for training, with the choice about missing ones in the options of a
    question.
    """
    state, missing = project.state, str(options.get(MISSING_LANDMARKS))
    chosen = state.chosen("training", with_parts=False)
    key = (chosen, state.point_names, state.curves, missing)
    return project.cached(key, lambda: _landmarks_of(chosen, state, missing))


def _landmarks_of(specimens: Sequence[Specimen], state: State, missing: str) -> PlacedLandmarks:
    points = {specimen.id: specimen.read_points() for specimen in specimens}
    names, curves = state.point_names, state.curves
    lacking = {name: len(set(names) - set(placed)) for name, placed in points.items()}
    if missing == EXCLUDE_LANDMARKS:
        names = tuple(name for name in names if all(name in placed for placed in points.values() if placed))
        curves = {name: curve for name, curve in curves.items() if {*curve.names(name)} <= {*names}}
    is_complete = missing not in MISSING_CHOICES[1:]
    used = {name: placed for name, placed in points.items() if placed and not (is_complete and lacking[name])}
    return PlacedLandmarks(names, used, lacking, curves, _ESTIMATES.get(missing, ""))
