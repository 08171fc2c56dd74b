"""Model files made to harm: each carries right checksums, which whoever makes one can compute as well as we."""

import hashlib
import io
import json
import os
import resource
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from shapespace.errors import FileFormatError, ModelFileError
from shapespace.io.containers.hdf5 import content_hash, write_hdf5
from shapespace.model.additive import AdditiveModel
from shapespace.model.shape_model import ShapeModel
from synthetic_shapes import blob_model

Build = Callable[[h5py.File], None]


@pytest.fixture(scope="module")
def parts(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], dict[str, Any]]:
    """Arrays and attributes of a good model."""
    path = tmp_path_factory.mktemp("good") / "m.h5"
    blob_model(vertices=200).save(path)
    with h5py.File(path) as file:
        arrays = {name: item[()] for name, item in file.items()}
        return arrays, {k: v.item() if isinstance(v, np.generic) else v for k, v in file.attrs.items()}


def sealed(path: Path, content: bytes) -> Path:
    """Write HDF5 `content`, of which the first 512 bytes are free, with the checksum that belongs to it."""
    digest = hashlib.sha256(content[512:]).hexdigest().encode()
    path.write_bytes((b"shapespace sha256 " + digest + b"\n").ljust(512, b"\0") + content[512:])
    return path


def hostile(path: Path, parts: Any, build: Build, without: tuple[str, ...] = (), **attributes: Any) -> Path:
    """Write a good model without some arrays, with other attributes and with what `build` adds to it."""
    arrays, known = ({k: v for k, v in part.items() if k not in without} for part in parts)
    memory = io.BytesIO()
    with h5py.File(memory, "w", userblock_size=512) as file:
        for name, array in arrays.items():
            file[name] = array
        for name, value in (known | attributes).items():
            file.attrs[name] = value
        build(file)
    return sealed(path, memory.getvalue())


def nothing(file: h5py.File) -> None:
    pass


def refused(path: Path, why: str = "") -> None:
    with pytest.raises(ModelFileError, match=rf"{path.name}.*{why}") as error:
        ShapeModel.load(path)
    said = str(error.value)
    assert said.endswith(".") and "\n" not in said and len(said) < 1000


def test_the_way_these_files_are_made_gives_good_ones_too(parts: Any, tmp_path: Path) -> None:
    assert ShapeModel.load(hostile(tmp_path / "m.h5", parts, nothing)).n_modes == 5


def test_what_stands_in_other_files_is_never_read(parts: Any, tmp_path: Path) -> None:
    stddev = parts[0]["stddev"]
    secret = tmp_path / "secret"
    secret.write_bytes(stddev.tobytes())
    other = tmp_path / "other.h5"
    with h5py.File(other, "w") as file:
        file["stddev"] = stddev

    def outside(file: h5py.File) -> None:
        file.create_dataset("stddev", (5,), "f8", external=[(str(secret), 0, stddev.nbytes)])

    def virtual(file: h5py.File) -> None:
        layout = h5py.VirtualLayout((5,), "f8")
        layout[:] = h5py.VirtualSource(str(other), "stddev", (5,))
        file.create_virtual_dataset("stddev", layout)

    def link(file: h5py.File) -> None:
        file["stddev"] = h5py.ExternalLink(str(other), "stddev")

    def soft(file: h5py.File) -> None:
        file["kept"] = stddev
        file["stddev"] = h5py.SoftLink("/kept")

    for build in (outside, virtual, link, soft):
        refused(hostile(tmp_path / "m.h5", parts, build, without=("stddev",)), "not in the layout of shapespace")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no pipes with names here")
