"""Generalised Procrustes analysis of landmarks in 2-D and 3-D, with sliding semilandmarks and missing landmarks.

Rohlf and Slice, Syst. Zool. 39(1), 1990; Gunz, Mitteroecker and Bookstein, in Modern Morphometrics in Physical
Anthropology, 2005; Gunz et al., J. Hum. Evol. 57(1), 2009. The order of the steps, the criterion that ends them and the
orientation are those of `gpagen` in geomorph 4.0, except that the set is never reflected. Equations Mn are those of
docs/morphometrics.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal, TypeAlias, get_args

import numpy as np

from shapespace.errors import InputError
from shapespace.geometry.procrustes import Gauge
from shapespace.geometry.similarity import fit_rotations
from shapespace.geometry.thin_plate_spline import ThinPlateSpline, bending_energy_matrix
from shapespace.reprs import list_briefly, short_repr
from shapespace.types import BoolArray, FloatArray, IntArray, read_only

if TYPE_CHECKING:
    from shapespace.io.landmarks.landmark_configurations import LandmarkConfigurations

SlidingCriterion: TypeAlias = Literal["bending-energy", "procrustes"]
MissingMethod: TypeAlias = Literal["tps", "regression", "refuse"]

_ITERATIONS, _SLIDING_ITERATIONS = 5, 10
"""Largest numbers of iterations without and with semilandmarks, as in `gpagen`."""
_NEIGHBOURS = 5  # landmarks, the sliding one among them, whose principal axes span the tangent plane; as in `gpagen`
_FLAT = 1e-9  # ratio of singular values; landmarks nearer to a line than rounding
_MOST_MISSING = 0.5  # share of the specimens that may lack a landmark
_AXIS_SPECIMENS = 10  # complete specimens for each PLS axis of a regression, the usual rule for regressors
_OUTLIER = 2.5, 0.5
"""Robust standard score of an outlier: a constant, and a factor of the logarithm of the number of landmarks, since the
largest of more displacements has a longer tail; 5 % of clean sets of 20 to 400 specimens exceed it (simulated)."""
_MAD = 1.4826  # standard deviations of a normal distribution in a median absolute deviation
_LEAST_SPREAD = 0.01  # of log displacements; specimens within 1 % of each other do not differ
_MATCHING_ITERATIONS = 20  # limit; alternates starts of curves and mean; simulated outlines need 3 to 8
_STILL = 1e-3  # movement of a start, in points, that ends the iteration; below digitisation accuracy
_ROUNDING = 1e-9  # of the size; displacements below it are rounding
_MIRRORED, _SWAPPED = 0.5, 0.6
"""A specimen is mirrored, or has swapped landmarks, if reflection or exchange reduces its Procrustes distance to this
share; no specimen of the published sets in tests reaches 0.8 by chance."""
_SWAP_CANDIDATES, _SWAP_GAIN = 5, 0.3
"""Most pairs of landmarks whose exchange is superimposed exactly, and the share of the squared distance that it must
remove before; an exchange to the share `_SWAPPED` of the distance removes twice as much after it."""


@dataclass(frozen=True, kw_only=True)
class AlignConfig:
    """Options of the alignment of landmarks.

    Args:
        gauge: `shape` scales each specimen to unit centroid size; `form` keeps its size.
        tangent: project shapes orthogonally onto the tangent space at their mean.
        slide_by: criterion that sliding semilandmarks minimise: `bending-energy` of the thin-plate spline from the
            mean, or `procrustes`, the distance from the mean (default: bending-energy; for outlines and other data
            where at most as many landmarks as dimensions do not slide, procrustes, because affine movements of all
            points along a curve have no bending energy)
        missing: estimation of missing landmarks from complete specimens: by thin-plate spline of their mean (`tps`), by
            `regression` on the scores of partial least squares. The third choice of `MissingMethod` raises an error for
            specimens with missing landmarks.
        structures: structure of each landmark; structures are aligned separately, and combined at their relative
            centroid sizes. None for one structure.
        tolerance: change of the summed squared distances from the mean, in units of the squared centroid size, that
            ends the alignment.
        iterations: largest number of iterations (default: 5, or 10 with semilandmarks, as in geomorph).
        match_curves: whether to move the start of closed curves, and reverse curves, if this brings a specimen nearer
            to the mean; False keeps starts and directions of the file.

    Example:
        >>> config = ss.geometry.AlignConfig(gauge="form")
        >>> ss.geometry.align_landmarks(configurations, config).gauge
        'form'
    """

    gauge: Gauge = "shape"
    tangent: bool = True
    slide_by: SlidingCriterion | None = None
    missing: MissingMethod = "tps"
    structures: Mapping[str, str] | None = None
    tolerance: float = 1e-4
    iterations: int | None = None
    match_curves: bool = True

    def __post_init__(self) -> None:
        for name, value, choices in (
            ("gauge", self.gauge, get_args(Gauge)),
            ("slide_by", self.slide_by or "procrustes", get_args(SlidingCriterion)),
            ("missing", self.missing, get_args(MissingMethod)),
        ):
            if value not in choices:
                raise InputError(f"AlignConfig: there is no {name} {value!r}; choose one of {', '.join(choices)}.")
        if not self.tolerance >= 0 or (self.iterations is not None and self.iterations < 1):
            raise InputError("AlignConfig: the tolerance must be 0 or more, and the iterations 1 or more.")


@dataclass(frozen=True, eq=False, kw_only=True)
class AlignedLandmarks:
    """Landmarks of N specimens after generalised Procrustes analysis.

    Args:
        names: N names of specimens.
        landmarks: L names of landmarks.
        coords: (N, L, D) aligned coordinates with D 2 or 3.
        sizes: (N,) centroid sizes in the unit of the file.
        columns: name -> N cells of covariates.
        estimated: (N, L) True for missing landmarks, whose positions are estimates.
        gauge: `shape` or `form`.
        tangent: whether `coords` are projected onto the tangent space at their mean, as one structure.
        unit: unit of `sizes`, and of `coords` in the gauge `form`: `mm`, or empty if unknown.
        iterations: number of iterations; with separate structures the largest one.
        converged: False if the iterations ended before the criterion was met.
        where: name of the data in messages.
        notes: sentences about the data and the alignment.

    Example:
        >>> aligned = ss.geometry.align_landmarks(configurations)
        >>> aligned.sizes.shape
        (6,)
    """

    names: tuple[str, ...]
    landmarks: tuple[str, ...]
    coords: FloatArray
    sizes: FloatArray
    estimated: BoolArray
    columns: Mapping[str, tuple[str, ...]] = field(default_factory=dict[str, tuple[str, ...]])
    gauge: Gauge = "shape"
    tangent: bool = False
    unit: str = ""
    iterations: int = 0
    converged: bool = True
    where: str = "The landmarks"
    notes: tuple[str, ...] = ()

    __repr__ = short_repr

    def __len__(self) -> int:
        return len(self.names)

    @property
    def dimensions(self) -> int:
        """Dimension of the space, 2 or 3."""
        return int(self.coords.shape[2])

    @property
    def mean(self) -> FloatArray:
        """(L, D) mean of the aligned coordinates."""
        return self.coords.mean(axis=0)

    @property
    def forms(self) -> FloatArray:
        """(N, L, D) aligned coordinates with their centroid sizes, without projection."""
        if self.gauge == "form":
            return self.coords
        coords = self.coords
        if self.tangent:
            away = coords - self.mean
            along = np.sqrt(np.maximum(1.0 - (away**2).sum(axis=(1, 2)), 0.0))
            coords = away + along[:, None, None] * self.mean
        return coords * self.sizes[:, None, None]


@dataclass(frozen=True)
class LandmarkFinding:
    """A specimen to check.

    Args:
        specimen: name of the specimen.
        reason: `outlier`, `swapped` (landmarks) or `mirrored`.
        value: displacement of the most displaced landmark of an outlier, in units of the median displacement of this
            landmark; otherwise the share to which exchange or reflection reduces the Procrustes distance from the mean.
        landmarks: names of the two swapped landmarks, or of the most displaced landmark of an outlier.

    Example:
        >>> findings = ss.geometry.find_outliers(ss.geometry.align_landmarks(configurations))
        >>> [finding.reason for finding in findings]
        []
    """

    specimen: str
    reason: Literal["outlier", "swapped", "mirrored"]
    value: float
    landmarks: tuple[str, ...] = ()

    def __str__(self) -> str:
        if self.reason == "outlier":
            return (
                f"{self.specimen} is an outlier: its landmark {self.landmarks[0]} lies {self.value:.1f} times as far "
                "from the mean as in half of the specimens; check its landmarks."
            )
        fall = f"reduces its Procrustes distance from the mean to {100 * self.value:.0f} %"
        if self.reason == "mirrored":
            return f"{self.specimen} is mirrored: reflection {fall}; reflect or exclude it."
        return f"{self.specimen}: exchange of the landmarks {' and '.join(self.landmarks)} {fall}; check their order."


def align_landmarks(configurations: LandmarkConfigurations, config: AlignConfig | None = None) -> AlignedLandmarks:
    """Return landmarks after generalised Procrustes analysis; missing landmarks are estimated before.

    Args:
        configurations: landmarks of two or more specimens.
        config: options of the alignment; None for the defaults.

    Raises:
        InputError: one specimen, fewer than three landmarks, landmarks on a line, too many missing landmarks, invalid
            sliders, or structures that do not contain each landmark.

    Example:
        >>> ss.geometry.align_landmarks(configurations).coords.shape
        (6, 10, 3)
    """
    config = with_criterion(config or AlignConfig(), configurations)
    if config.match_curves and len(configurations) > 1:
        configurations = match_curves(configurations)
    points, notes = _estimate_missing(configurations, config)
    _check_sliders(configurations)
    chosen = _structures(configurations, config)
    parts: list[Superimposition] = []
    sizes = np.zeros((len(chosen), len(points)))
    for row, members in enumerate(chosen):
        part = points[:, members]
        _check_degenerate(part, configurations)
        own = np.full(points.shape[1], -1, dtype=np.int32)
        own[members] = np.arange(len(members))
        curves = own[configurations.curve_sliders]
        curves = curves[curves[:, 1] >= 0]
        surface = own[configurations.surface_sliders]
        sizes[row] = np.linalg.norm(part - part.mean(axis=1, keepdims=True), axis=(1, 2))  # M1
        parts.append(superimpose(part, config, curves, surface[surface >= 0]))
    total = np.sqrt((sizes**2).sum(axis=0))
    coords = np.empty_like(points)
    for members, part, size in zip(chosen, parts, sizes, strict=True):
        relative = size / total if config.gauge == "shape" and len(parts) > 1 else np.ones(len(points))
        coords[:, members] = part.coords * relative[:, None, None]  # M10
    iterations, converged = max(part.iterations for part in parts), all(part.converged for part in parts)
    if not converged:
        notes.append(
            f"The alignment ended after {iterations} iterations, before the summed squared distances changed by less "
            f"than {config.tolerance:g}, as gpagen of geomorph ends it; increase the limit with --set iterations=N."
        )
    return AlignedLandmarks(
        names=configurations.names,
        landmarks=configurations.landmarks,
        coords=read_only(coords),
        sizes=read_only(total),
        estimated=~configurations.observed,
        columns=configurations.columns,
        gauge=config.gauge,
        tangent=config.tangent and config.gauge == "shape" and len(parts) == 1,
        unit=configurations.unit,
        iterations=iterations,
        converged=converged,
        where=configurations.where,
        notes=(*configurations.notes, *notes),
    )


def with_criterion(config: AlignConfig, configurations: LandmarkConfigurations) -> AlignConfig:
    """Return a configuration with the criterion by which the semilandmarks of these landmarks slide."""
    sliding = {*configurations.curve_sliders[:, 1].tolist(), *configurations.surface_sliders.tolist()}
    is_held = len(configurations.landmarks) - len(sliding) > configurations.dimensions
    return replace(config, slide_by=config.slide_by or ("bending-energy" if is_held else "procrustes"))


@dataclass(frozen=True, eq=False)
class Superimposition:
    """Coordinates (N, L, D) after generalised Procrustes analysis, and how it ended."""

    coords: FloatArray
    iterations: int
    converged: bool


def superimpose(
    points: FloatArray, config: AlignConfig, curves: IntArray | None = None, surface: IntArray | None = None
) -> Superimposition:
    """Superimpose complete landmarks (N, L, D) by rotations, with semilandmarks that slide.

    The axes are the principal axes of the mean, each with a positive component on the original axis of its number; the
    last axis is reversed if the set would otherwise be reflected.

    Args:
        points: (N, L, D) landmarks in any poses and sizes.
        config: options of the alignment.
        curves: (M, 3) indices of the landmarks before, sliding and after.
        surface: (S,) indices of the landmarks that slide in tangent planes.
    """
    n = len(points)
    curves = np.zeros((0, 3), np.int32) if curves is None else curves
    surface = np.zeros(0, np.int32) if surface is None else surface
    slides = len(curves) + len(surface) > 0
    centred = points - points.mean(axis=1, keepdims=True)
    size = np.linalg.norm(centred, axis=(1, 2))  # M1
    unit = np.sqrt((size**2).mean()) if config.gauge == "form" and not slides else size
    coords = centred / np.reshape(unit, (-1, 1, 1))
    coords = _rotate_to(coords, coords[0])
    mean = coords.mean(axis=0)
    most = config.iterations or (_SLIDING_ITERATIONS if slides else _ITERATIONS)
    squares, iterations = n * float((mean**2).sum()), 1
    converged = not slides and n - squares <= config.tolerance
    while not converged and iterations < most:
        iterations += 1
        if slides:
            B = None if config.slide_by == "procrustes" else bending_energy_matrix(mean)
            slid = np.stack([_slide(x, mean, curves, surface, B) for x in coords])
            previous, squares = squares, n * float((slid.mean(axis=0) ** 2).sum())
            coords = _rotate_to(slid, mean)
            mean = coords.mean(axis=0)
            mean = mean / np.linalg.norm(mean - mean.mean(axis=0))
        else:
            coords = _rotate_to(coords, mean)
            mean = coords.mean(axis=0)
            previous, squares = squares, n * float((mean**2).sum())
        converged = abs(previous - squares) <= config.tolerance  # M3
    if config.gauge == "form" and slides:
        rigid = superimpose(coords * size[:, None, None], replace(config, iterations=most))
        return Superimposition(rigid.coords, iterations, converged and rigid.converged)
    axes = np.linalg.svd(mean - mean.mean(axis=0))[2].T
    axes = axes * np.where(np.diag(axes) < 0, -1.0, 1.0)
    axes[:, -1] *= np.sign(np.linalg.det(axes))
    coords = coords @ axes
    if config.gauge == "form":
        return Superimposition(coords * unit, iterations, converged)
    return Superimposition(project_to_tangent(coords) if config.tangent else coords, iterations, converged)


def match_curves(configurations: LandmarkConfigurations, mean: FloatArray | None = None) -> LandmarkConfigurations:
    """Return landmarks whose curves have corresponding starts and directions in all specimens.

    The start of a closed curve is placed where the Procrustes distance from the mean is smallest; it may lie between
    two points of the curve. A closed curve in the plane is given the direction (clockwise or anticlockwise) of the
    curve in the mean; in 3-D, the direction with the smaller distance from the mean.
    An open curve is reversed if this halves its distance from the mean. Curves with missing points are unchanged.

    Args:
        configurations: landmarks of specimens in any poses and sizes.
        mean: (L, D) landmarks to match; None for the mean of the specimens, computed in alternation with the starts.
    """
    points, curves = configurations.points, [(np.array(at), closed) for at, closed in configurations.curves]
    usable = np.array([[len(at) > 2 and np.isfinite(x[at]).all() and np.ptp(x[at]) > 0 for at, _ in curves]
                       for x in points], dtype=np.bool_)  # fmt: skip
    whole = np.logical_and(np.isfinite(points).all(axis=(1, 2)), usable.all(axis=1))
    if not curves or (mean is None and not whole.any()):
        return configurations
    on_curves = [i for at, _ in curves for i in at.tolist()]
    shift, is_reversed = np.zeros(usable.shape), np.zeros(usable.shape, dtype=np.bool_)
    target: FloatArray = points[int(np.argmax(whole))] if mean is None else mean
    moved, change = points.copy(), np.inf
    for step in range(_MATCHING_ITERATIONS):
        if step and mean is None:
            target = superimpose(moved[whole], AlignConfig(tangent=False)).coords.mean(axis=0)
        change = 0.0
        for k, c in np.argwhere(usable).tolist():
            at, closed = curves[c]
            # In the first step, a curve is aligned by the landmarks and the preceding curves.
            known = np.isfinite(moved[k]).all(axis=1)
            known[on_curves[on_curves.index(at[0]) :] if step == 0 else at] = False
            by, reverse = _best_start(moved[k], target, known, at, closed)
            is_reversed[k, c] ^= reverse
            # The order of points is backwards along a reversed curve.
            shift[k, c] += -by if is_reversed[k, c] else by
            if by or reverse:
                moved[k, at] = _restart_curve(points[k, at], shift[k, c], bool(is_reversed[k, c]), closed)
            change = max(change, abs(by), float(reverse))
        if change < _STILL:
            break
    notes = list[str]()
    for c, (at, closed) in enumerate(curves):
        # The direction of the majority of specimens is kept.
        if mean is None and 2 * is_reversed[:, c].sum() > len(points):
            for k in np.flatnonzero(usable[:, c]).tolist():
                moved[k, at] = moved[k, np.append(at[0], at[:0:-1]) if closed else at[::-1]]
                is_reversed[k, c] ^= True
        if is_reversed[:, c].any():
            names = list_briefly([configurations.names[k] for k in np.flatnonzero(is_reversed[:, c]).tolist()])
            notes.append(f"Curve {c + 1} has the opposite direction in {names}, and is reversed there.")
    if any(closed for _, closed in curves):
        notes.append("Closed curves start at the best fit to the mean; match_curves=no keeps their first points.")
    return replace(configurations, points=read_only(moved), notes=(*configurations.notes, *notes))


def _best_start(x: FloatArray, mean: FloatArray, known: BoolArray, at: IntArray, closed: bool) -> tuple[float, bool]:
    """Return the shift of the start (in points) and the reversal with which a curve and `known` points fit best."""
    own, target, n = x[at], mean[at], int(known.sum()) + len(at)
    base = x[known].T @ mean[known] - np.outer(x[known].sum(axis=0) + own.sum(axis=0),
                                               mean[known].sum(axis=0) + target.sum(axis=0)) / n  # fmt: skip
    orders = [own, np.roll(own[::-1], 1, axis=0) if closed else own[::-1]]
    same_area = _area(target) * _area(own) if closed and x.shape[1] == 2 else 0.0
    # Sums over the points for all starts, by the correlation theorem.
    spectrum = np.conj(np.fft.rfft(target, axis=0))[:, None, :]
    products = np.stack([
        np.fft.irfft(np.fft.rfft(order, axis=0)[:, :, None] * spectrum, n=len(at), axis=0)[: None if closed else 1]
        for order in orders
    ]) + base  # fmt: skip
    if not closed:
        R = fit_rotations(products[:, 0])
        away = list[float]()
        for order, rotation in zip(orders, R, strict=True):
            both = np.concatenate([x[known], order]) @ rotation.T, np.concatenate([mean[known], target])
            own, other = (part - part.mean(axis=0) for part in both)
            own = own * ((own * other).sum() / (own**2).sum())
            away.append(float(np.linalg.norm((own - other)[-len(at) :])))
        return 0.0, away[1] < _MIRRORED * away[0]
    singular = np.linalg.svd(products, compute_uv=False)
    score = singular.sum(axis=2) - 2 * singular[..., -1] * (np.linalg.det(products) < 0)
    if same_area:
        score[int(same_area > 0)] = -np.inf
    order, start = (int(i) for i in np.unravel_index(int(np.argmax(score)), score.shape))
    before, best, after = (float(score[order, (start + i) % len(at)]) for i in (-1, 0, 1))
    curvature = before - 2 * best + after
    fraction = 0.5 * (before - after) / curvature if curvature < 0 else 0.0
    return (start + fraction + len(at) / 2) % len(at) - len(at) / 2, order == 1


def _restart_curve(own: FloatArray, shift: float, is_reversed: bool, closed: bool) -> FloatArray:
    """Return a curve (P, D) reversed, and then started `shift` points later, by periodic cubic splines."""
    if not closed:
        return own[::-1] if is_reversed else own
    from scipy.interpolate import CubicSpline

    ring = np.concatenate([own, own[:1]])
    places = np.arange(len(own))
    at = (shift + (-places if is_reversed else places)) % len(own)
    return np.asarray(CubicSpline(np.arange(len(ring)), ring, bc_type="periodic")(at), dtype=np.float64)


def _area(ring: FloatArray) -> float:
    """Return the signed area of a closed curve (P, 2) in the plane."""
    x, y = ring.T
    return 0.5 * float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum())


def project_to_tangent(coords: FloatArray, mean: FloatArray | None = None) -> FloatArray:
    """Return shapes (N, L, D) of unit centroid size projected orthogonally onto the tangent space at their mean.

    Args:
        coords: (N, L, D) aligned shapes.
        mean: (L, D) mean of another set; None for that of `coords`.
    """
    middle: FloatArray = coords.mean(axis=0) if mean is None else mean
    middle = (middle - middle.mean(axis=0)) / np.linalg.norm(middle - middle.mean(axis=0))
    along: FloatArray = (coords * middle).sum(axis=(1, 2))
    return coords + (1.0 - along)[:, None, None] * middle  # M4


def _rotate_to(coords: FloatArray, target: FloatArray) -> FloatArray:
    """Return `coords` (N, L, D) rotated to `target` (L, D) by least squares."""
    return coords @ fit_rotations(np.einsum("nli,lj->nij", coords, target)).transpose(0, 2, 1)  # M2


def _slide(x: FloatArray, mean: FloatArray, curves: IntArray, surface: IntArray, B: FloatArray | None) -> FloatArray:
    """Return a specimen (L, D) with its semilandmarks moved along its tangents.

    The movements minimise the bending energy with matrix `B` (L, L), or the Procrustes distance if `B` is None.
    """
    tangents = x[curves[:, 2]] - x[curves[:, 0]]
    lengths = np.linalg.norm(tangents, axis=1, keepdims=True)
    directions, sliding = [tangents / np.where(lengths > 0, lengths, 1.0)], [curves[:, 1]]
    if len(surface):
        squares = ((x[surface][:, None] - x) ** 2).sum(axis=2)
        near = x[np.argsort(squares, axis=1, kind="stable")[:, :_NEIGHBOURS]]
        planes = np.linalg.svd(near - near.mean(axis=1, keepdims=True))[2]
        directions += [planes[:, 0], planes[:, 1]]
        sliding += [surface, surface]
    U, at = np.concatenate(directions), np.concatenate(sliding)
    offset = x - mean
    steps: FloatArray = (U * (offset if B is None else B @ offset)[at]).sum(axis=1)  # M7
    if B is not None:
        system: FloatArray = (U @ U.T) * B[np.ix_(at, at)]
        try:
            steps = np.asarray(np.linalg.solve(system, steps), dtype=np.float64)  # M6
        except np.linalg.LinAlgError:
            steps = np.asarray(np.linalg.lstsq(system, steps)[0], dtype=np.float64)
    out = x.copy()
    np.subtract.at(out, at, steps[:, None] * U)
    return out


def find_outliers(aligned: AlignedLandmarks) -> tuple[LandmarkFinding, ...]:
    """Return the specimens that are mirrored, have swapped landmarks, or are far from the mean.

    Distances are from the median of the coordinates, which is robust to few outliers. The score of a specimen is the
    logarithm of its largest displacement of a landmark, relative to the median displacement of that landmark, so that
    variation of many landmarks does not hide a displaced landmark.

    Args:
        aligned: aligned landmarks of three or more specimens; with fewer the result is empty.

    Example:
        >>> findings = ss.geometry.find_outliers(ss.geometry.align_landmarks(configurations))
        >>> isinstance(findings, (list, tuple))
        True
    """
    if len(aligned) < 3:
        return ()
    middle = np.median(aligned.coords, axis=0)
    middle = (middle - middle.mean(axis=0)) / np.linalg.norm(middle - middle.mean(axis=0))
    x = aligned.coords - aligned.coords.mean(axis=1, keepdims=True)
    x = x / np.linalg.norm(x, axis=(1, 2))[:, None, None]

    def distances(shapes: FloatArray) -> FloatArray:
        return np.linalg.norm(_rotate_to(shapes, middle) - middle, axis=(1, 2))

    displacements = np.linalg.norm(_rotate_to(x, middle) - middle, axis=2)
    own = np.linalg.norm(displacements, axis=1)
    moved = np.maximum(displacements, _ROUNDING)
    moved /= np.median(moved, axis=0)
    mirrored = distances(x * np.append(-1.0, np.ones(aligned.dimensions - 1)))
    logs = np.log(moved.max(axis=1))
    logs -= np.median(logs)
    scores = logs / max(_MAD * float(np.median(np.abs(logs))), _LEAST_SPREAD)  # M11
    bound = _OUTLIER[0] + _OUTLIER[1] * float(np.log(len(middle)))
    findings: list[LandmarkFinding] = []
    for k, name in enumerate(aligned.names):
        if mirrored[k] <= _MIRRORED * own[k]:
            findings.append(LandmarkFinding(name, "mirrored", float(mirrored[k] / own[k])))
            continue
        swaps = _swaps(x[k], middle, _SWAP_GAIN * own[k] ** 2)
        after = distances(np.stack([x[k][order] for order in swaps])) if swaps else np.array([np.inf])
        best = int(np.argmin(after))
        if after[best] <= _SWAPPED * own[k]:
            pair = tuple(aligned.landmarks[int(i)] for i in np.flatnonzero(swaps[best] != np.arange(len(middle))))
            findings.append(LandmarkFinding(name, "swapped", float(after[best] / own[k]), pair))
        elif scores[k] > bound:
            worst = int(np.argmax(moved[k]))
            findings.append(LandmarkFinding(name, "outlier", float(moved[k, worst]), (aligned.landmarks[worst],)))
    return tuple(findings)


def _swaps(x: FloatArray, middle: FloatArray, least: float) -> list[IntArray]:
    """Return orders (L,) with a pair of landmarks exchanged that reduces the squared distance by `least` or more."""
    cross = x @ middle.T
    own = np.diag(cross)
    gain = 2 * (cross + cross.T - own[:, None] - own)
    if gain.max() < least:
        return []
    gain = np.triu(gain, 1)
    largest = np.partition(gain, -_SWAP_CANDIDATES, axis=None)[-_SWAP_CANDIDATES]
    first, second = np.nonzero(gain >= max(least, float(largest)))
    orders: list[IntArray] = []
    for a, b in zip(first.tolist(), second.tolist(), strict=True):
        order = np.arange(len(x), dtype=np.int32)
        order[[a, b]] = b, a
        orders.append(order)
    return orders


def _estimate_missing(configurations: LandmarkConfigurations, config: AlignConfig) -> tuple[FloatArray, list[str]]:
    """Return the points (N, L, D) with estimates of missing landmarks, and notes on them."""
    points, where = configurations.points, configurations.where
    observed, (n, L, D) = configurations.observed, configurations.points.shape
    if n < 2:
        raise InputError(f"{where}: one specimen cannot be aligned; give two or more.")
    if L < 3:
        raise InputError(f"{where}: {L} landmarks have no shape; at least three are needed.")
    if np.isinf(points).any():
        raise InputError(f"{where}: a coordinate is infinite; correct it, or leave it empty if it is missing.")
    missing = ~observed
    if not missing.any():
        return points, []
    incomplete = np.flatnonzero(missing.any(axis=1))
    first = configurations.names[int(incomplete[0])]
    if config.missing == "refuse":
        raise InputError(
            f"{where}: {len(incomplete)} of {n} specimens lack landmarks (such as {first}); exclude these, or "
            "estimate the landmarks with --missing tps."
        )
    few = np.flatnonzero(observed.sum(axis=1) < D + 1)
    if len(few):
        count, name = int(observed[few[0]].sum()), configurations.names[int(few[0])]
        raise InputError(
            f"{where}: {count or 'no'} landmark{'s are' if count != 1 else ' is'} observed of {name}, "
            f"and at least {D + 1} are needed to estimate the others; exclude this specimen."
        )
    share = missing.mean(axis=0)
    worst = int(np.argmax(share))
    complete = np.flatnonzero(~missing.any(axis=1))
    if share[worst] > _MOST_MISSING or len(complete) < 2:
        problem = "" if share[worst] > _MOST_MISSING else f", and {len(complete)} specimens have all landmarks"
        raise InputError(
            f"{where}: landmark {configurations.landmarks[worst]} is missing in {int(missing[:, worst].sum())} of {n} "
            f"specimens{problem}; exclude that landmark, or the specimens without it."
        )
    centred = points[complete] - points[complete].mean(axis=1, keepdims=True)
    form = superimpose(centred, AlignConfig()).coords * np.linalg.norm(centred, axis=(1, 2))[:, None, None]
    mean, out = form.mean(axis=0), points.copy()
    for k in map(int, incomplete):
        seen = observed[k]
        try:
            if config.missing == "tps":
                out[k, ~seen] = ThinPlateSpline.fit(mean[seen], points[k, seen]).apply(mean[~seen])  # M8
            else:
                out[k, ~seen] = _estimate_by_regression(form, points[k], seen)
        except InputError as error:
            raise InputError(
                f"{where}: the observed landmarks of {configurations.names[k]} do not determine the others, since they "
                "lie on a line or a plane; exclude this specimen."
            ) from error
    count = int(missing.sum())
    noun = "landmark is an estimate" if count == 1 else "landmarks are estimates"
    names = list_briefly([configurations.names[int(k)] for k in incomplete])
    return out, [f"{count} missing {noun} ({config.missing}, from {len(complete)} complete specimens): {names}."]


def _estimate_by_regression(form: FloatArray, points: FloatArray, seen: BoolArray) -> FloatArray:
    """Return the missing landmarks (M, D) of a specimen by regression on PLS scores of the observed landmarks.

    Args:
        form: (n, L, D) complete specimens, aligned with their sizes.
        points: (L, D) landmarks of the specimen.
        seen: (L,) mask of its observed landmarks.
    """
    n, _, D = form.shape
    x, y = form[:, seen].reshape(n, -1), form[:, ~seen].reshape(n, -1)
    x_mean, y_mean = x.mean(axis=0), y.mean(axis=0)
    centre, target = points[seen].mean(axis=0), x_mean.reshape(-1, D).mean(axis=0)
    own = points[seen] - centre
    rotation = fit_rotations((own.T @ (x_mean.reshape(-1, D) - target))[None])[0]
    axes = np.linalg.svd((x - x_mean).T @ (y - y_mean), full_matrices=False)[0][:, : max(1, n // _AXIS_SPECIMENS)]
    slopes = np.asarray(np.linalg.lstsq((x - x_mean) @ axes, y - y_mean)[0], dtype=np.float64)
    scores = ((own @ rotation.T + target).ravel() - x_mean) @ axes
    return ((y_mean + scores @ slopes).reshape(-1, D) - target) @ rotation + centre  # M9


def _structures(configurations: LandmarkConfigurations, config: AlignConfig) -> list[IntArray]:
    """Return the indices of the landmarks of each structure."""
    names = configurations.landmarks
    if config.structures is None:
        return [np.arange(len(names), dtype=np.int32)]
    where, given = configurations.where, config.structures
    unknown = [name for name in given if name not in names] or [name for name in names if not given.get(name)]
    if unknown:
        raise InputError(
            f"{where}: landmark {unknown[0]!r} "
            + ("does not exist" if unknown[0] not in names else "has no structure")
            + "; the table of --separate names each landmark once, and its structure."
        )
    structure = np.array([given[name] for name in names])
    for row in configurations.curve_sliders:
        if len(set(structure[row])) > 1:
            raise InputError(f"{where}: landmark {names[row[1]]!r} slides between landmarks of different structures; "
                             "correct the sliders.")  # fmt: skip
    return [np.flatnonzero(structure == label).astype(np.int32) for label in dict.fromkeys(structure.tolist())]


def _check_sliders(configurations: LandmarkConfigurations) -> None:
    curves, surface = configurations.curve_sliders, configurations.surface_sliders
    where, L = configurations.where, len(configurations.landmarks)
    every = np.concatenate([curves.ravel(), surface])
    outside = every[(every < 0) | (every >= L)]
    if len(outside):
        raise InputError(f"{where}: the sliders contain landmark {int(outside[0]) + 1} of {L}; correct them.")
    sliding, counts = np.unique(np.concatenate([curves[:, 1], surface]), return_counts=True)
    if (counts > 1).any():
        name = configurations.landmarks[int(sliding[counts > 1][0])]
        raise InputError(f"{where}: landmark {name} slides twice; list it once in the sliders.")
    repeated = curves[(curves[:, 0] == curves[:, 1]) | (curves[:, 2] == curves[:, 1]) | (curves[:, 0] == curves[:, 2])]
    if len(repeated):
        name = configurations.landmarks[int(repeated[0, 1])]
        raise InputError(f"{where}: landmark {name} needs two other landmarks, before and after, to slide between.")
    if len(surface) and configurations.dimensions == 2:
        raise InputError(f"{where}: semilandmarks slide on surfaces in 3-D only; use curves for planar landmarks.")


def _check_degenerate(points: FloatArray, configurations: LandmarkConfigurations) -> None:
    if points.shape[1] < 3:
        raise InputError(f"{configurations.where}: a structure of {points.shape[1]} landmarks has no shape; at least "
                         "three are needed.")  # fmt: skip
    spread = np.linalg.svd(points - points.mean(axis=1, keepdims=True), compute_uv=False)
    flat = np.flatnonzero(spread[:, 1] <= _FLAT * spread[:, 0])
    if len(flat):
        k = int(flat[0])
        place = "lie on a line" if spread[k, 0] > 0 else "coincide"
        raise InputError(
            f"{configurations.where}: all landmarks of {configurations.names[k]} {place}; correct them, or leave it "
            "out."
        )
