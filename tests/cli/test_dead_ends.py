"""Sentences that tell a user what to do name commands and options that there are."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import shapespace
from conftest import Run, World
from shapespace.cli.command_table import COMMANDS
from shapespace.io.meshes.mesh_io import read_mesh, write_mesh
from shapespace.model.additive import AdditiveModel
from shapespace.model.shape_model import ShapeModel

OF_OTHERS = {"--stl", "--version", "--nthreads"}


def sentences() -> Iterator[tuple[Path, str]]:
    """Yield each text of the code that is no docstring, with what stands in its braces left out."""
    for file in sorted(Path(shapespace.__file__).parent.rglob("*.py")):
        tree = ast.parse(file.read_text("utf-8"))
        documents = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
        inside = {id(part) for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for part in node.values}
        for node in ast.walk(tree):
            if isinstance(node, ast.JoinedStr):
                yield file, "".join(str(p.value) if isinstance(p, ast.Constant) else "X" for p in node.values)
            elif (
                isinstance(node, ast.Constant) and isinstance(node.value, str) and not {id(node)} & (documents | inside)
            ):
                yield file, node.value


def test_every_option_and_command_that_a_sentence_names_is_there() -> None:
    known = {word for command in COMMANDS for word in command.name.split()}
    every = [option for command in COMMANDS for option in command.options]
    options = {"--help", "--help-all", *(name for option in every for name in option.spellings)}
    assert len(options) > 50
    wrong: list[str] = []
    for file, text in sentences():
        named = set(re.findall(r"(?<![\w-])--[a-z][a-z-]*[a-z]", text))
        wrong += [f"{file.name}: {option}" for option in named - options - OF_OTHERS]
        told = re.findall(r"(?<=run shapespace )([a-z]+)", text)
        wrong += [f"{file.name}: shapespace {command}" for command in told if command not in known]
    assert wrong == []


def test_meshes_that_do_not_correspond_lead_to_the_command_that_brings_them_there(
    run: Run, world: World, tmp_path: Path
) -> None:
    outcome = run("build", *world.scans[:2], world.meshes, "-o", tmp_path / "m.h5")
    assert outcome.code == 2 and "shapespace correspond" in outcome.sentence()
    mesh = read_mesh(world.scan)
    others = mesh.faces[:-1]
    write_mesh(tmp_path / "b.ply", type(mesh)(mesh.vertices, others, name="b.ply"))
    outcome = run("build", world.scan, tmp_path / "b.ply", "-o", tmp_path / "m.h5")
    assert outcome.code == 2 and "shapespace correspond" in outcome.sentence()


@pytest.mark.parametrize("additive", [True, False])
def test_info_says_of_an_additive_model_that_it_is_one(run: Run, tmp_path: Path, additive: bool) -> None:
    rng = np.random.default_rng(3)
    shape = ShapeModel(
        mean=rng.normal(0, 50, 60), basis=np.linalg.qr(rng.standard_normal((60, 4)))[0], stddev=np.arange(8.0, 4.0, -1),
        total_variance=200.0, n_training=30,
    )  # fmt: skip
    model = AdditiveModel(shape, np.linalg.qr(rng.standard_normal((4, 4)))[0], 3) if additive else shape
    model.save(tmp_path / "m.h5")
    outcome = run("info", tmp_path / "m.h5")
    assert ("additive: identity_modes 3, expression_modes 1" in outcome.out) == additive