def test_no_file_makes_a_reader_wait_at_a_pipe(parts: Any, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")

    def outside(file: h5py.File) -> None:
        file.create_dataset("stddev", (5,), "f8", external=[(str(tmp_path / "pipe"), 0, 40)])

    refused(hostile(tmp_path / "m.h5", parts, outside, without=("stddev",)))


def test_arrays_that_are_packed_in_pieces_or_of_other_types_are_refused(parts: Any, tmp_path: Path) -> None:
    mean = parts[0]["mean"]
    ways: list[dict[str, Any]] = [
        {"data": mean, "chunks": (60,)}, {"data": mean, "compression": "gzip"}, {"data": mean, "shuffle": True},
        {"data": mean.astype("f4")}, {"data": mean.astype(">f8")}, {"data": mean.astype("i8")},
        {"data": mean.astype(complex)}, {"data": mean.astype("S8")}, {"data": h5py.Empty("f8")},
        {"data": np.zeros(len(mean), [("a", "f8")])}, {"data": ["text"] * 3}, {"data": mean, "maxshape": (None,)},
    ]  # fmt: skip
    for way in ways:
        path = hostile(tmp_path / "m.h5", parts, lambda file, way=way: file.create_dataset("mean", **way), ("mean",))
        refused(path)


def test_an_array_named_often_takes_no_more_memory_than_the_file_has(tmp_path: Path) -> None:
    memory = io.BytesIO()
    with h5py.File(memory, "w", userblock_size=512) as file:
        file["mean"] = np.zeros(2**17)
        for k in range(30):
            file[f"again{k}"] = file["mean"]
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    refused(sealed(tmp_path / "m.h5", memory.getvalue()), "declares 1048576 bytes")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 50_000


def test_more_names_than_any_model_has_are_refused(tmp_path: Path) -> None:
    memory = io.BytesIO()
    with h5py.File(memory, "w", userblock_size=512) as file:
        file["mean"] = np.zeros(1)
        for k in range(3000):
            file[f"again{k}"] = file["mean"]
    refused(sealed(tmp_path / "m.h5", memory.getvalue()), "names are stored in another layout")


def test_a_text_named_often_takes_no_more_memory_than_the_file_has(tmp_path: Path) -> None:
    memory = io.BytesIO()
    with h5py.File(memory, "w", userblock_size=512) as file:
        for k in range(40):
            file.attrs[f"a{k:02}"] = "x" * 40_000 if k == 0 else "y" * (9 + k)
    content = bytearray(memory.getvalue())
    first = content.index(b"\x40\x9c\x00\x00")  # the length of the text, before its place and number in the heap
    for k in range(1, 40):
        at = content.index((9 + k).to_bytes(4, "little"), content.index(f"a{k:02}".encode()) + 32)
        content[at : at + 16] = content[first : first + 16]
    refused(sealed(tmp_path / "m.h5", bytes(content)), "declares 40000 bytes in the attribute")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("total_variance", np.array([1.0, 2.0])),
        ("total_variance", np.inf),
        ("total_variance", "much"),
        ("total_variance", h5py.Empty("f8")),
        ("n_training", 2.5),
        ("n_training", np.bool_(True)),
        ("n_training", np.uint64(2**64 - 1)),
        ("format", np.bytes_(b"shapespace model")),
        ("format_version", np.array([1, 1])),
        ("gauge", "other"),
        ("licence", b"\xff\xfe"),
        ("licence", h5py.Empty("S1")),
        ("landmarks", "[" * 200_000),
        ("landmarks", '{"a": ' * 200 + "1" + "}" * 200),
        ("landmarks", '{"a": [1]}'),
        ("landmarks", '{"a": 1e400}'),
        ("landmarks", '{"a": 1' + "0" * 400 + "}"),
        ("landmarks", '{"a": 1' + "0" * 5000 + "}"),
        ("landmarks", '{"a": -1}'),
        ("landmarks", "[1, 2]"),
        ("landmarks", 3),
        ("representation", "bspline"),
        ("variance_divisor", 7),
        ("format_version", "1" * 100_000),
        ("gauge", "x" * 100_000),
    ],
)
def test_attributes_of_other_types_and_values_are_refused_in_one_sentence(
    parts: Any, tmp_path: Path, name: str, value: Any
) -> None:
    path = hostile(tmp_path / "m.h5", parts, nothing, **{name: value})
    if type(value) in (str, int, float):  # of the types that we write, so that the reader comes to look at the value
        arrays, attributes = parts
        write_hdf5(path, arrays, attributes | {name: value})
    refused(path)


