"""The bundled simulated faces: a generator of people and expressions on one topology, made from CC0 MakeHuman assets.

The surface is head, face, ears and neck of an adult in millimetres: y up, the face looks along +z, x to the subject's
left, the pupils of the average adult 62 mm apart. A face is linear in its weights; only the weights are random. Faces
are written as files in correspondence, or as raw scans, with their labels and landmarks.
"""

from __future__ import annotations

import functools
import importlib.resources
import io
import zipfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from shapespace.datasets.simulated_scan import plain_scan
from shapespace.errors import DataError, InputError
from shapespace.geometry.mirror_plane import FLIP
from shapespace.geometry.normals import faces_of, vertex_normals
from shapespace.geometry.remesh import loop_operator
from shapespace.io.files import make_folder
from shapespace.io.landmarks.landmark_io import write_landmark_indices
from shapespace.io.meshes.mesh_io import write_mesh
from shapespace.io.tables.table_io import write_rows
from shapespace.reprs import short_repr
from shapespace.types import FloatArray, IntArray, Mesh, generator_of, read_only

LICENSE = "CC0-1.0"
"""Licence of the bundled faces and of everything the generator draws."""

EXPRESSIONS: Mapping[str, Mapping[str, float]] = MappingProxyType(
    {
        "neutral": {},
        "anger": {
            "browDown": 1.0, "eyeSquint": 0.7, "noseSneer": 0.6, "mouthPress": 0.6, "mouthFrown": 0.35,
            "mouthRollUpper": 0.25, "jawForward": 0.3, "cheekSquint": 0.2,
        },
        "disgust": {
            "noseSneer": 1.0, "mouthUpperUp": 0.9, "browDown": 0.5, "eyeSquint": 0.6, "cheekSquint": 0.7,
            "mouthFrown": 0.4, "mouthLowerDown": 0.25, "mouthShrugLower": 0.2,
        },
        "fear": {
            "browInnerUp": 1.0, "browOuterUp": 0.35, "eyeWide": 1.0, "mouthStretch": 0.9, "mouthLowerDown": 0.5,
            "jawOpen": 0.32,
        },
        "smile": {
            "mouthSmile": 0.9, "cheekSquint": 0.6, "eyeSquint": 0.4, "mouthDimple": 0.1, "mouthUpperUp": 0.3,
            "jawOpen": 0.06,
        },
        "sadness": {
            "browInnerUp": 1.0, "mouthFrown": 0.9, "mouthShrugLower": 0.5, "eyeLookDown": 0.35, "eyeSquint": 0.2,
            "mouthPucker": 0.1,
        },
        "surprise": {
            "browInnerUp": 0.9, "browOuterUp": 1.0, "eyeWide": 1.0, "jawOpen": 0.65, "mouthFunnel": 0.1,
        },
    }
)  # fmt: skip
"""Name -> {unit: weight at full intensity}; a unit without a side applies to both sides."""

# Standard deviation of the weights of each kind of detail; weights are bounded by 2.5 standard deviations.
_SPREAD = {
    "asym": 0.05, "cheek": 0.22, "chin": 0.18, "ear": 0.20, "eyebrows": 0.18, "eye": 0.22, "forehead": 0.06,
    "head": 0.10, "mouth": 0.20, "neck": 0.08, "nose": 0.19,
}  # fmt: skip
_SIDE_SPREAD = 0.03  # standard deviation of the difference between left and right
_FACE_MM = 110.0
"""Largest distance of the vertices of a face without the head from the tip of the nose, mm."""
_OPPOSITES = {
    "decr": "incr", "down": "up", "in": "out", "backward": "forward", "concave": "convex", "compress": "uncompress",
}  # fmt: skip
_ETHNICITIES, _GENDERS = ("african", "asian", "caucasian"), ("female", "male")


@dataclass(frozen=True, eq=False)
class Person:
    """Identity weights of a simulated person.

    Args:
        weights: (I,) float64 in [0, 1], one for each of the generator's `identity_names`.
        name: name of the person, used in the names of meshes.
        warp_mm: (C, 3) displacements outside the span of those shapes, on the generator's vertices before subdivision,
            mm; None for none.
    """

    weights: FloatArray
    name: str = "person"
    warp_mm: FloatArray | None = None

    __repr__ = short_repr

    def __post_init__(self) -> None:
        object.__setattr__(self, "weights", _check_weights(self.weights, "person"))
        if self.warp_mm is not None:
            object.__setattr__(self, "warp_mm", read_only(self.warp_mm))


