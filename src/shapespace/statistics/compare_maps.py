"""Changes of shape tested at every vertex; the largest F of each arrangement holds the family-wise error.

Nichols and Holmes, Human Brain Mapping 15, 2001; Benjamini and Hochberg, JRSS B 57(1), 1995.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from shapespace.cohort.cohort import Cohort
from shapespace.geometry.surface import vertex_normals
from shapespace.statistics.compare_strata import Stratum
from shapespace.types import FloatArray, Mesh, read_only

_VERTICES = 512
_BYTES = 48 * 2**20
_TIE = 1e-9
_NONE = 1e-12


@dataclass(frozen=True, eq=False)
class Tested:
    """A statistic at each vertex.

    Args:
        f: (V,) squared change by its variance.
        p: (V,) share of arrangements with an F as large there.
        p_family: (V,) share of arrangements whose largest F of all vertices is as large: with `p_family` below 5 % a
            whole map without any effect shows a vertex in 5 % of studies.
        q: (V,) false discovery rate at which the vertex is found.
    """

    f: FloatArray
    p: FloatArray
    p_family: FloatArray
    q: FloatArray


@dataclass(frozen=True, eq=False)
class EffectMap:
    """A change of shape at each vertex.

    Args:
        change_mm: (V, 3).
        normal_mm: (V,) along the normal of the mean, outwards positive; None for points.
        length_mm: (V,).
        along: test of `normal_mm`; None for points.
        any_way: test of `change_mm`, in whatever direction.
    """

    change_mm: FloatArray
    normal_mm: FloatArray | None
    length_mm: FloatArray
    along: Tested | None
    any_way: Tested

    @property
    def shown_mm(self) -> FloatArray:
        """(V,) along the normal where there is one, else the length."""
        return self.length_mm if self.normal_mm is None else self.normal_mm

    @property
    def shown(self) -> Tested:
        """The test of `shown_mm`."""
        return self.any_way if self.along is None else self.along


def effect_maps(
    cohort: Cohort,
    stratum: Stratum,
    residual: FloatArray,
    products: FloatArray,
    along: FloatArray,
    changes: FloatArray,
) -> Sequence[EffectMap]:
    """Return the maps of E effects that are tested beside the same other terms; memory does not grow with V.

    Args:
        cohort: whose vertices they are.
        stratum: in which they are tested.
        residual: (n, K) of the other terms.
        products: (P, m, K) of orthonormal columns of the model with it, in each arrangement; the observed one first.
        along: (E, m) unit vectors: each effect in these columns.
        changes: (E, K) mm.
    """
    P, m, K = products.shape
    E, V = len(along), cohort.n_vertices
    mean = cohort.coefficients.mean(axis=0)
    normals = None if cohort.faces is None else vertex_normals(Mesh(cohort.vertices(mean), cohort.faces))
    kinds = 1 if normals is None else 2
    largest = np.zeros((kinds, E, P))
    observed = np.zeros((kinds, E, V))
    as_large = np.zeros((kinds, E, V))
    moved = np.empty((E, V, 3))
    flat = products.reshape(P * m, K)
    chunk = max(1, _BYTES // (m * 3 * _VERTICES * 8))
    for first in range(0, V, _VERTICES):
        part = slice(first, min(first + _VERTICES, V))
        rows = cohort.basis[:, 3 * part.start : 3 * part.stop]
        moved[:, part] = (changes @ rows).reshape(E, -1, 3)
        own = (residual @ rows).reshape(len(residual), -1, 3)
        squares = [(own**2).sum(axis=(0, 2))]
        if normals is not None:
            squares.append((np.einsum("nvc,vc->nv", own, normals[part]) ** 2).sum(axis=0))
        for start in range(0, P, chunk):
            stop = min(start + chunk, P)
            drawn = (flat[start * m : stop * m] @ rows).reshape(stop - start, m, -1, 3)
            for kind, one in enumerate((None, normals)[:kinds]):
                if one is None:
                    effect = np.tensordot(along, drawn, axes=(1, 1))
                    explained = np.einsum("epvc,epvc->epv", effect, effect)
                    fitted = np.einsum("pmvc,pmvc->pv", drawn, drawn)
                else:
                    ahead = np.einsum("pmvc,vc->pmv", drawn, one[part])
                    explained = np.tensordot(along, ahead, axes=(1, 1)) ** 2
                    fitted = np.einsum("pmv,pmv->pv", ahead, ahead)
                left = np.maximum(squares[kind] - fitted, _NONE * squares[kind] + 1e-300)
                f = explained * stratum.df_error / left
                if start == 0:
                    observed[kind, :, part] = f[:, 0]
                as_large[kind, :, part] += (f >= observed[kind, :, None, part] * (1 - _TIE)).sum(axis=1)
                np.maximum(largest[kind, :, start:stop], f.max(axis=2), out=largest[kind, :, start:stop])
    tested = [
        [_tested(observed[kind, at], as_large[kind, at] / P, largest[kind, at]) for kind in range(kinds)]
        for at in range(E)
    ]
    return [
        EffectMap(
            change_mm=read_only(moved[at]),
            normal_mm=None if normals is None else read_only((moved[at] * normals).sum(axis=1)),
            length_mm=read_only(np.linalg.norm(moved[at], axis=1)),
            along=None if normals is None else tested[at][1],
            any_way=tested[at][0],
        )
        for at in range(E)
    ]


def _tested(f: FloatArray, p: FloatArray, largest: FloatArray) -> Tested:
    from scipy.stats import false_discovery_control  # loads much

    as_large = len(largest) - np.searchsorted(np.sort(largest), f * (1 - _TIE))
    return Tested(read_only(f), read_only(p), read_only(as_large / len(largest)), read_only(false_discovery_control(p)))