def test_no_file_is_read_that_does_not_carry_both_checksums(parts: Any, tmp_path: Path) -> None:
    arrays, attributes = parts
    bare = tmp_path / "bare.h5"
    with h5py.File(bare, "w") as file:
        for name, array in arrays.items():
            file[name] = array
        file.attrs.update(attributes)
    refused(bare, "has no checksum")
    path = hostile(tmp_path / "m.h5", parts, lambda file: file.attrs.__delitem__("content_hash"))
    refused(path, "damaged")
    refused(hostile(path, parts, nothing, content_hash=content_hash(arrays, {})), "damaged")


def test_faces_beyond_the_vertices_are_refused_and_never_wrapped(parts: Any, tmp_path: Path) -> None:
    arrays, attributes = parts
    for faces in (arrays["faces"].astype(np.int64) + 2**32, arrays["faces"] + 190, arrays["faces"].astype(np.float64)):
        write_hdf5(tmp_path / "m.h5", arrays | {"faces": faces}, attributes)
        refused(tmp_path / "m.h5")


def values(name: str) -> list[Any]:
    return [np.nan, np.inf, -1.0, 0.0, 1e308, -1e308, 5e-324] if name != "faces" else [-1, 200, 2**31 - 1, -(2**31)]


@pytest.mark.parametrize("name", ["mean", "basis", "stddev", "faces"])
def test_arrays_of_any_value_and_shape_give_a_model_or_one_sentence(parts: Any, tmp_path: Path, name: str) -> None:
    arrays, attributes = parts
    array = arrays[name]
    others = [np.full_like(array, value) for value in values(name)]
    for value in values(name):
        others.append(array.copy())
        others[-1].flat[1] = value
    others += [array[:1], array[:-1], array[..., None], array.ravel(), array.reshape(-1)[0], array.T]
    for other in others:
        write_hdf5(tmp_path / "m.h5", arrays | {name: np.asarray(other)}, attributes)
        try:
            model = ShapeModel.load(tmp_path / "m.h5")
        except ModelFileError:
            continue
        assert np.isfinite(model.reconstruct(model.stddev)).all()


@pytest.fixture(scope="module")
def parts_with_rest(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], dict[str, Any]]:
    """Arrays and attributes of a good model whose training shapes have further modes."""
    path = tmp_path_factory.mktemp("rest") / "m.h5"
    blob_model(vertices=200, modes=2).save(path)
    with h5py.File(path) as file:
        arrays = {name: item[()] for name, item in file.items()}
        return arrays, {k: v.item() if isinstance(v, np.generic) else v for k, v in file.attrs.items()}


@pytest.mark.parametrize("name", ["training", "training_rest", "training_log_scale"])
def test_training_shapes_of_any_value_and_shape_give_a_model_or_one_sentence(
    parts_with_rest: Any, tmp_path: Path, name: str
) -> None:
    arrays, attributes = parts_with_rest
    array = arrays[name]
    others = [np.full_like(array, value) for value in values(name)]
    for value in values(name):
        others.append(array.copy())
        others[-1].flat[1] = value
    for other in others:
        write_hdf5(tmp_path / "m.h5", arrays | {name: other}, attributes)
        try:
            model = ShapeModel.load(tmp_path / "m.h5").with_all_modes
        except ModelFileError:
            continue
        assert np.isfinite(model.reconstruct(model.stddev)).all() and model.training is not None
        assert np.isfinite(np.exp(model.training.log_scale)).all() and np.isfinite(model.training.stddev).all()
    wrong = [array[:1], array[:-1], array[..., None], array.reshape(-1)[0], array.astype(np.int32)]
    if array.ndim == 2:
        wrong += [array[:, 1:], array.T, array.ravel(), np.concatenate([array, array], axis=1)]
    for other in wrong:
        write_hdf5(tmp_path / "m.h5", arrays | {name: np.asarray(other)}, attributes)
        refused(tmp_path / "m.h5")


@pytest.mark.parametrize(
    ("name", "value", "why"),
    [
        ("training", np.nan, "must be finite"),
        ("training", 1e308, "no shape of its size"),
        ("training_rest", 0.5, "not of length 1"),
        ("training_log_scale", 1000.0, "must be finite"),
        ("training_log_scale", np.inf, "must be finite"),
    ],
)
def test_training_shapes_that_cannot_be_are_refused(
    parts_with_rest: Any, tmp_path: Path, name: str, value: float, why: str
) -> None:
    arrays, attributes = parts_with_rest
    write_hdf5(tmp_path / "m.h5", arrays | {name: np.full_like(arrays[name], value)}, attributes)
    refused(tmp_path / "m.h5", why)


