"""FLAME and the SMPL family, as .npz and as pickles of several writers; pickles that do more are refused."""

import io
import os
import pickle
import random
import struct
import sys
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.sparse

from own_file_fuzz import damaged_bytes, fuzzed
from shapespace.errors import ModelFileError, ShapespaceError
from shapespace.formats.registry import read_linear
from shapespace.io.sandbox import SandboxError, read_pickle_sandboxed
from shapespace.model.additive import AdditiveModel
from shapespace.model.shape_model import ShapeModel

V = 150


def parts(joints: int = 5, modes: int = 20, seed: int = 0) -> dict[str, Any]:
    """Return the contents of such a file, small; `joints` tell the family."""
    rng = np.random.default_rng(seed)
    return {
        "v_template": rng.normal(scale=0.1, size=(V, 3)),
        "f": rng.permutation(V).astype(np.uint32).reshape(-1, 3),
        "shapedirs": rng.normal(scale=0.01, size=(V, 3, modes)) / np.arange(1, modes + 1),
        "posedirs": rng.normal(size=(V, 3, 9)),
        "weights": np.full((V, joints), 1 / joints),
        "J_regressor": scipy.sparse.csc_matrix(np.eye(joints, V)),
        "J": np.zeros((joints, 3)),
        "kintree_table": np.zeros((2, joints), dtype=np.uint32),
        "bs_type": "lrotmin",
    }


def is_made_of(model: ShapeModel, made_of: dict[str, Any]) -> None:
    assert np.allclose(model.mean_vertices, 1000 * made_of["v_template"], atol=1e-9)
    moved = 1000 * made_of["shapedirs"].reshape(3 * V, -1)
    wanted, found = moved @ moved.T, (model.basis * model.stddev**2) @ model.basis.T
    assert np.linalg.norm(found - wanted) < 1e-9 * np.linalg.norm(wanted)


def saved(made_of: dict[str, Any], folder: Path, ending: str, protocol: int = 2) -> Path:
    path = folder / f"model{ending}"
    if ending == ".npz":
        plain = {
            name: np.array(value, dtype=object) if name == "J_regressor" else value for name, value in made_of.items()
        }
        np.savez(path, **plain)
    else:
        path.write_bytes(pickle.dumps(made_of, protocol))
    return path


@pytest.mark.parametrize(("ending", "protocol"), [(".npz", 0), *((".pkl", number) for number in range(6))])
def test_identity_and_expression_are_parted_and_the_rig_is_left_out(ending: str, protocol: int, tmp_path: Path) -> None:
    made_of = parts()
    path = saved(made_of, tmp_path, ending, protocol)
    _, linear = read_linear(path)
    assert "pose rig" in linear.notes[0] and "research" in linear.licence and linear.licence.startswith("FLAME")
    model = AdditiveModel.load(path)
    is_made_of(model.shape, made_of)
    assert (model.n_identity, model.n_expression) == (10, 10)
    a = np.random.default_rng(1).normal(size=10)
    # Modes of identity are those of the file but for their order and signs, so that only their span is asked for.
    moved = (model.mesh(a, ()).vertices - model.shape.mean_vertices).ravel()
    identity = made_of["shapedirs"].reshape(3 * V, -1)[:, :10]
    assert np.linalg.norm(moved - identity @ np.linalg.lstsq(identity, moved, rcond=None)[0]) < 1e-8


@pytest.mark.parametrize(("joints", "family"), [(24, "SMPL"), (52, "SMPL+H"), (16, "MANO")])
def test_bodies_and_hands_have_shape_alone(joints: int, family: str, tmp_path: Path) -> None:
    path = saved(parts(joints, 10), tmp_path, ".pkl")
    model = ShapeModel.load(path)
    assert model.n_modes == 10 and model.licence.startswith(f"{family}:")
    with pytest.raises(ModelFileError, match="does not separate"):
        AdditiveModel.load(path)


