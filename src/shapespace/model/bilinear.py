"""The bilinear model: each coefficient vector is a core tensor times an identity times an expression vector.

Source: Tenenbaum and Freeman, Neural Computation 12(6), 2000; Vlasic et al., SIGGRAPH 2005, for faces. The comparator
of the additive model: it knows that one person's smile differs from another's, and needs every expression of everyone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shapespace.errors import InputError
from shapespace.types import FloatArray

_TOLERANCE = 1e-4


@dataclass(frozen=True, eq=False)
class BilinearModel:
    """z is close to mean + sum over i, j of identity_i expression_j core_ij.

    Args:
        mean: (K,) of all training coefficients, in standard deviations.
        core: (I, J, K).
        identities: (S, I) of the training people.
        expressions: (X, J) of the training expressions.
    """

    mean: FloatArray
    core: FloatArray
    identities: FloatArray
    expressions: FloatArray

    @classmethod
    def fit(cls, table: FloatArray, identity_rank: int, expression_rank: int) -> BilinearModel:
        """Fit by the higher-order singular value decomposition (De Lathauwer et al., SIAM J. Matrix Anal. 21(4), 2000).

        Args:
            table: (S, X, K) coefficients of S people in the same X expressions, in standard deviations.
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
        shown = np.linalg.svd(centred.transpose(1, 0, 2).reshape(X, -1), full_matrices=False)[0][:, :expression_rank]
        core = np.einsum("sxk,si,xj->ijk", centred, people, shown, optimize=True)
        return cls(mean, core, people, shown)

    def decode(self, identity: FloatArray, expression: FloatArray) -> FloatArray:
        """Return z (K,) of an identity (I,) with an expression (J,)."""
        return self.mean + np.einsum("i,j,ijk->k", identity, expression, self.core)

    def encode(
        self, z: FloatArray, z_stddev: FloatArray | None = None, *, iterations: int = 8
    ) -> tuple[FloatArray, FloatArray]:
        """Return identity (n, I) and expression (n, J) of coefficients z (n, K), by alternating ridge least squares.

        Args:
            z: in standard deviations.
            z_stddev: (n, K) how well each is known; None for equally well.
            iterations: at most.

        Raises:
            InputError: coefficients of another number, or not finite.
        """
        K = len(self.mean)
        if z.ndim != 2 or z.shape[1] != K or not np.isfinite(z).all():
            raise InputError(f"Give (n, {K}) finite coefficients, not {z.shape}.")
        told = 1.0 / (np.full(z.shape, 0.3) if z_stddev is None else np.maximum(z_stddev, 0.05)) ** 2
        priors = [
            (part.mean(axis=0), 1.0 / part.var(axis=0).clip(1e-12)) for part in (self.identities, self.expressions)
        ]
        identities, expressions = np.empty((len(z), self.core.shape[0])), np.empty((len(z), self.core.shape[1]))
        for row, (value, weight) in enumerate(zip(z - self.mean, told, strict=True)):
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
