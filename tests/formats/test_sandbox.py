"""Files that are made to harm whoever opens them end in one sentence, whatever library reads them."""

import os
import random
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import scipy.io
import statismo_by_hand as by_hand

from own_file_fuzz import damaged_bytes, fuzzed
from shapespace.errors import ModelFileError, ShapespaceError
from shapespace.io import sandbox, sandbox_child
from shapespace.io.sandbox import SandboxError, read_hdf5_sandboxed, read_matlab_sandboxed
from shapespace.model.shape_model import ShapeModel

Harm = Callable[[Any, Path], None]


def soft_link(file: Any, secret: Path) -> None:
    file["model/pcaBasis"] = h5py.SoftLink("/kept")


def external_link(file: Any, secret: Path) -> None:
    file["model/pcaBasis"] = h5py.ExternalLink(str(secret), "/kept")


def external_storage(file: Any, secret: Path) -> None:
    file.create_dataset("model/pcaBasis", (18, 4), "f4", external=[(str(secret), 0, 288)])


def virtual(file: Any, secret: Path) -> None:
    layout = h5py.VirtualLayout((18, 4), "f4")
    layout[:] = h5py.VirtualSource(str(secret), "kept", (18, 4))
    file.create_virtual_dataset("model/pcaBasis", layout)


def nothing_packed(file: Any, secret: Path) -> None:
    file.create_dataset("model/pcaBasis", (2**30, 4), "f4", chunks=(2**20, 4), compression="gzip")


def zeros_packed(file: Any, secret: Path) -> None:
    file.create_dataset("model/pcaBasis", data=np.zeros((5 * 2**20, 4), "f4"), chunks=(2**20, 4), compression="gzip")


def one_huge_chunk(file: Any, secret: Path) -> None:
    file.create_dataset("model/pcaBasis", (18, 4), "f4", chunks=(2**27, 4), maxshape=(None, 4), compression="gzip")


def in_circles(file: Any, secret: Path) -> None:
    file["model/again"] = file["model"]


def many_groups(file: Any, secret: Path) -> None:
    for number in range(sandbox_child._MOST_NODES + 1):
        file.create_group(f"many/{number}")


def unknown_packing(file: Any, secret: Path) -> None:
    file.create_dataset("model/pcaBasis", data=np.zeros((18, 4), "f4"), chunks=(18, 4), compression="lzf")


HARMS: dict[Harm, str] = {
    soft_link: "link to elsewhere", external_link: "link to elsewhere", external_storage: "in another file",
    virtual: "in another file", nothing_packed: "out of proportion", zeros_packed: "out of proportion",
    one_huge_chunk: "out of proportion", in_circles: "more groups", many_groups: "more groups",
    unknown_packing: "compressed in a way",
}  # fmt: skip


@pytest.fixture
def harmless(tmp_path: Path) -> Path:
    by_hand.scalismo(tmp_path / "m.h5", by_hand.truth())
    return tmp_path / "m.h5"


@pytest.mark.parametrize("harm", HARMS, ids=lambda harm: harm.__name__)
def test_a_file_that_reaches_out_or_unfolds_is_refused(harm: Harm, harmless: Path, tmp_path: Path) -> None:
    secret = tmp_path / "secret.h5"
    with h5py.File(secret, "w") as other:
        other["kept"] = np.ones((18, 4), "f4")
    with h5py.File(harmless, "a") as file:
        file["kept"] = np.ones((18, 4), "f4")
        del file["model/pcaBasis"]
        harm(file, secret)
    with pytest.raises(ModelFileError, match=HARMS[harm]) as refused:
        ShapeModel.load(harmless)
    assert "\n" not in str(refused.value)


def test_a_file_is_read_apart_as_it_is_in_this_process(harmless: Path) -> None:
    tree = read_hdf5_sandboxed(harmless, leave=("/modelinfo",))
    with h5py.File(harmless) as file:
        for path, array in tree.arrays.items():
            assert np.array_equal(array, file[path][()])  # type: ignore[index]
    assert tree.attributes["/representer"]["version/minorVersion"] == "9"
    assert "/modelinfo/build-time" not in tree.texts and "/modelinfo" in tree.groups


def test_a_file_that_takes_too_long_or_too_much_is_given_up(harmless: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sandbox, "MOST_SECONDS", 0)
    with pytest.raises(SandboxError, match="longer than 0 s"):
        read_hdf5_sandboxed(harmless)
    monkeypatch.undo()
    if sys.platform == "linux":
        monkeypatch.setattr(sandbox, "PROGRAM_BYTES", -3 * 2**26)
        with pytest.raises(SandboxError, match=r"survive|cannot be read|memory"):
            read_hdf5_sandboxed(harmless)


def test_a_library_that_dies_or_lies_half_way_is_no_model() -> None:
    for answer in (b"", b"half a line", b'{"arrays":[["/a","<f4",[4]]],"texts":{},"attributes":{},"groups":[]}\n1234'):
        with pytest.raises(SandboxError, match="library that reads it crashes"):
            sandbox._tree(answer)


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such pipes")
@pytest.mark.parametrize("name", ["m.h5", "m.h5.json", "m.npz", "m.pkl", "m.mat", "m.statismo.h5"])
def test_nobody_waits_at_a_pipe(name: str, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / name)
    with pytest.raises(ShapespaceError, match="pipe"):
        ShapeModel.load(tmp_path / name)


def test_a_folder_that_one_stands_in_is_not_imported_from(
    harmless: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "numpy.py").write_text("raise SystemExit(3)")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", ["", *sys.path])  # as in a session of Python
    assert ShapeModel.load(harmless).n_modes == 4


def test_matlab_variables_that_unfold_to_far_more_than_the_file_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scipy.io.savemat(tmp_path / "m.mat", {"mean": np.zeros(10**6)}, do_compression=True)
    assert (tmp_path / "m.mat").stat().st_size < 20_000
    monkeypatch.setattr(sandbox, "SPARE_BYTES", 2**20)
    with pytest.raises(SandboxError, match="out of proportion"):
        read_matlab_sandboxed(tmp_path / "m.mat", ["mean"])


@fuzzed(6)
def test_a_damaged_file_gives_a_model_or_one_sentence(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    rng, folder = random.Random(seed), tmp_path_factory.mktemp("damaged")
    if rng.random() < 0.5:
        path = folder / "m.h5"
        by_hand.cpp(path, by_hand.truth())
    else:
        path, one = folder / "m.mat", by_hand.truth()
        parts = {"mean": one.mean, "components": one.basis, "eigenvalues": one.variance, "trilist": one.faces}
        scipy.io.savemat(path, parts, do_compression=rng.random() < 0.5)
    path.write_bytes(damaged_bytes(path.read_bytes(), rng))
    try:
        ShapeModel.load(path)
    except ShapespaceError as error:
        assert "\n" not in str(error)
