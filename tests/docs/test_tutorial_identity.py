"""The tutorial on identity goes through quickly from fits that are there already."""

import contextlib
import csv
import io
import json
from pathlib import Path

import numpy as np
import pytest
from test_docs import ROOT, arguments, run, workplace

from shapespace import cli
from shapespace.geometry.similarity import fit_similarity
from shapespace.io.meshes.mesh_io import read_mesh
from shapespace.model.shape_model import ShapeModel
from stored_fits import record

pytest.importorskip("sklearn", reason="the extra `statistics` is not installed")

TYPED = "shapespace data faces -o scans --subjects 12 --seed 7 --expressions neutral,smile,surprise --raw"
workplace_of_documents = workplace


def make_scans() -> None:
    """Write the faces as they are: to cut them up as a scanner would takes most of the time."""
    with contextlib.redirect_stdout(io.StringIO()):
        assert cli.main(arguments(TYPED.removesuffix(" --raw"))) == 0


def make_fits() -> None:
    """Write what a fit that is right to a third of a standard deviation in each coefficient would."""
    model = ShapeModel.load("model.h5")
    Path("fits").mkdir()
    rng = np.random.default_rng(0)
    with Path("scans/labels.csv").open() as file:
        names = [Path(row["file"]).stem for row in csv.DictReader(file)]
    for k, name in enumerate(names):
        face = read_mesh(f"scans/{name}.ply").vertices
        placed = fit_similarity(face, model.mean_vertices, with_scale=True).apply(face)
        z = model.to_z(model.project(placed, align=False))
        z = z + 0.3 * rng.standard_normal(len(z))
        told = record(
            name, k, z=z.tolist(), b=model.to_b(z).tolist(), b_stddev=(0.3 * model.stddev).tolist(),
            model={"name": "model.h5", "hash": model.content_hash, "path": "../model.h5"},
            shrinkage=[1.0] * len(z),
        )  # fmt: skip
        Path(f"fits/{name}.fit.json").write_text(json.dumps(told))


@pytest.mark.long
def test_the_tutorial_on_identity_goes_from_saved_fits(workplace_of_documents: Path) -> None:
    instead = {TYPED: make_scans, "shapespace fit model.h5 scans -o fits": make_fits}
    assert run(ROOT / "docs" / "tutorial-identity.md", with_data=False, instead=instead) == 5
    figures = {
        (row["score"], row["figure"]): float(row["value"])
        for row in csv.DictReader(Path("verified/figures.csv").read_text().splitlines())
        if row["value"]
    }
    assert figures["plda", "eer"] <= 0.5 * figures["distance", "eer"]
    assert Path("verified/report.html").is_file() and Path("identified/report.html").is_file()
    assert Path("again/analysis.json").is_file()
