"""What `data` does: open data sets, and simulated faces and organs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from shapespace.batch.progress import progress, steps
from shapespace.commands.about import write_about
from shapespace.errors import InputError
from shapespace.io.files import make_folder


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
    source: str,
    subjects: int,
    expressions: Sequence[str],
    seed: int,
    area: str | None,
    quiet: bool,
    raw: bool = False,
    wide: bool = False,
    intensities: Sequence[float] = (1.0,),
    effect_mm: float | None = None,
) -> int:
    """Write corresponded faces of the bundled or of the ICT generator, or raw scans of them, and return how many.

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
    said = f"{subjects} simulated {who} of {of}, seed {seed}, expressions: {', '.join(expressions)}"
    write_about(folder, said, licence)
    return total


def write_simulated_bones(folder: Path, *, count: int, seed: int, effect_mm: float, quiet: bool) -> None:
    """Write raw scans of simulated bones of two groups, and their table.

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


def write_simulated_organs(folder: Path, *, count: int, seed: int, volumes: bool, quiet: bool) -> None:
    """Write raw surfaces, or label volumes, of simulated organs.

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