def test_faces_of_400_modes_have_300_of_identity(tmp_path: Path) -> None:
    made_of = parts(modes=400)
    _, linear = read_linear(saved(made_of, tmp_path, ".npz"))
    assert linear.expression is not None
    assert (linear.shape.moved.shape[1], linear.expression.moved.shape[1]) == (300, 100)
    assert np.array_equal(linear.expression.moved[:, 3], made_of["shapedirs"].reshape(3 * V, -1)[:, 303])


@pytest.fixture
def chumpy() -> Iterator[Any]:
    """A stand-in for chumpy, by which pickles of old FLAME and SMPL files name their arrays."""
    modules = {name: types.ModuleType(name) for name in ("chumpy", "chumpy.ch", "chumpy.reordering")}
    for module, kind in (("chumpy.ch", "Ch"), ("chumpy.reordering", "Select")):
        setattr(modules[module], kind, type(kind, (), {"__module__": module}))
    sys.modules.update(modules)
    yield modules
    for name in modules:
        del sys.modules[name]


def test_arrays_inside_chumpy_are_found(chumpy: Any, tmp_path: Path) -> None:
    made_of = parts()
    wrapped, selected = chumpy["chumpy.ch"].Ch(), chumpy["chumpy.reordering"].Select()
    wrapped.x, wrapped._dirty_vars = made_of["v_template"], set[str]()
    more = np.concatenate([made_of["shapedirs"], made_of["shapedirs"][:, :, :3]], axis=2)
    at = np.arange(more.size).reshape(more.shape)[:, :, :20].ravel()
    selected.a, selected.idxs, selected.preferred_shape = more, at, (V, 3, 20)
    del wrapped._dirty_vars  # sets of Python 2 are refused, and chumpy drops them when it pickles
    path = saved(made_of | {"v_template": wrapped, "shapedirs": selected}, tmp_path, ".pkl")
    is_made_of(ShapeModel.load(path), made_of)


