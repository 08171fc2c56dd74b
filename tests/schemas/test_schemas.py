"""What is written can be read, what is read was checked, and files of earlier versions stay readable."""

import json
import math
from typing import Any

import numpy as np
import pytest
from msgspec import structs

from shapespace import schemas
from shapespace.batch.fit_records import fit_record, read_record, write_record
from shapespace.errors import FileFormatError
from shapespace.fit.fit_scan import FitConfig, fit_scan
from shapespace.schemas import File, FitRecord
from synthetic_shapes import blob_model, raw_scan


@pytest.fixture(scope="module")
def record() -> dict[str, Any]:
    model = blob_model(300, 4)
    result = fit_scan(model, raw_scan(np.zeros(5), seed=1, vertices=500).scan, FitConfig(max_iterations=3))
    return fit_record(result, File(name="a.ply", hash="ab", path="../a.ply"), File(name="m.h5", hash="cd")).to_json()


def test_a_record_that_was_written_comes_back_as_it_was(record: dict[str, Any]) -> None:
    read = schemas.to_json(FitRecord.from_json(json.loads(json.dumps(record)), "a.fit.json"))
    # A part that was left out, such as an unknown path, comes back empty.
    known = {key: value for key, value in read.items() if key in record and key not in ("scan", "model")}
    assert known == {key: value for key, value in record.items() if key in known}
    assert record.keys() <= read.keys()
    assert record["scan"].items() <= read["scan"].items() and record["model"].items() <= read["model"].items()


def test_records_of_earlier_versions_lack_what_came_later_and_are_read(record: dict[str, Any]) -> None:
    new = {"shown", "size_mm", "evidence", "format_version", "landmarks", "notes"}
    old = FitRecord.from_json({key: value for key, value in record.items() if key not in new}, "a.fit.json")
    assert old.shown is None and old.b == tuple(record["b"])
    assert old.distances_mm["final"].scan_to_model.mean == record["distances_mm"]["final"]["scan_to_model"]["mean"]


def test_keys_that_are_not_known_are_passed_over(record: dict[str, Any]) -> None:
    assert FitRecord.from_json({**record, "colour": "blue"}, "a.fit.json").status == record["status"]


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"format": "shapespace model"}, r"^a\.fit\.json is not the record of a fit"),
        ({"format_version": 2}, r"^a\.fit\.json has the format version 2, .* supports only 1; update shapespace"),
        ({"status": "splendid"}, r"^a\.fit\.json is damaged: invalid enum value 'splendid' - at status; fit the scan"),
        ({"b": [1.0, None]}, r"damaged: expected float, got null - at b\[1\]; fit the scan again\.$"),
        ({"T_scan_model": {"scale": 1.0}}, r"damaged: missing required field rotation - at T_scan_model"),
        ({"history": [{"phase": "one"}]}, r"damaged: expected int, got str - at history\[0\]\.phase"),
    ],
)
def test_what_is_wrong_with_a_record_is_said_in_one_sentence(
    record: dict[str, Any], change: dict[str, Any], told: str
) -> None:
    with pytest.raises(FileFormatError, match=told):
        FitRecord.from_json({**record, **change}, "a.fit.json")


def test_no_record_is_written_that_could_not_be_read(record: dict[str, Any], tmp_path: Any) -> None:
    path, typed = tmp_path / "a.fit.json", FitRecord.from_json(record, "a.fit.json")
    with pytest.raises(FileFormatError, match="at b"):
        write_record(path, structs.replace(typed, b="none"))
    assert not path.exists()
    write_record(path, structs.replace(typed, mm_per_scan_unit=math.nan))
    assert read_record(path).mm_per_scan_unit is None


def test_the_parts_of_a_study_are_known_by_their_kind() -> None:
    part = schemas.read_part({"kind": "curve", "series": [{"x": [1], "y": [0.5]}]}, "recognition.json")
    assert isinstance(part, schemas.CurvePart) and part.series[0].y == (0.5,)
    for wrong in ({}, {"kind": "dream"}, {"kind": [1]}, {"kind": "curve", "series": 3}, None):
        with pytest.raises(FileFormatError, match=r"^recognition\.json is damaged"):
            schemas.read_part(wrong, "recognition.json")
