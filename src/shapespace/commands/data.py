"""What `data` does: open data sets, and simulated faces and organs."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from shapespace.batch.progress import progress, steps
from shapespace.errors import InputError
from shapespace.io.containers.json_files import read_json
from shapespace.io.files import make_folder, write_text


def data_list() -> list[dict[str, object]]:
    """Return the open data sets with licence, size, hash, and whether they are here already."""
    from shapespace.datasets import fetch  # loads much, as the generators of faces do

    return fetch.data_list()


def data_get(name: str, to: Path | None, *, quiet: bool) -> Path:
    """Return the folder of a data set, downloaded and verified if it is not here yet.

    Raises:
        DataError: no such data set, no network, or content that does not match its hash.
    """
    from shapespace.datasets import fetch

    return fetch.data_get(name, to=to, progress=False if quiet else None)


def write_simulated_faces(
    folder: Path,
    *,
    source: str = "bundled",
    subjects: int = 100,
    expressions: Sequence[str] = ("neutral",),
    seed: int = 0,
    area: str | None = None,
    quiet: bool = False,
    raw: bool = False,
    wide: bool = False,
    intensities: Sequence[float] = (1.0,),
    effect_mm: float | None = None,
) -> int:
    """Write corresponded faces of the bundled or of the ICT generator, or raw scans of them, and return how many.

    Args:
        folder: output folder.
        source: `bundled`, or `ict-facekit`, which must be downloaded already.
        subjects: number of people.
        expressions: names with commas between them: neutral, anger, disgust, fear, smile, sadness, surprise.
        seed: random seed; person k of a seed is the same for every number of people.
        area: part to write (default: face of ict-facekit, face_and_head of bundled).
        quiet: no progress.
        raw: raw scans: 20,000 other triangles, any pose, 0.2 mm of noise, two small holes; they are not in
            correspondence.
        wide: bundled people who vary as widely as real ones, for models of real scans.
        intensities: intensities of bundled expressions, such as 0.3,0.6: one is drawn for each face (default: 1).
        effect_mm: also write a sex and an age into labels.csv, and move the chin of men forward by this length, mm.

    Raises:
        InputError: an unknown expression or area, intensities that cannot be, or wide people or an effect of
            ICT-FaceKit.
        DataError: ICT-FaceKit is asked for and absent.
        FileError: the folder cannot be written.
    """
    from shapespace.datasets import face_files, ict
    from shapespace.datasets.faces import LICENSE

    if area not in (None, "face", "face_and_head"):
        raise InputError(f"The area must be face or face_and_head, not {area!r}.")
    if wide and source == "ict-facekit":
        raise InputError("People of ICT-FaceKit vary as widely as real ones already; leave --wide out.")
    if tuple(intensities) != (1.0,) and source == "ict-facekit":
        raise InputError("Expressions of ICT-FaceKit are written at full intensity; leave --intensity out.")
    if effect_mm is not None and source == "ict-facekit":
        raise InputError("Effects of sex are put in bundled people only; leave --effect out.")
    make_folder(folder)
    total = subjects * len(expressions)
    with steps(total, "writing", "face", quiet=quiet) as step:
        if source == "ict-facekit":
            ict.write_people(
                folder, subjects=subjects, seed=seed, area=area or "face", expressions=expressions, raw=raw,
                progress=step,
            )  # fmt: skip
        else:
            face_files.write_faces(
                folder, subjects=subjects, expressions=expressions, seed=seed, raw=raw, wide=wide,
                face_only=area == "face", intensities=intensities, effect_mm=effect_mm,
                progress=step,
            )  # fmt: skip
    licence, of = ("MIT", f"ICT-FaceKit, area {area or 'face'}") if source == "ict-facekit" else (LICENSE, "shapespace")
    who = "people who vary widely" if wide else "people"
    description = f"{subjects} simulated {who} of {of}, seed {seed}, expressions: {', '.join(expressions)}"
    write_about(folder, description, licence)
    return total


def write_simulated_bones(
    folder: Path, *, count: int = 16, seed: int = 0, effect_mm: float = 4.0, quiet: bool = False
) -> None:
    """Write raw scans of simulated bones of two groups, and their table.

    Args:
        folder: output folder.
        count: number of bones; the groups alternate.
        seed: random seed; bone k of a seed is the same for every count.
        effect_mm: difference of the snout length between the two groups in mm, at most 10.
        quiet: no progress.

    Raises:
        InputError: a count or an effect out of range.
        FileError: the folder cannot be written.
    """
    from shapespace.datasets.bones import write_bones
    from shapespace.datasets.faces import LICENSE

    with progress(count, "writing", "bone", quiet=quiet) as bar:

        def one_more() -> None:
            bar.update()

        write_bones(folder, count=count, seed=seed, effect_mm=effect_mm, progress=one_more)
    write_about(folder, f"{count} simulated bones of shapespace in two groups, seed {seed}", LICENSE)


def write_simulated_landmarks(folder: Path, *, count: int = 40, seed: int = 0) -> None:
    """Write simulated landmarks of skulls of two species at two sites (TPS, 2-D), and their table.

    Args:
        folder: output folder.
        count: number of skulls; species and sites alternate.
        seed: random seed; skull k of a seed is the same for every count.

    Raises:
        InputError: a count out of range.
        FileError: the folder cannot be written.
    """
    from shapespace.datasets.faces import LICENSE
    from shapespace.datasets.skull_landmarks import write_skull_landmarks

    write_skull_landmarks(folder, count=count, seed=seed)
    write_about(folder, f"landmarks of {count} simulated skulls of shapespace, seed {seed}", LICENSE)


def write_simulated_organs(
    folder: Path, *, count: int = 40, seed: int = 0, volumes: bool = False, quiet: bool = False
) -> None:
    """Write raw surfaces, or label volumes, of simulated organs.

    Args:
        folder: output folder.
        count: number of organs.
        seed: random seed; organ k of a seed is the same for every count.
        volumes: write label volumes (NIfTI) of the same organs instead; needs the extra `volumes`.
        quiet: no progress.

    Raises:
        InputError: too many.
        ShapespaceError: volumes, without the extra `volumes`.
        FileError: the folder cannot be written.
    """
    from shapespace.datasets.faces import LICENSE
    from shapespace.datasets.organs import write_organs

    with progress(count, "writing", "organ", quiet=quiet) as bar:

        def one_more() -> None:
            bar.update()

        write_organs(folder, count=count, seed=seed, volumes=volumes, progress=one_more)
    write_about(folder, f"{count} simulated organs of shapespace, seed {seed}", LICENSE)


ABOUT = "about.json"


def write_about(folder: Path, provenance: str, licence: str) -> None:
    """Write what the meshes in `folder` are.

    Raises:
        FileError: it cannot be written.
    """
    write_text(folder / ABOUT, json.dumps({"provenance": provenance, "licence": licence}, indent=1) + "\n")


def read_about(folder: Path) -> tuple[str, str] | None:
    """Return the provenance and licence of the meshes in `folder`, or None if no file states them."""
    path = folder / ABOUT
    if not path.is_file():
        return None
    try:
        stored = read_json(path, "make the faces again")
        return str(stored["provenance"]), str(stored["licence"])
    except (ValueError, KeyError, TypeError):
        return None