@pytest.mark.parametrize("name", ["training", "training_log_scale"])
def test_training_shapes_without_their_coefficients_or_sizes_are_refused(
    parts_with_rest: Any, tmp_path: Path, name: str
) -> None:
    arrays, attributes = parts_with_rest
    write_hdf5(tmp_path / "m.h5", {key: array for key, array in arrays.items() if key != name}, attributes)
    refused(tmp_path / "m.h5", f"missing or wrong: '{name}'")


@pytest.mark.parametrize(
    "more",
    [
        {"control_counts": [60_000, 60_000], "degree": 3},
        {"control_counts": [2**31 - 1, 2**31 - 1], "degree": 3},
        {"control_counts": [-4, -4], "degree": 3},
        {"control_counts": [8, 8], "degree": [3, 3]},
        {"control_counts": [8, 8], "degree": 2},
        {},
    ],
)
@pytest.mark.parametrize("representation", ["bspline", "bspline-detail"])
def test_codings_that_do_not_fit_are_refused_before_memory_is_taken(
    parts: Any, tmp_path: Path, more: Mapping[str, Any], representation: str
) -> None:
    arrays, attributes = parts
    coding = {"uv": np.full((200, 2), 0.5), "detail": np.zeros((200, 3))}
    coding |= {name: np.array(value, dtype=np.int32) for name, value in more.items()}
    write_hdf5(tmp_path / "m.h5", arrays | coding, attributes | {"representation": representation})
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    refused(tmp_path / "m.h5")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000


@pytest.mark.parametrize("identity", [-1, 0, 5, 10**15, float("inf"), float("nan"), "2", "much"])
def test_a_split_that_cannot_be_is_refused(parts: Any, tmp_path: Path, identity: Any) -> None:
    arrays, attributes = parts
    write_hdf5(tmp_path / "m.h5", arrays | {"split_rotation": np.eye(5)}, attributes | {"split_identity": identity})
    assert ShapeModel.load(tmp_path / "m.h5").n_modes == 5
    if identity == "2":
        return
    with pytest.raises(ModelFileError):
        AdditiveModel.load(tmp_path / "m.h5")


def test_words_of_any_text_come_back_and_what_is_no_text_is_refused_before_it_is_written(
    tmp_path: Path, parts: Any
) -> None:
    arrays, attributes = parts
    words = "Gesichter «éà» 顔" + "long " * 20_000
    told = {"landmarks": json.dumps({"näse \udcff": 3}), "provenance": words, "licence": ""}
    first = {name: array[:1] for name, array in arrays.items() if name.startswith("landmark_")}
    vertex = {"landmark_corners": np.array([[3, 3, 3]], dtype=np.int32)}
    write_hdf5(tmp_path / "m.h5", arrays | first | vertex, attributes | told)
    model = ShapeModel.load(tmp_path / "m.h5")
    assert (dict(model.landmarks), model.provenance, model.licence) == ({"näse \udcff": 3}, words, "")
    for wrong in ("\udcff", "\0"):
        with pytest.raises(FileFormatError, match=r"Cannot write .*licence"):
            replace(model, licence=wrong).save(tmp_path / "n.h5")
    assert not (tmp_path / "n.h5").exists()


def test_a_model_is_written_as_it_is_read_whatever_h5py_is_set_to_and_else_not_at_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = blob_model(vertices=200)
    monkeypatch.setattr(h5py.get_config(), "track_order", True)
    model.save(tmp_path / "m.h5")
    assert ShapeModel.load(tmp_path / "m.h5").content_hash == model.content_hash
    whole = h5py.File
    monkeypatch.setattr(h5py, "File", lambda *_, **options: whole(*_, **(options | {"libver": "latest"})))
    with pytest.raises(FileFormatError, match=r"n\.h5 was not written: h5py .* cannot be read back"):
        model.save(tmp_path / "n.h5")
    assert not (tmp_path / "n.h5").exists()
