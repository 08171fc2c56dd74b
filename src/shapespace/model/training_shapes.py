"""Training shapes of a model: the only sample of its population, by which results are calibrated."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.linalg import eigh

from shapespace.errors import InputError
from shapespace.reprs import short_repr
from shapespace.types import FloatArray, read_only, set_fields

MOST_SHAPES = 500  # training shapes of a model file; of larger sets a fixed random subset, to bound size and time
UNIT_TOLERANCE = 1e-3  # difference of the length of a mode from 1; float32 rounding of many coordinates is smaller
_SAME_SIZE = 1e-6  # spread of the logarithm of size; shapes that were scaled to one size have less
_ROUNDING = 1e-6  # share of the total variance; modes with less are rounding errors


@dataclass(frozen=True, eq=False)
class TrainingShapes:
    """Coefficients of training shapes in all of their modes: their vertices are mean + [P, rest] c.

    Args:
        coefficients: (n, K + M) mm, n at most `MOST_SHAPES`; K is the number of modes of the model.
        rest: (3V, M) orthonormal modes outside those of the model.
        log_scale: (n,) logarithm of the size that alignment removed, about its mean; zero if size is part of the modes.

    Raises:
        InputError: arrays whose shapes do not belong together, or that are not finite.
    """

    coefficients: FloatArray
    rest: FloatArray
    log_scale: FloatArray

    __repr__ = short_repr

    def __post_init__(self) -> None:
        coefficients, rest, log_scale = (read_only(x) for x in (self.coefficients, self.rest, self.log_scale))
        if coefficients.ndim != 2 or rest.ndim != 2 or coefficients.shape[1] < rest.shape[1] or len(coefficients) < 2:
            raise InputError(
                f"Training shapes need coefficients (n, K + M) and modes (3V, M), not {coefficients.shape} and "
                f"{rest.shape}."
            )
        if log_scale.shape != (len(coefficients),):
            raise InputError(f"{len(coefficients)} training shapes need as many sizes, not {log_scale.shape}.")
        if not all(np.isfinite(x).all() for x in (coefficients, rest, log_scale)):
            raise InputError("The training shapes of a model must be finite.")
        with np.errstate(over="ignore"):
            if not np.isfinite(np.exp(np.abs(log_scale))).all():
                raise InputError("The sizes of the training shapes of a model must be finite.")
            length = np.einsum("dk,dk->k", rest, rest)
        if not (np.abs(length - 1.0) < UNIT_TOLERANCE).all():
            raise InputError("A further mode of the training shapes is not of length 1.")
        set_fields(self, coefficients=coefficients, rest=rest, log_scale=log_scale)

    @staticmethod
    def of(
        shape: Callable[[int], FloatArray], sizes: FloatArray, mean: FloatArray, basis: FloatArray
    ) -> TrainingShapes:
        """Return the coefficients of aligned shapes.

        Args:
            shape: function that returns the vertices (V, 3) of a shape by its index.
            sizes: (N,) sizes of the shapes before alignment, relative to those after it; only those of `indices` are
                used.
            mean: (V, 3) mean of the model, mm.
            basis: (3V, K) orthonormal modes of the model.
        """
        index = TrainingShapes.indices(len(sizes))
        off: FloatArray = np.empty((len(index), mean.size))
        for row, i in enumerate(index):
            off[row] = (shape(int(i)) - mean).reshape(-1)
        total = float(np.vdot(off, off))
        b = off @ basis
        log_scale = np.log(sizes[index])
        log_scale -= log_scale.mean()
        if total - float(np.vdot(b, b)) <= _ROUNDING * total:
            return TrainingShapes(b, np.zeros((mean.size, 0)), log_scale)
        for row, own in zip(off, b, strict=True):  # one by one, to have only one copy of the shapes in memory
            row -= basis @ own
        value, vector = eigh(off @ off.T)
        significant = np.flatnonzero(value > _ROUNDING * total)[::-1]
        rest = off.T @ (vector[:, significant] / np.sqrt(value[significant]))
        return TrainingShapes(np.concatenate([b, off @ rest], axis=1), rest, log_scale)

    @staticmethod
    def indices(count: int) -> npt.NDArray[np.int64]:
        """Return the indices, in order, of the shapes that a model of `count` shapes contains."""
        every = np.arange(count, dtype=np.int64)
        if count <= MOST_SHAPES:
            return every
        return np.sort(np.random.default_rng(0).choice(every, MOST_SHAPES, replace=False))

    def __len__(self) -> int:
        """Return n, the number of shapes."""
        return len(self.coefficients)

    def truncated(self, basis: FloatArray, modes: int) -> TrainingShapes:
        """Return the same shapes for a model that keeps the first `modes` of `basis` (3V, K)."""
        rest = [basis[:, modes:], *([self.rest] if self.rest.shape[1] else [])]
        return replace(self, rest=np.concatenate(rest, axis=1))

    @cached_property
    def stddev(self) -> FloatArray:
        """Standard deviation (K + M,) of the coefficients about the mean of the model, mm."""
        return np.sqrt((self.coefficients**2).sum(axis=0) / (len(self) - 1))

    @property
    def log_scale_stddev(self) -> float | None:
        """Standard deviation of the logarithm of new shapes' size; None if size was not removed by alignment."""
        spread = float(self.log_scale.std(ddof=1))
        return spread * float(np.sqrt(1.0 + 1.0 / len(self))) if spread > _SAME_SIZE else None
