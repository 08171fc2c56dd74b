"""Settings of a correspondence, and the unit of its lengths."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

from shapespace.correspondence.register import ElasticSettings

PoseRange: TypeAlias = Literal["search", "near", "as-given"]
SIZE = 100.0
"""The template's RMS size in its own frame: all lengths of the method are in hundredths of an object's size."""
LARGEST_ROTATION_DEG: Mapping[PoseRange, float] = {"near": 60.0, "as-given": 30.0}
"""Largest rotation, degrees, of the pose of a scan from the frame of its file."""
FEWEST = 2
"""Smallest number of scans in a correspondence, and of scans that observe a vertex for its estimation elsewhere."""


@dataclass(frozen=True, kw_only=True)
class CorrespondConfig:
    """How scans are brought into correspondence; lengths are shares of the object's size (RMS from its centroid).

    Args:
        vertices: approximate number of vertices of the template, if it is one of the scans.
        rounds: maximum number of rounds.
        settled: a round that moves vertices by less (RMS over all) is the last.
        first: settings of the elastic registration in round 1.
        next: the same in later rounds, which begin at the leave-one-out predictions.
        guided: whether later rounds begin at the leave-one-out predictions, or at the mean.
        noise_share: noise variance of a prediction, as a share of a mode's mean variance.
        fewest_seen: smallest share of the template that a scan must observe.
        fewest_covered: smallest share of a scan that the template must cover.
        outlier_threshold: scans whose distance from their prediction by the largest group of similar scans is beyond
            this many times the median of that group are excluded as other objects.
        mirror: treatment of scans that are mirror images of the majority, such as left among right teeth: they are
            reflected (auto), excluded (ask), or the files are trusted (never).
        pose: rotation of the scans: found by a search over all rotations (search), or that of the frames of the files,
            refined by at most 30 degrees (as-given) or 60 degrees (near). Position and size are always found. A scan
            with another frame is excluded from the second round on, if there are six scans or more.
        outer: remove inner surfaces first, such as marrow cavities and trabeculae of CT scans, which are hardly visible
            from outside.
        ignore_colours: match points by place and normal alone, also where scans have colours; for colours that are not
            those of the surface.
        symmetric_template: make the first template symmetric, with vertices in left and right pairs and on the midline;
            for objects with mirror symmetry, such as faces.
        landmark_uncertainty: standard deviation of the landmarks, as a share of the object's size (RMS distance from
            its centre).
        seed: random seed.
    """

    vertices: int = 10_000
    rounds: int = 3
    settled: float = 0.002
    first: ElasticSettings = field(default_factory=ElasticSettings)
    next: ElasticSettings = field(default_factory=ElasticSettings)
    guided: bool = True
    noise_share: float = 1.0
    fewest_seen: float = 0.4
    fewest_covered: float = 0.6
    outlier_threshold: float = 2.7
    mirror: Literal["auto", "ask", "never"] = "auto"
    pose: PoseRange = "search"
    outer: bool = False
    ignore_colours: bool = False
    symmetric_template: bool = False
    landmark_uncertainty: float = 0.02
    seed: int = 0
