"""Labels of the fits in a folder, and the location of their table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from shapespace.cohort.labels import LABELS_FILE, Label, read_labels
from shapespace.cohort.table import names_of_file
from shapespace.report.blocks.wording import listed
from shapespace.report.inputs.saved_fits import Folder, SavedFit


def find_labels(folder: Folder, fits: Sequence[SavedFit], labels_path: Path | None) -> tuple[list[Label | None], str]:
    """Return the label of each fit, and sentences on their source and on what has no label, or on the reason why there
    are none.

    They are looked for in `labels_path`, else in labels.csv in `folder`, else beside the scans. They are matched by the
    name of the fit or of the scan's file.

    Raises:
        FileError: `labels_path` cannot be read.
        FileFormatError: the table is damaged, or two rows are of one scan.
        InputError: no row is of a scan.
    """
    places = [folder.root / LABELS_FILE] if labels_path is None else [labels_path]
    source = f"{LABELS_FILE} in the folder" if labels_path is None else labels_path.name
    if labels_path is None and not places[0].is_file():
        paths = (fit.record.scan.path for fit in fits)
        beside = dict.fromkeys((folder.root / path).parent / LABELS_FILE for path in paths if path and "\0" not in path)
        places = [file for file in beside if file.is_file()]
        source = f"{listed([f'{file.parent.name}/{LABELS_FILE}' for file in places])}, beside the scans"
    names = [(fit.name, *names_of_file(fit.record.scan.name or fit.name)) for fit in fits]
    labels: list[Label | None] = [None] * len(fits)
    sentences = [f"Labels are from {source}."] if places else []
    for file in places:
        table = read_labels(file, of_any=labels_path is not None)
        # Pages name no folder of the machine.
        own, notes = replace(table, table=replace(table.table, where=file.name)).match(names, "the fits")
        labels = [new or old for new, old in zip(own, labels, strict=True)]
        sentences += notes
    return labels, " ".join(sentences)


def with_label(fit: SavedFit, label: Label | None) -> SavedFit:
    """Return `fit` with its label; unchanged without one."""
    if label is None or not label.text:
        return fit
    return fit.with_entry(expression=label.text, subject=label.subject, intensity=label.intensity)