@dataclass(frozen=True, eq=False)
class Expression:
    """Expression weights of a simulated face.

    Args:
        weights: (U,) float64 in [0, 1], one for each of the generator's `unit_names`.
        name: one of `EXPRESSIONS`, or "mixed".
        intensity: number in [0, 1].
    """

    weights: FloatArray
    name: str = "mixed"
    intensity: float = 1.0

    __repr__ = short_repr

    def __post_init__(self) -> None:
        object.__setattr__(self, "weights", _check_weights(self.weights, "expression"))


def _check_weights(weights: npt.ArrayLike, weight_kind: str) -> FloatArray:
    out = read_only(weights)
    if out.ndim != 1 or not np.isfinite(out).all() or (out < 0).any() or (out > 1).any():
        raise InputError(f"The weights of a simulated {weight_kind} must be a list of numbers from 0 to 1.")
    return out


@dataclass(frozen=True, eq=False)
class FaceGenerator:
    """Generator of people and expressions in one topology; see `load_faces`.

    Args:
        template: the average young adult, V vertices in mm, with all landmarks.
        mirror: (V,) int32, the vertex on the other side of the face; its own inverse.
        landmarks: name -> vertex.
        regions: name -> (n,) int32 vertices; semi_rigid, eyes, mouth, ears, nose, boundary, eyeballs, mouth_interior.
        identity_names: the I shapes that make a person.
        unit_names: the U = 52 units that make an expression; mouthClose only makes sense with an open jaw, and
            tongueOut moves nothing, since the surface has no tongue.

    Example:
        >>> generator = ss.load_faces()
        >>> generator.face(generator.draw_person(0)).vertices.shape
        (12731, 3)
    """

    template: Mesh
    mirror: IntArray
    landmarks: Mapping[str, int]
    regions: Mapping[str, IntArray]
    identity_names: tuple[str, ...]
    unit_names: tuple[str, ...]
    _coarse: FloatArray = field(repr=False)
    _identity: npt.NDArray[np.float32] = field(repr=False)
    _units: npt.NDArray[np.float32] = field(repr=False)
    _generic: FloatArray = field(repr=False)
    _loop: Any = field(repr=False)

    __repr__ = short_repr

    def draw_person(self, rng: np.random.Generator | int, name: str = "person", *, wide: bool = False) -> Person:
        """Draw a plausible adult: bounded weights, symmetric except for a small asymmetry.

        Args:
            rng: generator or seed, the only source of randomness.
            name: name of the person, used in the names of the meshes.
            wide: whether the same person also differs by smooth changes at every scale (`Warp`), as real people do: a
                model of such people represents real faces for which a model of the other people is too narrow.
        """
        rng = generator_of(rng, "draw_person")
        weights = dict.fromkeys(self.identity_names, 0.0)
        ethnicity = rng.dirichlet([0.6] * len(_ETHNICITIES))
        male, old, heavy = rng.beta(0.6, 0.6), 0.7 * rng.beta(0.9, 1.6), rng.beta(2.0, 2.0)
        gender, age = (1 - male, male), {"young": 1 - old, "old": old}
        build = {"min": max(0.0, 1 - 2 * heavy), "max": max(0.0, 2 * heavy - 1)}
        for g, w_gender in zip(_GENDERS, gender, strict=True):
            for a, w_age in age.items():
                for e, w_ethnicity in zip(_ETHNICITIES, ethnicity, strict=True):
                    weights[f"{e}_{g}_{a}"] = float(w_ethnicity * w_gender * w_age)
                for b, w_build in build.items():
                    key = f"universal_{g}_{a}_{b}weight"
                    if key in weights:
                        weights[key] = float(w_build * w_gender * w_age)
        for decrease, increase in self._pairs():
            spread = _SPREAD[decrease.removeprefix("left_").split("_")[0]]
            shared = _draw_bounded_factor(rng, spread)
            sides = ("left_", "right_") if decrease.startswith("left_") else ("",)
            lopsided = decrease.startswith("left_asym")
            for side in sides:
                # An asymmetry target is drawn for each side separately; every other pair of sides shares its weight.
                x = _draw_bounded_factor(rng, spread) if lopsided else shared
                if side and not lopsided:
                    x = float(np.clip(x + _draw_bounded_factor(rng, _SIDE_SPREAD), -2.5 * spread, 2.5 * spread))
                down, up = (side + n.removeprefix("left_") for n in (decrease, increase))
                if x < 0 and down != up:
                    weights[down] = -x
                elif x > 0:
                    weights[up] = x
        identity_weights = np.array([weights[n] for n in self.identity_names])
        if not wide:
            return Person(identity_weights, name)
        mirror = self.mirror[: len(self._coarse)]  # subdivision keeps these vertices first
        return Person(
            identity_weights, name, Warp().draw(self._coarse + self._identity_change(identity_weights), mirror, rng)
        )

    def _pairs(self) -> list[tuple[str, str]]:
        """Return (towards less, towards more) for each detail on the left or in the middle; (x, x) without a pair."""
        known = set(self.identity_names)
        out: list[tuple[str, str]] = []
        for name in self.identity_names:
            stem, _, side = name.rpartition("_")
            if name.startswith(("right_", "universal_", *_ETHNICITIES)):
                continue
            if side in _OPPOSITES and f"{stem}_{_OPPOSITES[side]}" in known:
                out.append((name, f"{stem}_{_OPPOSITES[side]}"))
            elif not (side in _OPPOSITES.values() and any(f"{stem}_{k}" in known for k in _OPPOSITES)):
                out.append((name, name))
        return out

    def draw_expression(
        self, name: str, intensity: float, rng: np.random.Generator | int, variation: float = 0.12
    ) -> Expression:
        """Draw a random variant of an expression.

        Args:
            name: one of `EXPRESSIONS`.
            intensity: intensity from 0 (neutral) to 1.
            rng: generator or seed, the only source of randomness.
            variation: standard deviation of each unit between drawings, as a share of its weight.

        Raises:
            InputError: unknown name, or an intensity outside [0, 1].
        """
        if not 0 <= intensity <= 1:
            raise InputError(f"The intensity of an expression must lie between 0 and 1, not at {intensity!r}.")
        rng = generator_of(rng, "draw_expression")
        return Expression(np.clip(intensity * self._recipe(name, rng, variation), 0, 1), name, float(intensity))

    def mixed_expression(self, rng: np.random.Generator | int, variation: float = 0.03) -> Expression:
        """Draw a mixture of the six expressions, each at its own intensity, for a training set of one person.

        Args:
            rng: generator or seed, the only source of randomness.
            variation: standard deviation of each unit, as a share of its weight.
        """
        rng = generator_of(rng, "mixed_expression")
        names = [n for n in EXPRESSIONS if n != "neutral"]
        intensity = float(np.sqrt(rng.uniform()))
        shares = intensity * rng.dirichlet([0.5] * len(names))
        total = sum(
            (s * self._recipe(n, rng, variation) for n, s in zip(names, shares, strict=True)),
            np.zeros(len(self.unit_names)),
        )
        return Expression(np.clip(total, 0, 1), "mixed", intensity)

    def _recipe(self, name: str, rng: np.random.Generator, variation: float) -> FloatArray:
        if name not in EXPRESSIONS:
            raise InputError(f"Unknown expression {name!r}; choose one of {', '.join(EXPRESSIONS)}.")
        out = np.zeros(len(self.unit_names))
        for unit, weight in EXPRESSIONS[name].items():
            pair_weight = weight * (1 + _draw_bounded_factor(rng, variation))
            for side in ("Left", "Right") if unit not in self.unit_names else ("",):
                lean = 1 + (_draw_bounded_factor(rng, 0.3 * variation) if side else 0.0)
                out[self.unit_names.index(unit + side)] = min(1.0, pair_weight * lean)
        return out

    def face(self, person: Person, expression: Expression | None = None, name: str | None = None) -> Mesh:
        """Return the surface of a person with an expression, in mm, with all landmarks.

        Args:
            person: person of this generator.
            expression: expression of this generator; None for neutral.
            name: name of the mesh; None for one made from person and expression.

        Raises:
            InputError: another number of weights, or of vertices of a warp, than the generator has.
        """
        if person.warp_mm is not None and person.warp_mm.shape != self._coarse.shape:
            raise InputError("The warp of this person has another number of vertices than the generator.")
        for weights, shapes, weight_kind in (
            (person.weights, self._identity, "person"),
            (expression.weights if expression else np.zeros(len(self._units)), self._units, "expression"),
        ):
            if len(weights) != len(shapes):
                raise InputError(
                    f"This {weight_kind} has {len(weights)} weights, but the generator has {len(shapes)} shapes; draw "
                    "it from the same generator."
                )
        change = self._identity_change(person.weights)
        if person.warp_mm is not None:
            change = change + person.warp_mm
        if expression is not None:
            change = change + _combine(expression.weights, self._units)
        vertices = np.asarray(self._loop @ (self._coarse + change), dtype=np.float64)
        title = name or (person.name if expression is None else f"{person.name} {expression.name}")
        points = {k: vertices[v] for k, v in self.landmarks.items()}
        return Mesh(vertices, self.template.faces, points, title)

    def cut_to_face(self, mesh: Mesh) -> Mesh:
        """Return only the face of a surface of this generator, always the same part: no ears, crown, nape and neck.

        Models of it can be fitted to scans that show hair, a collar or only the face.
        """
        used, triangles = self._face_part
        left = mesh.vertices[used]
        return Mesh(left, triangles, {k: left[v] for k, v in self.face_landmarks.items()}, mesh.name)

    @cached_property
    def face_landmarks(self) -> Mapping[str, int]:
        """Name -> vertex of the landmarks on the part of `cut_to_face`, in its numbering."""
        number = {int(v): k for k, v in enumerate(self._face_part[0])}
        return MappingProxyType({name: number[v] for name, v in self.landmarks.items() if v in number})

    @cached_property
    def _face_part(self) -> tuple[IntArray, IntArray]:
        x = self.template.vertices
        is_face = np.linalg.norm(x - x[self.landmarks["pronasale"]], axis=1) < _FACE_MM
        triangles = faces_of(self.template)
        used, inside = np.unique(triangles[is_face[triangles].all(axis=1)], return_inverse=True)
        return used.astype(np.int32), inside.reshape(-1, 3).astype(np.int32)

    def _identity_change(self, weights: FloatArray) -> FloatArray:
        return _combine(weights - self._generic, self._identity)


