"""From what was measured of shape spaces at equal numbers of modes to the tables of the report."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from shape_spaces import (
    SCANS,
    TRAINING,
    Record,
    ShapeSpaces,
    expressive_people,
    person_path,
    read_record,
    read_rows,
)
from shapespace.errors import FileFormatError
from shapespace.recognise import evaluate
from shapespace.schemas import Part
from shapespace.study import parts
from shapespace.types import FloatArray


def shape_space_parts(inside: Path, compared: ShapeSpaces, seed: int) -> list[Part]:
    """Return the parts of recognition.json that compare vertices with control points.

    Args:
        inside: folder of the measurements, all done.
        compared: its settings.
        seed: of the people whose expressions are told.

    Raises:
        FileError: a file cannot be read.
        FileFormatError: it is damaged.
    """
    rows = read_rows(inside, compared)
    try:
        return [
            _sizes(rows, compared),
            _fits(rows, compared),
            _training(rows),
            _recognition(inside, compared, seed),
            *_maps(read_record(inside / "maps.json")),
        ]
    except (KeyError, TypeError, IndexError, AttributeError) as error:
        raise FileFormatError(f"A file in {inside} is damaged; delete the folder and run the study again.") from error


def _sizes(rows: list[Record], compared: ShapeSpaces) -> Part:
    return parts.table(
        f"Vertices and control points at {compared.modes} modes",
        [("Shape space", "text"), ("File, MB", "number"), ("Build, CPU s", "number"), ("Floor", "mm"),
         ("Surface floor", "mm"), ("CPU s a fit", "number"), ("Doubtful", "count"), ("Failed", "count")],
        [
            (row["shape space"], round(row["file_mb"], 2), round(row["build_s"], 1), row["floor_mm"],
             row["floor_surface_mm"], round(row["scans"]["0.2 mm noise"]["seconds"] or np.nan, 2),
             sum(row["scans"][name]["doubtful"] for name in SCANS),
             sum(row["scans"][name]["failed"] for name in SCANS))
            for row in rows
        ],
        f"{compared.training} neutral people of ICT-FaceKit in each model, {compared.people} others scanned "
        f"{len(SCANS)} times. Floor: the best the model can do with the true correspondences.",
    )  # fmt: skip


def _fits(rows: list[Record], compared: ShapeSpaces) -> Part:
    return parts.table(
        "Fits of scans with noise and holes: vertex error, and distance of the surfaces",
        [("Shape space", "text"), *((f"{name}{what} (mm)", "mm") for name in SCANS for what in ("", ", surfaces"))],
        [
            (row["shape space"],
             *(row["scans"][name][key] for name in SCANS for key in ("vertex_mm", "surface_mm")))
            for row in rows
        ],
        f"Raw scans of {compared.triangles:,} triangles in any pose; means over {compared.people} people.",
    )  # fmt: skip


def _training(rows: list[Record]) -> Part:
    return parts.table(
        "The same models made of damaged meshes: floor on undamaged faces of others",
        [("Shape space", "text"), *((f"trained on {name} (mm)", "mm") for name in TRAINING)],
        [(row["shape space"], *(row["trained on"][name] for name in TRAINING)) for row in rows],
        "Vertices refuse meshes with holes; control points are found without them.",
    )


def _recognition(inside: Path, compared: ShapeSpaces, seed: int) -> Part:
    people = expressive_people(seed)
    expression = np.array([name for name, _ in people.shown])[1:]
    half = compared.taught
    everybody = range(compared.taught + compared.tested)
    rows: list[tuple[object, ...]] = []
    for kind in compared.recognised:
        found = [read_record(person_path(inside, kind, person)) for person in everybody]
        codes = [_codes(record, compared.modes) for record in found]
        row: list[object] = [kind]
        for known in (True, False):
            told = [z[1:] - z[:1] if known else z[1:] for z in codes]
            train, test = np.concatenate(told[:half]), np.concatenate(told[half:])
            usable = np.isfinite(train).all(axis=1)
            names = [[f"p{p}" for p in some for _ in expression] for some in (everybody[:half], everybody[half:])]
            labels = [np.tile(expression, count) for count in (compared.taught, compared.tested)]
            fold = evaluate.Fold(
                train[usable], labels[0][usable].tolist(), np.array(names[0])[usable].tolist(),
                test, labels[1].tolist(), names[1],
            )  # fmt: skip
            answer = evaluate.fixed_predictions([fold], "lda")
            row += parts.accuracy_of(answer.labels, answer.predicted, answer.subjects)
        errors = [e for record in found[half:] for e in record["error_mm"] if e is not None]
        status = [s for record in found[half:] for s in record["status"]]
        rows.append(
            (*row, float(np.mean(errors)) if errors else None, status.count("doubtful"), status.count("failed"))
        )
    return parts.table(
        f"Expressions told in each shape space, {compared.modes} modes",
        [("Shape space", "text"), ("Neutral face known", "percent"), ("95 % over people, known", "interval"),
         ("From one scan", "percent"), ("95 % over people, one scan", "interval"), ("Mean vertex error", "mm"),
         ("Doubtful", "count"), ("Failed", "count")],
        rows,
        f"One PCA of {compared.taught} people, shrinkage LDA, {compared.tested} others at half and full intensity, "
        f"{len(people.shown)} raw scans each. Intervals that overlap say that nothing is better.",
    )  # fmt: skip


def _codes(record: Record, modes: int) -> FloatArray:
    """Return (S, K) coefficients in standard deviations; NaN where the fit failed."""
    return np.array([np.full(modes, np.nan) if z is None else z for z in record["z"]], dtype=np.float64)


def _maps(found: Record) -> list[Part]:
    by_map: dict[str, dict[str, dict[str, Any]]] = {}
    for one in found["regions"]:
        by_map.setdefault(one["map"], {})[one["region"]] = one
    regions = list(next(iter(by_map.values())))
    first = {name.split()[0]: of for name, of in reversed(by_map.items())}
    return [
        parts.table(
            "What lies double when a face is laid out flat",
            [("Faces", "text"), ("Map", "text"), ("Area folded over", "percent"), ("Area lying double", "percent")],
            [(one["faces"], one["map"], one["folded"], one["shared"]) for one in found["overlap"]],
            "A height field over a cylinder holds one point for each angle and height.",
        ),
        parts.table(
            "The same by part of the face: vertices that share their place",
            [("Map", "text"), *((name, "percent") for name in regions)],
            [(name, *(first[name][region]["shared"] for region in regions)) for name in ("cylinder", "disc")],
            "Bundled faces. Nostrils are the pockets of the nose narrower than 5 mm.",
        ),
        *(
            parts.table(
                title,
                [("Map and control points", "text"), *((name, "mm") for name in regions)],
                [(name, *(of[region][key] for region in regions)) for name, of in by_map.items()],
                note,
            )
            for title, key, note in (
                ("How far splines are from the surfaces, by part of the face", "surface_mm", "20 bundled faces."),
                ("How far they are from the changes between people", "change_mm",
                 "All that bspline-detail leaves to the spline, since the mean's own detail is kept."),
            )
        ),
    ]  # fmt: skip
