"""What fits and the demo saved, read back for pictures: JSON, arrays, meshes and models, checked, inside one folder."""

from __future__ import annotations

import json
import os
import zipfile
import zlib
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from shapespace.errors import FileFormatError, InputError, ShapespaceError
from shapespace.io.files import read_bytes, read_error
from shapespace.io.meshes import read_mesh
from shapespace.model.shape_model import ShapeModel
from shapespace.report.staged import StagedFit
from shapespace.types import FloatArray, Mesh

_LARGEST_JSON = 64 * 2**20
_LARGEST_ARRAY = 2**30
_AGAIN = "make it again with shapespace fit --stages"
_RECORD = ".fit.json"


@dataclass(frozen=True)
class Folder:
    """A folder of results; names in its files are relative to it and stay inside it.

    Args:
        root: the folder.
        again: what a reader can do about a file that is wrong.
    """

    root: Path
    again: str = _AGAIN

    def path(self, name: object) -> Path:
        """Return the file called `name`, as the folder was named by the user.

        Raises:
            FileFormatError: it is no name, or it leads out of the folder.
        """
        if not isinstance(name, str) or not name:
            raise FileFormatError(f"A result file has no name where one is needed; {self.again}.")
        try:
            path = self.root / name
            inside = path.resolve().is_relative_to(self.root.resolve())
        except (OSError, ValueError, RuntimeError) as error:
            raise FileFormatError(f"{name[:80]!r} in a result file is not a file name; {self.again}.") from error
        if not inside:
            raise FileFormatError(
                f"{name[:80]!r} in a result file leads out of the folder of the results; {self.again}."
            )
        return path

    def json(self, name: object) -> dict[str, Any]:
        """Return the object in a JSON file, its strings free of what cannot be printed.

        Raises:
            FileError: it cannot be read.
            FileFormatError: it is not a JSON object, or too large to be one of ours.
        """
        path = self.path(name)
        with self._named_shortly():
            _bounded(path, _LARGEST_JSON, self.again)
            try:
                content: object = json.loads(read_bytes(path))
            except (ValueError, RecursionError) as error:
                raise FileFormatError(f"{path} is not JSON, or it is cut short; {self.again}.") from error
            if not isinstance(content, dict):
                raise FileFormatError(f"{path} does not hold a JSON object; {self.again}.")
        return cast(dict[str, Any], _printable(cast(object, content)))

    def arrays(self, name: object) -> dict[str, npt.NDArray[Any]]:
        """Return the arrays of an .npz file by name; no pickles, nothing larger than it says.

        Raises:
            FileError: it cannot be read.
            FileFormatError: it is damaged, or declares arrays that it does not hold.
        """
        path = self.path(name)
        with self._named_shortly():
            _bounded(path, _LARGEST_ARRAY, self.again)
            try:
                with zipfile.ZipFile(path) as archive:
                    for member in archive.infolist():
                        _check_member(path, archive, member, self.again)
                with np.load(path, allow_pickle=False) as loaded:
                    return {key: np.asarray(loaded[key]) for key in loaded.files}
            except OSError as error:
                raise read_error(path, error) from error
            except (zipfile.BadZipFile, zlib.error, ValueError, EOFError, NotImplementedError) as error:
                if isinstance(error, FileFormatError):
                    raise
                raise FileFormatError(
                    f"{path} is not an .npz file of arrays, or it is cut short; {self.again}."
                ) from error

    def mesh(self, name: object) -> Mesh:
        """Return the mesh in a file.

        Raises:
            FileError: it cannot be read.
            FileFormatError: it is damaged.
        """
        with self._named_shortly():
            return read_mesh(self.path(name))

    @contextmanager
    def _named_shortly(self) -> Generator[None]:
        # A report is mailed and a viewer has visitors: neither is to tell where the folder lies on this machine.
        try:
            yield
        except ShapespaceError as error:
            told = str(error)
            for root in dict.fromkeys((str(self.root.resolve()), str(self.root))):
                told = told.replace(f"{root}{os.sep}", "")
            raise type(error)(told) from error