def _combine(weights: FloatArray, shapes: npt.NDArray[np.float32]) -> FloatArray:
    used = np.flatnonzero(weights)
    return np.tensordot(weights[used].astype(np.float32), shapes[used], axes=1).astype(np.float64)


def _draw_bounded_factor(rng: np.random.Generator, spread: float) -> float:
    """Draw from a normal distribution truncated at 2.5 standard deviations."""
    while True:
        x = float(rng.normal())
        if abs(x) <= 2.5:
            return spread * x


@functools.cache
def load_faces() -> FaceGenerator:
    """Return the generator of the bundled simulated faces; read once, then kept.

    Raises:
        DataError: the bundled file is missing or damaged.

    Source: MakeHuman system assets and the Face Units pack, CC0 1.0; see datasets/data/faces.md.
    """
    source = importlib.resources.files("shapespace.datasets") / "data" / "faces.npz"
    try:
        with np.load(io.BytesIO(source.read_bytes()), allow_pickle=False) as packed:
            data: dict[str, npt.NDArray[Any]] = {k: packed[k] for k in packed.files}
        return _generator(data)
    except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise DataError("The bundled file faces.npz is missing or damaged; install shapespace again.") from error


def _generator(data: Mapping[str, npt.NDArray[Any]]) -> FaceGenerator:
    step = float(data["step_mm"])
    coarse = np.asarray(data["template"], dtype=np.float64) * step
    coarse_mirror = data["mirror"].astype(np.int64)
    faces = data["faces"].astype(np.int64)
    operator, refined = loop_operator(len(coarse), faces)
    edges = np.unique(np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    swapped = np.sort(coarse_mirror[edges], axis=1)
    keys, mirrored_keys = edges @ [len(coarse), 1], swapped @ [len(coarse), 1]
    mirror = np.concatenate([coarse_mirror, len(coarse) + np.searchsorted(keys, mirrored_keys)]).astype(np.int32)

    all_names, kinds = [str(n) for n in data["names"]], [str(k) for k in data["kinds"]]
    shapes = data["shapes"].astype(np.float32) * np.float32(step)
    flip = np.array([-1, 1, 1], dtype=np.float32)
    people: dict[str, npt.NDArray[np.float32]] = {}
    units: dict[str, npt.NDArray[np.float32]] = {}
    for name, kind, shape in zip(all_names, kinds, shapes, strict=True):
        into = units if kind == "unit" else people
        into[name] = shape
        opposite = name.removesuffix("Left") + "Right" if kind == "unit" else "right_" + name.removeprefix("left_")
        if name.endswith("Left") or name.startswith("left_"):
            into[opposite] = shape[coarse_mirror] * flip
    generic = np.zeros(len(people))
    for k, name in enumerate(people):
        if name.startswith(_ETHNICITIES) and name.endswith("_young"):
            generic[k] = 1 / (len(_ETHNICITIES) * len(_GENDERS))

    landmarks = {str(n): int(v) for n, v in zip(data["landmark_names"], data["landmark_vertices"], strict=True)}
    splits = np.cumsum(data["region_sizes"])[:-1]
    groups = np.split(data["region_vertices"].astype(np.int32), splits)
    regions = {str(n): g for n, g in zip(data["region_names"], groups, strict=True)}
    for array in (mirror, *regions.values()):
        array.setflags(write=False)
    vertices = np.asarray(operator @ coarse, dtype=np.float64)
    template = Mesh(vertices, refined, {k: vertices[v] for k, v in landmarks.items()}, "simulated face template")
    return FaceGenerator(
        template=template,
        mirror=mirror,
        landmarks=MappingProxyType(landmarks),
        regions=MappingProxyType(regions),
        identity_names=tuple(people),
        unit_names=tuple(units),
        _coarse=coarse,
        _identity=np.stack(list(people.values())),
        _units=np.stack(list(units.values())),
        _generic=read_only(generic),
        _loop=operator,
    )


# Smooth random deformations at several scales, for variation beyond a fixed set of shapes

_WAVES = 96  # random Fourier features of the field


@dataclass(frozen=True)
class Warp:
    """Amplitude and length scales of a random deformation, mm for a head.

    The shape is stretched along its axes, and displaced by Gaussian processes with squared-exponential covariance, each
    a sum of cosine waves in space (random Fourier features: Rahimi and Recht, NIPS 2007). No triangle is inverted as
    long as the amplitude of a field is far below its length scale.

    Args:
        stretch: standard deviation of the logarithm of the stretch along each axis; the volume stays.
        fields: (length over which a field is smooth, its standard deviation along each axis), from coarse to fine.
        lopsided: standard deviation of the asymmetric part, relative to that of the symmetric part.
    """

    stretch: float = 0.04
    fields: tuple[tuple[float, float], ...] = ((60.0, 2.6), (25.0, 1.4), (12.0, 0.6))
    lopsided: float = 0.3

    def draw(self, x: FloatArray, mirror: IntArray, rng: np.random.Generator) -> FloatArray:
        """Draw displacements (V, 3) of the vertices `x` (V, 3), mm.

        Args:
            x: (V, 3) vertices, x to the left, so that a change of sign mirrors them.
            mirror: (V,) the vertex on the other side.
            rng: the only source of randomness.
        """
        stretch = np.exp(self.stretch * rng.standard_normal(3))
        out = x * (stretch / stretch.prod() ** (1 / 3) - 1.0)
        for length_mm, stddev_mm in self.fields:
            component = _field(x, length_mm, rng)
            other = component[mirror] * FLIP
            out += stddev_mm / np.sqrt(2.0) * (component + other + self.lopsided * (component - other))
        return out


def _field(x: FloatArray, length_mm: float, rng: np.random.Generator) -> FloatArray:
    """Return a random field (V, 3) of variance 1 along each axis, smooth over `length_mm`."""
    waves, phases = rng.standard_normal((_WAVES, 3)) / length_mm, rng.uniform(0.0, 2.0 * np.pi, _WAVES)
    heights = rng.standard_normal((_WAVES, 3))
    return np.asarray(np.sqrt(2.0 / _WAVES) * np.cos(x @ waves.T + phases) @ heights, dtype=np.float64)


_LARGEST_EFFECT_MM = 20.0  # mm; limit for a plausible chin
_CHIN_WIDTH_MM = 12.0  # mm, standard deviation of the Gaussian around the pogonion


def chin_of(faces: FaceGenerator) -> FloatArray:
    """Return the (V,) weight of the chin at each vertex: 1 at its tip, with a smooth edge."""
    template = faces.template.vertices
    distance = np.linalg.norm(template - template[faces.landmarks["pogonion"]], axis=1)
    return np.exp(-0.5 * (distance / _CHIN_WIDTH_MM) ** 2)


def with_chin(faces: FaceGenerator, face: Mesh, mm: float) -> Mesh:
    """Return a face of the generator with a chin that protrudes by `mm` more."""
    return face.with_vertices(face.vertices + mm * chin_of(faces)[:, None] * vertex_normals(face))


def _sex_and_age(seed: int, subject: int) -> tuple[str, str]:
    rng = np.random.default_rng([seed, subject, 0, 3])
    return ("female", "male")[int(rng.integers(2))], f"{rng.uniform(20.0, 70.0):.1f}"


def write_faces(
    folder: Path,
    *,
    subjects: int,
    expressions: Sequence[str] = ("neutral",),
    seed: int = 0,
    raw: bool = False,
    wide: bool = False,
    face_only: bool = False,
    intensities: Sequence[float] = (1.0,),
    effect_mm: float | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Write simulated faces in correspondence: subject_000_neutral.ply and so on, labels.csv and landmarks.csv.

    Subject k is the same person whatever the number of subjects, and looks the same whatever the other expressions.

    Args:
        folder: output folder; created if it does not exist.
        subjects: number of people, 1 to 100,000.
        expressions: names from `EXPRESSIONS`, each drawn once per person.
        seed: seed, 0 or more.
        raw: whether to write raw scans (`plain_scan`) instead of surfaces in correspondence; there is then no
            landmarks.csv, since the vertices do not correspond.
        wide: whether people vary as widely as real ones; see `FaceGenerator.draw_person`.
        face_only: whether to omit ears, crown, nape and neck; see `FaceGenerator.cut_to_face`.
        intensities: intensities of the expressions, from which one is drawn for each expression; 1 is full.
        effect_mm: protrusion of the chin of men, mm, for tests of group comparisons; labels.csv then has a sex and an
            age, and nothing else depends on sex, and nothing on age. None for no such effect.
        progress: function called with (files written, files in all).

    Returns:
        The folder.

    Raises:
        InputError: no subjects, too many, a negative seed, an unknown or repeated expression, or intensities or effects
            out of range.
        FileError: the folder cannot be written.
    """
    known = list(EXPRESSIONS)
    if not 1 <= subjects <= 100_000:
        raise InputError(f"The number of subjects must lie between 1 and 100000, not at {subjects}.")
    if seed < 0:
        raise InputError(f"The seed must be 0 or more, not {seed}.")
    if not expressions or len(set(expressions)) != len(expressions):
        raise InputError("Give at least one expression, and each expression once.")
    for name in expressions:
        if name not in known:
            raise InputError(f"Unknown expression {name!r}; choose one of {', '.join(known)}.")
    if effect_mm is not None and not abs(effect_mm) <= _LARGEST_EFFECT_MM:
        raise InputError(f"The effect must lie between -{_LARGEST_EFFECT_MM} and {_LARGEST_EFFECT_MM} mm.")
    if not intensities or not all(0 < intensity <= 1 for intensity in intensities):
        raise InputError("Give one or more intensities, each above 0 and at most 1.")
    folder = make_folder(Path(folder))
    faces = load_faces()
    labels: list[tuple[str, ...]] = []
    for k in range(subjects):
        person = faces.draw_person(np.random.default_rng([seed, k]), f"subject_{k:03d}", wide=wide)
        sex, age = _sex_and_age(seed, k)
        for name in expressions:
            drawn_intensity = float(
                np.random.default_rng([seed, k, 1 + known.index(name), 2]).choice(list(intensities))
            )
            expression = faces.draw_expression(
                name, drawn_intensity, np.random.default_rng([seed, k, 1 + known.index(name)])
            )
            file = f"{person.name}_{name}.ply"
            face = faces.face(person, expression)
            if effect_mm is not None and sex == "male":
                face = with_chin(faces, face, effect_mm)
            face = faces.cut_to_face(face) if face_only else face
            rng = np.random.default_rng([seed, k, 1 + known.index(name), 1])
            write_mesh(folder / file, plain_scan(face, rng) if raw else face)
            known_of = () if effect_mm is None else (sex, age)
            labels.append((file, person.name, name, "0" if name == "neutral" else f"{drawn_intensity:g}", *known_of))
            if progress is not None:
                progress(len(labels), subjects * len(expressions))
    extra_columns = () if effect_mm is None else ("sex", "age")
    write_rows(folder / "labels.csv", ("file", "subject", "expression", "intensity", *extra_columns), labels)
    if not raw:
        write_landmark_indices(folder / "landmarks.csv", faces.face_landmarks if face_only else faces.landmarks)
    return folder
