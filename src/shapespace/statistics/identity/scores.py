"""Similarity scores of two scans, larger for more similar scans; each score is trained on people who are not tested."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TypeAlias, cast

import numpy as np
from scipy.linalg import eigh
from scipy.spatial.distance import cdist

from shapespace.cohort.cohort import Cohort, FitDiagnostics
from shapespace.errors import InputError
from shapespace.lazy import require_package
from shapespace.reprs import short_repr
from shapespace.types import FloatArray, read_only

_NO_VARIANCE = 1e-9  # share of the largest; below is rounding


@dataclass(frozen=True, eq=False)
class Samples:
    """Scans of people.

    Args:
        x: (N, K) whitened coefficients of identity, in standard deviations.
        variance: (N, K) variance of their error that each fit states; 0 if none is stated.
        mm: (N, D) coefficients of the complete shapes in an orthonormal basis, mm.
        subjects: (N,) person that each scan shows.
        n_vertices: number of vertices over which distances in mm are averaged.

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
            raise InputError("Samples need one row of coefficients, of variances and of the shape for each scan.")
        if not all(np.isfinite(a).all() for a in arrays) or (self.variance < 0).any():
            raise InputError("Samples need finite coefficients, and variances that are not negative.")

    def __len__(self) -> int:
        return len(self.subjects)

    def take(self, rows: Sequence[int]) -> Samples:
        """Return some of the scans, in the order of `rows`."""
        indices = np.asarray(rows, dtype=np.intp)
        return replace(
            self,
            x=self.x[indices],
            variance=self.variance[indices],
            mm=self.mm[indices],
            subjects=tuple(self.subjects[row] for row in rows),
        )

    def leading(self, modes: int | None) -> Samples:
        """Return the scans with the first `modes` coefficients; None for all.

        Raises:
            InputError: there are fewer coefficients.
        """
        if modes is None or modes == self.x.shape[1]:
            return self
        if not 1 <= modes <= self.x.shape[1]:
            raise InputError(
                f"The number of modes must be 1 to {self.x.shape[1]}, as there are coefficients, not {modes}."
            )
        return replace(self, x=self.x[:, :modes], variance=self.variance[:, :modes])


def samples_of(
    cohort: Cohort, subjects: Sequence[str], training: Sequence[int], *, uncertainty: bool = True
) -> Samples:
    """Return the coefficients of identity of each shape of a cohort.

    For fits by a model that separates identity and expression these are the coefficients of identity, for other fits
    all coefficients, in the model's standard deviations. Surfaces without fits are whitened by the principal components
    of `training`.

    Args:
        cohort: cohort of N shapes.
        subjects: (N,) person that each shape shows.
        training: rows of people who are not tested.
        uncertainty: whether the stated errors of fits are used; False assumes exact fits.

    Raises:
        InputError: surfaces without fits, and fewer than three training surfaces.
    """
    mm, vertices = cohort.coefficients, cohort.n_vertices
    if cohort.fitted is not None:
        x, variance = _identity_of_fits(cohort.fitted)
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


def _identity_of_fits(fitted: FitDiagnostics) -> tuple[FloatArray, FloatArray]:
    """Return the coefficients of identity (N, K) and the variances of their errors."""
    stddev = fitted.model.stddev[: fitted.b.shape[1]]
    z, variance = fitted.z, (fitted.b_stddev / stddev) ** 2
    if fitted.additive is None:
        return z, variance
    # Files contain only the diagonal, so errors of different modes are assumed to be independent.
    turn = fitted.additive.rotation[: fitted.additive.n_identity, : z.shape[1]]
    return z @ turn.T, variance @ (turn**2).T


Scorer: TypeAlias = Callable[[Samples, Samples], FloatArray]
"""(gallery, probes) -> (G, P) scores; exchanging the two transposes the scores."""


def _directions(x: FloatArray) -> FloatArray:
    norms = np.linalg.norm(x, axis=1, keepdims=True)
    return x / np.where(norms > 0, norms, 1.0)


SCORES: Mapping[str, Callable[[Samples], Scorer]] = MappingProxyType(
    {
        "plda": lambda training: TwoCovariance.learn(training).score,
        "cosine": lambda _: lambda gallery, probes: _directions(gallery.x) @ _directions(probes.x).T,
        "mahalanobis": lambda _: lambda gallery, probes: -cdist(gallery.x, probes.x),
        "distance": lambda _: lambda gallery, probes: -cdist(gallery.mm, probes.mm) / np.sqrt(gallery.n_vertices),
    }
)
"""Similarity scores of two scans: by the two-covariance model (PLDA), by the angle and by the distance of whitened
coefficients of identity, and by the plain distance of the shapes, RMS over vertices in mm. No score is a likelihood
ratio."""


def check_score_names(names: Sequence[str]) -> None:
    """Check that `names` are scores.

    Raises:
        InputError: the list is empty, or a score is not known.
    """
    unknown = [name for name in names if name not in SCORES]
    if unknown or not names:
        raise InputError(f"Scores are {', '.join(SCORES)}, not {', '.join(unknown) or 'an empty list'}.")


# PLDA: a score of two scans being of one person, by normal within- and between-person covariance

