"""Simulated landmarks: the same for every count, with the differences that were put in."""

import csv
from pathlib import Path

import numpy as np
import pytest

from shapespace.cli import main
from shapespace.datasets.skull_landmarks import skull_landmarks, write_skull_landmarks
from shapespace.errors import InputError


def jaw_depth(k: int) -> float:
    """Return the distance of the third landmark from the line of the first and the sixth, as a share of it."""
    x = skull_landmarks(0, k)[0]
    along = x[5] - x[0]
    return float(np.cross(np.append(along, 0), np.append(x[2] - x[0], 0))[2] / (along @ along))


def test_species_differ_more_at_the_site_where_both_live() -> None:
    depth = np.array([jaw_depth(k) for k in range(400)]).reshape(-1, 2, 2)  # site, species
    alone, together = (depth[:, :, 1] - depth[:, :, 0]).mean(axis=0)
    assert together < alone < 0
    assert together == pytest.approx(3 * alone, rel=0.35)


def test_files_are_the_same_for_every_count(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["data", "landmarks", "-o", str(tmp_path / "a"), "--count", "12", "--quiet"]) == 0
    assert capsys.readouterr().out == f"12 skulls in {tmp_path / 'a'}\n"
    write_skull_landmarks(tmp_path / "b", count=8)
    short = (tmp_path / "b" / "skulls.tps").read_text()
    assert (tmp_path / "a" / "skulls.tps").read_text().startswith(short)
    rows = list(csv.DictReader((tmp_path / "a" / "skulls.csv").read_text().splitlines()))
    assert [row["species"] for row in rows[:4]] == ["agilis", "robusta", "agilis", "robusta"]
    assert [row["site"] for row in rows[:4]] == ["alone", "alone", "together", "together"]


@pytest.mark.parametrize("count", [0, 7, 10_001])
def test_counts_out_of_range_are_refused(tmp_path: Path, count: int) -> None:
    with pytest.raises(InputError, match="must be between"):
        write_skull_landmarks(tmp_path, count=count)
