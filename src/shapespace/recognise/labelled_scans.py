"""Coefficients of fitted scans with labels, from records or a coefficients.csv, in the order given."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from shapespace.cohort.table import Labels, names_of_file
from shapespace.errors import FileFormatError, InputError
from shapespace.io.containers.json_files import check_file
from shapespace.io.files import read_bytes
from shapespace.io.tables.table_io import table_rows
from shapespace.reprs import short_repr
from shapespace.schemas import FitRecord
from shapespace.store.results import Results, modes_of
from shapespace.types import BoolArray, FloatArray, read_only

NEUTRAL = "neutral"
"""Default label of neutral faces."""

STATUSES = ("converged", "max_iterations", "doubtful", "failed")
_LARGEST_BYTES = 2**28  # 256 MiB
_TABLE_AGAIN = "run shapespace fit to write it again, or take the column checksum out if that was meant"


@dataclass(frozen=True, eq=False)
class ScanCoefficients:
    """Coefficients, labels and status of one fitted scan.

    Args:
        name: name of the fit.
        status: status of the fit: `converged`, `max_iterations`, `doubtful` or `failed`.
        reason: reason for the status.
        z: (K,) coefficients in standard deviations; None if the fit failed.
        model_hash: content hash of the model.
        label: class of the scan; empty if not known.
        subject: subject of the scan; empty if not known.
        file: name of the scan's file; empty if not known.
    """

    name: str
    status: str
    reason: str
    z: FloatArray | None
    model_hash: str
    label: str = ""
    subject: str = ""
    file: str = ""

    __repr__ = short_repr

    @property
    def trusted(self) -> bool:
        """Whether the fit neither failed nor is doubtful."""
        return self.z is not None and self.status in ("converged", "max_iterations")


def from_record(name: str, record: FitRecord) -> ScanCoefficients:
    """Return the scan of a NAME.fit.json.

    Raises:
        FileFormatError: the record lacks data that recognition needs, or it is damaged.
    """
    if record.status != "failed" and not record.z:
        raise FileFormatError(f"The record of {name} is incomplete or contradicts itself; fit the scan again.")
    z = None if record.status == "failed" else read_only(np.asarray(record.z, dtype=np.float64))
    scan = ScanCoefficients(name, record.status, record.reason, z, record.model.hash, file=record.scan.name)
    return _check(scan, f"The record of {name}")


def from_results(results: Results) -> list[ScanCoefficients]:
    """Return the fits of a folder with a store, in the order of their names.

    Fits in unreadable shards are excluded; `Results.problems` lists them.

    Raises:
        FileFormatError: a fit is damaged, or lacks data that recognition needs.
        InputError: the folder has no fits.
    """
    texts = ("scan", "status", "reason", "model_hash", "scan_name")
    columns = [f"z{k}" for k in range(1, modes_of(results) + 1)]
    scans: list[ScanCoefficients] = []
    for rows in results.iter_rows((*texts, "modes", *columns)):
        z = np.array([rows[column] for column in columns], dtype=np.float64).reshape(len(columns), -1).T
        for labels, modes, values in zip(
            zip(*(rows[text] for text in texts), strict=True), rows["modes"], z, strict=True
        ):
            name, status, reason, model, file = (text or "" for text in labels)
            coefficients = None if status == "failed" else read_only(values[: modes or 0])
            scans.append(
                _check(ScanCoefficients(name, status, reason, coefficients, model, file=file), f"The fit {name}")
            )
    if not scans:
        raise InputError(f"{results.folder} contains no results of fits; fit some scans first.")
    return sorted(scans, key=lambda scan: scan.name)


def read_coefficients(path: Path) -> list[ScanCoefficients]:
    """Return the scans in a coefficients.csv.

    Raises:
        FileError: the file cannot be read.
        FileFormatError: the file is not such a table, or it does not state the model of its coefficients.
    """
    check_file(path, _LARGEST_BYTES, _TABLE_AGAIN)
    rows = table_rows(read_bytes(path))
    try:
        heads = next(rows)
        modes = _modes(heads, path)
        scans = [
            _from_row(dict(zip(heads, row, strict=True)), modes, f"{path}, row {number}")
            for number, row in enumerate(rows, 1)
        ]
    except FileFormatError:
        raise
    except ValueError as error:
        raise FileFormatError(f"{path} {error}; {_TABLE_AGAIN}.") from error
    if not scans:
        raise FileFormatError(f"{path} has no rows; fit some scans first.")
    return scans


def _modes(heads: Sequence[str], path: Path) -> int:
    known, modes = set(heads), 0
    while f"z{modes + 1}" in known:
        modes += 1
    if not modes or not {"scan", "status", "reason"} <= known:
        raise FileFormatError(f"{path} is no table of coefficients; give a table that shapespace fit wrote.")
    if "model_hash" not in known:
        raise FileFormatError(
            f"{path} does not state the model of its coefficients; run shapespace fit to write it again, "
            "or give the folder of the results."
        )
    return modes


def _from_row(row: Mapping[str, str], modes: int, row_name: str) -> ScanCoefficients:
    status = row["status"]
    z: FloatArray | None = None
    if status != "failed":
        try:
            z = read_only(np.asarray([float(row[f"z{k}"]) for k in range(1, modes + 1)]))
        except ValueError as error:
            raise FileFormatError(f"{row_name}: a coefficient is not a number; fit the scan again.") from error
    scan = ScanCoefficients(row["scan"], status, row["reason"], z, row["model_hash"])
    return _check(scan, row_name)


def _check(scan: ScanCoefficients, row_name: str) -> ScanCoefficients:
    if scan.status not in STATUSES:
        raise FileFormatError(f"{row_name} has the status {scan.status[:40]!r}, which no fit has; fit the scan again.")
    if scan.z is not None and (scan.z.ndim != 1 or not len(scan.z) or not np.isfinite(scan.z).all()):
        raise FileFormatError(f"{row_name} has coefficients that are not finite numbers; fit the scan again.")
    if not scan.model_hash:
        raise FileFormatError(f"{row_name} does not state the model of its coefficients; fit the scan again.")
    return scan


def with_labels(
    scans: Sequence[ScanCoefficients], labels: Labels, where: Path | str = "the fits"
) -> tuple[list[ScanCoefficients], list[str]]:
    """Return `scans` with labels and subjects, found by the name of the fit or of the scan's file, and the sentences of
    `match_rows`.

    Raises:
        FileFormatError: two rows are of one scan.
        InputError: no row is of a scan.
    """
    found, notes = labels.match([(scan.name, *names_of_file(scan.file or scan.name)) for scan in scans], where)
    matched = (
        replace(scan, label=label.text, subject=label.subject) if label else scan
        for scan, label in zip(scans, found, strict=True)
    )
    return list(matched), notes


def one_model(scans: Sequence[ScanCoefficients]) -> str:
    """Return the hash of the model that all `scans` were fitted with.

    Raises:
        InputError: there are several, or no scans.
    """
    hashes = sorted({scan.model_hash for scan in scans})
    if not hashes:
        raise InputError("There are no fits to recognise anything in; fit some scans first.")
    if len(hashes) > 1:
        raise InputError(
            f"These fits are of {len(hashes)} different models ({', '.join(h[:12] for h in hashes[:4])}), so their "
            "coefficients cannot be compared; fit all scans with one model."
        )
    return hashes[0]


def relative_to_neutral(z: FloatArray, subjects: Sequence[str], is_neutral: Sequence[bool] | Any) -> FloatArray:
    """Return coefficients (n, K) relative to those of the same person's neutral face.

    Args:
        z: (n, K) in standard deviations; rows that are not finite stay so, and are no neutral face.
        subjects: n names of people.
        is_neutral: (n,) which are neutral; of several neutral faces of a person the mean is taken.

    Raises:
        InputError: arrays that do not belong together, or people without a neutral face, named.
    """
    people, neutral = np.asarray(subjects, dtype=str), np.asarray(is_neutral, dtype=bool)
    if z.ndim != 2 or people.shape != (len(z),) or neutral.shape != (len(z),):
        raise InputError(
            f"Coefficients (n, K) need a subject and a mark each, not {z.shape}, {people.shape} and {neutral.shape}."
        )
    neutral = neutral & np.isfinite(z).all(axis=1)
    without_neutral = sorted(set(people.tolist()) - set(people[neutral].tolist()))
    if without_neutral:
        others_note = f" and {len(without_neutral) - 5} more" if len(without_neutral) > 5 else ""
        subject_names = ", ".join(name or "(no name)" for name in without_neutral[:5])
        raise InputError(
            f"There is no usable neutral face of {subject_names}{others_note}; add it with its label, or "
            "recognise without neutral faces."
        )
    return relative_where_known(z, people, neutral)


def relative_where_known(z: FloatArray, people: npt.NDArray[np.str_], is_neutral: BoolArray) -> FloatArray:
    """Return coefficients as `relative_to_neutral` does, with NaN for people without a finite neutral face."""
    relative = np.full_like(z, np.nan)
    neutral = is_neutral & np.isfinite(z).all(axis=1)
    for name in np.unique(people):
        is_subject = people == name
        if (is_subject & neutral).any():
            relative[is_subject] = z[is_subject] - z[is_subject & neutral].mean(axis=0)
    return relative