# bounds as shares of the variance within and between people, so that both stay positive
_MOST_NOISE, _LEAST_BETWEEN = 0.9, 1e-3


@dataclass(frozen=True, eq=False)
class TwoCovariance:
    """Between- and within-person covariance, in the coordinates in which both are diagonal: the two-covariance PLDA.

    A scan is x = m + y + w: y ~ N(0, B) is the identity, w ~ N(0, W) the other variation and the error of the fit. W
    differs between scans with the variances that their fits state. Sources: Brummer and de Villiers, "The speaker
    partitioning problem", Odyssey 2010; Ioffe, "Probabilistic linear discriminant analysis", ECCV 2006; variances of
    single samples: Cumani, Plchot and Laface, IEEE/ACM TASLP 22(4), 2014.

    Args:
        mean: (K,) mean of all people.
        basis: (K, K) columns v with v^T W v = 1, so that basis^T B basis is diagonal.
        between: (K,) this diagonal.
        noise: (K,) share of the covariance within that is attributed to errors of fits.
        noise_scale: (K,) factor of the variances that fits state, so that those of training make up `noise` on average.
        people: number of training people.
        scans: number of training scans.
    """

    mean: FloatArray
    basis: FloatArray
    between: FloatArray
    noise: FloatArray
    noise_scale: FloatArray
    people: int
    scans: int

    @staticmethod
    def learn(training: Samples) -> TwoCovariance:
        """Return the covariances of `training`, shrunk by the amount of Ledoit and Wolf (2004).

        The errors that fits state are part of the covariance within. If they exceed nine tenths, they are scaled down
        to that share: files contain only their diagonal, which overstates the error in directions in which errors of
        several coefficients cancel.

        Raises:
            InputError: fewer than three people, or no person with two scans.
            ShapespaceError: scikit-learn is not installed.
        """
        shrunk = require_package("sklearn.covariance", "The PLDA score", "'shapespace[statistics]'").ledoit_wolf
        names, whose = np.unique(np.asarray(training.subjects), return_inverse=True)
        counts = np.bincount(whose, minlength=len(names)).astype(np.float64)
        if len(names) < 3 or counts.max(initial=0.0) < 2:
            raise InputError(
                f"The PLDA score is trained on subjects who are not tested, and there are {len(names)}, of whom "
                f"{int((counts > 1).sum())} have two scans; give three subjects or more and several scans of each, or "
                "remove it from --scores."
            )
        n, k = training.x.shape
        means = np.zeros((len(names), k))
        np.add.at(means, whose, training.x)
        means /= counts[:, None]
        mean = means.mean(axis=0)
        own = training.x - means[whose]
        several = counts[whose] > 1
        freedom = several.sum() - (counts > 1).sum()
        within = cast(FloatArray, shrunk(own[several], assume_centered=True)[0]) * (several.sum() / freedom)
        spread = cast(FloatArray, shrunk(means - mean, assume_centered=True)[0]) * (len(names) / (len(names) - 1))
        between = _subtract_covariance(spread, within * float((1.0 / counts).mean()), _LEAST_BETWEEN)  # S61
        values, basis = cast(tuple[FloatArray, FloatArray], eigh(between, within))
        stated = training.variance.mean(axis=0) @ basis**2
        noise = np.minimum(stated, _MOST_NOISE)
        scale = np.divide(noise, stated, out=np.ones_like(noise), where=stated > 0)
        arrays = (mean, basis, np.maximum(values, 0.0), noise, scale)
        return TwoCovariance(*map(read_only, arrays), people=len(names), scans=n)

    def score(self, gallery: Samples, probes: Samples) -> FloatArray:
        """Return (G, P) scores: natural log likelihood, by the model, of one person minus that of two.

        They are likelihood ratios only if the normal model and its covariances are right, which a small training set
        does not ensure; `calibrated` converts them to likelihood ratios.

        The covariance within of each scan has its own errors in the place of those of the training; their diagonal in
        the coordinates of `basis` is used.
        """
        g, p = (samples.x - self.mean for samples in (gallery, probes))
        g, p = g @ self.basis, p @ self.basis
        # Total variances, (G, K) and (P, K).
        of_g, of_p = (self.between + self.within(samples) for samples in (gallery, probes))
        alone = (p**2 / of_p + np.log(of_p)).sum(axis=1)
        out = np.empty((len(g), len(p)))
        for row, (x, total) in enumerate(zip(g, of_g, strict=True)):
            # Of the probe given the gallery scan, if they are of one person.
            pull = self.between / total
            left = of_p - self.between * pull  # S63
            together = ((p - pull * x) ** 2 / left + np.log(left)).sum(axis=1)
            out[row] = 0.5 * (alone - together)  # S62
        return out

    def within(self, samples: Samples) -> FloatArray:
        """Return (N, K) variances within a person, 1 on average over training scans, in the coordinates of `basis`."""
        return 1.0 - self.noise + self.noise_scale * (samples.variance @ self.basis**2)


def _subtract_covariance(total: FloatArray, part: FloatArray, least: float) -> FloatArray:
    """Return `total` less `part`, with at least the share `least` of `total` left in each direction."""
    shares, vectors = eigh(part, total)
    back = np.linalg.inv(vectors)
    return (back.T * np.maximum(1.0 - shares, least)) @ back
