"""Command `surface`: label volumes in files to surfaces in files."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from shapespace.batch.fit_work import naming
from shapespace.batch.progress import progress
from shapespace.batch.result_folder import names_for
from shapespace.commands.outcome import LISTED, Outcome, exit_code_of, first_lines
from shapespace.errors import ShapespaceError
from shapespace.geometry.volume_surface import SMOOTH, VolumeSurface, surface_of_volume
from shapespace.io.files import make_folder, remove_file
from shapespace.io.meshes.mesh_io import mesh_files, write_mesh
from shapespace.io.volume_io import VOLUME_ENDINGS, default_limit_bytes, read_volume, require_volumes_extra, volume_name

_MANY = 4  # surfaces; a median of fewer does not show what is usual
_OTHER_SIZE = 0.02  # relative difference of voxel sizes beyond rounding in image headers
_OTHER_VOLUME = 4.0  # ratio to the median volume; beyond it probably another object


def write_surfaces(
    volumes: Sequence[Path],
    output: Path,
    *,
    labels: int | str | Sequence[int | str] | None = None,
    smooth: float = SMOOTH,
    keep_pieces: bool = False,
    recursive: bool = False,
    max_memory_bytes: int | None = None,
    quiet: bool = False,
    say: Callable[[str], None],
) -> Outcome:
    """Write the surface of each volume as NAME.ply into `output`, in LPS coordinates and mm.

    The record of an unusable volume has an `error`.

    Args:
        volumes: label volumes, and folders of label volumes.
        output: output folder.
        labels: labels or names of segments that form one object, or `all` (default: the only label of the volume).
        smooth: standard deviation of the smoothing in voxels, 0 to 10; 0 for none (default 1.3).
        keep_pieces: keep all pieces and cavities (default: the largest piece, cavities filled, with a message).
        recursive: also search subfolders of the given folders.
        max_memory_bytes: memory limit for a volume and its surface; a volume that needs more is rejected before it is
            read (default: `MAX_MEMORY_BYTES`, 4G, or 80 % of the free memory if that is less).
        quiet: show no progress.
        say: called with each message on skipped files and unusable volumes.

    Raises:
        ShapespaceError: the extra `volumes` is not installed.
        FileError: the folder cannot be written.
        InputError: a folder without volumes.
    """
    require_volumes_extra()
    listed = mesh_files(volumes, recursive=recursive, apart_from=output, endings=VOLUME_ENDINGS, kind_name="volumes")
    for sentence in listed.left_out:
        say(sentence)
    make_folder(output)
    files = list({path.resolve(): path for path in listed.files}.values())
    records: list[dict[str, Any]] = []
    limit = default_limit_bytes() if max_memory_bytes is None else max_memory_bytes
    with progress(len(files), "making", "surface", quiet=quiet) as bar:
        for path, name in zip(files, _names(files), strict=True):
            target = output / f"{name}.ply"
            known: dict[str, Any] = {"name": name, "volume": str(path)}
            try:
                made = surface_of_volume(
                    read_volume(path, max_memory_bytes=limit),
                    labels,
                    smooth=smooth,
                    keep_pieces=keep_pieces,
                    max_memory_bytes=limit,
                )
            except (ShapespaceError, MemoryError) as error:
                short = f"{path}: there is not enough memory for it; crop or resample it, as by 3D Slicer."
                reason = short if isinstance(error, MemoryError) else naming(path, str(error))
                # A surface of an earlier run would contradict the message.
                remove_file(target)
                bar.clear()
                say(reason)
                records.append({**known, "error": reason})
            else:
                write_mesh(target, made.mesh)
                records.append({**known, "surface": str(target), **_facts(made)})
            bar.update()
    usable = [record for record in records if "error" not in record]
    _note_odd_surfaces(usable)
    for record in usable:
        record["notes"] += record["odd"]
    facts = {"folder": str(output), "volumes": len(records), "surfaces": len(usable), "records": records}
    lines = _lines(usable, len(records), output) if usable else ()
    return Outcome(facts, lines, exit_code=exit_code_of(len(records) - len(usable), len(records)))


def _lines(made: Sequence[Mapping[str, Any]], volumes: int, folder: Path) -> list[str]:
    odd = [f"{record['name']}.ply: {note}" for record in made[LISTED:] for note in record["odd"]]
    total = f"{len(made)} of {volumes} {'volume' if volumes == 1 else 'volumes'} to surfaces in {folder}: LPS, mm"
    return [*first_lines(made, _describe_record), *odd, total]


def _describe_record(record: Mapping[str, Any]) -> list[str]:
    size = " x ".join(f"{mm:.3g}" for mm in record["voxel_mm"])
    labels = f"label{'s' if len(record['labels']) > 1 else ''} {', '.join(map(str, record['labels']))}"
    line = (
        f"{record['name']}.ply: {record['triangles']:,} triangles around {record['volume_mm3']:.4g} mm3 of {labels}, "
        f"voxels of {size} mm"
    )
    return [line, *(f"  {note}" for note in record["notes"])]


def _names(files: Sequence[Path]) -> list[str]:
    """Return NAME of the surface of each volume; those of one folder that differ in their ending alone keep it."""
    bare = [path.with_name(volume_name(path)) for path in files]
    times = Counter(bare)
    alone = [short if times[short] == 1 else path for path, short in zip(files, bare, strict=True)]
    # Text after the last dot would not be part of a name.
    return names_for([path.with_name(f"{path.name}.volume") for path in alone])


def _facts(made: VolumeSurface) -> dict[str, Any]:
    faces = made.mesh.faces
    return {
        "frame": "LPS",
        "unit": "mm",
        "labels": list(made.labels),
        "voxel_mm": made.voxel_mm.tolist(),
        "voxels": made.voxels,
        "pieces": made.pieces,
        "left_out_voxels": made.left_out,
        "filled_voxels": made.filled,
        "border_voxels": made.at_border,
        "vertices": len(made.mesh.vertices),
        "triangles": 0 if faces is None else len(faces),
        "volume_mm3": made.volume_mm3,
        "bounds_mm": [made.mesh.vertices.min(axis=0).tolist(), made.mesh.vertices.max(axis=0).tolist()],
        "notes": list(made.notes),
        "odd": [],
    }


def _note_odd_surfaces(records: Sequence[dict[str, Any]]) -> None:
    """Note each surface that equals an earlier surface, has other voxels than most, or has quite another size."""
    first: dict[Any, str] = {}
    for record in records:
        earlier = first.setdefault((record["vertices"], record["volume_mm3"], *record["bounds_mm"][0]), record["name"])
        if earlier != record["name"]:
            record["odd"].append(f"It is the same surface as {earlier}.ply.")
    if len(records) < _MANY:
        return
    middle = float(np.median([record["volume_mm3"] for record in records]))
    usual = np.median(np.array([record["voxel_mm"] for record in records]), axis=0)
    others = [bool((np.abs(np.array(record["voxel_mm"]) / usual - 1) > _OTHER_SIZE).any()) for record in records]
    voxel_text = " x ".join(f"{mm:.3g}" for mm in usual)
    for record, other in zip(records, others, strict=True):
        if other and sum(others) < len(others) / 2:
            record["odd"].append(f"Most of the others have voxels of {voxel_text} mm.")
        ratio = float(record["volume_mm3"]) / middle
        if not 1 / _OTHER_VOLUME < ratio < _OTHER_VOLUME:
            record["odd"].append(f"Its volume is {ratio:.2g} times that in the middle of all.")
