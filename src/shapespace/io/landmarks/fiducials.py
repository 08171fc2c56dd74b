"""Landmarks predicted by a fit, with their standard deviations, as files of other programs."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from shapespace.io.landmarks.landmark_io import LANDMARK_FORMATS, fcsv_text
from shapespace.io.tables.table_io import rows_text
from shapespace.types import FloatArray

FIDUCIAL_ENDINGS = (".landmarks.csv", ".landmarks.mrk.json", ".landmarks.fcsv")
"""Of the files that hold the landmarks of a fit, after NAME."""

_AXES = "xyz"

Found = Mapping[str, Mapping[str, Any]]
"""Name -> `at` (x, y, z) in the scan's frame and unit, and `stddev_mm` along its axes, None where it is not known."""


def fiducial_texts(fiducials: Found) -> dict[str, str]:
    """Return ending -> text of each file: a table, and 3D Slicer's two formats, all in the scan's frame and unit.

    Slicer takes the coordinates of a mesh as they are, for LPS and mm, so it shows the points on the scan.
    """
    points = {name: np.array(fiducial["at"], dtype=np.float64) for name, fiducial in fiducials.items()}
    descriptions = {name: _describe(fiducial["stddev_mm"]) for name, fiducial in fiducials.items()}
    return point_texts(points, descriptions, _table(fiducials))


def point_texts(points: Mapping[str, FloatArray], descriptions: Mapping[str, str], table: str) -> dict[str, str]:
    """Return ending -> text of each file: `table`, and 3D Slicer's two formats of `points` with `descriptions`."""
    texts = table, _markups(points, descriptions), fcsv_text(points, descriptions)
    return dict(zip(FIDUCIAL_ENDINGS, texts, strict=True))


def _table(fiducials: Found) -> str:
    header = ["name", *_AXES, *(f"stddev_{axis}_mm" for axis in _AXES)]
    return rows_text(
        [
            header,
            *(
                [name, *_format_numbers(fiducial["at"]), *_format_numbers(fiducial["stddev_mm"])]
                for name, fiducial in fiducials.items()
            ),
        ]
    )


def _markups(points: Mapping[str, FloatArray], descriptions: Mapping[str, str]) -> str:
    content = json.loads(LANDMARK_FORMATS[".mrk.json"].write(points))
    for point in content["markups"][0]["controlPoints"]:
        point["description"] = descriptions[point["label"]]
    return json.dumps(content, indent=1) + "\n"


def _format_numbers(numbers: Sequence[float] | None) -> list[str]:
    return [""] * len(_AXES) if numbers is None else [repr(float(number)) for number in numbers]


def _describe(stddev_mm: Sequence[float] | None) -> str:
    return "" if stddev_mm is None else f"standard deviation {' '.join(f'{mm:.2f}' for mm in stddev_mm)} mm"
