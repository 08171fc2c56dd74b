"""The files of the simulated study: where they are, and every fit in them."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from shapespace.errors import FileFormatError
from shapespace.io.files import read_bytes
from shapespace.types import FloatArray, IntArray

STATUSES = ("converged", "max_iterations", "doubtful", "failed")
_SAVED = ("z", "z_stddev", "status", "error_mm", "seconds", "e_beside", "e_together", "a_together")


@dataclass(frozen=True, eq=False)
class Fits:
    """Every scan of a study fitted with the models of all folds.

    Args:
        z: (F, N, K) coefficients in standard deviations; K is that of the largest model and the rest is 0; NaN where a
            fit failed, or was not needed.
        z_stddev: (F, N, K) theirs.
        status: (F, N) index of `STATUSES`; -1 where none was needed.
        error_mm: (N,) mean distance of the vertices to the true ones, in the fold where the scan is tested.
        seconds: (N,) of that fit.
        e_beside: (F, N, Ke) expressions by tying each scan with the person's neutral scan, less that scan's; NaN where
            there is none. Ke is that of the largest model and the rest is 0.
        e_together: (F, N, Ke) by tying all expressive scans of the person, none of them known as anything.
        a_together: (F, P, Ka) the identity of those.
        person: (N,) who is scanned.
        shown: (N,) index of `StudyPeople.shown`.
    """

    z: FloatArray
    z_stddev: FloatArray
    status: IntArray
    error_mm: FloatArray
    seconds: FloatArray
    e_beside: FloatArray
    e_together: FloatArray
    a_together: FloatArray
    person: IntArray
    shown: IntArray


def model_path(folder: Path, fold: int) -> Path:
    """Return the file of the model made without the subjects of `fold`."""
    return folder / f"fold_{fold}.h5"


def person_path(folder: Path, person: int) -> Path:
    """Return the file of a person's fits."""
    return folder / "fits" / f"person_{person:03d}.npz"


def paper_path(folder: Path) -> Path:
    """Return the file of the fits of the paper's experiment 1."""
    return folder / "fits" / "experiment_1.npz"


def stranger_path(folder: Path, person: int) -> Path:
    """Return the file of a stranger's fits."""
    return folder / "fits" / f"stranger_{person:03d}.npz"


def read_fits(paths: Sequence[Path], n_modes: int) -> Fits:
    """Return the fits in `paths`, one file a person, with `n_modes` coefficients.

    Raises:
        FileError: a file cannot be read.
        FileFormatError: a file is damaged.
    """
    parts: list[dict[str, npt.NDArray[Any]]] = []
    for path in paths:
        part = _read_arrays(path, _SAVED)
        for key, rest in (("z", 0.0), ("z_stddev", 1.0)):
            whole = np.full((*part[key].shape[:2], n_modes), rest)
            whole[..., : part[key].shape[2]] = part[key]
            part[key] = whole
        parts.append(part)
    for key in ("e_beside", "e_together", "a_together"):
        most = max(part[key].shape[2] for part in parts)
        for part in parts:
            part[key] = np.pad(part[key], ((0, 0), (0, 0), (0, most - part[key].shape[2])))
    counts = [parts[0]["z"].shape[1]] * len(parts)
    return Fits(
        z=_joined(parts, "z", 1),
        z_stddev=_joined(parts, "z_stddev", 1),
        status=np.concatenate([part["status"] for part in parts], axis=1).astype(np.int32),
        error_mm=_joined(parts, "error_mm", 0),
        seconds=_joined(parts, "seconds", 0),
        e_beside=_joined(parts, "e_beside", 1),
        e_together=_joined(parts, "e_together", 1),
        a_together=_joined(parts, "a_together", 1),
        person=np.repeat(np.arange(len(parts), dtype=np.int32), counts),
        shown=np.tile(np.arange(counts[0], dtype=np.int32), len(parts)),
    )


def read_paper(path: Path) -> tuple[FloatArray, FloatArray, IntArray]:
    """Return b (17, K) mm of experiment 1, neutral first, the model's stddev (K,), and the status of each fit.

    Raises:
        FileError: the file cannot be read.
        FileFormatError: it is damaged.
    """
    found = _read_arrays(path, ("b", "stddev", "status"))
    return found["b"].astype(np.float64), found["stddev"].astype(np.float64), found["status"].astype(np.int32)


def _read_arrays(path: Path, names: Sequence[str]) -> dict[str, npt.NDArray[Any]]:
    try:
        with np.load(io.BytesIO(read_bytes(path)), allow_pickle=False) as loaded:
            return {name: np.asarray(loaded[name]) for name in names}
    except (ValueError, KeyError, EOFError, OSError, zipfile.BadZipFile) as error:
        raise FileFormatError(f"{path} is damaged; delete it and run the study again.") from error


def _joined(parts: Sequence[dict[str, npt.NDArray[Any]]], key: str, axis: int) -> FloatArray:
    return np.concatenate([part[key] for part in parts], axis=axis).astype(np.float64)
