"""Surfaces are named after their scans."""

from pathlib import Path

import pytest

from shapespace.store.corresponding import surface_stem


@pytest.mark.parametrize(
    "file",
    ["anna.ply", "anna.PLY", "anna.ply.gz", "anna.obj", "anna.dense.ply", "anna.fitted.ply", "anna.corresponding.ply"],
)
def test_a_surface_has_the_name_of_its_scan(file: str) -> None:
    assert surface_stem(Path("folder.ply") / file) == "anna"


def test_other_dots_belong_to_the_name() -> None:
    assert surface_stem(Path("anna.2.dense.ply")) == surface_stem(Path("anna.2.ply")) == "anna.2"
