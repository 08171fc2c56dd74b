"""Registry of model formats, and detection of the format of a file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from shapespace.errors import InputError, ModelFileError
from shapespace.formats.eos import is_eos, read_eos, write_eos
from shapespace.formats.face_models import is_flame, is_matlab, read_flame, read_matlab
from shapespace.formats.gias_monai import is_gias, is_monai, read_gias, read_monai
from shapespace.formats.gltf_model import is_gltf_model, read_gltf_model, write_gltf_model
from shapespace.formats.model_parts import LinearModel, ModelFormat, ModelReader
from shapespace.formats.obj_folder import is_obj_folder, read_obj_folder, write_obj_folder
from shapespace.formats.scalismo_json import is_scalismo_json, read_scalismo_json, write_scalismo_json
from shapespace.formats.shapeworks import is_shapeworks, read_shapeworks, write_shapeworks
from shapespace.formats.statismo import is_statismo, read_statismo, write_statismo
from shapespace.io.containers.json_files import check_file
from shapespace.io.files import open_file

MODEL_FORMATS: Mapping[str, ModelFormat] = {
    entry.name: entry
    for entry in (
        ModelFormat("eos", "eos .bin", (".bin",), is_eos, read_eos, write_eos),
        ModelFormat(
            "statismo", "statismo/scalismo HDF5", (".statismo.h5",), is_statismo, read_statismo, write_statismo
        ),
        ModelFormat(
            "scalismo-json",
            "scalismo .h5.json",
            (".h5.json",),
            is_scalismo_json,
            read_scalismo_json,
            write_scalismo_json,
        ),
        ModelFormat("gltf", "glTF morph targets", (".glb", ".gltf"), is_gltf_model, read_gltf_model, write_gltf_model),
        ModelFormat("obj-folder", "folder of OBJ blendshapes", (), is_obj_folder, read_obj_folder, write_obj_folder),
        ModelFormat(
            "shapeworks", "ShapeWorks project", (".swproj", ".xlsx"), is_shapeworks, read_shapeworks, write_shapeworks
        ),
    )
}
"""Formats that can be read and written, by name, in the order of detection."""
READ_ONLY_MODELS: Mapping[str, ModelReader] = {
    entry.name: entry
    for entry in (
        ModelReader("gias", "GIAS2 .pc.npz", (".pc.npz",), is_gias, read_gias),
        ModelReader("flame", "FLAME/SMPL .npz and .pkl", (".npz", ".pkl"), is_flame, read_flame),
        ModelReader("mat", "BFM 2009, LSFM and LYHM .mat", (".mat",), is_matlab, read_matlab),
        ModelReader("monai-physio", "MONAI-Physio", (), is_monai, read_monai),
    )
}
"""Formats that can only be read, by name; they follow in the order of detection."""
LARGEST_BYTES = 2**34  # 16 GiB
_HEAD_BYTES = 4096  # contain the signature and first fields of every format


def read_linear(path: Path) -> tuple[ModelReader, LinearModel]:
    """Return the format of `path`, and the model that it contains.

    Raises:
        FileError: it cannot be read.
        ModelFileError: no format is recognised, or it is damaged.
    """
    check_file(path, LARGEST_BYTES, "give a model file")
    model_format = _format_of(path)
    if model_format is None:
        known = ", ".join(reader.title for reader in _readers())
        raise ModelFileError(f"{path} is in no format of shape models that shapespace reads: its own, {known}.")
    # The last bits depend on the number of threads, and workers, which have one thread, must compute the same model.
    with threadpool_limits(1, user_api="blas"), np.errstate(invalid="ignore", over="ignore"):
        model = model_format.read(path)
    model.check(path)
    return model_format, model


def is_known(path: Path) -> bool:
    """Return whether `path` looks like a model in one of these formats."""
    return (path.is_file() or path.is_dir()) and _format_of(path) is not None


def format_to_write(path: Path, name: str | None) -> ModelFormat:
    """Return the format called `name`, or the format with the ending of `path`.

    Raises:
        InputError: there is no such format, or it can only be read.
    """

    def is_meant(candidate: ModelReader) -> bool:
        return candidate.name == name or (name is None and path.name.lower().endswith(candidate.suffixes))

    if (meant := next(filter(is_meant, MODEL_FORMATS.values()), None)) is not None:
        return meant
    if (read_only := next(filter(is_meant, READ_ONLY_MODELS.values()), None)) is not None:
        problem = f"Cannot write {path}: {read_only.title} can only be read"
    else:
        problem = f"There is no format {name!r}" if name else f"The ending of {path.name!r} is not that of a format"
    names = ", ".join(
        f"{writer.name} ({writer.suffixes[0]})" if writer.suffixes else writer.name for writer in MODEL_FORMATS.values()
    )
    raise InputError(f"{problem}; choose one of {names}, or .h5 for shapespace's own.")


def _readers() -> list[ModelReader]:
    return [*MODEL_FORMATS.values(), *READ_ONLY_MODELS.values()]


def _format_of(path: Path) -> ModelReader | None:
    head = b""
    if not path.is_dir():
        with open_file(path) as file:
            head = file.read(_HEAD_BYTES)
    return next((reader for reader in _readers() if reader.recognises(path, head)), None)