@dataclass(frozen=True, eq=False)
class SavedFit:
    """One fit, as its record tells it and what is known beside it.

    Args:
        entry: `name`, and where there are such `json`, `stages`, `fitted`, `dense`, `expression`, `intensity`: from
            demo.json, or from the files of a folder.
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
        """`converged`, `max_iterations`, `doubtful` or `failed`; `unreadable` where the record is."""
        return str(self.record.get("status", "unreadable"))

    @property
    def reason(self) -> str:
        """Why it has that status."""
        return str(self.record.get("reason", ""))

    @property
    def pictured(self) -> bool:
        """Whether surfaces were kept."""
        return bool(self.entry.get("stages")) and self.status not in ("failed", "unreadable")

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


def has_fits(folder: Folder) -> bool:
    """Return whether the record of a fit lies directly in `folder`.

    Raises:
        FileError: the folder cannot be read.
    """
    return bool(_records(folder))


def find_fits(folder: Folder) -> list[SavedFit]:
    """Return the fits whose records lie directly in `folder`, in the order of their names.

    One that cannot be read has the status `unreadable` and says why.

    Raises:
        FileError: the folder cannot be read.
        InputError: there is no fit in it.
    """
    names = _records(folder)
    if not names:
        raise InputError(f"{folder.root} holds no fits (NAME{_RECORD}); give a folder that shapespace fit wrote.")
    return [_found(folder, name) for name in names]


def _records(folder: Folder) -> list[str]:
    try:
        return sorted(path.name for path in folder.root.iterdir() if path.name.endswith(_RECORD))
    except OSError as error:
        raise read_error(folder.root, error) from error


def _found(folder: Folder, file: str) -> SavedFit:
    name = file.removesuffix(_RECORD)
    beside = {
        key: f"{name}.{ending}"
        for key, ending in (("stages", "stages.npz"), ("fitted", "fitted.ply"), ("dense", "dense.ply"))
        if (folder.root / f"{name}.{ending}").is_file()
    }
    entry = {"name": _printable(name), "json": file, **beside}
    try:
        record = folder.json(file)
        if record.get("format") != "shapespace fit":
            raise FileFormatError(f"{file} is not the record of a fit; {_AGAIN}.")
    except ShapespaceError as error:
        record = {"status": "unreadable", "reason": str(error)}
    return SavedFit(entry, record)


def staged_fit(folder: Folder, fit: SavedFit) -> StagedFit:
    """Return what pictures of `fit` need.

    Raises:
        FileError: its stages cannot be read.
        FileFormatError: they were not saved, or are damaged.
    """
    stages = fit.entry.get("stages")
    if not stages:
        raise FileFormatError(f"{fit.name}: its stages were not saved; fit the scan again with --stages.")
    return StagedFit.from_arrays(
        folder.arrays(stages),
        name=fit.name,
        label=fit.label,
        status=fit.status,
        reason=fit.reason,
        b=fit.numbers("b"),
        z=fit.numbers("z"),
        b_stddev=fit.numbers("b_stddev"),
        shrinkage=fit.numbers("shrinkage"),
    )


def model_of(folder: Folder, fits: Sequence[SavedFit], given: Path | None = None) -> ShapeModel:
    """Return the model by which `fits` were made.

    Args:
        folder: where the fits lie.
        fits: one or more; those without a readable record do not count.
        given: the model's file; None goes by the path in the records.

    Raises:
        FileError: it cannot be read.
        FileFormatError: it is damaged.
        InputError: it is not where the records say, or not the one they name.
    """
    sources = [
        cast(Mapping[str, Any], fit.record["model"]) for fit in fits if isinstance(fit.record.get("model"), dict)
    ]
    hashes = {str(source.get("hash")) for source in sources}
    if not sources:
        raise InputError(f"{folder.root}: no record names a model; give it with --model.")
    if len(hashes) > 1 and given is None:
        raise InputError(f"{folder.root}: its fits are by {len(hashes)} different models; give one with --model.")
    path = given or folder.root / str(sources[0].get("path") or sources[0].get("name"))
    if given is None and not path.is_file():
        raise InputError(f"{folder.root}: the model {path.name} is no longer at {path}; give it with --model.")
    model = ShapeModel.load(path)
    if model.content_hash not in hashes:
        raise InputError(f"{path} is not the model of the fits in {folder.root}; give the right one with --model.")
    return model


def _bounded(path: Path, most: int, again: str) -> None:
    try:
        size = path.stat().st_size
    except OSError as error:
        raise read_error(path, error) from error
    if size > most:
        raise FileFormatError(f"{path} is larger ({size / 2**20:.0f} MiB) than such a file can be; {again}.")


def _check_member(path: Path, archive: zipfile.ZipFile, member: zipfile.ZipInfo, again: str) -> None:
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
        raise FileFormatError(f"{path}: the array {member.filename!r} is not what its header says; {again}.")


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
