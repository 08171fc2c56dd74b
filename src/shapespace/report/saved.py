"""What the demo saved, read back for the report: JSON, arrays and meshes, checked and inside the demo's folder."""

from __future__ import annotations

import json
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from shapespace.errors import FileFormatError
from shapespace.io.files import read_bytes, read_error
from shapespace.io.meshes import read_mesh
from shapespace.types import FloatArray, IntArray, Mesh, Similarity

_LARGEST_JSON = 64 * 2**20
_LARGEST_ARRAY = 2**30
_AGAIN = "run the demo again"


@dataclass(frozen=True)
class Folder:
    """The folder of a demo; paths in its files are relative to it and stay inside it."""

    root: Path

    def path(self, name: object) -> Path:
        """Return the file called `name`.

        Raises:
            FileFormatError: it is no name, or it leads out of the folder.
        """
        if not isinstance(name, str) or not name:
            raise FileFormatError(f"{self.root}: a result file has no name where one is needed; {_AGAIN}.")
        try:
            path = (self.root / name).resolve()
        except (OSError, ValueError) as error:
            raise FileFormatError(f"{self.root}: {name[:80]!r} is not a file name; {_AGAIN}.") from error
        if not path.is_relative_to(self.root.resolve()):
            raise FileFormatError(f"{self.root}: {name[:80]!r} leads out of the folder of the results; {_AGAIN}.")
        return path

    def json(self, name: object) -> dict[str, Any]:
        """Return the object in a JSON file, its strings free of what cannot be printed.

        Raises:
            FileError: it cannot be read.
            FileFormatError: it is not a JSON object, or too large to be one of ours.
        """
        path = self.path(name)
        _bounded(path, _LARGEST_JSON)
        try:
            content: object = json.loads(read_bytes(path))
        except (ValueError, RecursionError) as error:
            raise FileFormatError(f"{path} is not JSON, or it is cut short; {_AGAIN}.") from error
        if not isinstance(content, dict):
            raise FileFormatError(f"{path} does not hold a JSON object; {_AGAIN}.")
        return cast(dict[str, Any], _printable(cast(object, content)))

    def arrays(self, name: object) -> dict[str, npt.NDArray[Any]]:
        """Return the arrays of an .npz file by name; no pickles, nothing larger than it says.

        Raises:
            FileError: it cannot be read.
            FileFormatError: it is damaged, or declares arrays that it does not hold.
        """
        path = self.path(name)
        _bounded(path, _LARGEST_ARRAY)
        try:
            with zipfile.ZipFile(path) as archive:
                for member in archive.infolist():
                    _check_member(path, archive, member)
            with np.load(path, allow_pickle=False) as loaded:
                return {key: np.asarray(loaded[key]) for key in loaded.files}
        except OSError as error:
            raise read_error(path, error) from error
        except (zipfile.BadZipFile, zlib.error, ValueError, EOFError, NotImplementedError) as error:
            if isinstance(error, FileFormatError):
                raise
            raise FileFormatError(f"{path} is not an .npz file of arrays, or it is cut short; {_AGAIN}.") from error

    def mesh(self, name: object) -> Mesh:
        """Return the mesh in a file.

        Raises:
            FileError: it cannot be read.
            FileFormatError: it is damaged.
        """
        return read_mesh(self.path(name))


@dataclass(frozen=True, eq=False)
class SavedFit:
    """One fit of the demo, as its entry in demo.json and its record tell it.

    Args:
        entry: from demo.json.
        record: NAME.fit.json.
    """

    entry: Mapping[str, Any]
    record: Mapping[str, Any]

    @property
    def name(self) -> str:
        """What it is called."""
        return str(self.entry["name"])

    @property
    def label(self) -> str:
        """Expression and intensity in words."""
        if not float(self.entry.get("intensity") or 0):
            return str(self.entry.get("expression") or self.name)
        return f"{self.entry['expression']} {100 * float(self.entry['intensity']):.0f} %"

    @property
    def status(self) -> str:
        """`converged`, `max_iterations`, `doubtful` or `failed`."""
        return str(self.record.get("status", "unknown"))

    @property
    def pictured(self) -> bool:
        """Whether surfaces were kept."""
        return bool(self.entry.get("stages")) and self.status != "failed"

    def summary_mm(self, stage: str, direction: str, measure: str) -> float:
        """Return a distance summary in mm, or not-a-number where the record has none."""
        value: Any = self.record.get("distances_mm")
        for key in (stage, direction, measure):
            value = cast(Mapping[str, Any], value).get(key) if isinstance(value, Mapping) else None
        return float("nan") if value is None else float(value)

    def numbers(self, key: str) -> FloatArray:
        """Return a list of numbers of the record, such as `b` or `z`, (K,).

        Raises:
            FileFormatError: it is absent or holds something else.
        """
        try:
            values = np.asarray(self.record[key], dtype=np.float64)
        except (KeyError, TypeError, ValueError) as error:
            raise FileFormatError(f"The record of {self.name} holds no list of numbers {key!r}; {_AGAIN}.") from error
        if values.ndim != 1 or not np.isfinite(values).all():
            raise FileFormatError(f"The record of {self.name} holds no list of finite numbers {key!r}; {_AGAIN}.")
        return values

    def history(self) -> list[tuple[int, int, float]]:
        """Return (phase, iteration, RMS in mm) in order."""
        return [
            (int(row["phase"]), int(row["iteration"]), float(row["rms_mm"]))
            for row in cast(list[Mapping[str, Any]], self.record.get("history") or [])
            if row["rms_mm"] is not None
        ]


