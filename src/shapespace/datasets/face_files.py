"""Files of simulated faces in correspondence, or of raw scans of them, with their labels and landmarks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from shapespace.datasets.faces import EXPRESSIONS, FaceGenerator, load_faces
from shapespace.datasets.simulated_scan import plain_scan
from shapespace.errors import InputError
from shapespace.geometry.normals import vertex_normals
from shapespace.io.files import make_folder
from shapespace.io.landmarks.landmark_io import write_landmark_indices
from shapespace.io.meshes.mesh_io import write_mesh
from shapespace.io.tables.table_io import write_rows
from shapespace.types import FloatArray, Mesh

_LARGEST_EFFECT_MM = 20.0  # mm; limit for a plausible chin
_CHIN_WIDTH_MM = 12.0  # mm, standard deviation of the Gaussian around the pogonion


def chin_of(faces: FaceGenerator) -> FloatArray:
    """Return (V,) how much of the chin each vertex is: 1 at its tip, with a smooth edge."""
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
        folder: created when missing.
        subjects: how many people, 1 to 100,000.
        expressions: names out of `EXPRESSIONS`, each drawn once per person.
        seed: a number of 0 or more.
        raw: as a scanner would give them, by `plain_scan`; there is then no landmarks.csv, since no vertex is the same.
        wide: whether people vary as widely as real ones; see `FaceGenerator.draw_person`.
        face_only: whether to leave out ears, crown, nape and neck; see `FaceGenerator.cut_to_face`.
        intensities: of the expressions, of which one is drawn for each; 1 is full.
        effect_mm: gives each a sex and an age in labels.csv, and men a chin that stands out by so much more, for trying
            comparisons of groups: nothing else goes with sex, and nothing with age.
        progress: called with (files written, files in all).

    Returns:
        The folder.

    Raises:
        InputError: no subjects, too many, a negative seed, an unknown or repeated expression, or such intensities or
            effects.
        FileError: the folder cannot be written.
    """
    known = list(EXPRESSIONS)
    if not 1 <= subjects <= 100_000:
        raise InputError(f"The number of subjects must lie between 1 and 100000, not at {subjects}.")
    if seed < 0:
        raise InputError(f"The seed must be 0 or more, not {seed}.")
    if not expressions or len(set(expressions)) != len(expressions):
        raise InputError("Give at least one expression, and each one once.")
    for name in expressions:
        if name not in known:
            raise InputError(f"Unknown expression {name!r}; choose one of {', '.join(known)}.")
    if effect_mm is not None and not abs(effect_mm) <= _LARGEST_EFFECT_MM:
        raise InputError(f"The effect must lie between -{_LARGEST_EFFECT_MM} and {_LARGEST_EFFECT_MM} mm.")
    if not intensities or not all(0 < intensity <= 1 for intensity in intensities):
        raise InputError("Intensities must lie above 0 and at most at 1, and there must be one.")
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
