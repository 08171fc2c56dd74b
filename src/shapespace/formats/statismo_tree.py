"""Conversion of a model to the tree of groups of statismo 0.9, and to HDF5."""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from shapespace.formats.model_parts import LinearModel, orthonormal
from shapespace.io.landmarks.landmark_io import LANDMARK_FORMATS
from shapespace.io.sandbox import Tree
from shapespace.types import FloatArray

PARAMETERS: Final = "modelinfo/modelBuilder-0/parameters"
"""Texts by name in each model, where we leave what statismo has no place for."""
_GREY = 0.5  # mean colour of a model without colours, of 0 to 1
_LEFT_OUT = 1e-6  # relative; rounding in single precision


@dataclass
class _TreeBuilder:
    """Builder of the tree of `model`."""

    model: LinearModel
    parameters: Mapping[str, str]
    built: str
    arrays: dict[str, npt.NDArray[Any]] = field(default_factory=dict[str, npt.NDArray[Any]])
    texts: dict[str, str] = field(default_factory=dict[str, str])
    attributes: dict[str, dict[str, str]] = field(default_factory=dict[str, dict[str, str]])
    groups: list[str] = field(default_factory=list[str])

    def add_version(self, root: str) -> None:
        self.arrays[f"{root}/version/majorVersion"] = np.array(0, dtype=np.int32)
        self.arrays[f"{root}/version/minorVersion"] = np.array(9, dtype=np.int32)

    def add_model(self, root: str, mean: FloatArray, displacements: FloatArray, representer: str) -> None:
        """Add one model: `mean` (D,), and what one standard deviation of each mode does, `displacements` (D, K)."""
        basis, stddev, _ = orthonormal(displacements)
        if not len(stddev):
            basis, stddev = np.full((len(mean), 1), len(mean) ** -0.5), np.zeros(1)
        numbers = {"mean": mean, "pcaBasis": basis, "pcaVariance": stddev**2, "noiseVariance": np.zeros(1)}
        self.arrays.update({f"{root}/model/{name}": value.astype(np.float32) for name, value in numbers.items()})
        builder = f"{root}/modelinfo/modelBuilder-0"
        self.arrays[f"{root}/modelinfo/scores"] = np.zeros((1, 1), dtype=np.float32)
        self.texts[f"{root}/modelinfo/build-time"] = self.texts[f"{builder}/buildTime"] = self.built
        self.texts[f"{builder}/builderName"] = "shapespace"
        self.texts.update({f"{root}/{PARAMETERS}/{name}": text for name, text in self.parameters.items()})
        self.groups += [f"{builder}/dataInfo", f"{root}/{PARAMETERS}", f"{root}/representer/pointData"]
        faces = self.model.faces
        self.attributes[f"{root}/representer"] = {
            "name": representer,
            "datasetType": "POINT_SET" if faces is None else "POLYGON_MESH",
            "version": "1.0",
            "version/majorVersion": "0",
            "version/minorVersion": "9",
        }
        self.arrays[f"{root}/representer/points"] = np.ascontiguousarray(self.model.mean.T, dtype=np.float32)
        if faces is not None:
            self.arrays[f"{root}/representer/cells"] = np.ascontiguousarray(faces.T, dtype=np.int32)
        self.add_version(root)

    def add_catalogue(self, *names: str) -> None:
        for name in names:
            self.texts[f"/catalog/MorphableModel.{name}/modelType"] = "POLYGON_MESH_MODEL"
            self.texts[f"/catalog/MorphableModel.{name}/modelPath"] = f"/{name}"

    def tree(self) -> Tree:
        groups = ["/"]
        for path in [*self.arrays, *self.texts, *(f"{group}/" for group in self.groups)]:
            parents = path.split("/")[1:-1]
            groups += ["/" + "/".join(parents[:count]) for count in range(1, len(parents) + 1)]
        return Tree(self.arrays, self.texts, self.attributes, tuple(dict.fromkeys(groups)))


