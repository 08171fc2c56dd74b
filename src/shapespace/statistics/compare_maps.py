"""Changes of shape tested at every vertex; the largest F of each arrangement controls the family-wise error.

A change can also be tested relative to the variation between shapes: at each vertex a bump of given width along the
normals, by its matched filter in the covariance of the residuals (as in Fisher's linear discriminant; the covariance is
shrunk by Ledoit and Wolf, J. Multivariate Analysis 88, 2004, towards that of the model and the noise of the fits).

Nichols and Holmes, Human Brain Mapping 15, 2001; Benjamini and Hochberg, JRSS B 57(1), 1995.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from shapespace.cohort.cohort import Cohort
from shapespace.geometry.normals import vertex_normals
from shapespace.lazy import require_package
from shapespace.reprs import short_repr
from shapespace.statistics.compare_formula import INSTALL
from shapespace.statistics.compare_strata import Stratum
from shapespace.statistics.dispersion import EffectEstimate
from shapespace.statistics.tolerances import TIE
from shapespace.types import BoolArray, FloatArray, Mesh, read_only

_VERTICES = 512  # vertices at a time; with _BYTES it bounds the memory of permuted values
_BYTES = 48 * 2**20  # bytes of permuted values at a time
_NONE = 1e-12  # share of the squares; a residual below is rounding
_BINS = 6000
"""Number of bins of the logarithm of F, from a millionth to a million."""
_REACH = 2.5
"""Number of standard deviations after which a bump ends."""
_FLOOR = 1e-6  # share of the mean variance that the error variance is at least, so that the matrix is invertible


@dataclass(frozen=True, eq=False)
class Tested:
    """A statistic at each vertex.

    Args:
        f: (V,) squared change divided by its variance.
        p: (V,) share of arrangements with an F as large at the vertex.
        p_family: (V,) share of arrangements whose largest F of all vertices is as large: with `p_family` below 5 % a
            map without any effect shows a vertex in 5 % of studies.
        critical: F above which `p_family` is at most the level of the intervals: the change ± its length times
            sqrt(critical / f) is an interval that is simultaneous over all vertices.
        q: (V,) false discovery rate at which the vertex is found, from the F of all vertices in all arrangements, which
            have the same distribution without an effect; p of a single vertex has too few different values.
    """

    f: FloatArray
    p: FloatArray
    p_family: FloatArray
    q: FloatArray
    critical: float

    __repr__ = short_repr


@dataclass(frozen=True, eq=False)
class EffectMap:
    """A change of shape at each vertex.

    Args:
        change_mm: (V, 3) change, mm.
        normal_mm: (V,) change along the normal of the mean, outwards positive; None for points.
        length_mm: (V,) length of the change, mm.
        along: test of `normal_mm`; None for points.
        any_way: test of `change_mm` in any direction.
        bump_mm: (V,) height, for each vertex, of the bump centred there that explains the change best; None if no bumps
            were searched for.
        bump: test of `bump_mm`.
        weight: (V,) factor by which F is multiplied: the share of the information at each vertex that the observations
            contain (`information`); 0 where the map is blank. None if all vertices are observed.
    """

    change_mm: FloatArray
    normal_mm: FloatArray | None
    length_mm: FloatArray
    along: Tested | None
    any_way: Tested
    bump_mm: FloatArray | None = None
    bump: Tested | None = None
    weight: FloatArray | None = None

    @property
    def blank(self) -> BoolArray | None:
        """(V,) bool, where the map is blank because too few shapes observe the vertex; None if nowhere."""
        return None if self.weight is None or self.weight.all() else self.weight == 0

    __repr__ = short_repr

    def interval_mm(self, vertex: int) -> tuple[float, float]:
        """Return the interval of `shown_mm` at a vertex, which is simultaneous over all vertices."""
        f, change = float(self.test.f[vertex]), float(self.shown_mm[vertex])
        half = float("inf") if f <= 0 else abs(change) * float(np.sqrt(self.test.critical / f))  # S9
        # A length is not negative.
        return (change - half if self.normal_mm is not None else max(change - half, 0.0)), change + half

    @property
    def shown_mm(self) -> FloatArray:
        """(V,) change along the normal if there is one, else the length of the change; 0 where blank."""
        mm = self.length_mm if self.normal_mm is None else self.normal_mm
        return mm if self.blank is None else np.where(self.blank, 0.0, mm)

    @property
    def test(self) -> Tested:
        """The test of `shown_mm`."""
        return self.any_way if self.along is None else self.along


def effect_maps(
    cohort: Cohort,
    stratum: Stratum,
    residual: FloatArray,
    products: FloatArray,
    along: FloatArray,
    changes: FloatArray,
    bump_width_mm: float | None = None,
    weights: FloatArray | None = None,
    *,
    estimates: Sequence[EffectEstimate] | None = None,
    alpha: float = 0.05,
) -> Sequence[EffectMap]:
    """Return the maps of E effects that share the other terms of the model; memory does not grow with P times V.

    Args:
        cohort: cohort of the shapes.
        stratum: stratum in which the effects are tested.
        residual: (n, K) residuals of the other terms.
        products: (P, m, K) products of orthonormal columns of the model with the residuals in each arrangement, the
            observed one first.
        along: (E, m) unit vectors: each effect in these columns.
        changes: (E, K) changes, mm.
        bump_width_mm: standard deviation of the bumps; None for no search.
        weights: (E, V) factors of F; None for 1.
        estimates: E estimates whose statistics allow unequal variances; None for the pooled variance of `residual`.
        alpha: level of significance, and one minus the confidence of intervals.
    """
    P, m, K = products.shape
    E, V = len(along), cohort.n_vertices
    lenses = _lenses(cohort, residual, bump_width_mm)
    seen = {name: np.empty((E, V, 3 if name == "any_way" else 1)) for name in lenses}
    observed, as_large = ({name: np.zeros((E, V)) for name in lenses} for _ in range(2))
    largest = {name: np.zeros((E, P)) for name in lenses}
    pooled = {name: np.zeros((E, _BINS)) for name in lenses}
    flat = products.reshape(P * m, K)
    chunk = max(1, _BYTES // (m * 3 * _VERTICES * 8))
    for first in range(0, V, _VERTICES):
        part = slice(first, min(first + _VERTICES, V))
        for name, lens in lenses.items():
            rows, unit = lens(part)
            width = rows.shape[1] // (part.stop - part.start)
            seen[name][:, part] = (changes @ rows).reshape(E, -1, width) / np.reshape(unit, (-1, 1))
            squares = ((residual @ rows) ** 2).sum(axis=0).reshape(-1, width).sum(axis=1)
            for start in range(0, P, chunk):
                if estimates is not None:
                    stop = min(start + chunk, P)
                    f = np.stack([estimate.statistic_of(rows, width, start, stop) for estimate in estimates])
                else:
                    drawn = (flat[start * m : (start + chunk) * m] @ rows).reshape(-1, m, len(squares), width)
                    effect = np.tensordot(along, drawn, axes=(1, 1))
                    explained = np.einsum("epvc,epvc->epv", effect, effect)
                    left = squares - np.einsum("pmvc,pmvc->pv", drawn, drawn)
                    f = explained * stratum.df_error / np.maximum(left, _NONE * squares + 1e-300)  # S7
                if weights is not None:
                    f *= weights[:, None, part]
                if start == 0:
                    observed[name][:, part] = f[:, 0]
                as_large[name][:, part] += (f >= observed[name][:, None, part] * (1 - TIE)).sum(axis=1)
                for e in range(E):
                    counted = f[e] if weights is None else f[e][:, weights[e, part] > 0]
                    pooled[name][e] += np.bincount(_bins_of(counted).ravel(), minlength=_BINS)
                so_far = largest[name][:, start : start + chunk]
                np.maximum(so_far, f.max(axis=2), out=so_far)
    made: list[EffectMap] = []
    for e in range(E):
        tests = {
            name: _make_vertex_test(observed[name][e], as_large[name][e] / P, largest[name][e], pooled[name][e], alpha)
            for name in lenses
        }
        own = {name: read_only(values[e, :, 0]) for name, values in seen.items()}
        change = seen["any_way"][e]
        made.append(
            EffectMap(
                change_mm=read_only(change),
                normal_mm=own.get("along"),
                length_mm=read_only(np.linalg.norm(change, axis=1)),
                along=tests.get("along"),
                any_way=tests["any_way"],
                bump_mm=own.get("bump"),
                bump=tests.get("bump"),
                weight=None if weights is None else read_only(weights[e]),
            )
        )
    return made


_Lens = Callable[[slice], tuple[FloatArray, FloatArray | float]]
"""Function of a slice of m vertices: columns (K, m c) from coefficients to c values per vertex, and values per mm."""


def _lenses(cohort: Cohort, residual: FloatArray, bump_width_mm: float | None) -> dict[str, _Lens]:
    def any_way(part: slice) -> tuple[FloatArray, FloatArray | float]:
        return cohort.basis[:, 3 * part.start : 3 * part.stop], 1.0

    lenses: dict[str, _Lens] = {"any_way": any_way}
    if cohort.faces is None:
        return lenses
    mean = cohort.vertices(cohort.coefficients.mean(axis=0))
    normals = vertex_normals(Mesh(mean, cohort.faces))

    def along(part: slice) -> tuple[FloatArray, FloatArray | float]:
        rows = any_way(part)[0].reshape(len(cohort.basis), -1, 3)
        seen: FloatArray = np.einsum("kvc,vc->kv", rows, normals[part])
        return seen, 1.0

    lenses["along"] = along
    if bump_width_mm is not None:
        lenses["bump"] = _bumps(
            along(slice(0, cohort.n_vertices))[0], mean, bump_width_mm, _precision(cohort, residual)
        )
    return lenses


def _bumps(ahead: FloatArray, mean: FloatArray, width_mm: float, precision: FloatArray) -> _Lens:
    """Return the matched filters of bumps, from the displacements (K, V) of vertices along their normals."""
    from scipy.spatial import cKDTree  # loads much

    tree: Any = cKDTree(mean)

    def bump(part: slice) -> tuple[FloatArray, FloatArray]:
        near = tree.sparse_distance_matrix(cKDTree(mean[part]), _REACH * width_mm, output_type="coo_matrix")
        near.data = np.exp(-0.5 * (near.data / width_mm) ** 2)
        shapes: FloatArray = np.asarray((near.tocsr().T @ ahead.T).T)
        filters: FloatArray = precision @ shapes  # S11
        return filters, np.maximum((filters * shapes).sum(axis=0), 1e-300)

    return bump


def _precision(cohort: Cohort, residual: FloatArray) -> FloatArray:
    """Return the (K, K) inverse covariance of residuals; it does not depend on their order, so tests stay exact."""
    sklearn: Any = require_package("sklearn.covariance", "Seeking bumps", INSTALL)
    prior = np.eye(len(cohort.basis))
    if cohort.fitted is not None:
        model = cohort.fitted.model
        modes = cohort.fitted.b.shape[1]
        known = cohort.basis @ model.vertex_basis[:, :modes]
        variance = model.stddev[:modes] ** 2 + (cohort.fitted.b_stddev**2).mean(axis=0)
        # Variation outside the modes of the model is assumed to be equal in all directions.
        error_variance = max(float((residual**2).sum() - ((residual @ known) ** 2).sum()), 0.0) / residual.size
        prior = (known * variance) @ known.T + max(error_variance, _FLOOR * float(variance.mean())) * prior
    factor = np.linalg.cholesky(prior)
    white = np.linalg.solve(factor, residual.T).T
    shrunk: FloatArray = sklearn.LedoitWolf(assume_centered=True).fit(white).covariance_
    half = np.linalg.solve(factor, np.eye(len(factor)))
    return half.T @ np.linalg.solve(shrunk, half)


def _bins_of(f: FloatArray) -> Any:
    """Return the bins of F, narrow bins of its logarithm."""
    return np.clip((np.log10(np.maximum(f, 1e-300)) + 6.0) * (_BINS / 12.0), 0, _BINS - 1).astype(np.intp)


def _make_vertex_test(f: FloatArray, p: FloatArray, largest: FloatArray, pooled: FloatArray, alpha: float) -> Tested:
    from scipy.stats import false_discovery_control  # loads much

    as_large = len(largest) - np.searchsorted(np.sort(largest), f * (1 - TIE))  # S8
    of_all = np.cumsum(pooled[::-1])[::-1] / pooled.sum()
    q = false_discovery_control(of_all[_bins_of(f)])
    critical = float(np.sort(largest)[-(int(alpha * len(largest) * (1 + TIE)) + 1)])
    return Tested(read_only(f), read_only(p), read_only(as_large / len(largest)), read_only(q), critical)
