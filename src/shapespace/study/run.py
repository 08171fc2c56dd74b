"""The whole study by one call: models, fits, tables, report; what is done already is kept."""

from __future__ import annotations

import json
import time
from collections.abc import Generator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from tqdm import tqdm

from shapespace.batch.run import Job, make_executor
from shapespace.errors import ShapespaceError
from shapespace.io.files import make_folder, read_bytes, write_text
from shapespace.report.html import require_report_extra, write_report
from shapespace.study.own_scans import run_own
from shapespace.study.parts import Part
from shapespace.study.shape_space_tables import shape_space_parts
from shapespace.study.shape_spaces import ShapeSpaces, prepare, stages
from shapespace.study.simulated import StudyConfig, prepare_folder, run_fits, run_jobs
from shapespace.study.tables import SHAPE_SPACES, make_tables, seconds_of_study

_PARTS = 14
"""Steps of the tables, for the bar."""


def run_study(
    folder: Path, config: StudyConfig, *, workers: int, quiet: bool = False, compared: ShapeSpaces | None = None
) -> Path:
    """Run the simulated study in `folder`, or go on with it, and return the path of its report.

    Args:
        folder: made if absent.
        config: of the study.
        workers: processes that fit.
        quiet: no progress bar.
        compared: shape spaces that are compared too, in tables that follow.

    Raises:
        DataError: ICT-FaceKit is not here.
        InputError: the folder holds another study.
        FileError: it cannot be written.
        ShapespaceError: the extras `recognise` and `report` are not installed.
    """
    require_report_extra()
    prepare_folder(folder, config)
    inside = None if compared is None else prepare(folder, compared, config.people.seed)
    more = [] if compared is None or inside is None else stages(inside, compared, config.people.seed)
    seconds = _Seconds(folder)
    with ExitStack() as stack:
        bar = stack.enter_context(tqdm(unit="step", leave=False, disable=True if quiet else None))
        bar.total = config.folds + 1 + config.people.people + config.strangers + _PARTS + 1
        bar.total += sum(len(jobs) for _, jobs, _ in more)
        counted: dict[str, int] = {}

        def progress(what: str, done: int, total: int) -> None:
            bar.set_description(what)
            bar.update(done - counted.get(what, 0))
            counted[what] = done

        def part(what: str) -> None:
            bar.set_description(what)
            bar.update()

        with seconds.of("models and fits"):
            run_fits(folder, config, workers=workers, on_progress=progress)
        further: list[Part] = []
        if compared is not None and inside is not None:
            with seconds.of(SHAPE_SPACES):
                run_jobs(more, workers=workers, on_progress=progress)
                further = shape_space_parts(inside, compared, config.people.seed)
        with seconds.of("tables", fresh=True):
            make_tables(folder, config, seconds=seconds.known, on_part=part, further=further)
        _tell_seconds(folder, seconds)
        bar.set_description("report")
        return write_report(folder)


def _tell_seconds(folder: Path, seconds: _Seconds) -> None:
    """Put the seconds of the tables themselves into recognition.json, which was written before they were known."""
    path = folder / "recognition.json"
    content = json.loads(read_bytes(path))
    for name, value in seconds.known.items():
        content["settings"][f"seconds, {name}"] = round(value, 1)
    total = seconds_of_study(seconds.known)
    for one in content["targets"]:
        if one["what"].startswith("Wall time"):
            one["reached"], one["met"] = f"{total / 60:.1f} minutes", total < 900
    write_text(path, json.dumps(content, indent=1, allow_nan=False) + "\n")


def run_own_study(
    folder: Path, data: Path, model: Path, *, folds: int, workers: int, seed: int = 0, quiet: bool = False
) -> tuple[Path, str]:
    """Run the study on labelled scans of one's own; return the path of its report, and what the scans are.

    Args:
        folder: for the results; fits that are there already are kept.
        data: BU-3DFE, Bosphorus, or a folder with labels.csv.
        model: file of the shape model.
        folds: by subject.
        workers: processes that fit.
        seed: of the folds.
        quiet: no progress bar.

    Raises:
        FileError: something cannot be read or written.
        InputError: too few people or expressions.
        ShapespaceError: the extras `recognise` and `report` are not installed.
    """
    require_report_extra()
    make_folder(folder)
    with ExitStack() as stack:
        executor = stack.enter_context(make_executor(model, workers)) if workers > 1 else None
        bar = stack.enter_context(tqdm(unit="scan", leave=False, desc="fitting", disable=True if quiet else None))

        def count(scans: int) -> None:
            bar.total = scans

        def fitted(job: Job, record: Mapping[str, Any]) -> None:
            bar.update()

        _, holds = run_own(
            folder,
            data,
            model,
            folds=folds,
            seed=seed,
            executor=executor,
            on_scans=count,
            on_fit=fitted,
        )
    return write_report(folder), holds


class _Seconds:
    """How long parts took, over all runs that went on with one folder."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / "seconds.json"
        self.known: dict[str, float] = {}
        if self._path.is_file():
            try:
                stored = json.loads(read_bytes(self._path))
                self.known = {str(name): float(value) for name, value in stored.items()}
            except (ValueError, TypeError, AttributeError) as error:
                raise ShapespaceError(f"{self._path} is damaged; delete it.") from error

    @contextmanager
    def of(self, name: str, *, fresh: bool = False) -> Generator[None]:
        """Add what the block takes to `name`, also when it is interrupted; `fresh` forgets earlier runs."""
        before = 0.0 if fresh else self.known.get(name, 0.0)
        since = time.perf_counter()
        try:
            yield
        finally:
            self.known[name] = before + time.perf_counter() - since
            write_text(self._path, json.dumps(self.known, indent=1) + "\n")
