"""Region fit: computed with the model of the region, reported in the coefficients of the full model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from shapespace.fit.iteration_state import UNSEEN, Fitted, IcpState
from shapespace.model.region import Part
from shapespace.model.shape_model import ShapeModel
from shapespace.types import IntArray, SurfaceLandmarks


@dataclass(frozen=True, eq=False)
class RegionFit:
    """What turns a fit of a part into one of the whole.

    Args:
        full: the model.
        part: of it.
    """

    full: ShapeModel
    part: Part

    @staticmethod
    def of(full: ShapeModel, region: str | tuple[int, ...]) -> RegionFit:
        """Return the region fit of a model.

        Raises:
            InputError: there is no such region, or no triangle lies in it.
        """
        return RegionFit(full, Part.of(full, region))

    def note(self, region: str | tuple[int, ...] | None) -> str:
        """Return a sentence on what the fit is held to."""
        called = f" {region!r}" if isinstance(region, str) else ""
        inside = self.part.inside
        return (
            f"Held to the region{called} of {int(inside.sum()):,} of the model's {len(inside):,} vertices; the rest of "
            "the surface is what the model makes of it."
        )

    def state(self, state: IcpState) -> IcpState:
        """Return a state with the coefficients of the whole."""
        return replace(state, b=self.part.to_b(state.b, self.full))

    def telling(self, on_state: Callable[[IcpState], None]) -> Callable[[IcpState], None]:
        """Return what tells `on_state` of such states."""
        return lambda state: on_state(self.state(state))

    def landmarks(self, model: ShapeModel) -> SurfaceLandmarks:
        """Return the landmarks of `model` that lie in the region."""
        return model.landmarks.within(self.part.inside)

    def fitted(self, fitted: Fitted, modes: int | None) -> Fitted:
        """Return where the fit ended with the first `modes` coefficients of the whole, None for all."""
        from shapespace.fit.robust.posterior import variance_of_new_shapes  # compiled, and loads SciPy

        full, part, k = self.full, self.part, modes
        b = part.to_b(fitted.b, full)
        known = np.diag(fitted.b_stddev**2) if fitted.b_covariance is None else fitted.b_covariance
        variance = variance_of_new_shapes(full) if fitted.b_covariance is not None else full.stddev**2
        covariance = part.to_covariance(known, full, variance)
        after = np.clip(covariance.diagonal(), 0.0, variance)
        vertices = fitted.T_scan_model.apply(full.reconstruct(b))
        vertices[part.inside] = fitted.vertices_scan_mm
        return replace(
            fitted,
            b=b[:k],
            b_stddev=np.sqrt(after)[:k],
            shrinkage=(1.0 - after / variance)[:k],
            b_covariance=None if fitted.b_covariance is None else covariance[:k, :k],
            vertices_scan_mm=vertices,
            regions=self._regions(fitted),
        )

    def _regions(self, fitted: Fitted) -> Callable[[], IntArray]:
        def find() -> IntArray:
            regions = np.full(len(self.part.inside), UNSEEN, dtype=np.int32)
            regions[self.part.inside] = fitted.regions()
            return regions

        return find
