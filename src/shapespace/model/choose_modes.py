"""Choice of the modes: as many as predict hidden vertices of unseen shapes, without artefacts of the alignment.

With noisy shapes, shares of the variance do not determine the number of modes; the prediction of hidden vertices does.

Alignment and rounding cause modes too: the remainder of the alignment, and details finer than the precision of the
coordinates. Procrustes removes from the shapes the effect of a similarity on the mean, to first order. The remainder to
second order is along the scale, and is removed by scaling before PCA (`scale_to_tangent`) if all vertices determined
the alignment. Modes in the tangent of the similarity group at the mean are omitted: a fit cannot distinguish
them from its pose. Sources: Goodall, JRSS B 53(2), 1991, section 4; for the edge of a spectrum of pure noise Marchenko
and Pastur, Math. USSR-Sbornik 1(4), 1967.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shapespace.errors import InputError
from shapespace.geometry.procrustes import Gauge
from shapespace.geometry.similarity import small_poses
from shapespace.model.krylov import largest_eigenpairs
from shapespace.model.pca import ALL_EQUAL, Modes, varying
from shapespace.types import MM_PER_UNIT, BoolArray, FloatArray, IntArray

_TANGENT_SHARE = 0.1
"""Modes of shapes lie in the tangent by less than a fiftieth; those of alignment by a third and more, unless mixed."""
_COARSE = 2.0
"""Rounding to one of two neighbours spreads almost twice as far as rounding over a complete step."""
_MOST_DECIMALS = 6  # decimals that files of rounded coordinates have at most; more are not tested for
_ROUNDING = 1e-14  # relative; some units in the last place of float64


def made_by_alignment(
    mean_vertices: FloatArray, vertex_basis: FloatArray, gauge: Gauge, alignment_vertices: IntArray | None
) -> BoolArray:
    """Return which modes (K,) lie in the tangent of the group of the alignment.

    Args:
        mean_vertices: (V, 3) vertices of the mean, mm.
        vertex_basis: (3V, K) orthonormal modes.
        gauge: `form`, rigid motions; `shape`, similarities.
        alignment_vertices: indices of the vertices that determined the alignment; None for all.
    """
    used = np.arange(len(mean_vertices)) if alignment_vertices is None else np.unique(alignment_vertices)
    moves = small_poses(mean_vertices[used])  # rotations, translations, and the scale last
    tangent = np.linalg.qr(moves if gauge == "shape" else moves[:, :-1])[0]
    rows = (3 * used[:, None] + np.arange(3)).ravel()
    return ((tangent.T @ vertex_basis[rows]) ** 2).sum(axis=0) > _TANGENT_SHARE


def below_precision(variance: FloatArray, n: int, coordinates: int, rounding_mm: float) -> BoolArray:
    """Return whether (K,) rounding alone can cause each variance, mm^2, in n shapes with this many coordinates."""
    return variance <= (_COARSE * rounding_mm * (1.0 + np.sqrt(coordinates / max(n - 1, 1)))) ** 2


def rounding_mm(vertices: FloatArray) -> float:
    """Return the standard deviation of the rounding of coordinates (V, 3), mm, in their file; 0 if not detected.

    They may have been written in any unit, as decimals or in single precision.
    """
    rounding = 0.0
    for mm in MM_PER_UNIT.values():
        y = vertices / mm
        near = np.maximum(np.abs(y), 1e-300) * _ROUNDING
        for decimals in range(_MOST_DECIMALS + 1):
            step = 10.0**-decimals
            if (np.abs(y - np.rint(y / step) * step) <= near + _ROUNDING).all():
                rounding = max(rounding, step * mm / np.sqrt(12.0))
                break
        with np.errstate(over="ignore"):  # extreme coordinates exceed single precision
            single = y.astype(np.float32)
        if (np.abs(y - single) <= near).all():
            rounding = max(
                rounding, float(np.sqrt((np.spacing(np.abs(single)).astype(np.float64) ** 2).mean() / 12.0)) * mm
            )
    return rounding


FEWEST_SHAPES = 4
"""Smallest number of shapes whose folds determine the number of modes."""
MOST_SHAPES = 2000
"""Largest sample of the shapes: the time grows with the cube of their number, and the standard error is small."""
_LEAST_NOISE = 1e-6  # share of the first variance per dimension, so that the likelihood of noise-free shapes is finite
_NO_VARIATION = 1e-24
"""Share of the variance of all shapes that is rounding error if the shapes are equal."""


@dataclass(frozen=True, eq=False)
class ModeChoice:
    """The error curve and the choice.

    Args:
        modes: smallest number of modes within one standard error of the best.
        candidates: (C,) int32 numbers of modes that were compared.
        error_mm: (C,) mean distance of hidden vertices from their prediction, mm.
        standard_error_mm: (C,) standard error of that mean over the held-out shapes, mm.
    """

    modes: int
    candidates: IntArray
    error_mm: FloatArray
    standard_error_mm: FloatArray


def choose_modes(data: FloatArray, *, folds: int = 5, seed: int = 0, counted: BoolArray | None = None) -> ModeChoice:
    """Choose the number of modes by held-out vertices with the one-standard-error rule.

    Of more than `MOST_SHAPES` shapes only the sample of `sample_shapes` is used, so that the time is bounded.

    In each fold the model is made without some shapes; half of the vertices of each are shown, coefficients are
    their maximum a posteriori, and the hidden half is predicted.

    Args:
        data: (N, 3V) aligned shapes, mm.
        folds: number of folds, at most N.
        seed: seed of the split and of the hidden halves.
        counted: (N, V) False for vertices that were filled in, which are no evidence; None if all are measured.

    Raises:
        InputError: fewer than four shapes.
    """
    n, d = data.shape
    if n < FEWEST_SHAPES:
        raise InputError(
            f"Choosing the number of modes by cross-validation needs at least {FEWEST_SHAPES} shapes, not {n}; "
            "ask for a number of modes or a share of the variance instead."
        )
    if n > MOST_SHAPES:
        rows = sample_shapes(n, seed)
        data, counted, n = data[rows], None if counted is None else counted[rows], len(rows)
    folds = min(folds, n)
    rng = np.random.default_rng(seed)
    parts = np.array_split(rng.permutation(n).astype(np.int32), folds)
    most = n - max(len(part) for part in parts) - 1
    spaced = {round(most ** (step / 23)) for step in range(24)}
    candidates: IntArray = np.array(sorted(spaced), dtype=np.int32)
    # Coordinate by coordinate, so that the summands of the three coordinates are contiguous.
    centred = np.ascontiguousarray((data - data.mean(axis=0)).reshape(n, -1, 3).transpose(0, 2, 1))
    gram = _gram(centred.reshape(n, d))
    errors = np.zeros((n, len(candidates)))
    for held_out in parts:
        observed = np.zeros(d // 3, dtype=np.bool_)
        observed[rng.permutation(d // 3)[: d // 6]] = True
        errors[held_out] = _hidden_errors(centred, gram, held_out, observed, candidates, counted)
    mean = errors.mean(axis=0)
    standard_error = errors.std(axis=0, ddof=1) / np.sqrt(n)
    best = int(mean.argmin())
    choice = int(np.flatnonzero(mean <= mean[best] + standard_error[best])[0])
    return ModeChoice(int(candidates[choice]), candidates, mean, standard_error)


def number_of_modes(modes: Modes, data: FloatArray, seed: int, counted: BoolArray | None = None) -> Modes:
    """Return `modes`; for `auto` the choice of `choose_modes`, or all for fewer than `FEWEST_SHAPES` shapes."""
    if modes != "auto":
        return modes
    return choose_modes(data, seed=seed, counted=counted).modes if len(data) >= FEWEST_SHAPES else "all"


def modes_notes(modes: Modes, kept: int, shapes: int, noun: str = "training shapes") -> list[str]:
    """Return why a model of `shapes` shapes has `kept` modes, in a sentence, if that is not the requested number."""
    if modes == "auto" and shapes < FEWEST_SHAPES:
        return [f"With {shapes} meshes the number of modes cannot be cross-validated, so all modes are kept."]
    if modes == "auto" and shapes > MOST_SHAPES:
        return [f"The number of modes is chosen on {MOST_SHAPES} of the {shapes} shapes, a random sample by the seed."]
    if isinstance(modes, int) and kept < modes:
        count = "1 mode" if kept == 1 else f"{kept} modes"
        return [f"The {shapes} {noun} determine {count}, so the model has {kept} and not the requested {modes}."]
    return []


def sample_shapes(n: int, seed: int) -> IntArray:
    """Return the indices, in order, of the shapes on which the number of modes is chosen: all, or `MOST_SHAPES`."""
    if n <= MOST_SHAPES:
        return np.arange(n, dtype=np.int32)
    return np.sort(np.random.default_rng(seed).permutation(n)[:MOST_SHAPES]).astype(np.int32)


def _coordinates_of(centred: FloatArray, vertices: BoolArray) -> FloatArray:
    return centred.take(np.flatnonzero(vertices), axis=2).reshape(len(centred), -1)


def _gram(rows: FloatArray) -> FloatArray:
    return np.asarray(rows @ rows.T, dtype=np.float64)


def _hidden_errors(
    centred: FloatArray,
    gram: FloatArray,
    held_out: IntArray,
    observed: BoolArray,
    candidates: IntArray,
    counted: BoolArray | None,
) -> FloatArray:
    """Return the mean error (H, C), mm, of the hidden vertices of the shapes `held_out` (H,), one column per candidate.

    A mode is a sum of training shapes, so all but the prediction itself is computed from the (N, N) products.

    Args:
        centred: (N, 3, V) all shapes minus their mean.
        gram: (N, N) products of the shapes over all coordinates.
        held_out: (H,) indices of the shapes that the model does not contain.
        observed: (V,) True for the vertices that coefficients are computed from.
        candidates: (C,) numbers of modes.
        counted: (N, V) False for vertices that are no evidence; None for all.
    """
    n, d = len(centred), centred[0].size
    known = np.setdiff1d(np.arange(n), held_out)
    shares = np.zeros((n, n))
    shares[:, known] = 1.0 / len(known)
    from_mean = np.eye(n) - shares
    within = from_mean @ gram @ from_mean.T
    within = within[np.ix_(known, known)]
    variance, sums = _modes_as_sums(within, float(gram.trace()))
    total = float(within.trace()) / (len(known) - 1)

    in_shown = from_mean @ _gram(_coordinates_of(centred, observed)) @ from_mean.T
    overlap = sums.T @ in_shown[np.ix_(known, known)] @ sums
    evidence = in_shown[np.ix_(held_out, known)] @ sums
    hidden = _coordinates_of(centred, ~observed)
    mean = hidden[known].mean(axis=0)
    # The sums of each column are zero except for rounding, so the mean need not be subtracted first.
    modes = sums.T @ hidden[known]
    residual = hidden[held_out] - mean
    weight = None
    if counted is not None:
        weight = counted[held_out][:, ~observed].astype(np.float64)
        weight /= np.maximum(weight.sum(axis=1, keepdims=True), 1.0)
    errors = np.empty((len(held_out), len(candidates)))
    for column, k in enumerate(candidates):
        count = min(int(k), len(variance))
        noise = max((total - variance[:count].sum()) / (d - count), _LEAST_NOISE * variance[0] / d)
        system = overlap[:count, :count] + noise * np.diag(1.0 / variance[:count])
        b: FloatArray = np.asarray(np.linalg.solve(system, evidence[:, :count].T), dtype=np.float64)
        wrong = (residual - b.T @ modes[:count]).reshape(len(held_out), 3, -1)
        distance = np.sqrt(wrong[:, 0] ** 2 + wrong[:, 1] ** 2 + wrong[:, 2] ** 2)
        errors[:, column] = distance.mean(axis=1) if weight is None else (distance * weight).sum(axis=1)
    return errors


def _modes_as_sums(products: FloatArray, of_all: float) -> tuple[FloatArray, FloatArray]:
    """Return the variances (R,) and modes (N, R) of shapes with centred `products` (N, N), as sums of these shapes."""
    n = len(products)
    if float(products.trace()) <= _NO_VARIATION * of_all:
        raise InputError(ALL_EQUAL)
    values, vectors = largest_eigenpairs(products)
    variance = varying(values / (n - 1))[: n - 1]
    return variance, vectors[:, : len(variance)] / np.sqrt(variance * (n - 1))
