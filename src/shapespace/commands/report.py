"""What `report` does."""

from __future__ import annotations

from pathlib import Path

from shapespace.batch.progress import progress


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
