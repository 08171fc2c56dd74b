"""Recognition measured on simulated people: models, fits, tables, and a report that opens in a browser.

    python studies/recognition.py -o study                   a hundred people; 13 minutes on two cores
    python studies/recognition.py -o study --shape-spaces    and vertices against B-spline control points
    python studies/recognition.py -o small --people 12 --strangers 4 --folds 3

What is done already is kept, so a study that was interrupted goes on where it stopped.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
import webbrowser
from collections.abc import Generator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

from tqdm import tqdm

from shape_space_tables import shape_space_parts
from shape_spaces import ShapeSpaces, prepare, stages
from shapespace.batch.progress import telling_of_compiling
from shapespace.batch.workers import cores
from shapespace.errors import ShapespaceError
from shapespace.io.files import read_bytes, write_text
from shapespace.report.pages.write_html import require_report_extra, write_report
from shapespace.schemas import Part
from simulated import StudyConfig, prepare_folder, run_fits, run_jobs
from study_people import StudyPeople
from tables import SHAPE_SPACES, make_tables, seconds_of_study

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


def main(argv: Sequence[str] | None = None) -> int:
    """Run the study that the command line asks for and return the exit code, as `shapespace` has them."""
    arguments = _parser().parse_args(argv)
    try:
        people = replace(StudyPeople(), people=arguments.people, seed=arguments.seed)
        config = StudyConfig(people=people, folds=arguments.folds, strangers=arguments.strangers)
        with telling_of_compiling(quiet=arguments.quiet):
            report = run_study(
                arguments.output,
                config,
                workers=arguments.jobs or cores(),
                quiet=arguments.quiet,
                compared=ShapeSpaces() if arguments.shape_spaces else None,
            )
    except ShapespaceError as error:
        print(f"recognition.py: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("recognition.py: stopped; run it again, and it goes on with the files written so far.", file=sys.stderr)
        return 130
    targets = json.loads(read_bytes(arguments.output / "recognition.json"))["targets"]
    if arguments.json:
        print(json.dumps({"report": str(report), "targets": targets}, indent=1))
    else:
        for one in targets:
            print(f"{one['what']}: {one['reached']} ({one['target']}{'' if one['met'] else '; missed'})")
        print(f"The report is {report}")
    if not arguments.no_open:
        webbrowser.open(report.absolute().as_uri())
    return 0


def whole_number(text: str) -> int:
    """Return a number from 0 on; argparse says which it refuses."""
    value = int(text)
    if value < 0:
        raise ValueError
    return value


def _parser() -> argparse.ArgumentParser:
    usual = StudyConfig()
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("shapespace-study"), metavar="DIR")
    for name, default, what in (
        ("people", usual.people.people, "simulated people"),
        ("strangers", usual.strangers, "people of another generator"),
        ("folds", usual.folds, "folds by person"),
        ("seed", usual.people.seed, "of everything that is drawn"),
    ):
        parser.add_argument(f"--{name}", type=whole_number, default=default, metavar="N", help=f"{what}; {default}")
    parser.add_argument("--shape-spaces", action="store_true", help="compare B-spline control points too; 11 minutes")
    parser.add_argument("--jobs", type=whole_number, default=0, metavar="N", help="fits at a time; default: one a core")
    parser.add_argument("--no-open", action="store_true", help="do not open the report in a browser")
    parser.add_argument("--json", action="store_true", help="print facts as JSON")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    return parser


if __name__ == "__main__":
    sys.exit(main())
