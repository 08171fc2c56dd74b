"""Command `data`: open data sets, and simulated faces and organs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from shapespace.batch.progress import progress, steps
from shapespace.commands.outcome import Outcome
from shapespace.datasets import fetch
from shapespace.datasets.about import write_about
from shapespace.errors import InputError
from shapespace.io.files import make_folder


def data_list() -> Outcome:
    """List the open data sets with licence, size, hash, and whether they are here already."""
    rows = fetch.data_list()
    lines = [f"{'  ' if number else ''}{key}: {row[key]}" for row in rows for number, key in enumerate(row)]
    return Outcome(rows, lines)


def data_get(name: str, to: Path | None, *, quiet: bool) -> Outcome:
    """Download and verify a data set that is not here yet.

    Raises:
        DataError: no such data set, no network, or content that does not match its hash.
    """
    folder = str(fetch.data_get(name, to=to, progress=False if quiet else None))
    return Outcome({"folder": folder}, [folder])


def _write_about(folder: Path, noun: str, count: int, provenance: str, licence: str = "") -> Outcome:
    """Write the provenance of the simulated shapes in a folder, and return their number; an empty licence is ours."""
    from shapespace.datasets.faces import LICENSE

    write_about(folder, provenance, licence or LICENSE)
    line = f"{count} {noun}{'' if count == 1 else 's'} in {folder}"
    return Outcome({"folder": str(folder), f"{noun}s": count}, [line])


def write_simulated_faces(
    output: Path,
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
) -> Outcome:
    """Write corresponded faces of the bundled or of the ICT generator, or raw scans of such faces.

    Args:
        output: output folder.
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
        InputError: an unknown expression or area, impossible intensities, or wide people or an effect of
            ICT-FaceKit.
        DataError: ICT-FaceKit is asked for and absent.
        FileError: the folder cannot be written.
    """
    from shapespace.datasets import faces, ict  # these load the geometry, which data list does not need

    if area not in (None, "face", "face_and_head"):
        raise InputError(f"The area must be face or face_and_head, not {area!r}.")
    if wide and source == "ict-facekit":
        raise InputError("People of ICT-FaceKit vary as widely as real people already; omit --wide.")
    if tuple(intensities) != (1.0,) and source == "ict-facekit":
        raise InputError("Expressions of ICT-FaceKit are written at full intensity; omit --intensity.")
    if effect_mm is not None and source == "ict-facekit":
        raise InputError("Effects of sex exist for bundled people only; omit --effect.")
    make_folder(output)
    total = subjects * len(expressions)
    with steps(total, "writing", "face", quiet=quiet) as step:
        if source == "ict-facekit":
            ict.write_people(
                output, subjects=subjects, seed=seed, area=area or "face", expressions=expressions, raw=raw,
                progress=step,
            )  # fmt: skip
        else:
            faces.write_faces(
                output, subjects=subjects, expressions=expressions, seed=seed, raw=raw, wide=wide,
                face_only=area == "face", intensities=intensities, effect_mm=effect_mm,
                progress=step,
            )  # fmt: skip
    licence, of = ("MIT", f"ICT-FaceKit, area {area or 'face'}") if source == "ict-facekit" else ("", "shapespace")
    who = "people who vary widely" if wide else "people"
    description = f"{subjects} simulated {who} of {of}, seed {seed}, expressions: {', '.join(expressions)}"
    return _write_about(output, "face", total, description, licence)


def write_simulated_bones(
    output: Path, *, count: int = 16, seed: int = 0, effect_mm: float = 4.0, quiet: bool = False
) -> Outcome:
    """Write raw scans of simulated bones of two groups, and their table.

    Args:
        output: output folder.
        count: number of bones; the groups alternate.
        seed: random seed; bone k of a seed is the same for every count.
        effect_mm: difference of the snout length between the two groups in mm, at most 10.
        quiet: no progress.

    Raises:
        InputError: a count or an effect out of range.
        FileError: the folder cannot be written.
    """
    from shapespace.datasets.bones import write_bones

    with progress(count, "writing", "bone", quiet=quiet) as bar:
        write_bones(output, count=count, seed=seed, effect_mm=effect_mm, progress=bar.update)
    return _write_about(output, "bone", count, f"{count} simulated bones of shapespace in two groups, seed {seed}")


def write_simulated_joints(
    output: Path, *, count: int = 16, seed: int = 0, effect_degrees: float = 12.0, quiet: bool = False
) -> Outcome:
    """Write raw scans of simulated joints of two bones, and their table.

    Args:
        output: output folder.
        count: number of subjects; the groups alternate.
        seed: random seed; subject k of a seed is the same for every count.
        effect_degrees: difference of the mean flexion between the two groups in degrees, at most 60.
        quiet: no progress.

    Raises:
        InputError: a count or an effect out of range.
        FileError: the folder cannot be written.
    """
    from shapespace.datasets.joints import write_joints

    with progress(count, "writing", "subject", quiet=quiet) as bar:
        write_joints(output, count=count, seed=seed, effect_degrees=effect_degrees, progress=bar.update)
    return _write_about(output, "joint", count, f"{count} simulated joints of shapespace in two groups, seed {seed}")


def write_simulated_landmarks(output: Path, *, count: int = 40, seed: int = 0) -> Outcome:
    """Write simulated landmarks of skulls of two species at two sites (TPS, 2-D), and their table.

    Args:
        output: output folder.
        count: number of skulls; species and sites alternate.
        seed: random seed; skull k of a seed is the same for every count.

    Raises:
        InputError: a count out of range.
        FileError: the folder cannot be written.
    """
    from shapespace.datasets.skull_landmarks import write_skull_landmarks

    write_skull_landmarks(output, count=count, seed=seed)
    return _write_about(output, "skull", count, f"landmarks of {count} simulated skulls of shapespace, seed {seed}")


def write_simulated_organs(
    output: Path, *, count: int = 40, seed: int = 0, volumes: bool = False, quiet: bool = False
) -> Outcome:
    """Write raw surfaces, or label volumes, of simulated organs.

    Args:
        output: output folder.
        count: number of organs.
        seed: random seed; organ k of a seed is the same for every count.
        volumes: write label volumes (NIfTI) of the same organs instead; needs the extra `volumes`.
        quiet: no progress.

    Raises:
        InputError: too many.
        ShapespaceError: volumes, without the extra `volumes`.
        FileError: the folder cannot be written.
    """
    from shapespace.datasets.organs import write_organs

    with progress(count, "writing", "organ", quiet=quiet) as bar:
        write_organs(output, count=count, seed=seed, volumes=volumes, progress=bar.update)
    return _write_about(output, "organ", count, f"{count} simulated organs of shapespace, seed {seed}")
