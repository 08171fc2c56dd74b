"""Files of the report of an analysis, and its HTML page."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from shapespace.batch.progress import progress, waiting
from shapespace.batch.workers import DRAWING, deferred_calls
from shapespace.commands.outcome import Outcome
from shapespace.errors import InputError, ShapespaceError
from shapespace.lazy import call_later
from shapespace.schemas import to_json

if TYPE_CHECKING:
    from shapespace.report.analyses.analysis_report import AnalysisReport


def write_answer(report: AnalysisReport, output: Path, *, quiet: bool) -> Outcome:
    """Write the report of an analysis to a folder, with its HTML page if the extra `report` is installed.

    Args:
        report: report of the analysis.
        output: the folder.
        quiet: no progress.

    Raises:
        FileError: the folder cannot be written.
    """
    from shapespace.report.pages.write_html import require_report_extra

    with waiting("writing the results", quiet=quiet):
        report.save(output)
    page, notes = None, list(report.notes)
    try:
        require_report_extra()
    except ShapespaceError as error:
        notes.append(str(error))
    else:
        page = str(write_report(output, None, model=None, labels=None, quiet=quiet))
    return Outcome(
        lambda: {"folder": str(output), "report": page, **to_json(report.analysis())},
        [*report.summary, f"The report is {page}" if page is not None else f"All numbers are in {output}"],
        notes,
    )


def report(
    results: Sequence[Path], output: Path | None, *, specimens: Path | None, model: Path | None, labels: Path | None,
    no_open: bool, quiet: bool,
) -> Outcome:  # fmt: skip
    """Write the report on a folder of results, or on several results, and open it.

    Raises:
        InputError: options of one folder for several results, or no file for their report.
        FileError, InputError, ShapespaceError: as for `write_report`.
    """
    from shapespace.report.pages.write_html import write_study_report

    inputs = [path.resolve() for path in (*results, *([] if specimens is None else [specimens]))]
    if output is not None and (output.suffix.lower() not in (".html", ".htm") or output.resolve() in inputs):
        raise InputError(f"{output} cannot be the file of the report; give a name that ends in .html.")
    if len(results) == 1 and specimens is None and not results[0].is_file():
        page = write_report(results[0], output, model=model, labels=labels, quiet=quiet)
    elif model is not None or labels is not None:
        raise InputError("--model and --labels are of one folder of fits; omit them, or give that folder alone.")
    elif output is None:
        names = ", ".join(map(str, results[:3]))
        raise InputError(f"Name the file of the report on {names}, such as -o report.html.")
    else:
        with drawing(quiet=quiet) as step:
            page = write_study_report(results, output, specimens=specimens, on_step=step)
    facts = {"report": str(page), "bytes": page.stat().st_size}
    return Outcome(facts, [f"The report is {page}"], page=None if no_open else page)


def write_report(folder: Path, output: Path | None, *, model: Path | None, labels: Path | None, quiet: bool) -> Path:
    """Write the report on the results in `folder`, and return its path.

    Raises:
        FileError: something in it cannot be read, or the report not written.
        InputError: the folder contains no results, or `model` is not of its fits.
        ShapespaceError: the extra `report` is not installed.
    """
    with ExitStack() as stack:
        # Before the imports of this process, which take as long as those of the others.
        defer = call_later
        if any(folder.glob("*.fit.json")) or (folder / "demo.json").is_file():
            defer = stack.enter_context(deferred_calls(*DRAWING))
        step = stack.enter_context(drawing(quiet=quiet))
        from shapespace.report.pages import write_html as html

        return html.write_report(folder, output, model=model, labels=labels, on_step=step, defer=defer)


@contextmanager
def drawing(*, quiet: bool) -> Generator[Callable[[str, int], None]]:
    """Return a context with a progress bar; its function is called after each picture, with (name, number planned)."""
    with progress(None, "drawing", "picture", quiet=quiet) as bar:

        def step(name: str, planned: int) -> None:
            bar.total = max(planned, bar.n + 1)
            bar.update()

        yield step
