"""Content of a methods section: sample sizes, the analysed space, and tests of equal dispersion."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from shapespace.cohort.cohort import Cohort
from shapespace.lazy import lazy_import
from shapespace.schemas import Dispersion, Methods, SampleSize
from shapespace.statistics.dispersion import DispersionTest
from shapespace.statistics.tolerances import RANK

SCAN_OF_SUBJECT = "scan of a subject"
"""`TestScheme.unit` if values are permuted within subjects, and between subjects with the same number of scans."""
REDUCED_OF_EACH_TERM = ("the reduced model of each term",)
"""`TestScheme.reduced_model` of several terms, each tested by residuals of the model of the other terms."""

_ALONG = 0.01
"""Largest share of the squared distance from the mean that shapes in the tangent space may vary along the mean.
Shapes of one size vary along the mean by half of their squared distance, those in the tangent space by nothing."""


def methods_of(cohort: Cohort, subjects: int, **known: Any) -> Methods:
    """Return the methods of an analysis of all coefficients of a cohort.

    Args:
        cohort: cohort of the shapes.
        subjects: number of subjects.
        **known: further fields of `Methods`, or fields that replace those of the cohort.
    """
    centred = cohort.coefficients - cohort.coefficients.mean(axis=0)
    mean = cohort.vertices(cohort.coefficients.mean(axis=0))
    middle = (mean - mean.mean(axis=0)).ravel()
    singular = np.linalg.svd(centred, compute_uv=False)
    along = np.abs(centred @ (cohort.basis @ middle)).max(initial=0.0)
    facts: dict[str, Any] = {
        "shapes": len(cohort),
        "vertices": cohort.n_vertices,
        "coordinates": cohort.dimensions,
        "gauge": cohort.gauge,
        "tangent": cohort.gauge == "shape" and bool(along <= _ALONG * (centred**2).sum(axis=1).max(initial=0.0)),
        "source": cohort.source.kind,
        "review": cohort.review,
        "modes": cohort.source.modes,
        "explained_variance_ratio": cohort.source.explained_variance_ratio,
        "dimensions": int((singular > RANK * singular.max(initial=0.0)).sum()),
        "unit": cohort.unit,
    }
    return Methods(subjects=subjects, **{**facts, **known})


def sample_sizes(subjects: Sequence[str], variables: Sequence[tuple[str, Sequence[str]]]) -> tuple[SampleSize, ...]:
    """Return the subjects and shapes of each class of each variable, and of each combination of their classes.

    Args:
        subjects: subject of each shape.
        variables: name of each variable, and the class of each shape.
    """
    sizes: list[SampleSize] = []
    sets: list[tuple[tuple[str, Sequence[str]], ...]] = [(variable,) for variable in variables]
    if len(variables) > 1:
        sets.append(tuple(variables))
    for chosen in sets:
        members: dict[tuple[str, ...], list[str]] = {}
        for subject, *classes in zip(subjects, *(values for _, values in chosen), strict=True):
            members.setdefault(tuple(classes), []).append(subject)
        names = tuple(name for name, _ in chosen)
        sizes += [
            SampleSize(variables=names, classes=classes, subjects=len(set(own)), shapes=len(own))
            for classes, own in sorted(members.items())
        ]
    return tuple(sizes)


def dispersion_record(test: DispersionTest, alpha: float) -> Dispersion:
    """Return the record of a test of equal dispersion in analysis.json.

    Args:
        test: the test.
        alpha: level of significance.
    """
    return Dispersion(
        variable=test.variable, stratum=test.stratum, groups=test.groups, counts=test.counts, stddev=test.stddev_mm,
        f=test.f, p=test.p, arrangements=test.permutations, equal=test.p > alpha,
        smaller_is_more_variable=test.smaller_is_more_variable,
    )  # fmt: skip


class AnalysisResult:
    """The result of an analysis of a cohort."""

    def save(self, folder: Path | str) -> Path:
        """Write the report, tables, arrays and meshes to a folder.

        The command `shapespace report FOLDER` renders the report from these files.

        Args:
            folder: output folder; created if it does not exist.

        Returns:
            The path of analysis.json.

        Raises:
            FileError: the folder cannot be written, or the disk is full.
        """
        return lazy_import("save_analysis")(self, folder)

    def _repr_html_(self) -> str:
        return lazy_import("html_of_analysis")(self)