def tree_of(model: LinearModel) -> tuple[Tree, list[str]]:
    """Return `model` as version 0.9 has it, in single precision, and sentences on what was changed or left out.

    With expressions it is a Morphable Model of scalismo-faces, with a grey stand-in for the colour that it asks for.
    """
    provenance = {
        "provenance": model.provenance,
        "licence": model.licence,
        "held_out": "yes" if model.held_out else "no",
    }
    provenance |= {"unit": "mm"} if model.mm == 1.0 else {}
    provenance |= {"n_training": str(model.n_training)} if model.n_training else {}
    provenance = {name: text.replace("\0", " ") for name, text in provenance.items() if text}
    growing = _TreeBuilder(model, provenance, datetime.now(UTC).strftime("%a %b %d %H:%M:%S UTC %Y"))
    notes = ["Numbers are in single precision."]
    mean = model.mean.ravel()
    if model.expression is None:
        growing.add_model("", mean, model.shape.moved, "itkStandardMeshRepresenter")
    else:
        no_motion, grey = np.zeros(len(mean)), np.full(len(mean), _GREY)
        growing.add_model("/shape", mean, model.shape.moved, "gravis::MeshShapeRepresenter")
        growing.add_model("/color", grey, np.zeros((len(mean), 0)), "gravis::MeshColorRepresenter")
        growing.add_model("/expression", no_motion, model.expression.moved, "gravis::MeshExpressionRepresenter")
        growing.texts["/color/representer/colorspace"] = "RGB"
        growing.add_version("")
        growing.add_catalogue("shape", "color", "expression")
        notes.append("It is a Morphable Model of scalismo-faces, whose colour is a grey stand-in.")
    if model.landmarks:
        # Placed on the surface in single precision, as in the file.
        positions = model.landmarks.positions(model.mean.astype(np.float32).astype(np.float64))
        growing.texts["/metadata/landmarks/json"] = LANDMARK_FORMATS[".json"].write(positions)
    blocks = [model.shape] if model.expression is None else [model.shape, model.expression]
    kept_variance = sum(float((block.moved**2).sum()) for block in blocks)
    total = model.shape.total_variance
    if total is not None and total > kept_variance * (1 + _LEFT_OUT):
        notes.append(f"The {1 - kept_variance / total:.2g} of the variance that no mode holds is left out.")
    return growing.tree(), notes


def hdf5_of(tree: Tree) -> bytes:
    """Return `tree` as an HDF5 file; texts and attributes are single ones of fixed length, ended by a zero."""
    import h5py  # a twentieth of a second that only those who write should wait

    low: Any = h5py

    def fixed(text: str) -> tuple[Any, Any]:
        data = text.encode("utf-8", "replace") + b"\0"
        kind = low.h5t.C_S1.copy()
        kind.set_size(len(data))
        kind.set_strpad(low.h5t.STR_NULLTERM)
        return kind, np.array(data, dtype=f"S{len(data)}")

    memory = io.BytesIO()
    with h5py.File(memory, "w", libver="earliest", track_order=False) as file:
        scalar = low.h5s.create(low.h5s.SCALAR)
        for path in sorted(tree.groups):
            file.require_group(path)
        for path, array in tree.arrays.items():
            file.create_dataset(path, data=array, track_order=False)
        for path, text in tree.texts.items():
            group_path, _, name = path.rpartition("/")
            kind, value = fixed(text)
            parent: Any = file[group_path or "/"]
            low.h5d.create(parent.id, name.encode(), kind, scalar).write(low.h5s.ALL, low.h5s.ALL, value)
        for path, attributes in tree.attributes.items():
            owner: Any = file[path]
            for name, text in attributes.items():
                kind, value = fixed(str(text))
                low.h5a.create(owner.id, name.encode(), kind, scalar).write(value)
    return memory.getvalue()
