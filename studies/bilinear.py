"""The bilinear model: each coefficient vector b is a core tensor times an identity times an expression vector.

Source: Tenenbaum and Freeman, Neural Computation 12(6), 2000; Vlasic et al., SIGGRAPH 2005, for faces. The comparator
of the additive model: it knows that one person's smile differs from another's, and needs every expression of everyone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shapespace.errors import InputError
from shapespace.types import FloatArray

_TOLERANCE = 1e-4  # change of the expression, in standard deviations, that ends the iterations
_LEAST_VARIANCE_MM2 = 1e-4  # mm^2; keeps the precision of exactly known coefficients finite


@dataclass(frozen=True, eq=False)
class BilinearModel:
    """b is close to mean + sum over i, j of identity_i expression_j core_ij.

    Args:
        mean: (K,) of all training coefficients, mm.
        core: (I, J, K) mm.
        identities: (S, I) of the training people.
        expressions: (X, J) of the training expressions.
        left: (K,) variance that the ranks leave, mm^2.
    """

    mean: FloatArray
    core: FloatArray
    identities: FloatArray
    expressions: FloatArray
    left: FloatArray

    @classmethod
    def fit(cls, table: FloatArray, identity_rank: int, expression_rank: int) -> BilinearModel:
        """Fit by the higher-order singular value decomposition (De Lathauwer et al., SIAM J. Matrix Anal. 21(4), 2000).

        Args:
            table: (S, X, K) coefficients b of S people in the same X expressions, mm; modes of equal variance, as z
                has, could not be cut to a rank.
            identity_rank: at most S.
            expression_rank: at most X.

        Raises:
            InputError: a table that is not complete, or ranks that it cannot give.
        """
        if table.ndim != 3 or not np.isfinite(table).all():
            raise InputError("A bilinear model needs every expression of every person; leave out those that lack some.")
        S, X, _ = table.shape
        if not (1 <= identity_rank <= S and 1 <= expression_rank <= X):
            raise InputError(f"{S} people in {X} expressions give ranks up to {S} and {X} only.")
        mean = table.mean(axis=(0, 1))
        centred = table - mean
        people = np.linalg.svd(centred.reshape(S, -1), full_matrices=False)[0][:, :identity_rank]
        unfolded = centred.transpose(1, 0, 2).reshape(X, -1)
        expressions = np.linalg.svd(unfolded, full_matrices=False)[0][:, :expression_rank]
        core = np.einsum("sxk,si,xj->ijk", centred, people, expressions, optimize=True)
        left = centred - np.einsum("si,xj,ijk->sxk", people, expressions, core, optimize=True)
        return cls(mean, core, people, expressions, left.var(axis=(0, 1)))

    def decode(self, identity: FloatArray, expression: FloatArray) -> FloatArray:
        """Return b (K,), mm, of an identity (I,) with an expression (J,)."""
        return self.mean + np.einsum("i,j,ijk->k", identity, expression, self.core)

    def encode(self, b: FloatArray, b_stddev: FloatArray, *, iterations: int = 8) -> tuple[FloatArray, FloatArray]:
        """Return identity (n, I) and expression (n, J) of coefficients b (n, K), by alternating ridge least squares.

        Args:
            b: mm.
            b_stddev: (n, K) how well each is known, mm.
            iterations: at most.

        Raises:
            InputError: coefficients of another number, or not finite.
        """
        K = len(self.mean)
        if b.ndim != 2 or b.shape[1] != K or b_stddev.shape != b.shape or not np.isfinite(b).all():
            raise InputError(f"Give (n, {K}) finite coefficients and standard deviations, not {b.shape}.")
        precision = 1.0 / (b_stddev**2 + self.left + _LEAST_VARIANCE_MM2)
        priors = [
            (part.mean(axis=0), 1.0 / part.var(axis=0).clip(1e-12)) for part in (self.identities, self.expressions)
        ]
        identities, expressions = np.empty((len(b), self.core.shape[0])), np.empty((len(b), self.core.shape[1]))
        for row, (value, weight) in enumerate(zip(b - self.mean, precision, strict=True)):
            identity, expression = priors[0][0].copy(), priors[1][0].copy()
            for _ in range(iterations):
                before = expression
                identity = _ridge(np.einsum("ijk,j->ki", self.core, expression), value, weight, *priors[0])
                expression = _ridge(np.einsum("ijk,i->kj", self.core, identity), value, weight, *priors[1])
                if np.abs(expression - before).max() < _TOLERANCE:
                    break
            identities[row], expressions[row] = identity, expression
        return identities, expressions


def _ridge(
    design: FloatArray, value: FloatArray, weight: FloatArray, mean: FloatArray, precision: FloatArray
) -> FloatArray:
    """Return x near `mean` for which design @ x is near `value`."""
    weighted = design.T * weight
    return np.asarray(
        np.linalg.solve(weighted @ design + np.diag(precision), weighted @ value + precision * mean), dtype=np.float64
    )
