"""Every setting of the robust method, in one place."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class ResidualSettings:
    """How far a shape may leave its model.

    Args:
        count: modes beside the model's own, at most.
        range_share: over what share of the model's size (RMS distance from its centre) the covariance is damped.
        local_share: variance of the local modes as a share of the model's own.
        mirror_share: the same of the mirrored modes, for means that are their own mirror image.
    """

    count: int = 300
    range_share: float = 1.6
    local_share: float = 0.03
    mirror_share: float = 1.0


@dataclass(frozen=True)
class Level:
    """One step from coarse to fine.

    Args:
        modes: how many are free; None for all; 0 is phase 1.
        scan_points: how many points of the scan are matched; None for all.
        vertices: how many of the model's vertices are matched; None for all.
        triangles: those vertices are matched to the scan's triangles; False for its nearest vertices, which is faster.
        iterations: at most.
        stop_motion_mm: it ends when no vertex moves more than this, mm.
    """

    modes: int | None
    scan_points: int | None
    vertices: int | None
    triangles: bool
    iterations: int
    stop_motion_mm: float

    @property
    def sample(self) -> tuple[int | None, int | None, bool]:
        """What is matched, and to what; levels with the same one share a matcher."""
        return self.scan_points, self.vertices, self.triangles

    def free(self, modes: int) -> int:
        """Return how many of `modes` are free."""
        return modes if self.modes is None else min(self.modes, modes)


@dataclass(frozen=True)
class RobustSettings:
    """Settings of the robust method; the defaults were chosen by `benchmarks/sweep.py` on people of their own.

    Args:
        levels: from coarse to fine; the first without modes is phase 1.
        beyond: the level that follows where the model cannot make the shape.
        residual: the modes that it adds.
        beyond_share: it follows when what the model leaves is this share of the residuals' variance, and
        beyond_mm: this large (RMS), mm.
        weight: a name of `WEIGHTS`.
        narrow: scale of the weights in units of the residuals' spread, where many residuals lie far out;
        wide: the same where they are as few as in pure noise, of which narrow weights waste a part.
        least_spread_mm: the spread is not taken for less than this, mm.
        normal_cosine: matches whose normals disagree more than this are left out.
        reach: matches farther than this many widths and
        reach_mm: this, mm, count little.
        vertex_share: weight of a vertex's match beside that of a scan point's, for scans at least as fine as the
            model; less for coarser ones, whose flat triangles cut the corners.
        prior: weight of the prior beside one match,
        beyond_prior: the same beside modes that the model lacks.
        scale_stddev: of log s about the start.
        seed: of the subsamples.
    """

    levels: tuple[Level, ...] = (
        Level(0, 1_500, 1_000, False, 8, 1.0),
        Level(10, 1_500, 1_000, False, 6, 1.0),
        Level(40, 2_500, 1_500, False, 2, 1.0),
        Level(None, 5_000, 2_000, False, 6, 0.2),
        Level(None, 20_000, 1_500, True, 15, 0.05),
    )
    beyond: Level = Level(None, 8_000, 4_000, True, 10, 0.1)
    residual: ResidualSettings = field(default_factory=ResidualSettings)
    beyond_share: float = 0.2
    beyond_mm: float = 0.05
    weight: str = "welsch"
    narrow: float = 1.5
    wide: float = 3.5
    least_spread_mm: float = 0.02
    normal_cosine: float = 0.4
    reach: float = 4.0
    reach_mm: float = 2.0
    vertex_share: float = 0.3
    prior: float = 0.3
    beyond_prior: float = 1.0
    scale_stddev: float = 0.15
    seed: int = 0


@dataclass(frozen=True)
class DenseSettings:
    """Settings of the dense stage; lengths are mm of the model's frame.

    Args:
        range_share: over what share of the model's size (RMS distance from its centre) the field is smooth.
        amplitude: its standard deviation in units of what the fit left unexplained.
        least_unexplained_mm: where less is left (RMS), there is only the field of details.
        rounds: of matching and solving.
        fine_range_share: over what share of the size the field of details is smooth.
        fine_amplitude_mm: its standard deviation: finer noise is followed, coarser noise is not.
        fine_rounds: of matching and solving for the details.
        scan_points: how many points of the scan are matched at most.
        vertex_share: weight of a vertex's match beside that of a scan point's.
        weight: a name of `WEIGHTS`.
        width: scale of the weights in units of the residuals' spread.
        normal_cosine: matches whose normals disagree more than this are left out.
        reach: matches farther than this many widths and
        reach_mm: this count little.
        least_noise_mm: the scan's noise is not taken for less than this.
        turn_cosine: no triangle turns further than this.
        tolerance: of the solver, as a share of the pull.
        iterations: of the solver, at most.
        seed: of the subsamples.
    """

    range_share: float = 1.0
    amplitude: float = 6.0
    least_unexplained_mm: float = 0.06
    rounds: int = 3
    fine_range_share: float = 0.05
    fine_amplitude_mm: float = 0.18
    fine_rounds: int = 2
    scan_points: int = 40_000
    vertex_share: float = 0.3
    weight: str = "welsch"
    width: float = 2.5
    normal_cosine: float = 0.4
    reach: float = 4.0
    reach_mm: float = 2.0
    least_noise_mm: float = 0.02
    turn_cosine: float = 0.2
    tolerance: float = 1e-2
    iterations: int = 150
    seed: int = 0