def of_python_2(array: Any) -> bytes:
    """Return what Python 2 writes of an array, whose bytes are a text there."""

    def whole(number: int) -> bytes:
        return b"J" + struct.pack("<i", number)

    raw = np.asfortranarray(array).tobytes("F")
    shape = b"(" + b"".join(map(whole, array.shape)) + b"t"
    dtype = (
        b"cnumpy\ndtype\n(U\x02f8"
        + whole(0)
        + whole(1)
        + b"tR("
        + whole(3)
        + b"U\x01<NNN"
        + 2 * whole(-1)
        + whole(0)
        + b"tb"
    )
    made = b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(" + whole(0) + b"tU\x01btR"
    return made + b"(" + whole(1) + shape + dtype + b"\x88T" + struct.pack("<i", len(raw)) + raw + b"tb"


def test_a_pickle_of_python_2_is_read(tmp_path: Path) -> None:
    made_of = parts()
    entries = b"".join(
        b"U" + bytes([len(name)]) + name.encode() + of_python_2(made_of[name]) for name in ("v_template", "shapedirs")
    )
    (tmp_path / "model.pkl").write_bytes(b"\x80\x02}(" + entries + b"u.")
    is_made_of(ShapeModel.load(tmp_path / "model.pkl"), made_of)


class Call:
    """Pickled, it has Python call something."""

    def __init__(self, call: Any, *arguments: Any) -> None:
        self.called = call, arguments

    def __reduce__(self) -> Any:
        return self.called


def hostile(marker: str) -> dict[str, bytes]:
    code = f"open({marker!r}, 'w')"
    calls = {
        "os.system": Call(os.system, f"touch {marker}"), "eval": Call(eval, code), "exec": Call(exec, code),
        "open": Call(open, marker, "w"), "getattr": Call(getattr, "text", "upper"), "import": Call(__import__, "os"),
        "numpy.load": Call(np.load, marker), "numpy.fromfile": Call(np.fromfile, marker),
        "numpy.memmap": Call(np.memmap, marker, "u1", "w+", 0, (4,)), "numpy.save": Call(np.save, marker, 1),
        "numpy.zeros": Call(np.zeros, 2**40), "numpy.loadtxt": Call(np.loadtxt, marker),
        "pickle.loads": Call(pickle.loads, b"N."), "bytearray": Call(bytearray, 2**40),
        "partial": Call(__import__("functools").partial, os.system, f"touch {marker}"),
    }  # fmt: skip
    made = {
        f"{name} {protocol}": pickle.dumps({"v_template": call}, protocol)
        for name, call in calls.items()
        for protocol in (0, 2, 4)
    }
    by_name = {
        "numpy.core.multiarray.fromfile": b"cnumpy.core.multiarray\nfromfile\n(S'x'\ntR.",
        "dotted": b"\x80\x04\x8c\x05numpy\x8c\x0ccompat.os.sys\x93.",
        "chumpy with a dot": b"\x80\x04\x8c\x06chumpy\x8c\x09os.system\x93.",
        "inst": b"(S'true'\nios\nsystem\n.", "obj": b"(cos\nsystem\nS'true'\no.", "extension": b"\x80\x02\x82\x01.",
        "persistent": b"Pname\n.", "state of a name": b"cnumpy\nndarray\n}b0N.", "state of a list": b"]}b.",
    }  # fmt: skip
    return made | by_name


@pytest.mark.parametrize("name", hostile("x"))
def test_a_pickle_that_does_more_than_hold_arrays_is_refused(name: str, tmp_path: Path) -> None:
    path, marker = tmp_path / "model.pkl", tmp_path / "marker"
    path.write_bytes(hostile(str(marker))[name])
    with pytest.raises(ModelFileError) as refused:
        ShapeModel.load(path)
    assert "\n" not in str(refused.value)
    assert name[-1] not in "024" or "asks for" in str(refused.value)
    assert not marker.exists()


def test_allowed_names_are_never_called(tmp_path: Path) -> None:
    from shapespace.io import sandbox_child

    path = saved(parts(), tmp_path, ".pkl", 4)
    assert np.array_equal(read_pickle_sandboxed(path, ["v_template"]).arrays["/v_template"], parts()["v_template"])
    reader = sandbox_child._Unpickler(io.BytesIO())
    for module, name in [*sandbox_child._ARRAY_NAMES, ("chumpy.ch", "Ch")]:
        assert issubclass(reader.find_class(module, name), sandbox_child._PickledObject)


def laughs() -> bytes:
    """Return a list of 99 times the same list, of 99 times the same list, and so on."""
    return b"]" + b"".join(b"q%c](" % n + 99 * (b"h%c" % n) + b"e" for n in range(9))


LARGE = of_python_2(np.ones((1, 1))).replace(struct.pack("<i", 1) + b"J", struct.pack("<i", 2**30) + b"J", 2)
HUGE = {
    "memo": b"\x80\x02}r\xff\xff\xff\x7f.",
    "bytes": b"\x80\x05\x96" + struct.pack("<Q", 2**40) + b"x.",
    "shape": b"}U\x01a" + LARGE + b"s.",
    "lists": b"\x80\x02}U\x01a" + laughs() + b"s.",
    "steps": b"\x80\x02" + b"N0" * 200_001 + b"}.",
}


@pytest.mark.parametrize("name", HUGE)
def test_a_small_pickle_takes_little(name: str, tmp_path: Path) -> None:
    path = tmp_path / "model.pkl"
    path.write_bytes(HUGE[name])
    with pytest.raises(SandboxError) as error:
        read_pickle_sandboxed(path, ["a"])
    assert "\n" not in str(error.value)


@fuzzed(60)
def test_a_damaged_file_gives_a_model_or_one_sentence(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    rng, folder = random.Random(seed), tmp_path_factory.mktemp("damaged")
    path = saved(parts(modes=10), folder, rng.choice([".npz", ".pkl"]), rng.choice([0, 2, 4, 5]))
    path.write_bytes(damaged_bytes(path.read_bytes(), rng))
    try:
        ShapeModel.load(path)
    except ShapespaceError as error:
        assert "\n" not in str(error)
