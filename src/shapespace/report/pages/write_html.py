"""One self-contained HTML file from saved results: of the demo, of fits, of a correspondence. It runs no fit."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

from shapespace.errors import InputError, ShapespaceError
from shapespace.io.files import write_text
from shapespace.report.inputs.saved_fits import Folder, find_fits
from shapespace.report.pages.correspondence_page import CorrespondencePage
from shapespace.report.pages.demo_page import DemoPage
from shapespace.report.pages.folder_page import FolderPage, ManyPage, is_many
from shapespace.report.pages.page import LARGEST_REPORT_BYTES, Step
from shapespace.report.pages.study_page import standalone_file, study_page
from shapespace.schemas import CorrespondenceRecord
from shapespace.store.results import Results

__all__ = ["LARGEST_REPORT_BYTES", "require_report_extra", "write_report"]


def require_report_extra() -> None:
    """Raise unless the packages that draw are installed.

    Raises:
        ShapespaceError: they are not; the sentence says how to install them.
    """
    missing = [name for name in ("jinja2", "matplotlib", "PIL") if find_spec(name) is None]
    if missing:
        raise ShapespaceError(
            f"The report needs {' and '.join(missing)}, which is not installed; run pip install 'shapespace[report]'."
        )


def write_report(
    folder: Path,
    output: Path | None = None,
    *,
    model: Path | None = None,
    labels: Path | None = None,
    on_step: Step | None = None,
) -> Path:
    """Write one HTML file on the results saved in `folder`, and return its path.

    A folder with a demo.json is reported as the demo, one with a correspondence.json as a correspondence, one with a
    recognition.json and no fits as a study of recognition, one with an analysis.json and no fits as an analysis, any
    other as the results of `shapespace fit`; of very many fits those to look at have rows and pictures, and all are in
    the distributions. Analyses in the folder of fits, or in folders directly in it, are sections of its report. The
    page needs no network; without a script it loses what turns and sorts, and can be read.

    Args:
        folder: of the results.
        output: the file; None writes `folder`/report.html.
        model: file of the model of the fits; None goes by their records. The demo names its own, a study has none.
        labels: table of labels of the scans; None looks for labels.csv in `folder`, then beside the scans.
        on_step: called after each picture.

    Raises:
        FileError: the folder, demo.json, `model` or `labels` cannot be read, or the report cannot be written.
        FileFormatError: demo.json, correspondence.json or the mean shape beside it, the recognition.json of a study,
            the analysis.json of an analysis, `model` or `labels` is damaged.
        InputError: the folder holds no results, or only records that cannot be read, or `model` is not of its fits.
        ShapespaceError: the extra `report` is not installed.
    """
    require_report_extra()
    path = Path(output) if output is not None else Path(folder) / "report.html"
    write_text(path, _page(Folder(Path(folder)), model, labels, on_step))
    return path


def _page(folder: Folder, model: Path | None, labels: Path | None, on_step: Step | None) -> str:
    """Return the page on the results in `folder`."""
    root, given = folder.root, model is not None or labels is not None
    if (root / "demo.json").is_file():
        if given:
            raise InputError(
                f"{root} is a demo, which names its models and labels itself; leave out --model and --labels."
            )
        return DemoPage(folder, on_step).html()
    if (root / CorrespondenceRecord.FILE).is_file():
        if given:
            raise InputError(f"{root} is a correspondence without fits; leave out --model and --labels.")
        return CorrespondencePage(folder, on_step).html()
    if (standalone := standalone_file(folder)) is not None:
        if given:
            raise InputError(f"{root} holds {standalone.article} without fits; leave out --model and --labels.")
        return study_page(folder, standalone, on_step)
    if is_many(results := Results(root)):
        return ManyPage(folder, results, model=model, labels=labels, on_step=on_step).html()
    fits = find_fits(folder)
    if all(fit.status == "unreadable" for fit in fits):
        raise InputError(f"{root}: none of its {len(fits)} records can be read; {fits[0].reason}")
    return FolderPage(folder, fits, model=model, labels=labels, on_step=on_step).html()