def read_fit(folder: Folder, entry: Mapping[str, Any]) -> SavedFit:
    """Read the record of one fit.

    Raises:
        FileError: it cannot be read.
        FileFormatError: it is damaged.
    """
    return SavedFit(entry, folder.json(entry.get("json")))


def surfaces_of(
    folder: Folder, fit: SavedFit, stages: Sequence[str]
) -> tuple[Mesh, dict[str, Mesh], dict[str, FloatArray], dict[str, FloatArray]]:
    """Return the scan, the model's surface at each stage, and both directions' distances at each stage.

    Scan and surfaces are brought into the model's frame in mm by the final pose, so that faces look at the camera.

    Raises:
        FileError: a file cannot be read.
        FileFormatError: arrays are absent or do not fit together.
        MeshError: the scan is damaged.
    """
    T_model_scan = _pose(fit).inverse()
    unit = float(fit.record.get("mm_per_scan_unit") or 1.0)
    scan = folder.mesh(fit.entry["scan"])
    arrays = folder.arrays(fit.entry["stages"])
    faces: IntArray | None = arrays.get("faces")
    surfaces: dict[str, Mesh] = {}
    forward: dict[str, FloatArray] = {}
    backward: dict[str, FloatArray] = {}
    for stage in stages:
        try:
            vertices = arrays[stage].astype(np.float64)
            forward[stage] = arrays[f"model_to_scan_{stage}"].astype(np.float64)
            backward[stage] = arrays[f"scan_to_model_{stage}"].astype(np.float64)
        except (KeyError, ValueError) as error:
            raise FileFormatError(
                f"{fit.entry['stages']} lacks the surface or the distances {stage!r}; {_AGAIN}."
            ) from error
        surfaces[stage] = Mesh(T_model_scan.apply(vertices / unit), faces, name=fit.name)
        if forward[stage].shape != (len(vertices),) or backward[stage].ndim != 1:
            raise FileFormatError(f"{fit.entry['stages']}: the distances {stage!r} do not fit the surface; {_AGAIN}.")
        if not all(np.isfinite(values).all() for values in (vertices, forward[stage], backward[stage])):
            raise FileFormatError(f"{fit.entry['stages']}: {stage!r} holds values that are not finite; {_AGAIN}.")
    seen = scan.with_vertices(T_model_scan.apply(scan.vertices))
    return seen, surfaces, forward, backward


def _pose(fit: SavedFit) -> Similarity:
    try:
        T = fit.record["T_scan_model"]
        return Similarity(
            float(T["scale"]), np.array(T["rotation"], dtype=float), np.array(T["translation"], dtype=float)
        )
    except (KeyError, TypeError, ValueError) as error:
        raise FileFormatError(f"The record of {fit.name} holds no pose T_scan_model; {_AGAIN}.") from error


def _bounded(path: Path, most: int) -> None:
    try:
        size = path.stat().st_size
    except OSError as error:
        raise read_error(path, error) from error
    if size > most:
        raise FileFormatError(f"{path} is larger ({size / 2**20:.0f} MiB) than any file of the demo; {_AGAIN}.")


def _check_member(path: Path, archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> None:
    """Refuse an array whose header promises another size than the archive holds, before it is allocated."""
    with archive.open(member) as stream:
        version = np.lib.format.read_magic(stream)
        read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read_header(stream)
        header = stream.tell()
    promised = dtype.itemsize
    for extent in shape:
        promised *= int(extent)
    if dtype.hasobject or promised != member.file_size - header or promised > _LARGEST_ARRAY:
        raise FileFormatError(f"{path}: the array {member.filename!r} is not what its header says; {_AGAIN}.")


def _printable(value: object) -> object:
    """Return JSON content whose strings have control characters and lone surrogates replaced."""
    if isinstance(value, str):
        return "".join(
            c if c in "\n\t" or (c.isprintable() or c.isspace()) else "\N{REPLACEMENT CHARACTER}" for c in value
        )
    if isinstance(value, list):
        return [_printable(item) for item in cast(list[object], value)]
    if isinstance(value, dict):
        return {str(_printable(key)): _printable(item) for key, item in cast(dict[object, object], value).items()}
    return value
