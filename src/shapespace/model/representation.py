"""Representations of a surface as a vector for PCA: the only module where shapes are flattened and restored."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Protocol

import numpy as np
import numpy.typing as npt

from shapespace.errors import InputError
from shapespace.geometry.articulation import Articulation
from shapespace.geometry.bspline import DEGREE, SplineSquare, check_counts
from shapespace.geometry.flatten import disc_map
from shapespace.types import BoolArray, FloatArray, Mesh, read_only

CONTROL_POINTS = (24, 24)
"""Default number of control points along each side of the square."""


class Representation(Protocol):
    """Turns vertices into a vector and back; distances and inner products are always those of decoded vertices."""

    takes_holes: ClassVar[bool]
    """Whether `encode` accepts vertices that are not-a-number."""
    is_linear: ClassVar[bool]
    """Whether `decode` is linear except for a constant."""

    @classmethod
    def check(cls, control_points: tuple[int, int] | None) -> None:
        """Check the numbers of control points, before any mesh is read.

        Raises:
            InputError: this representation cannot have them.
        """
        ...

    @classmethod
    def of(cls, template: Mesh, control_points: tuple[int, int] | None) -> Representation:
        """Return the representation of surfaces that correspond to `template`, which is finite.

        Args:
            template: usually the mean of the training shapes.
            control_points: numbers along u and v; None for the default, or for representations without control points.

        Raises:
            InputError: such surfaces do not have this representation.
        """
        ...

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, npt.NDArray[Any]]) -> Representation:
        """Return the representation from its `arrays`.

        Raises:
            InputError: the arrays do not belong together.
        """
        ...

    def arrays(self) -> Mapping[str, npt.NDArray[Any]]:
        """Return the arrays for the model file, by the names of the datasets."""
        ...

    def encode(self, vertices: FloatArray) -> FloatArray:
        """Return the vectors (..., D) that represent surfaces with the vertices (..., V, 3), mm."""
        ...

    def decode(self, vector: FloatArray) -> FloatArray:
        """Return the vertices (..., V, 3), mm, of the surfaces that the vectors (..., D) represent."""
        ...

    def directions(self, basis: FloatArray, at: FloatArray | None = None) -> FloatArray:
        """Return (3V, K) displacements of the vertices along each column of `basis` (D, K), to first order.

        Args:
            basis: directions of vectors.
            at: (D,) vector from which they lead; None for the mean. Only representations that are not linear need it.
        """
        ...


class Vertices:
    """The paper's representation (P1): all coordinates, one vertex after the other, D = 3V."""

    takes_holes: ClassVar[bool] = False
    is_linear: ClassVar[bool] = True

    @classmethod
    def check(cls, control_points: tuple[int, int] | None) -> None:
        """Check that there are no control points.

        Raises:
            InputError: they are given.
        """
        if control_points is not None:
            raise InputError("Only B-spline surfaces have control points; choose the representation bspline for them.")

    @classmethod
    def of(cls, template: Mesh, control_points: tuple[int, int] | None) -> Vertices:
        """Return the representation; `template` is not needed.

        Raises:
            InputError: `control_points` are given.
        """
        cls.check(control_points)
        return cls()

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, npt.NDArray[Any]]) -> Vertices:
        """Return the representation; a model file contains no arrays for it."""
        return cls()

    def arrays(self) -> Mapping[str, npt.NDArray[Any]]:
        """Return no arrays."""
        return {}

    def encode(self, vertices: FloatArray) -> FloatArray:
        """Return (..., 3V) from vertices (..., V, 3)."""
        return vertices.reshape(*vertices.shape[:-2], -1)

    def decode(self, vector: FloatArray) -> FloatArray:
        """Return vertices (..., V, 3) from (..., 3V)."""
        return vector.reshape(*vector.shape[:-1], -1, 3)

    def directions(self, basis: FloatArray, at: FloatArray | None = None) -> FloatArray:
        """Return `basis` itself."""
        return basis


