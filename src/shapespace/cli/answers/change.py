"""`shapespace change`: the change between the visits of each subject."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from shapespace.cli.answers.common import cohort_of, finish
from shapespace.cli.options import given

if TYPE_CHECKING:
    from shapespace.types import SurfaceLandmarks


def run(arguments: argparse.Namespace) -> int:
    """Measure the changes, and write the report."""
    from shapespace.batch.progress import steps
    from shapespace.io.meshes.region_files import read_region
    from shapespace.report.analyses.change_report import change_report
    from shapespace.statistics.change_result import ChangeConfig
    from shapespace.statistics.measure_change import change

    cohort = cohort_of(arguments, "form")
    if arguments.landmarks is not None:
        cohort = replace(cohort, landmarks=_landmarks(arguments.landmarks, cohort.n_vertices))
    regions = {name: read_region(path) for name, path in arguments.region} or None
    config = ChangeConfig(**given(arguments, ChangeConfig, regions=regions))
    with steps(None, "comparing", "subject", quiet=arguments.quiet) as step:
        result = change(cohort, config, progress=step)
    return finish(change_report(result), arguments)


def _landmarks(path: Path, n_vertices: int) -> SurfaceLandmarks:
    from shapespace.errors import InputError
    from shapespace.io.landmarks.landmark_io import read_surface_landmarks

    found = read_surface_landmarks(path)
    for name, vertex in zip(found.names, found.corners.max(axis=1).tolist(), strict=True):
        if vertex >= n_vertices:
            raise InputError(
                f"{path}: landmark {name[:40]!r} is at vertex {vertex}, but the surfaces have {n_vertices}; give "
                "landmarks of these surfaces."
            )
    return found
