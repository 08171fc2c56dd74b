"""What a fit gives: pose, coefficients, distances both ways, how it went, and whether to trust it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal, TypeAlias

import numpy as np

from shapespace.fit.state import IcpState
from shapespace.geometry.distance import SurfaceDistances
from shapespace.geometry.surface import rms_size
from shapespace.model.pca import modes_for_variance
from shapespace.model.shape_model import ShapeModel
from shapespace.types import BoolArray, FloatArray, IntArray, Mesh, Similarity

Status: TypeAlias = Literal["converged", "max_iterations", "doubtful", "failed"]
STAGES = ("before", "initial", "final")
"""Stages of every fit: centroids aligned, after phase 1, after phase 2. `dense` follows where it was asked for."""

# Set on simulated scans: clean ones stay far from each bound, cut ones cross at least one.
_SHRUNK_BY_SHAPE = 0.85
_SHRUNK_IN_ALL = 0.7
_LEADING_SHARE = 0.9
_IMPLAUSIBLE = 1e-5
_CLOSE_SHARE = 0.01
_FAR_SHARE = 0.05
_GAP_RATIO = 4.0
_GAP_SHARE = 0.02
_SEEN_SHARE = 0.05


@dataclass(frozen=True, eq=False)
class Stage:
    """The model's surface at one moment of the fit.

    Args:
        T_scan_model: from the model's frame (mm) to the scan's frame and unit.
        b: (K,) coefficients, mm.
        measure: measures the distances; it holds the scan.
        vertices: (V, 3) in the scan's frame and unit where the surface is not the model's with b; else None.
        seen: (V,) False where such a surface has only the model to go by; else None.
    """

    T_scan_model: Similarity
    b: FloatArray
    measure: Callable[[], SurfaceDistances] = field(repr=False)
    vertices: FloatArray | None = None
    seen: BoolArray | None = None

    @cached_property
    def distances(self) -> SurfaceDistances:
        """Distances to the scan and back, mm of the model's frame, measured when first asked for."""
        return self.measure()


@dataclass(frozen=True, eq=False)
class FitResult:
    """A fitted scan.

    Args:
        scan_name: as the mesh was named.
        status: `converged`, `max_iterations`, or `doubtful` when the fit should not be trusted.
        reason: one sentence on why it has that status.
        T_scan_model: from the model's frame (mm) to the scan's frame and unit.
        mm_per_scan_unit: the scan's unit as found or given.
        b: (K,) coefficients, mm.
        b_stddev: (K,) their standard deviation, mm. Of the robust method it is calibrated (docs/uncertainty.md); of the
            paper's it goes by the model's own noise and is mostly too small.
        shrinkage: (K,) in [0, 1]: near 1 the scan told the coefficient, near 0 only the model did.
        z: (K,) b in standard deviations of the model.
        z_covariance: (K, K) of z, calibrated; None of the paper's method. It is in no file.
        stages: the surface at each of `STAGES`, and at `dense` where that was asked for.
        history: every state the loop went through, in the scan's mm frame.
        method: the method that ran.
        config: every setting in effect, with the software version.
        start: how the start was found.
        evidence: what the status goes by, by name; empty for the paper's method, which goes by the distances.
        notes: what was repaired or noticed in the scan.
        seconds: by part.
        model_hash: content hash of the model.
        scan: what was fitted: the scan as repaired, in its own frame and unit.
        find_regions: finds `regions`.
    """

    scan_name: str
    status: Status
    reason: str
    T_scan_model: Similarity
    mm_per_scan_unit: float
    b: FloatArray
    b_stddev: FloatArray
    shrinkage: FloatArray
    z: FloatArray
    z_covariance: FloatArray | None
    stages: Mapping[str, Stage]
    history: Sequence[IcpState]
    method: str
    config: Mapping[str, Any]
    start: str
    evidence: Mapping[str, float]
    notes: Sequence[str]
    seconds: Mapping[str, float]
    model_hash: str
    scan: Mesh = field(repr=False)
    find_regions: Callable[[], IntArray] = field(repr=False)

    @cached_property
    def regions(self) -> IntArray:
        """(V,) code of each model vertex in `fit.regions.REGIONS`, found when first asked for.

        The paper's method takes every vertex for followed, whatever the scan shows there: that is what it does.
        """
        return self.find_regions()

    @property
    def iterations(self) -> dict[str, int]:
        """Iterations done, by phase."""
        return {
            f"phase_{phase}": max((s.iteration for s in self.history if s.phase == phase), default=0)
            for phase in (1, 2)
        }

    @property
    def distances(self) -> SurfaceDistances:
        """Distances of the final surface."""
        return self.stages["final"].distances

    def surface(self, model: ShapeModel, stage: str = "final") -> Mesh:
        """Return the model's surface at `stage` in the scan's own frame and unit, all vertices in model order."""
        at = self.stages[stage]
        vertices = at.T_scan_model.apply(model.reconstruct(at.b)) if at.vertices is None else at.vertices
        landmarks = {name: vertices[index] for name, index in model.landmarks.items()}
        return Mesh(vertices, model.faces, landmarks, name=self.scan_name)


