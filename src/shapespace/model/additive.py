"""Models with separate identity and expression: x = mean + A a + B e, as a rotation of a shape model's coefficients.

A contains the modes of neutral shapes, B those of expression minus the same person's neutral. With a and e normal and
independent, x has the covariance A La A^T + B Le B^T, whose eigenvectors are a shape model like any other: a fit of
that model is a joint fit of a and e, and [a; e] in standard deviations is its z, rotated. Source: method.md 8; Amberg,
Knothe and Vetter, FG 2008, for the additive model of expressions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy.linalg import eigh

from shapespace.errors import InputError, ModelFileError
from shapespace.formats.model_parts import LinearModel
from shapespace.geometry.mirror_plane import mirrored_note
from shapespace.geometry.normals import without_estimates
from shapespace.geometry.procrustes import Gauge, align_in_place
from shapespace.geometry.similarity import fit_similarity
from shapespace.io.containers.hdf5 import read_hdf5
from shapespace.io.interop import as_meshes
from shapespace.lazy import lazy_import
from shapespace.model import model_file
from shapespace.model.choose_modes import modes_notes
from shapespace.model.foreign import Foreign, is_foreign, load_foreign, parted
from shapespace.model.krylov import largest_eigenpairs
from shapespace.model.local_modes import local_modes
from shapespace.model.new_shapes import HeldOut, held_out_shapes, variances_of_new_shapes
from shapespace.model.pca import modes_for_variance, plain_modes, principal_components, varying
from shapespace.model.shape_model import ShapeModel, odd_size_notes
from shapespace.reprs import short_repr
from shapespace.types import FloatArray, IntArray, Mesh, SurfaceLandmarks, common_faces, read_only

_STILL_ROUNDS = 3  # iterations of the alignment on the parts that expressions do not move
_STILL_SHAPES = 60  # shapes, evenly spread, that show which vertices expressions move
_NO_VARIANCE = 1e-10  # share of the first eigenvalue; below is rounding error
_NO_MOTION_MM = 1e-6  # mm per coordinate; far below any scanner's resolution
_LOCAL_MODES = 150  # local modes of identity that are added when the number of modes is automatic


@dataclass(frozen=True, eq=False)
class FitInformation:
    """The information of one fit on [a; e], in standard deviations, without its prior.

    The precision and the information vector are the natural parameters of a normal distribution.

    Args:
        precision: (K, K) precision from the scan alone.
        vector: (K,) precision @ the estimate from the scan alone.
    """

    precision: FloatArray
    vector: FloatArray


@dataclass(frozen=True, eq=False)
class AdditiveModel:
    """A shape model whose coefficients z split into identity a and expression e: [a; e] = rotation @ z.

    All coefficients here are in standard deviations; `shape.to_b` has them in mm.

    Args:
        shape: the shape model for fitting; its covariance is that of identity plus that of expression.
        rotation: (K, K) orthogonal; its first `n_identity` rows map z to a, the others to e, in standard deviations.
        n_identity: number of identity coefficients.

    Raises:
        InputError: parts that do not belong together.
    """

    shape: ShapeModel
    rotation: FloatArray
    n_identity: int

    __repr__ = short_repr

    def _repr_html_(self) -> str:
        return lazy_import("html_of_additive_model")(self)

    def __post_init__(self) -> None:
        rotation, k = read_only(self.rotation), self.shape.n_modes
        if rotation.shape != (k, k) or not 1 <= self.n_identity < k:
            raise InputError(
                f"An additive model of {k} modes needs a ({k}, {k}) rotation and 1 to {k - 1} identity modes, not "
                f"{rotation.shape} and {self.n_identity}."
            )
        if not np.allclose(rotation @ rotation.T, np.eye(k), atol=1e-6):
            raise InputError("The rotation of an additive model must be orthogonal.")
        object.__setattr__(self, "rotation", rotation)

    @classmethod
    def fit(
        cls,
        meshes: Sequence[Mesh],
        subjects: Sequence[str],
        neutral: Sequence[bool],
        *,
        identity_modes: int | float | Literal["all"] | None = "all",
        expression_modes: int | float | Literal["all"] | None = 0.99,
        gauge: Gauge = "shape",
        alignment_vertices: IntArray | None = None,
        local_identity_modes: int | None = None,
        still_share: float = 0.3,
        kin: Sequence[str] | None = None,
        landmarks: Mapping[str, int] | None = None,
        provenance: str = "",
        licence: str = "",
    ) -> AdditiveModel:
        """Build the model of corresponding `meshes`, in mm.

        The directions of the modes are those of all meshes, their variances those of held-out people.
        The part of a new face outside the modes of identity belongs to additional smooth local modes, which count as
        identity, so that it is not interpreted as an expression.

        Args:
            meshes: corresponding meshes, at least two neutral ones, and one or more expressions of people whose neutral
                is among them.
            subjects: (N,) name of the person of each mesh.
            neutral: (N,) whether each mesh is a neutral face; a person's neutrals are averaged.
            identity_modes: a number, fewer if the meshes determine fewer; a float below 1 for a share of the variance;
                `all`.
            expression_modes: number of modes of expression, as for `identity_modes`.
            local_identity_modes: maximum number of smooth local modes of identity, in addition to those of the people;
                None for 150, or for none if `identity_modes` is a number. The less variance is outside the people's
                modes, the fewer are kept.
            gauge: `shape` removes size, `form` keeps it.
            alignment_vertices: indices of the vertices that determine the alignment, such as forehead and nose; None
                takes the vertices that expressions move least.
            still_share: number of those vertices as a share of all.
            kin: (N,) names of the groups that are held out together when variances are estimated, such as a face and
                its mirror image; None takes `subjects`.
            landmarks: landmarks of the model: named points on the surface (`place_landmarks`), or name -> vertex.
            provenance: description of the meshes.
            licence: licence of the meshes.

        Raises:
            CorrespondenceError: the meshes differ in vertices or triangles.
            InputError: there are too few meshes, or an expression without its person's neutral.
        """
        identity_modes, expression_modes = plain_modes(identity_modes), plain_modes(expression_modes)
        meshes = [without_estimates(mesh) for mesh in as_meshes(meshes, "AdditiveModel.fit")]
        faces = common_faces(meshes)
        for mesh in meshes:
            if np.isnan(mesh.vertices).any():
                raise InputError(
                    f"{mesh.name}: vertices are missing, and a model that separates identity and expression needs "
                    "complete meshes; omit --additive, or exclude the meshes with holes."
                )
        neutrals, shapes, people, expressive = _neutrals_and_expressions(meshes, subjects, neutral, kin)
        row = np.array([people.index(subjects[i]) for i in expressive])
        still = still_vertices(neutrals[row], shapes, still_share) if alignment_vertices is None else alignment_vertices
        align_in_place(neutrals, gauge, alignment_vertices=still)
        for k, r in enumerate(row):
            T = fit_similarity(shapes[k][still], neutrals[r][still], with_scale=gauge == "shape")
            shapes[k] = T.apply(shapes[k]) - neutrals[r]
        kin_of = dict(zip(subjects, kin or subjects, strict=True))
        if local_identity_modes is None:
            local_identity_modes = 0 if isinstance(identity_modes, int) else _LOCAL_MODES
        whose = [kin_of[name] for name in people], [kin_of[subjects[i]] for i in expressive]
        mean, A, of_identity = _identity_modes(neutrals, whose[0], identity_modes, local_identity_modes)
        B, of_expression = _expression_modes(shapes.reshape(len(shapes), -1), whose[1], expression_modes)
        (basis, stddev), rotation = _as_shape_model(A, B)
        model = ShapeModel(
            mean=mean,
            basis=basis,
            stddev=stddev,
            total_variance=float((of_identity + of_expression).sum()),
            n_training=len(meshes),
            faces=faces,
            gauge=gauge,
            landmarks=SurfaceLandmarks.of(landmarks or {}),
            provenance=provenance,
            licence=licence,
            held_out=True,
            notes=[
                *mirrored_note(lambda i: meshes[i].vertices, lambda i: meshes[i].name, len(meshes)),
                *modes_notes(identity_modes, A.shape[1], len(people), "neutral shapes"),
                *modes_notes(expression_modes, B.shape[1], len(expressive), "expressions"),
                *odd_size_notes(mean.reshape(-1, 3)),
            ],
        )
        return cls(model, rotation, A.shape[1])

    @property
    def n_expression(self) -> int:
        """Number of expression coefficients."""
        return self.shape.n_modes - self.n_identity

    def split(self, z: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return identity a (..., Ka) and expression e (..., Ke), in standard deviations, of coefficients z (..., K).

        Raises:
            InputError: another number of coefficients than the model's, or some that are not finite.
        """
        t = self._check_coefficients(z) @ self.rotation.T
        return t[..., : self.n_identity], t[..., self.n_identity :]

    def join_z(self, a: npt.ArrayLike, e: npt.ArrayLike) -> FloatArray:
        """Return z (K,) of identity `a` and expression `e`, the inverse of `split`; missing coefficients are zero.

        An e of () is the neutral face.

        Raises:
            InputError: more coefficients than the model has, or some that are not finite.
        """
        t = np.zeros(self.shape.n_modes)
        for start, count, part, what in (
            (0, self.n_identity, a, "identity"),
            (self.n_identity, self.n_expression, e, "expression"),
        ):
            values = np.atleast_1d(np.asarray(part, dtype=np.float64))
            if values.ndim != 1 or len(values) > count or not np.isfinite(values).all():
                raise InputError(f"There are at most {count} finite coefficients of {what}, not {values.shape}.")
            t[start : start + len(values)] = values
        return t @ self.rotation

    def mesh(self, a: npt.ArrayLike, e: npt.ArrayLike) -> Mesh:
        """Return the surface of identity `a` with expression `e`, mm."""
        return self.shape.mesh(self.shape.to_b(self.join_z(a, e)))

    def transfer(self, z_of: npt.ArrayLike, z_expression: npt.ArrayLike) -> Mesh:
        """Return the person of coefficients `z_of` (K,) with the expression of `z_expression` (K,), as a mesh in mm."""
        return self.mesh(self.split(z_of)[0], self.split(z_expression)[1])

    def information(self, z: npt.ArrayLike, z_covariance: npt.ArrayLike) -> FitInformation:
        """Return the information of a fit on identity and expression, for `tie`.

        Args:
            z: (K,) coefficients, in standard deviations: `FitResult.z`.
            z_covariance: (K, K) covariance of z after the fit: `FitResult.z_covariance`. The diagonal alone is not
                enough, since the coefficients are correlated after the fit.

        Raises:
            InputError: arrays of other shapes, or no covariance.
        """
        z, covariance = self._check_coefficients(z), np.asarray(z_covariance, dtype=np.float64)
        k = self.shape.n_modes
        if z.ndim != 1 or covariance.shape != (k, k) or not np.isfinite(covariance).all():
            raise InputError(
                f"Give ({k},) coefficients and their ({k}, {k}) covariance, as the robust method returns them."
            )
        values, vectors = eigh(covariance)
        if values[0] <= 0:
            raise InputError("The covariance of coefficients must be positive definite.")
        known, turned = np.maximum(1.0 / values - 1.0, 0.0), self.rotation @ vectors
        return FitInformation((turned * known) @ turned.T, turned @ ((known + 1.0) * (vectors.T @ z)))

    def tie(
        self, fits: Sequence[FitInformation], neutral: Sequence[bool] | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return one identity and the expressions of several scans of one person, from all their fits together.

        The normal equations are block-arrow, so a is solved for first and each e after it. The part of identity outside
        the model is the same in all scans of a person and does not average out, so n scans, each with the prior of its
        own e, count 1/n each: the same scan n times has the result of one scan. For the same reason e is closer to the
        truth after subtracting the e of a neutral scan of the same call.

        Args:
            fits: the information of each fit.
            neutral: (n,) whether each scan is known to show the neutral face, with e = 0; None if no scan is.

        Returns:
            a (Ka,) and e (n, Ke), in standard deviations.

        Raises:
            InputError: there are no scans, or another number of values of `neutral`.
        """
        if not fits or (neutral is not None and len(neutral) != len(fits)):
            raise InputError("Pass at least one estimate of a fit, and one value of neutral for each or none.")
        k, share = self.n_identity, 1.0 / len(fits)
        left: FloatArray = np.eye(k)
        right: FloatArray = np.zeros(k)
        solves: list[FloatArray | None] = []
        for number, fit in enumerate(fits):
            precision, vector = share * fit.precision, share * fit.vector
            left, right = left + precision[:k, :k], right + vector[:k]
            if neutral is not None and neutral[number]:
                solves.append(None)
                continue
            cross, own = precision[:k, k:], precision[k:, k:] + share * np.eye(self.n_expression)
            solved = np.asarray(np.linalg.solve(own, np.column_stack([cross.T, vector[k:]])), dtype=np.float64)
            left, right = left - cross @ solved[:, :-1], right - cross @ solved[:, -1]
            solves.append(solved)
        a: FloatArray = np.asarray(np.linalg.solve(left, right), dtype=np.float64)
        rest = np.zeros(self.n_expression)
        return a, np.stack([rest if s is None else s[:, -1] - s[:, :-1] @ a for s in solves])

    def save(self, path: Path | str) -> None:
        """Write a model file that also reads as the plain shape model.

        Raises:
            FileError: the folder cannot be written, or the disk is full.
        """
        more = {"split_rotation": self.rotation}, {"split_identity": self.n_identity}
        model_file.save(self.shape.fields(), Path(path), *more)

    @classmethod
    def load(cls, path: Path | str) -> AdditiveModel:
        """Read a model written by `save`, or one of another tool that has modes of identity and of expression.

        Raises:
            FileError: the file cannot be read.
            ModelFileError: the file is damaged, of another version, or does not separate identity and expression.
        """
        if is_foreign(Path(path)):
            foreign = load_foreign(Path(path))
            model = model_of_foreign(foreign, Path(path))
            if isinstance(model, ShapeModel):
                raise ModelFileError(
                    f"{path} ({foreign.format}) does not separate identity and expression; give a model that does."
                )
            return model
        return _read_additive(ShapeModel.load(path), Path(path))

    def as_linear(self) -> LinearModel:
        """Return the model as formats of other tools can represent it, with separate identity and expression."""
        return parted(self.shape.as_linear(), self.rotation, self.n_identity)

    def _check_coefficients(self, z: npt.ArrayLike) -> FloatArray:
        array = np.asarray(z, dtype=np.float64)
        if array.ndim < 1 or array.shape[-1] != self.shape.n_modes or not np.isfinite(array).all():
            raise InputError(f"Give {self.shape.n_modes} finite coefficients for each shape, not {array.shape}.")
        return array


def load_model(path: Path) -> ShapeModel | AdditiveModel:
    """Return the model in `path`, as an `AdditiveModel` if its file separates identity and expression.

    Raises:
        FileError: the file cannot be read.
        ModelFileError: the file is damaged, of another version, or not a model.
    """
    if is_foreign(path):
        return model_of_foreign(load_foreign(path), path)
    shape = ShapeModel.load(path)
    try:
        return _read_additive(shape, path)
    except ModelFileError:
        return shape


def model_of_foreign(foreign: Foreign, path: Path) -> ShapeModel | AdditiveModel:
    """Return the model of another tool, an `AdditiveModel` if it separates identity and expression.

    Args:
        foreign: content of the file.
        path: path of the file.

    Raises:
        ModelFileError: the arrays of the file do not form a model.
    """
    shape = ShapeModel.of_foreign(foreign, path)
    return shape if foreign.rotation is None else AdditiveModel(shape, foreign.rotation, foreign.n_identity)


def _read_additive(shape: ShapeModel, path: Path) -> AdditiveModel:
    """Return the additive model of `shape` and of the two parts that its shapespace file `path` describes."""
    arrays, attributes = read_hdf5(path)
    if "split_rotation" not in arrays or "split_identity" not in attributes:
        raise ModelFileError(f"{path} does not separate identity and expression; build it with --additive LABELS.csv.")
    try:
        return AdditiveModel(shape, arrays["split_rotation"].astype(np.float64), int(attributes["split_identity"]))
    except (InputError, ValueError, TypeError, OverflowError) as error:
        raise ModelFileError(f"{path} is a shapespace model whose parts do not belong together: {error}") from error


def _neutrals_and_expressions(
    meshes: Sequence[Mesh], subjects: Sequence[str], neutral: Sequence[bool], kin: Sequence[str] | None
) -> tuple[FloatArray, FloatArray, list[str], list[int]]:
    """Return each person's mean neutral (P, V, 3), the expressions (E, V, 3), the P people, and E indices of meshes."""
    if not len(meshes) == len(subjects) == len(neutral) == len(kin or subjects):
        raise InputError("Give one subject and one value of neutral for each mesh, and kin for each or none.")
    own_neutrals: dict[str, list[FloatArray]] = {}
    for mesh, who, plain in zip(meshes, subjects, neutral, strict=True):
        if plain:
            own_neutrals.setdefault(who, []).append(mesh.vertices)
    expressive = [i for i, plain in enumerate(neutral) if not plain]
    if len(own_neutrals) < 2 or not expressive:
        raise InputError(
            f"An additive model needs the neutral faces of at least two people and some expressions, not "
            f"{len(own_neutrals)} and {len(expressive)}."
        )
    missing = sorted({subjects[i] for i in expressive} - set(own_neutrals))
    if missing:
        raise InputError(f"There is no neutral face of {', '.join(missing[:5])}; add it, or exclude these people.")
    neutrals = np.stack([np.asarray(np.mean(shapes, axis=0)) for shapes in own_neutrals.values()])
    expressions = np.stack([meshes[i].vertices for i in expressive])
    if not (np.isfinite(neutrals).all() and np.isfinite(expressions).all()):
        raise InputError(
            "The training meshes have vertices that are not finite; see shapespace check, and repair or exclude them."
        )
    return neutrals, expressions, list(own_neutrals), expressive


def still_vertices(neutrals: FloatArray, shapes: FloatArray, share: float = 0.3) -> IntArray:
    """Return the vertices that move least from `neutrals` to `shapes`, both (N, V, 3): the share `share` of all.

    The search alternates with the alignment by these vertices, on a subset of the shapes spread evenly over all; on
    faces the result is forehead, nose and the outer rim.

    Raises:
        InputError: a share outside (0, 1], or a share of fewer than three vertices.
    """
    count = round(share * shapes.shape[1])
    if not 0 < share <= 1 or count < 3:
        raise InputError(f"The share of still vertices must leave at least three vertices, not {share}.")
    still: IntArray = np.arange(shapes.shape[1], dtype=np.int32)
    some = np.unique(np.linspace(0, len(shapes) - 1, _STILL_SHAPES).round().astype(np.int64))
    for _ in range(_STILL_ROUNDS):
        moved = np.zeros(shapes.shape[1])
        for neutral, shape in zip(neutrals[some], shapes[some], strict=True):
            T = fit_similarity(shape[still], neutral[still], with_scale=False)
            moved += ((T.apply(shape) - neutral) ** 2).sum(axis=1)
        still = np.sort(np.argpartition(moved, count - 1)[:count]).astype(np.int32)
    return still


def _identity_modes(
    neutrals: FloatArray, kin: Sequence[str], modes: int | float | None, most_local: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the mean (3V,), modes times standard deviations (3V, Ka), and the variance inside and outside, mm^2."""
    flat = neutrals.reshape(len(neutrals), -1)
    components, centred = principal_components(flat, modes), flat - flat.mean(axis=0)
    gram = centred @ centred.T
    held = held_out_shapes(gram, kin, len(components.variance), centred=True)
    variance = _variances_of_new_people(gram / (len(flat) - 1), len(flat), held)
    L, of_local = local_modes(components.mean.reshape(-1, 3), components.basis, variance, held.left_mm2, most_local)
    directions = np.concatenate([components.basis, L], axis=1) * np.sqrt(np.concatenate([variance, of_local]))
    return components.mean, directions, np.array([variance.sum(), held.left_mm2])


def _expression_modes(
    moved: FloatArray, kin: Sequence[str], modes: int | float | None
) -> tuple[FloatArray, FloatArray]:
    """Return modes times standard deviations (3V, Ke), and the variance inside and outside the modes, mm^2."""
    gram = moved @ moved.T
    B, sample = _modes_through_zero(moved, gram, modes)
    held = held_out_shapes(gram, kin, len(sample), centred=False)
    # There is one more mode through zero than through a mean.
    variance = _variances_of_new_people(gram / len(gram), len(gram) + 1, held)
    return B * np.sqrt(variance), np.array([variance.sum(), held.left_mm2])


def _modes_through_zero(
    data: FloatArray, gram: FloatArray, wanted: int | float | None
) -> tuple[FloatArray, FloatArray]:
    """Return modes (D, K) and second moments (K,) about zero of `data` (N, D), whose products are `gram` (N, N).

    About zero and not the mean: neutral is zero, and an expression lies on a line through it.
    """
    values, vectors = largest_eigenpairs(gram / len(data))
    total = float(values.sum())
    if total <= data.shape[1] * _NO_MOTION_MM**2:
        raise InputError("No expression differs from its neutral face, so there is nothing to model.")
    count = len(varying(values))
    if isinstance(wanted, float):
        count = min(count, modes_for_variance(values, wanted))
    elif wanted is not None:
        count = min(count, wanted)
    values, vectors = values[:count], vectors[:, :count]
    modes = data.T @ (vectors / np.sqrt(values * len(data)))
    modes *= np.sign(modes[np.abs(modes).argmax(axis=0), np.arange(count)])
    return modes, values


def _variances_of_new_people(gram: FloatArray, n_shapes: int, held_out: HeldOut) -> FloatArray:
    """Return variances (K,) of people who took no part in the modes, from the complete spectrum of `gram` (N, N)."""
    spectrum = varying(eigh(gram, eigvals_only=True)[::-1])
    return variances_of_new_shapes(spectrum, float(spectrum.sum()), n_shapes, held_out)


def _as_shape_model(A: FloatArray, B: FloatArray) -> tuple[tuple[FloatArray, FloatArray], FloatArray]:
    """Return basis (D, K), stddev (K,) and rotation (K, K) with [A B] t = basis @ (stddev * z) and t = rotation @ z."""
    W = np.concatenate([A, B], axis=1)
    orthonormal, upper = np.linalg.qr(W)
    left, stddev, right = np.linalg.svd(upper)
    if stddev[-1] <= np.sqrt(_NO_VARIANCE) * stddev[0]:
        raise InputError("Identity and expression share modes, so they cannot be separated; ask for fewer modes.")
    return (orthonormal @ left, stddev), right.T
