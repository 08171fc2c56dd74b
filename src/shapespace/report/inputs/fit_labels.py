"""Labels of the fits in a folder, and the location of their table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from shapespace.io.meshes.mesh_io import stem_of
from shapespace.io.tables.label_table import LABELS_FILE, Label, read_labels
from shapespace.report.blocks.wording import listed
from shapespace.report.inputs.saved_fits import Folder, SavedFit


def find_labels(folder: Folder, fits: Sequence[SavedFit], labels_path: Path | None) -> tuple[dict[str, Label], str]:
    """Return labels and a sentence on their source, or on the reason why there are none.

    They are looked for in `labels_path`, else in labels.csv in `folder`, else beside the scans.

    Raises:
        FileError: `labels_path` cannot be read.
        FileFormatError: the table is damaged.
    """
    if labels_path is not None:
        return read_labels(labels_path, of_any=True), f"Labels are from {labels_path.name}."
    places = [folder.root / LABELS_FILE]
    for fit in fits:
        path = fit.record.scan.path
        if path and "\0" not in path:
            label_file = (folder.root / path).parent / LABELS_FILE
            if label_file not in places:
                places.append(label_file)
    if places[0].is_file():
        return read_labels(places[0]), f"Labels are from {LABELS_FILE} in the folder."
    labels: dict[str, Label] = {}
    used_names: list[str] = []
    for file in filter(Path.is_file, places[1:]):
        labels |= read_labels(file)
        used_names.append(f"{file.parent.name}/{LABELS_FILE}")
    return labels, f"Labels are from {listed(used_names)}, beside the scans." if used_names else ""


def with_label(fit: SavedFit, labels: Mapping[str, Label]) -> SavedFit:
    """Return `fit` with its label, matched by the scan's file name or the name of the fit; unchanged without one."""
    scan = fit.record.scan.name
    label = labels.get(stem_of(scan) if scan else fit.name) or labels.get(fit.name)
    if label is None or not label.text:
        return fit
    return fit.with_entry(expression=label.text, subject=label.subject, intensity=label.intensity)
