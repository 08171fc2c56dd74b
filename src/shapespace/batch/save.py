"""Write a fit made in Python as the command line does."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path

from shapespace.batch.fit_records import Source, fit_record
from shapespace.batch.fit_work import publish
from shapespace.batch.lock import only_writer
from shapespace.batch.result_folder import RECORD, CoefficientTable, names_for
from shapespace.errors import InputError, ShapespaceError
from shapespace.fit.result import FitResult
from shapespace.io.files import make_folder, sha256_of_file
from shapespace.store.results import Results
from shapespace.types import Mesh

_FORBIDDEN = re.compile(r'[<>:"/\\|?*\x00-\x1f]')
"""Characters that file names cannot contain on some systems."""
_HASH_CHARACTERS = 12  # hexadecimal digits, 48 bits: no two of a million scans share them by chance


def save_fit(result: FitResult, folder: Path, name: str, *, stages: bool) -> Path:
    """Implement `FitResult.save`."""
    if name and (_FORBIDDEN.search(name) or name in (".", "..")):
        raise InputError(f"{name!r} cannot be the name of files; leave out slashes, colons and the like.")
    make_folder(folder)
    with only_writer(folder):
        scan = _scan(result, folder)
        if not name and "scan" in result.files:
            [name] = names_for([result.files["scan"]], folder)
        name = name or _free_name(scan, folder)
        record = fit_record(result, scan, _model(result, folder), _landmarks(result))
        publish(result, record, name, folder, stages=stages)
        table = CoefficientTable(folder, [name], result.model.n_modes)
        table.add(name, record)
        table.save()
    return folder / f"{name}{RECORD}"


def _scan(result: FitResult, folder: Path) -> Source:
    if "scan" in result.files:
        return Source.hashed(result.files["scan"], folder)
    return Source(result.scan_name, _hash_of(result.scan))


def _hash_of(mesh: Mesh) -> str:
    content = hashlib.sha256(mesh.vertices.astype("<f8").tobytes())
    if mesh.faces is not None:
        content.update(mesh.faces.astype("<i4").tobytes())
    return content.hexdigest()


def _model(result: FitResult, folder: Path) -> Source:
    file = result.files.get("model") or result.model.file
    return Source.of_file(file, result.model_hash, folder) if file else Source("", result.model_hash)


def _landmarks(result: FitResult) -> Source | None:
    file = result.files.get("landmarks")
    return Source(file.name, sha256_of_file(file)) if file else None


def _free_name(scan: Source, folder: Path) -> str:
    """Return NAME for a scan without a file: its own name, unless another scan has results of that name."""
    stem = _FORBIDDEN.sub("_", Path(scan.name).stem).strip(". ") or "scan"
    results = Results(folder)
    try:
        free = stem not in results or results.fit(stem).scan.hash == scan.content_hash
    except ShapespaceError:
        free = False
    return stem if free else f"{stem}_{scan.content_hash[:_HASH_CHARACTERS]}"
