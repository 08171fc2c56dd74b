"""What is known of who somebody is: whitened coefficients of identity, and how well the fit knew them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from shapespace.cohort.cohort import Cohort, Fitted
from shapespace.errors import InputError
from shapespace.reprs import short_repr
from shapespace.types import FloatArray, read_only

_NO_VARIANCE = 1e-9  # share of the largest; below is rounding


@dataclass(frozen=True, eq=False)
class Samples:
    """Scans of people.

    Args:
        x: (N, K) whitened coefficients of identity, in standard deviations.
        variance: (N, K) of the error that each fit states of them; 0 where nothing is stated.
        mm: (N, D) coefficients of the whole shapes in an orthonormal basis, mm.
        subjects: (N,) whom each shows.
        n_vertices: over which distances in mm are averaged.

    Raises:
        InputError: arrays that do not belong together, or that are not finite.
    """

    x: FloatArray
    variance: FloatArray
    mm: FloatArray
    subjects: tuple[str, ...]
    n_vertices: int = 1

    __repr__ = short_repr

    def __post_init__(self) -> None:
        n = len(self.subjects)
        arrays = (self.x, self.variance, self.mm)
        if self.x.shape != self.variance.shape or any(a.ndim != 2 or len(a) != n for a in arrays):
            raise InputError("Samples need a row of coefficients, variances and a shape for each subject.")
        if not all(np.isfinite(a).all() for a in arrays) or (self.variance < 0).any():
            raise InputError("Samples need finite coefficients, and variances that are not negative.")

    def __len__(self) -> int:
        return len(self.subjects)

    def take(self, rows: Sequence[int]) -> Samples:
        """Return some of them, in their order."""
        indices = np.asarray(rows, dtype=np.intp)
        return replace(
            self,
            x=self.x[indices],
            variance=self.variance[indices],
            mm=self.mm[indices],
            subjects=tuple(self.subjects[row] for row in rows),
        )

    def leading(self, modes: int | None) -> Samples:
        """Return them with the first `modes` coefficients; None for all.

        Raises:
            InputError: there are not so many.
        """
        if modes is None or modes == self.x.shape[1]:
            return self
        if not 1 <= modes <= self.x.shape[1]:
            raise InputError(f"There are {self.x.shape[1]} coefficients of identity, so {modes} cannot be had.")
        return replace(self, x=self.x[:, :modes], variance=self.variance[:, :modes])


def samples_of(
    cohort: Cohort, subjects: Sequence[str], training: Sequence[int], *, uncertainty: bool = True
) -> Samples:
    """Return the identity in each shape of a cohort.

    Of fits by a model that parts identity and expression it is the identity; of other fits all coefficients, in the
    model's standard deviations. Surfaces without fits are whitened by the principal components of `training`.

    Args:
        cohort: N shapes.
        subjects: (N,) whom each shows.
        training: rows of people who are not tested.
        uncertainty: False takes all fits for exact.

    Raises:
        InputError: surfaces without fits, and fewer than three of them to learn from.
    """
    mm, vertices = cohort.coefficients, cohort.n_vertices
    if cohort.fitted is not None:
        x, variance = _of_fits(cohort.fitted)
        return Samples(x, variance if uncertainty else np.zeros_like(x), mm, tuple(subjects), vertices)
    if len(training) < 3:
        raise InputError(
            "Surfaces without fits are whitened by those of subjects who are not tested, of whom there are "
            f"{len(training)}, but at least three are needed; use folds, or name training subjects."
        )
    known = mm[np.asarray(training, dtype=np.intp)]
    mean = known.mean(axis=0)
    _, sizes, rows = np.linalg.svd(known - mean, full_matrices=False)
    significant = sizes > _NO_VARIANCE * sizes[0]
    stddev = sizes[significant] / np.sqrt(len(known) - 1)
    x = (mm - mean) @ rows[significant].T / stddev
    return Samples(read_only(x), np.zeros_like(x), mm, tuple(subjects), vertices)


def _of_fits(fitted: Fitted) -> tuple[FloatArray, FloatArray]:
    """Return the coefficients of identity (N, K) and the variances of their errors."""
    stddev = fitted.model.stddev[: fitted.b.shape[1]]
    z, variance = fitted.z, (fitted.b_stddev / stddev) ** 2
    if fitted.additive is None:
        return z, variance
    # Only the diagonal is kept in files, so errors of different modes are taken as independent.
    turn = fitted.additive.rotation[: fitted.additive.n_identity, : z.shape[1]]
    return z @ turn.T, variance @ (turn**2).T
