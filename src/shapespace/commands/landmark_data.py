"""Commands `landmarks convert`, `check` and `plot`, for the landmarks of many specimens."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import structs

from shapespace.cohort.orientation import find_orientation, read_links
from shapespace.commands.outcome import Aside, Outcome, short
from shapespace.errors import InputError
from shapespace.geometry.landmark_alignment import align_landmarks, find_outliers
from shapespace.io.files import write_text
from shapespace.io.landmarks.configuration_io import read_configurations, slider_texts, write_configurations
from shapespace.io.landmarks.landmark_configurations import LandmarkConfigurations
from shapespace.lazy import require_package
from shapespace.report.blocks.wording import counted
from shapespace.schemas import Orientation

_LONGEST = 400
"""Characters of a line on landmark data."""
_OTHER_SCALE = 4.0
"""Ratio to the median size of a specimen in another unit: units differ by 10 or more, individuals by less than 2."""


def convert_landmarks(
    data: Path,
    output: Path,
    *,
    to: str | None = None,
    sliders: Sequence[Path] = (),
    object_name: str | None = None,
    curve_points: int | None = None,
    dimensions: int | None = None,
) -> Outcome:
    """Write the landmarks of many specimens in another format, and note the changes.

    Sliders are written next to the output as OUT.curveslide.csv and OUT.surfslide.csv.

    Args:
        data: file or folder with landmarks.
        output: file, or folder for formats with a file for each specimen.
        to: format: tps, nts, morphoj, csv (a row for each specimen), long (a row for each landmark), or a folder of
            mrk.json or fcsv (default: by the ending of OUT)
        sliders: CSV of the semilandmarks as geomorph has them: before, slide, after, or surface; can be repeated
        object_name: name of the array in an R file with several arrays, such as plethodon$land
        curve_points: points of each curve or outline, at equal distances (default: see `align`)
        dimensions: 2 or 3, for raw MorphoJ coordinates if their number is divisible by both (default: by their number)

    Raises:
        FileError: something cannot be read or written.
        InputError: an unknown format, or one that cannot store the landmarks.
    """
    if data.resolve() == output.resolve():
        raise InputError(f"{output} is the file to convert; give another name to write to.")
    raw = read_configurations(data, name=object_name, sliders=sliders, curve_points=curve_points, dimensions=dimensions)
    notes = [*raw.notes, *write_configurations(output, raw, to)]
    for name, text in slider_texts(raw).items():
        path = output.with_name(f"{output.name.removesuffix(output.suffix)}.{name}")
        write_text(path, text)
        notes.append(f"The sliders are in {path.name}.")
    facts = {"output": str(output), "specimens": len(raw), "landmarks": len(raw.landmarks),
             "dimensions": raw.dimensions, "notes": notes}  # fmt: skip
    line = f"{counted(len(raw), 'specimen')} with {counted(len(raw.landmarks), 'landmark')} in {output}"
    return Outcome(facts, [line], notes)


def check_landmarks(
    marked: Path,
    scans: Path | None,
    output: Path | None,
    *,
    sliders: Sequence[Path] = (),
    say: Callable[[str], None],
) -> Outcome:
    """Return the content of landmark data: counts, missing landmarks, and `findings`, a sentence each.

    Findings are duplicates, specimens of another scale, mirrored specimens, swapped landmarks, and outliers. With
    scans in correspondence the landmarks are compared with their predictions.

    Args:
        marked: file or folder with the landmarks of many specimens.
        scans: see `check_marked`; None for landmark data alone.
        output: see `check_marked`.
        sliders: CSV of the semilandmarks as geomorph has them.
        say: called with each message.

    Raises:
        FileError: something cannot be read.
        InputError: an output without scans, and as for `check_marked`.
    """
    if scans is not None:
        from shapespace.commands.landmarks import check_marked  # loads much

        return check_marked(marked, scans, output, say=say)
    if output is not None:
        raise InputError("-o goes with SAME, the folder that correspond wrote; omit -o.")
    raw = read_configurations(marked, sliders=sliders)
    absent = ~raw.observed
    findings = [*_duplicates(raw), *find_other_scales(raw)]
    try:
        findings += map(str, find_outliers(align_landmarks(raw))) if len(raw) > 1 else ()
    except InputError as error:
        findings.append(f"The landmarks cannot be aligned: {error}")
    at = np.argwhere(absent).tolist()
    facts: dict[str, Any] = {
        "specimens": len(raw),
        "landmarks": len(raw.landmarks),
        "semilandmarks": len({*raw.curve_sliders[:, 1].tolist(), *raw.surface_sliders.tolist()}),
        "dimensions": raw.dimensions,
        "columns": list(raw.columns),
        "missing": int(absent.sum()),
        "missing_by_specimen": dict(Counter(raw.names[k] for k, _ in at).most_common()),
        "missing_by_landmark": dict(Counter(raw.landmarks[k] for _, k in at).most_common()),
    }
    texts = {key.replace("_", " "): short(value) for key, value in facts.items() if value not in ([], {})}
    lines = [f"{key}: {text if len(text) < _LONGEST else f'{text[:_LONGEST]}, ...'}" for key, text in texts.items()]
    asides = [Aside(sentence) for sentence in (*raw.notes, *findings)]
    found = counted(len(findings), "finding") if findings else "no problems found"
    facts |= {"notes": list(raw.notes), "findings": findings}
    return Outcome(facts, [*asides, *lines, found], exit_code=int(bool(findings)))


def _duplicates(raw: LandmarkConfigurations) -> list[str]:
    findings: list[str] = []
    first: dict[bytes, str] = {}
    together: Counter[tuple[str, str]] = Counter()
    for name, points in zip(raw.names, raw.points, strict=True):
        other = first.setdefault(points.tobytes(), name)
        if other != name:
            findings.append(f"{name} has the same coordinates as {other}; remove one of the specimens.")
        place: dict[tuple[float, ...], str] = {}
        for label, point in zip(raw.landmarks, points.tolist(), strict=True):
            # Missing landmarks differ, since NaN does not equal itself.
            before = place.setdefault(tuple(point), label)
            together[before, label] += before != label
    for (earlier, later), count in together.most_common():
        if count:
            findings.append(
                f"Landmarks {earlier} and {later} are at the same place in {count} of {len(raw)} specimens."
            )
    return findings


def find_other_scales(raw: LandmarkConfigurations) -> list[str]:
    """Return a sentence on each specimen whose size differs so much that it has another unit or scale."""
    # Root mean squares, which missing landmarks hardly change.
    known = [points[seen] for points, seen in zip(raw.points, raw.observed, strict=True)]
    sizes = np.array(
        [float(np.sqrt(np.var(shape - shape.mean(axis=0)))) if len(shape) > 1 else np.nan for shape in known]
    )
    ratios = sizes / np.nanmedian(sizes) if np.isfinite(sizes).any() else sizes
    return [
        f"{name} is {ratio:.3g} times the median size, so its unit or scale differs."
        for name, ratio in zip(raw.names, ratios.tolist(), strict=True)
        if ratio > _OTHER_SCALE or ratio < 1 / _OTHER_SCALE
    ]


def plot_configurations(data: Path, output: Path, links: Path | None = None, sliders: Sequence[Path] = ()) -> Outcome:
    """Draw all specimens superimposed around their mean with numbered landmarks.

    Views and links are those of orientation.json and links.csv next to the data.

    Args:
        data: file or folder with the landmarks of many specimens.
        output: FILE.svg, FILE.pdf or FILE.png.
        links: CSV of two columns of landmarks, by number or name, that lines connect (default: links.csv next to DATA)
        sliders: CSV of the semilandmarks as geomorph has them; can be repeated

    Raises:
        FileError: something cannot be read or written.
        InputError: another format, fewer than two specimens, or landmarks that cannot be aligned.
        ShapespaceError: the extra `report` is not installed.
    """
    require_package("matplotlib", "A plot", "'shapespace[report]'")
    from shapespace.report import figures

    raw = read_configurations(data, sliders=sliders)
    aligned = align_landmarks(raw)
    folders = [data if data.is_dir() else data.parent]
    orientation = find_orientation(None, folders, raw.landmarks, raw.curve_links) or Orientation()
    if links is not None:
        orientation = structs.replace(orientation, links=read_links(links, raw.landmarks))
    with figures.publication_style(), figures.oriented(orientation):
        figure = figures.superimposed_landmarks(aligned)
        figures.save_figure(figure, output.with_suffix(""), (output.suffix.lower().lstrip("."),))
    notes = (*raw.notes, *aligned.notes)
    return Outcome({"figure": str(output), "notes": notes}, [f"The figure is {output}"], notes)
