"""What the commands about cohorts end in: the files of an answer, and its report."""

from __future__ import annotations

from pathlib import Path

from shapespace.batch.progress import waiting
from shapespace.commands.report import write_report
from shapespace.errors import ShapespaceError
from shapespace.statistics.answer import Answer


def keep_answer(answer: Answer, output: Path, *, quiet: bool) -> tuple[Path | None, list[str]]:
    """Write an answer to a folder, with its report where the extra `report` is there.

    Args:
        answer: to keep.
        output: the folder.
        quiet: no progress.

    Returns:
        The path of the report, None where it cannot be drawn; and what the user should know.

    Raises:
        FileError: the folder cannot be written.
    """
    from shapespace.report.pages.write_html import require_report_extra

    with waiting("writing the results", quiet=quiet):
        answer.save(output)
    notes = list(answer.notes)
    try:
        require_report_extra()
    except ShapespaceError as error:
        return None, [*notes, str(error)]
    return write_report(output, None, model=None, labels=None, quiet=quiet), notes
