"""`shapespace change`: the change between the visits of each subject."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from shapespace.cli.answers.common import add_cohort, cohort_of, finish

if TYPE_CHECKING:
    from shapespace.types import SurfaceLandmarks


def add(sub: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    add_cohort(sub)
    sub.add_argument("--subject", default="subject", metavar="COLUMN",
                     help="column of the subjects (default: subject)")  # fmt: skip
    sub.add_argument("--time", metavar="COLUMN",
                     help="column of the times: numbers, dates (2026-05-31) or words (default: time, visit or "
                     "date)")  # fmt: skip
    sub.add_argument("--order", type=_words, metavar="LIST",
                     help="order of times that are words, such as before,after")  # fmt: skip
    sub.add_argument("--stable", default="auto", metavar="WHAT",
                     help="the part that did not change, by which visits are aligned: auto (detected), all, a region "
                     "of the model, a file of vertices, or landmarks:NAME,NAME and a radius in mm (default: "
                     "auto)")  # fmt: skip
    sub.add_argument("--region", type=_named_file, action="append", default=[], metavar="NAME=FILE",
                     help="a region whose volume is also reported: a CSV file of vertices; can be repeated (default: "
                     "the regions of the model)")  # fmt: skip
    sub.add_argument("--landmarks", type=Path, metavar="FILE",
                     help="CSV of name,vertex, or landmarks.csv of shapespace correspond (default: those of the "
                     "model)")  # fmt: skip
    sub.add_argument("--group", metavar="COLUMN",
                     help="column of two groups whose changes are compared")  # fmt: skip
    sub.add_argument("--unequal-variances", action="store_true",
                     help="with --group: allow groups of unequal dispersion (Welch's t, sign flips)")  # fmt: skip
    sub.add_argument("--rate", action="store_true",
                     help="analyse mm per unit of time instead of last minus first visit")  # fmt: skip
    sub.add_argument("--permutations", type=int, default=1000, metavar="N",
                     help="number of permutations (default 1000)")  # fmt: skip
    sub.add_argument("--seed", type=int, default=0, metavar="S", help="seed of the permutations (default 0)")
    sub.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Measure the changes, and write the report."""
    from shapespace.batch.progress import steps
    from shapespace.io.meshes.region_files import read_region
    from shapespace.statistics.change import change
    from shapespace.statistics.change_found import ChangeSettings

    cohort = cohort_of(arguments, "form")
    if arguments.landmarks is not None:
        cohort = replace(cohort, landmarks=_landmarks(arguments.landmarks, cohort.n_vertices))
    settings = ChangeSettings(
        subject=arguments.subject,
        time=arguments.time,
        order=arguments.order,
        stable=arguments.stable,
        regions={name: read_region(path) for name, path in arguments.region} or None,
        group=arguments.group,
        rate=arguments.rate,
        permutations=arguments.permutations,
        seed=arguments.seed,
        unequal_variances=arguments.unequal_variances,
    )
    columns = [column for column in (arguments.subject, arguments.group) if column]
    if arguments.drop_missing:
        from shapespace.statistics.change_visits import time_column

        cohort = cohort.complete([*columns, time_column(cohort.table, arguments.time)], drop_missing=True)
    with steps(None, "comparing", "subject", quiet=arguments.quiet) as step:
        answer = change(cohort, settings, on_step=step).answer()
    return finish(answer, arguments)


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


def _named_file(text: str) -> tuple[str, Path]:
    name, equals, path = text.partition("=")
    if not (equals and name.strip() and path):
        raise argparse.ArgumentTypeError(f"{text!r} is not NAME=FILE")
    return name.strip(), Path(path)


def _words(text: str) -> Any:
    return tuple(word.strip() for word in text.split(","))
