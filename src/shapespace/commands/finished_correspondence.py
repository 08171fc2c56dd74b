"""A finished correspondence in a folder, which changes and the joining of parts begin at."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from shapespace.batch.fit_work import FitJob
from shapespace.commands.correspond import CorrespondenceFolder, CorrespondFiles
from shapespace.commands.inputs import Given
from shapespace.correspondence.settings import CorrespondConfig
from shapespace.errors import InputError
from shapespace.geometry.mirror_plane import mirror_image
from shapespace.geometry.normals import faces_of
from shapespace.io.meshes.mesh_io import read_mesh
from shapespace.io.remote import is_address
from shapespace.reprs import first_names
from shapespace.schemas import CORRESPOND_AGAIN, CorrespondenceRecord, CorrespondRecord, read
from shapespace.store.corresponding import MEAN, SUMMARY, SURFACE
from shapespace.types import Mesh

_OPTIONS = {
    "vertices": "--vertices", "rounds": "--rounds", "outer": "--outer", "ignore_colours": "--set ignore_colours",
    "mirror": "--mirror", "pose": "--pose", "landmark_uncertainty": "--set landmark_uncertainty",
    "seed": "--set seed",
}  # fmt: skip
"""Options of the settings that a change takes from the finished correspondence, by their fields."""
_LISTED = 5  # names in a message, so that it stays short


@dataclass(frozen=True)
class FinishedFolder:
    """A finished correspondence in a folder.

    Args:
        results: the folder.
        summary: summary of the run.
        records: records of all scans by name, those in correspondence first.
        mean: mean shape.
        surfaces: surfaces of the scans in correspondence, by name; those of mirrored scans are reflected.
    """

    results: CorrespondenceFolder
    summary: CorrespondenceRecord
    records: dict[str, CorrespondRecord]
    mean: Mesh
    surfaces: dict[str, Mesh]

    @staticmethod
    def of(results: CorrespondenceFolder) -> FinishedFolder:
        """Read all files of a correspondence.

        Raises:
            InputError: its files do not belong together.
            FileError, FileFormatError: a file cannot be read, or is damaged.
        """
        folder, (summary, records) = results.path, results.read()
        mean = read_mesh(folder / MEAN)
        files = {name: read_mesh(folder / f"{name}{SURFACE}") for name in summary.corresponding}
        surfaces = {name: mirror_image(mesh) if name in summary.mirrored else mesh for name, mesh in files.items()}
        fault = ""
        if len(mean.vertices) != summary.vertices:
            fault = f"{MEAN} has {len(mean.vertices)} vertices, and the correspondence {summary.vertices}"
        elif other := [
            name for name, surface in surfaces.items() if not np.array_equal(faces_of(surface), faces_of(mean))
        ]:
            fault = f"{other[0]}{SURFACE} and {MEAN} have different triangles, so one of them was changed"
        elif summary.results_hash not in ("", results.hash_of(summary)):
            fault = "its files were changed after the correspondence"
        if fault:
            raise InputError(f"{folder}: {fault}; {CORRESPOND_AGAIN}.")
        return FinishedFolder(results, summary, records, mean, surfaces)

    def config(self, files: CorrespondFiles, asked: CorrespondConfig) -> CorrespondConfig:
        """Return the settings of the correspondence, which `asked` must not contradict.

        Raises:
            InputError: options ask for something else.
        """
        config = read(CorrespondConfig, self.summary.settings, str(self.results.path / SUMMARY), CORRESPOND_AGAIN)
        if self.summary.settings.get("symmetric"):
            raise InputError(
                f"{self.results.path} was computed with the setting symmetric, which was removed; {CORRESPOND_AGAIN}."
            )
        for option, file in (("--template", files.template), ("--model", files.model)):
            if file is not None:
                raise InputError(f"The template of a finished correspondence is its mean; omit {option}.")
        usual = CorrespondConfig()
        for name, option in _OPTIONS.items():
            own = getattr(config, name)
            if getattr(asked, name) not in (own, getattr(usual, name)):
                value = f"without {option}" if own is False else f"with {option} {own}"
                raise InputError(f"{self.results.path} was computed {value}, and a change keeps that; omit {option}.")
        return config

    def check_names(self, names: Sequence[str], option: str) -> None:
        """Raise InputError if no scan of the correspondence has one of `names`."""
        for name in names:
            if name not in self.records:
                known = first_names(list(self.records), _LISTED)
                raise InputError(f"{option} {name}: {self.results.path} has no scan of that name; it has {known}.")

    def job(self, name: str) -> FitJob:
        """Return the job of a scan, from where it was."""
        record = self.records[name]
        known = {key: str(value) for key, value in record.metadata.items() if value is not None}
        if is_address(record.path):
            return FitJob(name, Given(record.path).path, metadata=known, address=record.path)
        return FitJob(name, Path(os.path.normpath(self.results.path / record.path)), metadata=known)