def posterior_stddev(model: ShapeModel, residual_variance: float) -> FloatArray:
    """Return the standard deviation (K,), mm, of the coefficients given a complete surface.

    Probabilistic PCA with orthonormal modes: var_k = lam_k v / (lam_k + v) (Tipping and Bishop, 1999). It takes the
    residuals of the coordinates for independent, which they are not, so it is too small.

    Args:
        model: gives lam_k = stddev_k^2.
        residual_variance: v, mm^2 per coordinate.
    """
    variance = model.stddev**2
    return np.sqrt(variance * residual_variance / (variance + residual_variance))


def doubts(model: ShapeModel, stages: Mapping[str, Stage], start_scale: float) -> list[str]:
    """Return reasons not to trust the final stage, most serious first; none where nothing speaks against it.

    Args:
        model: the shape space.
        stages: as in `FitResult`.
        start_scale: scale of the start, in the scan's unit per mm.
    """
    final, initial = stages["final"], stages["initial"]
    forward, backward = final.distances.model_to_scan, final.distances.scan_to_model
    size_mm = rms_size(model.mean_vertices)
    found: list[str] = []
    shrunk = min(
        final.T_scan_model.scale / initial.T_scan_model.scale / _SHRUNK_BY_SHAPE,
        final.T_scan_model.scale / start_scale / _SHRUNK_IN_ALL,
    )
    if shrunk < 1.0:
        found.append("the model shrank while it was fitted, as it does when parts of the scan are missing")
    if forward.rms > _FAR_SHARE * size_mm:
        found.append(f"the model stays {forward.rms:.1f} mm (RMS) away from the scan")
    if backward.fraction < _SEEN_SHARE:
        found.append(f"the model covers only {100 * backward.fraction:.0f} % of the scan")
    elif backward.median > _GAP_RATIO * forward.median and backward.median > _GAP_SHARE * size_mm:
        found.append(
            f"half of the scan lies over {backward.median:.1f} mm from the model, while half of the model lies within "
            f"{forward.median:.1f} mm of the scan"
        )
    leading = min(modes_for_variance(model.stddev**2, _LEADING_SHARE), len(final.b))
    z2 = float(((final.b[:leading] / model.stddev[:leading]) ** 2).mean())
    # An extreme shape that lies on the scan all over is what the scan shows.
    if z2 > _hotelling_bound(leading, model.n_training) and forward.rms > _CLOSE_SHARE * size_mm:
        found.append(
            f"the shape is implausible: its {leading} main coefficients lie {np.sqrt(z2):.1f} standard deviations out "
            "on average, where about 1 is usual"
        )
    return found


def _hotelling_bound(k: int, n: int) -> float:
    """Return the mean z^2 of k coefficients that a new shape exceeds with probability `_IMPLAUSIBLE`.

    The variances come from n training shapes, so the bound is Hotelling's for a new sample, not chi-square's.
    """
    from scipy.special import fdtri  # takes a moment; scipy.stats would take half a second

    if n <= k + 1:
        return float("inf")
    return float((n**2 - 1) / (n * (n - k)) * fdtri(k, n - k, 1.0 - _IMPLAUSIBLE))
