"""scalismo's HDF5/JSON, written by hand as scalismo and as the converters of The HDF Group write it."""

import copy
import json
import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from statismo_by_hand import truth

from own_file_fuzz import damaged_bytes, damaged_json, fuzzed
from shapespace.errors import ModelFileError, ShapespaceError
from shapespace.formats.model_parts import LinearModel, Modes
from shapespace.formats.scalismo_json import write_scalismo_json
from shapespace.model.shape_model import ShapeModel

FLOAT = {"class": "H5T_FLOAT", "base": "H5T_IEEE_F32LE"}
INTEGER = {"class": "H5T_INTEGER", "base": "H5T_STD_I32LE"}
TEXT = {"class": "H5T_STRING", "charSet": "H5T_CSET_ASCII", "strPad": "H5T_STR_NULLPAD", "length": "H5T_VARIABLE"}
SCALAR = {"class": "H5S_SCALAR"}


def dataset(path: str, values: Any, kind: dict[str, Any]) -> dict[str, Any]:
    shape = np.shape(values)
    space = {"class": "H5S_SIMPLE", "dims": list(shape)} if shape else SCALAR
    return {
        "alias": [path],
        "type": kind,
        "shape": space,
        "value": np.asarray(values).tolist(),
        "creationProperties": {},
    }


def by_hand(*, listed: bool = False) -> dict[str, Any]:
    """Return the file as scalismo writes it; `listed` has texts and versions as lists of one, as converters do."""
    one = truth()
    listing = (lambda value: [value]) if listed else (lambda value: value)
    numbers = {
        "/version/majorVersion": (listing(0), INTEGER), "/version/minorVersion": (listing(9), INTEGER),
        "/model/mean": (one.mean.ravel(), FLOAT), "/model/pcaBasis": (one.basis, FLOAT),
        "/model/pcaVariance": (one.variance, FLOAT), "/model/noiseVariance": ([0.0], FLOAT),
        "/representer/points": (one.mean.T, FLOAT), "/representer/cells": (one.faces.T, INTEGER),
        "/modelinfo/build-time": (listing("Mon"), TEXT),
    }  # fmt: skip
    paths = ["/", "/version", "/model", "/representer", "/modelinfo"]
    told = {"name": "itkStandardMeshRepresenter", "datasetType": "POLYGON_MESH", "version/majorVersion": "0"}
    attributes = [{"name": k, "type": TEXT, "shape": SCALAR, "value": listing(v)} for k, v in told.items()]
    groups = {
        f"g{path}": {
            "alias": ["wrong"],  # advisory
            "attributes": attributes if path == "/representer" else [],
            "links": [
                {"title": p.rpartition("/")[2], "id": f"{'g' if p in paths else 'd'}{p}",
                 "collection": "groups" if p in paths else "datasets", "class": "H5L_TYPE_HARD"}
                for p in [*paths[1:], *numbers] if (p.rpartition("/")[0] or "/") == path
            ],
        }
        for path in paths
    }  # fmt: skip
    sets = {f"d{path}": dataset(path, values, kind) for path, (values, kind) in numbers.items()}
    return {"apiVersion": "1.0.0", "root": "g/", "groups": groups, "datasets": sets}


@pytest.mark.parametrize("listed", [False, True], ids=["scalismo", "converted"])
@pytest.mark.parametrize("name", ["femur.h5.json", "femur.h5", "femur.json"])
def test_a_file_of_scalismo_gives_the_model_whatever_it_is_named(listed: bool, name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(json.dumps(by_hand(listed=listed), indent=1 if listed else None))
    model, one = ShapeModel.load(tmp_path / name), truth()
    assert np.array_equal(model.mean_vertices, one.mean)
    assert np.array_equal(np.asarray(model.faces), one.faces)
    assert np.allclose((model.basis * model.stddev**2) @ model.basis.T, one.covariance, atol=1e-4)


def test_what_we_write_has_all_that_scalismo_asks_for(tmp_path: Path) -> None:
    one = truth()
    linear = LinearModel(mean=one.mean, shape=Modes(one.basis * np.sqrt(one.variance)), faces=one.faces)
    write_scalismo_json(linear, tmp_path / "m.h5.json")
    file = json.loads((tmp_path / "m.h5.json").read_text())
    assert file.keys() == {"apiVersion", "root", "groups", "datasets"}
    found: dict[str, Any] = {}

    def walk(known_as: str, path: str) -> None:
        for attribute in file["groups"][known_as]["attributes"]:
            assert attribute.keys() == {"name", "type", "shape", "value"}
            assert attribute["shape"] == SCALAR and isinstance(attribute["value"], str)
        for link in file["groups"][known_as]["links"]:
            assert link.keys() == {"title", "collection", "id", "class"}
            inner = f"{path}/{link['title']}"
            if link["collection"] == "groups":
                walk(link["id"], inner)
            else:
                found[inner] = file["datasets"][link["id"]]

    walk(file["root"], "")
    assert len(found) == len(file["datasets"])
    for one_set in found.values():
        assert one_set["type"]["base" if "base" in one_set["type"] else "strPad"] in (
            "H5T_IEEE_F32LE", "H5T_STD_I32LE", "H5T_STR_NULLTERM",
        )  # fmt: skip
        shape = tuple(one_set["shape"].get("dims", ()))
        assert np.shape(one_set["value"]) == shape
    assert np.array_equal(np.array(found["/model/mean"]["value"], np.float32), one.mean.ravel())
    assert np.array_equal(found["/representer/cells"]["value"], one.faces.T)


@pytest.mark.parametrize("change", ["link", "circle", "again", "short", "root", "kind"])
def test_a_file_that_does_not_hang_together_is_refused(change: str, tmp_path: Path) -> None:
    file = by_hand()
    links = file["groups"]["g/"]["links"]
    match change:
        case "link":
            links[0]["class"] = "H5L_TYPE_EXTERNAL"
        case "circle":
            file["groups"]["g/model"]["links"].append(links[1] | {"title": "again"})
        case "again":
            for number in range(3000):
                links.append({"title": f"a{number}", "id": "d/model/pcaBasis", "collection": "datasets",
                              "class": "H5L_TYPE_HARD"})  # fmt: skip
        case "short":
            file["datasets"]["d/model/mean"]["value"].pop()
        case "root":
            file["root"] = "nowhere"
        case _:
            file["datasets"]["d/model/mean"]["type"] = {"class": "H5T_COMPOUND"}
    (tmp_path / "m.h5.json").write_text(json.dumps(file))
    with pytest.raises(ModelFileError) as refused:
        ShapeModel.load(tmp_path / "m.h5.json")
    assert "\n" not in str(refused.value)


@fuzzed(60)
def test_a_damaged_file_gives_a_model_or_one_sentence(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    rng, path = random.Random(seed), tmp_path_factory.mktemp("damaged") / "m.h5.json"
    file = copy.deepcopy(by_hand())
    path.write_bytes(damaged_json(file, rng) if rng.random() < 0.7 else damaged_bytes(json.dumps(file).encode(), rng))
    try:
        ShapeModel.load(path)
    except ShapespaceError as error:
        assert "\n" not in str(error)
