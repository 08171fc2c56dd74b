"""All settings of the robust method."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class ResidualSettings:
    """Settings of the residual modes, the variation outside the model.

    Args:
        count: maximum number of residual modes in addition to the model's own.
        range_share: range over which the covariance is damped, as a share of the model's size (RMS distance from its
            centre).
        local_share: variance of the local modes as a share of the variance of the model's own.
        mirror_share: variance of the mirrored modes as a share of the variance of the model's own, for means that are
            their own mirror image.
    """

    count: int = 300
    range_share: float = 1.6
    local_share: float = 0.03
    mirror_share: float = 1.0


@dataclass(frozen=True)
class Level:
    """One step from coarse to fine.

    Args:
        modes: number of free modes; None for all; 0 is phase 1.
        scan_points: number of points of the scan that are matched; None for all.
        vertices: number of the model's vertices that are matched; None for all.
        triangles: whether those vertices are matched to the scan's triangles; False for its nearest vertices, which is
            faster.
        iterations: maximum number of iterations.
        stop_motion_mm: largest movement of a vertex, mm, at which the level ends.
    """

    modes: int | None
    scan_points: int | None
    vertices: int | None
    triangles: bool
    iterations: int
    stop_motion_mm: float

    @property
    def sample(self) -> tuple[int | None, int | None, bool]:
        """Sample and target of the matches; levels with the same sample share a matcher."""
        return self.scan_points, self.vertices, self.triangles

    def free(self, modes: int) -> int:
        """Return the number of free modes, at most `modes`."""
        return modes if self.modes is None else min(self.modes, modes)


@dataclass(frozen=True)
class RobustSettings:
    """Settings of the robust method; the defaults were chosen by `benchmarks/sweep.py` on separate people.

    Args:
        levels: levels from coarse to fine; the first without modes is phase 1.
        beyond: level that follows if the scan shows a shape outside the model.
        residual: settings of the residual modes of that level.
        beyond_share: smallest share of the residuals' variance outside the model for which that level follows.
        beyond_mm: smallest RMS of the residuals outside the model for which that level follows, mm.
        weight: a name of `WEIGHTS`.
        narrow: scale of the weights in units of the residuals' spread if many residuals are outliers.
        wide: scale of the weights in units of the residuals' spread if residuals are pure noise, of which narrow
            weights waste a part.
        least_spread_mm: lower bound of the spread, mm.
        normal_cosine: cosine of the angle between normals beyond which matches are excluded.
        reach: number of widths that `reach_mm` is added to; matches farther than the sum count little.
        reach_mm: distance that is added to `reach` widths, mm.
        vertex_share: weight of a vertex's match relative to that of a scan point's, for scans at least as fine as the
            model; less for coarser scans, whose flat triangles cut the corners.
        prior: weight of the prior relative to one match.
        beyond_prior: weight of the prior of the residual modes relative to one match.
        scale_stddev: standard deviation of log s about the start.
        no_contact: whether closed parts of a model must not lie inside each other: at the end of the fit, the depths of
            vertices inside another part are penalised.
        seed: seed of the subsamples.
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
    no_contact: bool = False
    seed: int = 0


@dataclass(frozen=True)
class DenseSettings:
    """Settings of the dense stage; lengths are mm of the model's frame.

    Args:
        range_share: range over which the field is smooth, as a share of the model's size (RMS distance from its
            centre).
        amplitude: standard deviation of the field in units of the unexplained residual of the fit.
        least_unexplained_mm: unexplained residual (RMS) below which only the field of details is used.
        rounds: number of rounds of matching and solving.
        fine_range_share: range over which the field of details is smooth, as a share of the size.
        fine_amplitude_mm: standard deviation of the field of details; it follows finer noise and not coarser noise.
        fine_rounds: number of rounds of matching and solving for the details.
        scan_points: maximum number of points of the scan that are matched.
        vertex_share: weight of a vertex's match relative to that of a scan point's.
        weight: a name of `WEIGHTS`.
        width: scale of the weights in units of the residuals' spread.
        normal_cosine: cosine of the angle between normals beyond which matches are excluded.
        reach: number of widths that `reach_mm` is added to; matches farther than the sum count little.
        reach_mm: distance that is added to `reach` widths.
        least_noise_mm: lower bound of the scan's noise.
        turn_cosine: cosine of the largest angle by which a triangle may turn.
        tolerance: tolerance of the solver, as a share of the pull.
        iterations: maximum number of iterations of the solver.
        seed: seed of the subsamples.
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
