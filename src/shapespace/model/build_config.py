"""Options of a shape model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from numbers import Real
from typing import get_args

from shapespace.errors import InputError
from shapespace.geometry.procrustes import Gauge
from shapespace.model.missing import MIN_SEEN
from shapespace.model.pca import Modes, plain_modes
from shapespace.model.representation import representation_named
from shapespace.types import IntArray, generator_of


@dataclass(frozen=True, kw_only=True, eq=False)
class BuildConfig:
    """Options of a shape model.

    Args:
        modes: number of modes (in Python also a float below 1, a share of the variance), fewer if the meshes determine
            fewer; `all`; `auto`: cross-validation on held-out vertices, of a random sample of 2,000 meshes if there are
            more, and `all` of fewer than four.
        gauge: `form`: size is part of the modes, and fits are rigid; `shape`: size is divided out, and fits have a free
            scale.
        align: whether to align the meshes.
        alignment_vertices: indices of the vertices that determine the alignment, such as forehead and nose where
            expressions vary; None for all.
        landmarks: landmarks of the model: named points on the surface (`place_landmarks`), or name -> vertex.
        representation: what the modes move: `vertices`; `bspline`, control points of a smooth surface;
            `bspline-detail`, the same with the detail of the mean that the B-spline cannot represent.
        control_points: control points of a B-spline along each side, 4 to 64 (default 24x24).
        min_seen: remove vertices that fewer than this share of the meshes show, with their triangles and landmarks,
            from a model of vertices.
        provenance: description of the meshes, kept in the model file.
        licence: licence of the meshes, kept in the model file.
        seed: seed of the cross-validation, and of the first directions of streamed modes.
        out_of_core: stream the meshes, each loaded once and not held, through a file of single precision as large as
            they are: the same model but for that rounding, with `ShapeModel.residuals`. None does so where a model of
            vertices would need more than four fifths of the free memory.
        without_training_shapes: omit the training shapes, from which their surfaces can be reconstructed, from the
            model, for example before you share a model of people; its results are then not calibrated.

    Example:
        >>> ss.build_model(meshes, ss.BuildConfig(modes=0.9, gauge="form")).gauge
        'form'
    """

    modes: Modes = "all"
    gauge: Gauge = "shape"
    align: bool = True
    alignment_vertices: IntArray | None = None
    landmarks: Mapping[str, int] | None = None
    representation: str = "vertices"
    control_points: tuple[int, int] | None = None
    min_seen: float = MIN_SEEN
    provenance: str = ""
    licence: str = ""
    seed: int = 0
    out_of_core: bool | None = None
    without_training_shapes: bool = False

    def __post_init__(self) -> None:
        """Check each option.

        Raises:
            InputError: an option cannot be.
        """
        if self.modes != "auto":
            object.__setattr__(self, "modes", plain_modes(self.modes) or "all")
        if self.gauge not in get_args(Gauge):
            raise InputError(f"There is no gauge {self.gauge!r}; choose form (rigid) or shape (with scale).")
        representation_named(self.representation, self.control_points)
        if not isinstance(self.min_seen, Real) or not 0 <= self.min_seen <= 1:
            raise InputError(f"min_seen is a share of the meshes from 0 to 1, not {self.min_seen!r}.")
        generator_of(self.seed, "BuildConfig.seed")
