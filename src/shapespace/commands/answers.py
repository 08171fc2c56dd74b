"""Files of the report of an analysis, and its HTML page."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from shapespace.batch.progress import progress, waiting
from shapespace.commands.outcome import Outcome
from shapespace.errors import InputError, ShapespaceError
from shapespace.report.analyses.analysis_report import AnalysisReport
from shapespace.schemas import Orientation

_FORMATS = ("svg", "pdf", "png")


@dataclass(frozen=True)
class FigureConfig:
    """Figures of an analysis.

    Args:
        formats: write all figures for a paper to OUT/figures, in these formats: svg, pdf, png (default: none).
        dpi: resolution of PNG figures, and of surfaces in SVG and PDF.
        orientation: JSON file with named views of the object, such as dorsal, and links between landmarks (default:
            orientation.json and links.csv next to the shapes).

    Raises:
        InputError: another format, or a resolution below 72 or above 1200.
    """

    formats: tuple[str, ...] = ()
    dpi: int = 300
    orientation: Path | None = None

    def __post_init__(self) -> None:
        unknown = [one for one in self.formats if one not in _FORMATS]
        if unknown:
            raise InputError(f"--format is {unknown[0][:40]!r}; choose from {', '.join(_FORMATS)}.")
        if not 72 <= self.dpi <= 1200:
            raise InputError(f"--dpi is {self.dpi}; choose a resolution from 72 to 1200.")


def save_report(
    report: AnalysisReport,
    output: Path,
    *,
    quiet: bool,
    figures: FigureConfig | None = None,
    orientation: Orientation | None = None,
) -> tuple[Path | None, list[str]]:
    """Write a report to a folder, with its HTML page and figures if the extra `report` is installed.

    Args:
        report: of the analysis.
        output: the folder.
        quiet: no progress.
        figures: formats and resolution; None for no figures as files.
        orientation: of all figures; None for that of the report.

    Returns:
        The path of the page, None where it cannot be drawn; and notes for the user.

    Raises:
        FileError: the folder cannot be written.
    """
    from shapespace.report.pages.write_html import require_report_extra

    with waiting("writing the results", quiet=quiet):
        (replace(report, orientation=orientation) if orientation else report).save(output)
    notes = list(report.notes)
    try:
        require_report_extra()
    except ShapespaceError as error:
        return None, [*notes, str(error)]
    if figures is not None and figures.formats:
        from shapespace.report.pages.figure_files import write_figures

        with waiting("drawing the figures", quiet=quiet):
            notes += write_figures(output, figures.formats, figures.dpi)[1]
    return write_report(output, None, model=None, labels=None, quiet=quiet), notes


def report(
    folder: Path, output: Path | None, *, model: Path | None, labels: Path | None, no_open: bool, quiet: bool
) -> Outcome:
    """Write the report on the results in `folder`, and open it.

    Raises:
        FileError, InputError, ShapespaceError: as for `write_report`.
    """
    page = write_report(folder, output, model=model, labels=labels, quiet=quiet)
    facts = {"report": str(page), "bytes": page.stat().st_size}
    return Outcome(facts, [f"The report is {page}"], page=None if no_open else page)


def write_report(folder: Path, output: Path | None, *, model: Path | None, labels: Path | None, quiet: bool) -> Path:
    """Write the report on the results in `folder`, and return its path.

    Raises:
        FileError: something in it cannot be read, or the report not written.
        InputError: the folder holds no results, or `model` is not of its fits.
        ShapespaceError: the extra `report` is not installed.
    """
    from shapespace.report.pages import write_html as html

    with progress(None, "drawing", "picture", quiet=quiet) as bar:

        def step(name: str, planned: int) -> None:
            bar.total = max(planned, bar.n + 1)
            bar.update()

        return html.write_report(folder, output, model=model, labels=labels, on_step=step)