class BSplineSurface:
    """Control points of a tensor-product cubic B-spline surface over a one-to-one map of the template, D = 3mn.

    Control points are those of regularised least squares with equal weights of the vertices, so that |x| is the same
    norm as that of `Vertices`. Vertices that are not-a-number have no weight: the thin-plate energy determines them.

    Args:
        uv: (V, 2) position of each vertex on the unit square.
        counts: m control points along u and n along v; the vector contains x, y, z of (0, 0), then of (0, 1), and so
            on.
        detail: (V, 3) mm added to the spline's vertices, the same for every shape; None for no detail.

    Raises:
        InputError: positions off the square, too few or too many control points.
    """

    takes_holes: ClassVar[bool] = True
    is_linear: ClassVar[bool] = True
    _keeps_detail: ClassVar[bool] = False

    def __init__(self, uv: FloatArray, counts: tuple[int, int], detail: FloatArray | None = None) -> None:
        self.spline = SplineSquare(read_only(uv), counts)
        self.detail = None if detail is None else read_only(detail)
        if self.detail is not None and not (self.detail.shape == (len(uv), 3) and np.isfinite(self.detail).all()):
            raise InputError("The detail of a B-spline surface must be one finite offset (3,) per vertex.")
        # Zero except for rounding and smoothing; with it the template is restored exactly.
        self._net_of_detail = 0.0 if self.detail is None else self.spline.fit(self.detail)

    @classmethod
    def check(cls, control_points: tuple[int, int] | None) -> None:
        """Check that there are neither too few nor too many control points.

        Raises:
            InputError: there are too few or too many.
        """
        check_counts(control_points or CONTROL_POINTS)

    @classmethod
    def of(cls, template: Mesh, control_points: tuple[int, int] | None) -> BSplineSurface:
        """Return the surfaces over `disc_map` of `template`.

        Raises:
            MeshError: the template cannot be mapped to a square.
            InputError: too few or too many control points.
        """
        cls.check(control_points)
        counts = control_points or CONTROL_POINTS
        if counts[0] * counts[1] > len(template.vertices):
            raise InputError(
                f"{counts[0]}x{counts[1]} control points are more than the {len(template.vertices)} vertices of the "
                "meshes; ask for fewer."
            )
        surface = cls(disc_map(template), counts)
        if not cls._keeps_detail:
            return surface
        return cls(surface.spline.uv, counts, template.vertices - surface.decode(surface.encode(template.vertices)))

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, npt.NDArray[Any]]) -> BSplineSurface:
        """Return the surfaces from their `arrays`.

        Raises:
            InputError: an array is missing, or they do not belong together.
        """
        missing = [name for name in ("uv", "control_counts", "degree") if name not in arrays]
        if missing or (cls._keeps_detail and "detail" not in arrays):
            raise InputError(f"A B-spline surface needs the array {(missing or ['detail'])[0]!r}.")
        if arrays["control_counts"].shape != (2,) or arrays["degree"].shape != () or arrays["degree"] != DEGREE:
            raise InputError("The B-spline surfaces of this version are cubic, with two numbers of control points.")
        m, n = (int(count) for count in arrays["control_counts"])
        detail = arrays["detail"].astype(np.float64) if cls._keeps_detail else None
        return cls(arrays["uv"].astype(np.float64), (m, n), detail)

    def arrays(self) -> Mapping[str, npt.NDArray[Any]]:
        """Return `uv` (V, 2), `control_counts` (2,) and `degree` (), and `detail` (V, 3) if the file keeps it."""
        arrays: dict[str, npt.NDArray[Any]] = {
            "uv": self.spline.uv,
            "control_counts": np.array(self.spline.counts, dtype=np.int32),
            "degree": np.array(DEGREE, dtype=np.int32),
        }
        return arrays if self.detail is None else {**arrays, "detail": self.detail}

    def encode(self, vertices: FloatArray) -> FloatArray:
        """Return (..., 3mn) from vertices (..., V, 3), of which some may be not-a-number."""
        shapes = vertices.reshape(-1, *vertices.shape[-2:])
        # Shapes are encoded one at a time, so that the code of a shape does not depend on the others, to the last bit.
        out = np.stack([self._control_points(shape).ravel() for shape in shapes])
        return out.reshape(*vertices.shape[:-2], -1)

    def _control_points(self, shape: FloatArray) -> FloatArray:
        plain = shape if self.detail is None else shape - self.detail
        there: BoolArray = np.logical_and.reduce(np.isfinite(plain), axis=1)
        weights = None if there.all() else np.asarray(there, dtype=np.float64)
        return self.spline.fit(np.where(there[:, None], plain, 0.0), weights) + self._net_of_detail

    def decode(self, vector: FloatArray) -> FloatArray:
        """Return vertices (..., V, 3) from (..., 3mn).

        Raises:
            InputError: vectors of another length.
        """
        size = 3 * self.spline.counts[0] * self.spline.counts[1]
        if vector.shape[-1] != size:
            raise InputError(f"These B-spline surfaces have {size} numbers, not {vector.shape[-1]}.")
        nets = vector.reshape(-1, size // 3, 3)
        out = np.stack([self.spline.values(net) for net in nets])
        if self.detail is not None:
            out += self.detail
        return out.reshape(*vector.shape[:-1], -1, 3)

    def directions(self, basis: FloatArray, at: FloatArray | None = None) -> FloatArray:
        """Return (3V, K) from `basis` (3mn, K)."""
        D, K = basis.shape
        return self.spline.values(basis.reshape(D // 3, 3 * K)).reshape(-1, K)


class DetailedBSplineSurface(BSplineSurface):
    """B-spline surfaces with the detail of the mean that the spline cannot represent, the same for every shape."""

    _keeps_detail: ClassVar[bool] = True


class Articulated(Vertices):
    """Tangent vertices of several parts: shapes of the parts and their relative poses, D = 3V (S1-S7).

    Args:
        parts: the parts in their mean shapes and relative poses.
    """

    is_linear: ClassVar[bool] = False

    def __init__(self, parts: Articulation) -> None:
        self.parts = parts

    @classmethod
    def of(cls, template: Mesh, control_points: tuple[int, int] | None) -> Articulated:
        """Raise, since a mesh does not state its parts.

        Raises:
            InputError: always.
        """
        raise InputError(
            "Models of several parts have the representation articulated if their relative pose is modelled; set "
            "relative_pose (--relative-pose) instead of the representation."
        )

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, npt.NDArray[Any]]) -> Articulated:
        """Return the representation from its `arrays`.

        Raises:
            InputError: an array is missing, or they do not belong together.
        """
        if missing := [name for name in ("template", "part_counts") if name not in arrays]:
            raise InputError(f"A model of several parts needs the array {missing[0]!r}.")
        template, counts = arrays["template"].astype(np.float64), arrays["part_counts"]
        if template.ndim != 2 or template.shape[1] != 3 or counts.ndim != 1 or not np.isfinite(template).all():
            raise InputError("The template of a model of several parts must be finite vertices (V, 3).")
        return cls(Articulation(read_only(template), counts.tolist()))

    def arrays(self) -> Mapping[str, npt.NDArray[Any]]:
        """Return `template` (V, 3) and `part_counts` (P,)."""
        return {"template": self.parts.template, "part_counts": np.array(self.parts.counts, dtype=np.int32)}

    def encode(self, vertices: FloatArray) -> FloatArray:
        """Return (..., 3V) from vertices (..., V, 3) in any pose."""
        shapes = vertices.reshape(-1, *vertices.shape[-2:])
        return np.stack([self.parts.encode(shape).ravel() for shape in shapes]).reshape(*vertices.shape[:-2], -1)

    def decode(self, vector: FloatArray) -> FloatArray:
        """Return vertices (..., V, 3), rigidly aligned to the template, from (..., 3V)."""
        rows = vector.reshape(-1, len(self.parts.template), 3)
        return np.stack([self.parts.decode(row) for row in rows]).reshape(*vector.shape[:-1], -1, 3)

    def directions(self, basis: FloatArray, at: FloatArray | None = None) -> FloatArray:
        """Return `basis` at the template, else the derivatives of `decode` at `at`."""
        return basis if at is None else self.parts.directions(basis, at.reshape(-1, 3))


REPRESENTATIONS: Mapping[str, type[Representation]] = {
    "vertices": Vertices,
    "bspline": BSplineSurface,
    "bspline-detail": DetailedBSplineSurface,
    "articulated": Articulated,
}
"""Representations by their names in model files."""


def representation_named(name: str, control_points: tuple[int, int] | None) -> type[Representation]:
    """Return the representation of that name, and check its control points.

    Raises:
        InputError: there is no such representation, or it cannot have these control points.
    """
    if name not in REPRESENTATIONS:
        raise InputError(f"There is no representation {name!r}; choose one of {', '.join(REPRESENTATIONS)}.")
    REPRESENTATIONS[name].check(control_points)
    return REPRESENTATIONS[name]
