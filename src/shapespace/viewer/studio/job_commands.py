"""The commands of jobs: from the choices of the user on the page to the arguments of a shapespace command, and from
the messages of commands, which name options, to sentences with the labels of the page."""

from __future__ import annotations

import csv
import io
import os
import re
import shutil
import threading
import weakref
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory, mkdtemp
from typing import Any, Literal, cast

import numpy as np
from msgspec.structs import replace

from shapespace.batch.result_folder import names_for
from shapespace.cohort.read import cohort_file_text
from shapespace.cohort.table import is_number, list_names
from shapespace.errors import FileError, InputError, ShapespaceError
from shapespace.io.containers.json_files import read_json
from shapespace.io.files import make_folder, write_bytes
from shapespace.io.landmarks.configuration_io import CONFIGURATION_FORMATS, RECORD
from shapespace.io.meshes.mesh_io import write_mesh
from shapespace.io.tables.table_io import DECIMAL_COMMA, table_text
from shapespace.io.volume_io import VOLUME_ENDINGS
from shapespace.model.shape_model import ShapeModel
from shapespace.schemas import AlignRecord, CorrespondenceRecord, CorrespondRecord, read
from shapespace.statistics.shape_tests.test_table import SHAPE_TESTS
from shapespace.store.results import Results
from shapespace.types import Mesh
from shapespace.viewer.studio.jobs import Job, Order
from shapespace.viewer.studio.placed_landmarks import MISSING_LANDMARKS, PLACED, placed_landmarks
from shapespace.viewer.studio.project import LANDMARK_COLUMN, Project, Specimen

Forms = Mapping[str, Mapping[str, Any]]
"""Kind -> `command` (its words), `label`, `summary`, `is_question`, `check`, a function of the arguments and of folders
that returns why the command of a question would reject its input, and `options`, each with `flag`, `argument`,
`label`, `help`, `kind`, `choices`, `initial`, `visible` and `required`; `argument` is `--set NAME` for a setting, and
empty for a positional argument."""

QUESTIONS = (
    "compare", "change", "asymmetry", "regress", "score", "identify", *(test.name for test in SHAPE_TESTS),
    "morphospace",
)  # fmt: skip
CORRESPONDENCES = ("correspond", "redo")
_STUDY = (*CORRESPONDENCES, "build", "quality", "morphospace", *QUESTIONS[:-1], "fit", "complete")
"""Kinds of results in the report of the study, in the order of its chapters."""
_OUTPUTS = {
    "correspond": "correspondence-{}", "surface": "surfaces/{:04d}", "groom": "groomed/{:04d}", "build": "model-{}.h5",
    "quality": "quality-{}", "fit": "fits-{}", "complete": "completed-{}", "report": "report-{}/report.html",
}  # fmt: skip
"""Kind of job -> its result in the folder of the project, with the number of the job; exports for all others."""
_INPUTS = "inputs"
_NAMES = ("name", "files", "ids", "set")
"""Keys of the options of a job that name scans or volumes; all others are options of its command."""
_MOST_ODD = 5  # findings on single specimens in the checks
_checking = threading.Lock()  # checks write their tables into the folder of the same small surfaces
_LEAST_WAYS = 60  # in which small surfaces of a check vary; few, so that the check of many specimens takes no time
_OF_SURFACES = ("--geometry", "--landmarks", "--length", "--modules", "--pairs", "--region", "--stable")
"""Options that depend on the vertices of surfaces, so that small ones cannot stand for them in a check."""
_TERMINAL_NOTES = re.compile(
    r" \([^()]*(?:NAME\.|MODEL\.h5|about\.json)[^()]*\)|; exit with \d [^.;]*|(?m:^(?:next|usage): .*\n?)"
)
"""Parts for the terminal alone: names of result files in parentheses, exit codes, usage, and the next command."""
_ERROR = re.compile(r"shapespace [a-z ]+: error: (?:argument (?:-\w/)?(?:(--set|--[\w-]+(?=: must)):)?)?")
"""The beginning of a message on an option with a wrong value."""
_GAUGE = re.compile(r"(?<!the )\bgauge (?=(?:form|shape)\b)")
_OPTION = re.compile(
    r"(?P<quantity>\b(?:fewer|more|smaller|larger|such an?) (?!\())?(?P<parenthesis>\()?--(?P<name>set \w+|[a-z][\w-]*)"
    r"(?: \([a-z]+_[a-z_]+\))?(?:(?P<equals>[ =])(?P<word>(?!out\b)\w[\w.,=-]*(?<![.,])))?(?P<end>(?=[.;:,)<\"\n]|$))?"
)
"""An option or setting, and its value or the next word."""
_MARKUP = re.compile(r"<(script|style|pre|code)\b.*?(?:</\1>|\Z)|<[^>]*>|[^<]+", re.DOTALL)
"""A part of an HTML page: code, a tag, or text."""


class OptionLabels:
    """The labels of options and actions on the page, for sentences that name options of commands.

    Args:
        forms: forms of the commands; the attribute contains them with labels in the help.
    """

    def __init__(self, forms: Forms) -> None:
        self._options = {option["flag"]: option for form in forms.values() for option in form["options"]}
        self._actions = {" ".join(form["command"]): form["label"] for form in forms.values()}
        names = "|".join(sorted(self._actions, key=len, reverse=True)) or "(?!)"
        self._action = re.compile(rf"(?:\bshapespace ({names})\b(?! \S+ -\w\b)|\b({names})(?= --))( (?=--))?")

        self.forms = {
            kind: {
                "options": [{**option, "help": self.sentence(option["help"])} for option in form["options"]],
                **{name: form[name] for name in ("command", "label", "is_question", "summary")},
            }
            for kind, form in forms.items()
        }

    def sentence(self, text: str) -> str:
        """Return a text, such as "give landmarks (--landmarks)", with labels in place of options and commands."""
        text = _ERROR.sub(r"\1", _TERMINAL_NOTES.sub("", text))
        names = self._actions
        text = self._action.sub(lambda at: f"“{names[at[1] or at[2]]}”{' and ' if at[3] else ''}", text)
        return _OPTION.sub(self._label, _GAUGE.sub("size handling: ", text))

    def page(self, html: str) -> str:
        """Return an HTML page with labels in its text, but not in its commands."""
        return _MARKUP.sub(lambda part: part[0] if part[0].startswith("<") else self.sentence(part[0]), html)

    def _label(self, found: re.Match[str]) -> str:
        """Return the label of an option with its value, or with the next word if it has no value."""
        name, word = found["name"].removeprefix("set ").replace("_", "-"), found["word"] or ""
        option = self._options.get(f"--{name}", {"label": name.replace("-", " ").capitalize(), "choices": ()})
        before = found.string[: found.start()].rstrip()
        article = "The" if not before or before[-1] in '.!?>"' or before.endswith("shapespace:") else "the"
        noun = "option" if "flag" in option else "command-line option"
        prefix = found["quantity"] or (f"({noun} " if found["parenthesis"] else f"{article} {noun} ")
        is_value = found["equals"] == "=" or found["end"] is not None or word in option["choices"] or word[:1].isdigit()
        has_none = not word or re.match(r"[A-Z]{2}|[A-Z]$", word)  # the name of a value
        return f"{prefix}“{option['label']}”{'' if has_none else f': {word}' if is_value else f' {word}'}"


def order(
    project: Project, jobs: Sequence[Job], forms: Forms, kind: str, options: Mapping[str, Any], on: int | None,
    number: int, scans: Mapping[str, str] = {},
) -> Order:  # fmt: skip
    """Return the command of a new job, with the files that it reads.

    Args:
        project: project with the specimens.
        jobs: earlier jobs.
        forms: forms of all kinds, whose options are accepted.
        kind: kind of the job.
        options: flag -> value, as sent by the page.
        on: number of the job whose result it uses; None for the newest that succeeded.
        number: number of the new job.
        scans: id of each specimen -> hash of its scan, for the record of the scans that are read.

    Raises:
        InputError: it cannot be run: no such kind or option, or a result or specimens are missing.
    """
    words = forms.get("correspond" if kind == "redo" else kind, {}).get("command", ())
    given = _option_arguments(forms, kind, {flag: options[flag] for flag in options if flag not in _NAMES})
    folder, stem = project.folder, f"{_INPUTS}/{number:04d}"
    state, listed = project.state, f"{stem}.csv"
    output = _OUTPUTS.get(kind, "exported-{}").format(number)
    if kind == "correspond":
        chosen = _require_specimens(state.chosen("training"), "to bring into correspondence", 2)
        files, prepared = project.scan_list(folder / listed, chosen)
        parts = ("--parts", *state.parts) if any(specimen.part for specimen in chosen) else ()
        words = (*words, listed, "-o", output, *parts, *given)
        return Order(words, output, prepared, files=files, scans=_keys_of(chosen, scans))
    if kind == "redo":
        before = result_of(jobs, CORRESPONDENCES, on)
        name = str(options.get("name", ""))
        chosen = [specimen for specimen in state.specimens if specimen.id in state.with_parts([name])]
        if not chosen:
            raise InputError(f"There is no specimen {name[:40]!r}; choose one of the list.")
        files, prepared = project.scan_list(folder / listed, chosen)
        redone = (*words, listed, "--redo", name, "-o", before.output)
        return Order(redone, before.output, prepared, files=files, scans=_keys_of(chosen, scans))
    if kind == "surface":
        return Order((*words, *stored_volumes(project, options.get("files")), "-o", output, *given), output)
    if kind == "groom":
        ids = options.get("ids")
        ids = state.with_parts(cast(list[Any], ids)) if isinstance(ids, list) else ()
        chosen = [specimen for specimen in state.specimens if specimen.id in ids]
        if not chosen or not given:
            raise InputError("Select the specimens to groom, and choose a step.")
        return Order((*words, *(specimen.file for specimen in chosen), "-o", output, *given, "--quiet"), output)
    if kind == "build":
        before = result_of(jobs, CORRESPONDENCES, on)
        files = {} if "--landmarks" in options else _landmark_files(project, before.output, stem)
        marks = ("--landmarks", *files) if files else ()
        return Order((*words, *_surfaces(project, before), "-o", output, *marks, *given), output, files=files)
    if kind == "quality":
        surfaces = _surfaces(project, result_of(jobs, CORRESPONDENCES, on))
        return Order((*words, *surfaces, "-o", output, *given), output)
    if kind in ("fit", "complete"):
        model = result_of(jobs, ("build",), on).output
        chosen = _require_specimens(state.chosen("new"), "to fit; drop new scans", 1)
        has_points, path = any(specimen.points for specimen in chosen), folder / model
        names = _landmark_names(path, path.stat().st_mtime if path.is_file() else 0.0) if has_points else ()
        files, prepared = project.scan_list(folder / listed, chosen, names)
        keys = _keys_of(chosen, scans)
        return Order((*words, model, listed, "-o", output, *given), output, prepared, files=files, scans=keys)
    if kind == "landmarks":
        return _export_landmarks(project, words, given, str(options.get("--to", "")), number)
    if kind == "report" and on is None:
        results = [job.output for job in _results_of_study(jobs)]
        files = {listed: project.table(specimen for specimen in state.specimens if specimen.included)}
        return Order((*words, *results, "--specimens", listed, "-o", output, "--no-open", *given), output, files=files)
    if kind == "report":
        before = result_of(jobs, (*CORRESPONDENCES, "fit"), on)
        return Order((*words, before.output, "--no-open", *given), f"{before.output}/report.html")
    if kind == "figures":
        before = result_of(jobs, QUESTIONS, on)
        return Order((*words, before.output, *given), before.output)
    if kind == "convert":
        model, to = result_of(jobs, ("build",), on).output, str(options.get("--to", ""))
        return Order((*words, model, f"{output}{_model_ending(to)}", *given), f"{output}{_model_ending(to)}")
    if kind == "export":
        fits = result_of(jobs, ("fit",), on).output
        excluded = {specimen.id for specimen in state.specimens if not specimen.included and specimen.role == "new"}
        names = [name for name in Results(folder / fits).names() if name not in excluded] if excluded else ["--all"]
        if not names:
            raise InputError(f"All specimens of {fits} are excluded; include one.")
        return Order((*words, fits, *names, "-o", output, *given), output)
    if kind not in QUESTIONS:
        raise InputError(f"There is no action {kind[:30]!r}; reload the page.")
    return _question(project, shapes_of(project, jobs, kind, on), forms, kind, options, number)


def _export_landmarks(project: Project, words: tuple[str, ...], given: Sequence[str], to: str, number: int) -> Order:
    """Return the command that writes the landmarks of the included scans."""
    included = (*project.state.chosen("training"), *project.state.chosen("new"))
    marked = [specimen for specimen in included if specimen.points]
    if not marked:
        raise InputError("No included specimen has landmarks; place some on a scan, or import a file of landmarks.")
    listed, output = f"{_INPUTS}/{number:04d}-landmarks.csv", f"landmarks-{number}{CONFIGURATION_FORMATS.get(to, '')}"
    return Order((*words, listed, "-o", output, *given), output, files={listed: project.point_table(marked)})


@lru_cache(maxsize=8)
def _landmark_names(model: Path, modified_s: float) -> frozenset[str]:
    """Return the names of the landmarks of the model that was written at a time; the page asks again and again.

    A model that cannot be read, which its command reports, has none.
    """
    try:
        return frozenset(ShapeModel.load(model).landmarks)
    except ShapespaceError:
        return frozenset()


def stored_volumes(project: Project, files: Any) -> Sequence[str]:
    """Return the paths of label volumes in the project.

    Raises:
        InputError: there are none, or a path is not that of a volume in the project.
    """
    files = cast(list[Any], files) if isinstance(files, list) else []
    for file in files:
        path = project.folder / str(file)
        if path.parent != project.folder / "scans" or not path.name.lower().endswith(VOLUME_ENDINGS):
            raise InputError(f"There is no volume {str(file)[:40]!r}; drop it again.")
    if not files:
        raise InputError("There is no volume with the chosen labels; drop label volumes.")
    return files


def groomed_scans(job: Job, folder: Path) -> dict[str, str]:
    """Return the path of each scan that a job groomed -> path of the groomed scan, both as in `Specimen.file`.

    Args:
        job: job that groomed scans.
        folder: folder of the project.
    """
    scans = job.arguments[1 : job.arguments.index("-o")]
    paths = {
        scan: f"{job.output}/{name}.ply"
        for scan, name in zip(scans, names_for([folder / scan for scan in scans]), strict=True)
    }
    return {scan: path for scan, path in paths.items() if (folder / path).is_file()}


def _question(project: Project, shapes: Job, forms: Forms, kind: str, options: Mapping[str, Any], number: int) -> Order:
    of_command = {flag: value for flag, value in options.items() if flag != MISSING_LANDMARKS}
    words, given = forms[kind]["command"], _option_arguments(forms, kind, of_command)
    stem, output = f"{_INPUTS}/{number:04d}", f"{kind}-{number}"
    chosen, marks, before = _specimens_of(project, shapes, options), dict[str, str](), ()
    if shapes.number == PLACED:
        folder = f"{stem}-landmarks"
        placed = placed_landmarks(project, options)
        marks, before = placed.files(folder), (placed.command(folder),)
        shapes = replace(shapes, output=f"{folder}/aligned")
        pairs = [pair for pair in project.state.mirrored_pairs if {*pair} <= {*placed.names}]
        if kind == "asymmetry" and pairs and not (options.get("--pairs") or options.get("--side")):
            marks[f"{folder}/pairs.csv"] = table_text(pairs[0], pairs[1:])
            given += ["--pairs", f"{folder}/pairs.csv"]
    if kind == "score":
        reference, others = _by_class(chosen, options.get("--reference"))
        reference_table, population = f"{stem}-reference.csv", f"{stem}-reference.toml"
        files = {
            f"{stem}.csv": project.table(_require_specimens(others, "to score", 1)),
            reference_table: project.table(_require_specimens(reference, "in the reference", 2)),
            population: cohort_file_text(
                project.folder / _INPUTS, project.folder / reference_table, shapes=project.folder / shapes.output
            ),
        }
        given = [word for word in given if not word.startswith("--reference=")]
        return Order(
            (*words, f"{stem}.csv", "--shapes", shapes.output, "--reference", population, "-o", output, *given),
            output, before, on=shapes.number, files=files | marks,
        )  # fmt: skip
    files = {f"{stem}.csv": project.table(_require_specimens(chosen, "to analyse", 2))} | marks
    if options.get("--geometry") == "landmarks" and not options.get("--landmarks") and shapes.kind in CORRESPONDENCES:
        marks = _landmark_files(project, shapes.output, stem)
        files |= marks
        given += [word for name in marks for word in ("--set", f"landmarks={name}")]
    arguments = (*words, f"{stem}.csv", "--shapes", shapes.output, "-o", output, *given)
    return Order(arguments, output, before, on=shapes.number, files=files)


def _landmark_files(project: Project, surfaces: str, stem: str) -> dict[str, str]:
    """Return the path and the content of the table of the landmarks that the user placed on surfaces, and of those of
    their scans; empty if the user placed none.

    Raises:
        InputError: they were placed on other surfaces.
    """
    state = project.state
    if not state.landmarks:
        return {}
    if state.landmarks_on not in ("", surfaces):
        raise InputError(
            f"The landmarks were placed on {state.landmarks_on}; place them on {surfaces}, or remove them."
        )
    return {f"{stem}-landmarks.csv": project.landmark_table(surfaces)}


def shapes_of(project: Project, jobs: Sequence[Job], kind: str, on: int | None) -> Job:
    """Return the job whose shapes a question is about: fits, surfaces in correspondence, or landmarks on scans, with
    the number `PLACED`. If no job is chosen, it is the newest correspondence, or else the landmarks.

    Raises:
        InputError: there is none.
    """
    if kind == "identify":
        return result_of(jobs, ("fit",), on)
    has_surfaces = any(job.kind in CORRESPONDENCES and job.status == "done" for job in jobs)
    if on == PLACED or (on is None and not has_surfaces and project.state.point_names):
        return Job(number=PLACED, kind="landmarks", arguments=(), output="")
    return result_of(jobs, CORRESPONDENCES if on is None else (*CORRESPONDENCES, "fit"), on)


def _specimens_of(project: Project, shapes: Job | None, options: Mapping[str, Any]) -> Sequence[Specimen]:
    """Return the included specimens that a job with shapes has: fits are of new scans."""
    if shapes is not None and shapes.number == PLACED:
        placed = placed_landmarks(project, options)
        return [row for row in project.state.chosen("training", with_parts=False) if row.id in placed.points]
    is_fit = shapes is not None and shapes.kind == "fit"  # of one scan each
    return project.state.chosen("new" if is_fit else "training", with_parts=is_fit)


def _by_class(specimens: Sequence[Specimen], named: Any) -> tuple[Sequence[Specimen], Sequence[Specimen]]:
    """Return the specimens of the class `column=value`, and the others."""
    column, _, value = str(named or "").partition("=")
    members = [specimen for specimen in specimens if value and specimen.cells.get(column) == value]
    ids = {specimen.id for specimen in members}
    return members, [specimen for specimen in specimens if specimen.id not in ids]


def result_of(jobs: Sequence[Job], kinds: Sequence[str], on: int | None) -> Job:
    """Return the job `on`, or the newest that succeeded, of some kinds. `on` may be a correspondence that still runs or
    waits, for whose end the job that uses it waits.

    Raises:
        InputError: there is none.
    """
    for job in reversed(jobs):
        is_awaited = on == job.number and job.kind in CORRESPONDENCES and job.status in ("waiting", "running")
        if job.kind in kinds and (job.status == "done" or is_awaited) and on in (None, job.number):
            return job
    missing = {"correspond": "a correspondence", "build": "a model", "fit": "fits of new scans"}
    needed = next((missing[kind] for kind in kinds if kind in missing), "an answer")
    raise InputError(f"This needs {needed}; run that first.")


def _results_of_study(jobs: Sequence[Job]) -> list[Job]:
    """Return the jobs whose results are in the report of the study: of each step the newest, and each answer once.

    Raises:
        InputError: there is none.
    """
    steps = {"redo": "correspond"}
    newest: dict[str, Job] = {}
    for job in jobs:
        if job.status == "done" and job.kind in _STUDY:
            is_answer = job.kind in QUESTIONS and job.kind != "morphospace"
            newest[f"{job.kind} {job.on} {job.options}" if is_answer else steps.get(job.kind, job.kind)] = job
    if not newest:
        raise InputError("There are no results yet; bring the specimens into correspondence first.")
    return sorted(newest.values(), key=lambda job: (_STUDY.index(job.kind), job.number))


def checks(
    project: Project, forms: Forms, kind: str, options: Mapping[str, Any], shapes: Job | None,
    odd: Sequence[str] = (),
) -> list[dict[str, str]]:  # fmt: skip
    """Return findings on a run before it is started: a level (`ok`, `warning`, `problem`) and a sentence each.

    Args:
        project: project with the specimens.
        forms: forms of all kinds.
        kind: kind of the job.
        options: flag -> value, as sent by the page.
        shapes: job whose shapes a question is about; None for other kinds.
        odd: sentences on specimens that differ from the others, or on landmarks that are not on their scans.
    """
    listed = chosen = _specimens_of(project, shapes, options)
    columns = _used_columns(project.state.columns, options)
    missing = {column: sum(not specimen.cells.get(column) for specimen in chosen) for column in columns}
    of_all = len(chosen)
    drop_missing = options.get("--missing") == "drop"
    if drop_missing:
        chosen = [specimen for specimen in chosen if all(specimen.cells.get(column) for column in columns)]
    found = [("ok" if len(chosen) >= 2 else "problem", f"Included specimens: {len(chosen)}.")]
    rest = [f"{len(odd) - _MOST_ODD} more specimens like these."] if len(odd) > _MOST_ODD else []
    found += [("warning", text) for text in (*odd[:_MOST_ODD], *rest)]
    if kind == "correspond":
        return _as_findings(found)
    if shapes is not None and shapes.kind in CORRESPONDENCES:
        there = _surface_files(project, shapes, chosen)
        lacking = [specimen.id for specimen in chosen if specimen.id not in there]
        have = "has no surface" if len(lacking) == 1 else "have no surfaces"
        text = f"{list_names(lacking)} {have} in {shapes.output} and cannot take part."
        found += [("warning" if len(chosen) - len(lacking) >= 2 else "problem", text)] if lacking else []
    if shapes is not None and shapes.number == PLACED:
        placed = placed_landmarks(project, options)
        every, excluded = len(project.state.point_names), len(placed.lacking) - len(placed.points)
        lacking = [f"{name} {count} of {every}" for name, count in placed.lacking.items() if count]
        result = f"excluded specimens: {excluded}" if excluded else f"landmarks in use: {len(placed.names)}"
        text = f"Landmarks are missing ({list_names(lacking)}); {result}. Place them, or see {MISSING_LANDMARKS}."
        found += [("warning", text)] if lacking else []
    if kind == "score" and options.get("--reference"):
        members, others = map(len, _by_class(chosen, options["--reference"]))
        text = f"{members} in the reference, {others} to score; percentiles have steps of 1 in {members + 1}."
        found.append(("problem" if members < 2 or not others else "warning" if members < 20 else "ok", text))
    if kind == "regress" and bool(options.get("--target")) == bool(options.get("--along")):
        text = (
            "Choose one column, by either --target or --along: to predict a number from shape, or shapes from a number"
        )
        found.append(("problem", f"{text}."))
    for column in columns:
        cells = [specimen.cells.get(column, "") for specimen in chosen]
        if missing[column]:
            what = "these are excluded" if drop_missing else "fill it in, or exclude these with --set missing=drop"
            text = f"{column} is missing for {missing[column]} of {of_all} specimens; {what}."
            found.append(("warning" if drop_missing else "problem", text))
        classes = {cell: cells.count(cell) for cell in dict.fromkeys(cells) if cell}
        decimals = [cell for cell in classes if DECIMAL_COMMA.fullmatch(cell)]
        if decimals:
            text = f"{column} has numbers with a decimal comma ({list_names(decimals)}); write a decimal point."
            found.append(("problem", text))
        elif len(classes) > 2 and all(map(is_number, classes)) and column != options.get("--group"):
            numbers = sorted(map(float, classes))
            found.append(("ok", f"{column}: numbers from {numbers[0]:g} to {numbers[-1]:g}."))
        elif 0 < len(classes) <= 12:
            text = f"{column}: {', '.join(f'{count} {name}' for name, count in classes.items())}."
            found.append(("warning" if min(classes.values()) < 3 else "ok", text))
        elif classes:
            found.append(("ok", f"{column}: {len(classes)} values."))
        if len(classes) == 1:
            found.append(("problem", f"{column} has one value for all specimens; nothing can differ."))
    for option in forms.get(kind, {}).get("options", ()):
        value = str(options.get(option["flag"]) or "").strip()
        if option["required"] and not value:
            found.append(("problem", f"Choose a value of {option['flag']}."))
        elif value and option["kind"] == "number" and not is_number(value):
            found.append(("problem", f"{option['flag']}: {value[:40]!r} is not a number."))
    if not any(level == "problem" for level, _ in found):
        names = [specimen.id for specimen in listed]
        reason, notes = _reason_of_rejection(project, forms, kind, options, shapes, names)
        found += [("warning", note) for note in notes]
        for column in columns if reason else ():
            is_group = column in (options.get("--group"), options.get("--points"))
            if is_group and len(chosen) == len({specimen.cells.get(column) for specimen in chosen}):
                reason = f"{column} has another value for each specimen; choose a column of classes."
        found += [("problem", reason)] if reason else []
    return _as_findings(found)


def _as_findings(found: Sequence[tuple[str, str]]) -> list[dict[str, str]]:
    return [{"level": level, "text": text} for level, text in found]


def _reason_of_rejection(
    project: Project, forms: Forms, kind: str, options: Mapping[str, Any], shapes: Job | None, names: Sequence[str]
) -> tuple[str, Sequence[str]]:
    """Return why the command of a question would reject its input, empty if it would not, or cannot be asked; and the
    first notes of the alignment of landmarks.

    It is asked with the table, options and fits of the project, and small surfaces of the same names in place of those
    in correspondence, which would take too long to read.
    """
    shapes = shapes or Job(number=1, kind="correspond", arguments=(), output="shapes")
    is_of_shapes = re.fullmatch(r"corrected|[\d.]+x", str(options.get("--effect") or "corrected"))
    if kind == "power" and is_of_shapes and shapes.number != PLACED:
        options = {**options, "--effect": "observed"}  # whether there is such an effect depends on the real surfaces
    is_placed, is_fit = shapes.number == PLACED, shapes.kind == "fit"
    with ExitStack() as stack:
        try:
            made = _question(project, shapes, forms, kind, options, 0)
            if is_placed or is_fit:
                temporary = TemporaryDirectory(prefix="shapespace-check-", ignore_cleanup_errors=True)
                folder = Path(stack.enter_context(temporary))
            else:
                ways = [int(options[flag]) for flag in ("--components", "--modes") if str(options.get(flag)).isdigit()]
                folder = _small_surfaces(project, shapes, names, max(_LEAST_WAYS, *ways, 0))
                stack.enter_context(_checking)
            made.write_files(folder)
            if is_fit:
                (folder / shapes.output).symlink_to(project.folder / shapes.output)
        except InputError as error:
            return str(error), ()
        except OSError:
            return "", ()  # Windows does not allow links to all users
        way = ["--set", "surfaces=coefficients"] if is_fit else []
        is_parsed_only = not is_placed and any(options.get(flag) for flag in _OF_SURFACES)
        folders = [] if is_parsed_only else [folder, project.folder]
        aligned = [[str(folder / word) if word in made.files else word for word in words] for words in made.before]
        check, record = forms[kind]["check"], folder / _INPUTS / "0000-landmarks/aligned" / RECORD
        reason = "".join(str(check(words, [folder])) for words in aligned) or str(
            check([*made.arguments, *way], folders)
        )
        notes = read(AlignRecord, read_json(record, ""), str(record), "").notes if record.is_file() else ()
        texts = [
            text.replace(str(folder / next(iter(made.files))), "The table")
            .replace(f"{_INPUTS}/0000-landmarks/pairs.csv", "The pairs of landmarks")
            .replace(f"{folder}{os.sep}", "")
            .replace(f"{project.folder}{os.sep}", "")
            for text in (reason, *notes[:_MOST_ODD])
        ]
        return texts[0], texts[1:]


def _small_surfaces(project: Project, shapes: Job, names: Sequence[str], ways: int) -> Path:
    """Return a folder with small symmetric surfaces, which vary in `ways` ways: for each specimen that has one in
    `shapes`, also if it was excluded, as the record lists it; or for all `names` if `shapes` has no folder."""
    source = project.folder / shapes.output
    names = sorted(_surface_names(project, shapes)) if source.is_dir() else names
    path = source / CorrespondenceRecord.FILE
    record = path.read_bytes() if path.is_file() else b""
    return project.cached(
        (shapes.output, tuple(names), ways, record),
        lambda: _write_small_surfaces(project, shapes.output, names, ways, record),
    )


def _write_small_surfaces(project: Project, output: str, names: Sequence[str], ways: int, record: bytes) -> Path:
    """Return a new folder with small surfaces, which is removed with the project's object."""
    folder = Path(mkdtemp(prefix="shapespace-check-"))
    weakref.finalize(project, shutil.rmtree, folder, ignore_errors=True)
    rng = np.random.default_rng(0)
    half = rng.normal([4.0, 0.0, 0.0], size=(min(ways, len(names)) // 6 + 6, 3))
    template = np.concatenate([half, half * (-1.0, 1.0, 1.0)])
    triangles = np.arange(len(half) - 2)[:, None] + np.arange(3)
    faces = np.concatenate([triangles, triangles[:, ::-1] + len(half)]).astype(np.int32)
    target = make_folder(folder / output)
    for name in names:
        vertices = template + 0.1 * rng.normal(size=template.shape)
        write_mesh(target / f"{name}{CorrespondRecord.SURFACE}", Mesh(vertices, faces))
    if record:
        write_bytes(target / CorrespondenceRecord.FILE, record)
    return folder


Outdated = Literal["specimens", "table", "landmarks", "redone", "source"]
"""What changed since a result was computed: the specimens or their scans, columns of the table that it uses, the
landmarks, the correspondence, in which a scan was registered again, or a result that it was computed from."""


def outdated_results(
    project: Project, jobs: Sequence[Job], forms: Forms, scans: Mapping[str, str] = {}
) -> dict[int, Outdated]:
    """Return what changed since results were computed, by the numbers of their jobs; other results are up to date.

    A result is up to date if the command for the same choices, with the same source, and the files that it would read
    are those of its job; of tables only the columns count that it uses. `scans` has the present hash of each scan by
    the id of its specimen.
    """
    found: dict[int, Outdated] = {}
    present = _keys_of([specimen for specimen in project.state.specimens if specimen.included], scans)
    done = [job for job in jobs if job.status == "done"]
    paths = {job.number: job.paths for job in done}
    for job in done:
        earlier = [other for other in done if other.number < job.number]
        sources = [other for other in earlier if other.output in paths[job.number]]
        redone = [other for other in done if other.kind == "redo" and other.number > job.number]
        has_outdated_source = any(source.number in found for source in sources)
        read, own = dict(job.scans), [other for other in redone if other.output == job.output]
        for other in own:
            read |= other.scans
        if job.kind != "redo" and any(present.get(name, key) != key for name, key in read.items()):
            found[job.number] = "specimens"
        elif (
            job.kind in (*_STUDY, "report", "export", "landmarks")
            and not (job.kind == "redo" or (job.kind == "report" and "--specimens" not in job.arguments))
            and (change := _change_since(project, earlier, forms, job, sources, own))
            and not (job.kind == "report" and change == "specimens" and has_outdated_source)
        ):
            found[job.number] = change
        elif any(other.output in paths[job.number] and other.output != job.output for other in redone):
            found[job.number] = "redone"
        elif has_outdated_source:
            found[job.number] = "source"
    return found


def _keys_of(specimens: Sequence[Specimen], scans: Mapping[str, str]) -> dict[str, str]:
    return {specimen.id: scans[specimen.id] for specimen in specimens if specimen.id in scans}


def _change_since(
    project: Project, earlier: Sequence[Job], forms: Forms, job: Job, sources: Sequence[Job], redone: Sequence[Job]
) -> Outdated | None:
    on = job.on if job.on is not None or not sources or job.kind == "report" else sources[-1].number
    try:
        now = order(project, earlier, forms, job.kind, job.options, on, job.number)
    except (InputError, FileError):
        has_marks = job.kind == "build" or job.on == PLACED or job.options.get("--geometry") == "landmarks"
        moved = bool(sources) and project.state.landmarks_on not in ("", sources[-1].output)
        return "landmarks" if has_marks and (moved or job.on == PLACED) else "specimens"
    is_each = job.kind in ("correspond", "fit", "complete")  # each scan has a result, also if others are excluded later
    if now.arguments != job.arguments and job.kind != "report":
        are_marked = ["-landmarks.csv" in " ".join(arguments) for arguments in (now.arguments, job.arguments)]
        return "landmarks" if are_marked[0] != are_marked[1] else "specimens"
    numbers = {str(other.options.get("name")): other.number for other in redone}  # of the job that read a scan last
    for name, content in now.files.items():
        try:
            number = numbers.get(Path(name).stem, job.number) if f"{job.number:04d}-landmarks/" in name else job.number
            before = (project.folder / name.replace(f"{job.number:04d}", f"{number:04d}", 1)).read_text(
                encoding="utf-8"
            )
        except OSError:
            continue  # the file was removed, so there is nothing to compare
        if name.startswith(f"{_INPUTS}/{job.number:04d}-landmarks"):
            if content != before:
                return "landmarks"
        elif is_each:
            listed, listed_before = _scans_of(content, job.number), _scans_of(before, job.number)
            for other in redone:
                with suppress(OSError):
                    path = project.folder / f"{_INPUTS}/{other.number:04d}.csv"
                    listed_before |= _scans_of(path.read_text(encoding="utf-8"), other.number)
            pairs = [(cells, listed_before.get(name, ("", ""))) for name, cells in listed.items()]
            if any(cells[0] != cells_before[0] for cells, cells_before in pairs):
                return "specimens"
            if any(cells != cells_before for cells, cells_before in pairs):
                return "landmarks"
        elif name.endswith(".csv"):
            columns = {*project.state.columns, *next(csv.reader(io.StringIO(before)))}
            used = {"specimen", "subject", *_used_columns(sorted(columns), job.options)}
            used = frozenset(columns if job.kind == "report" else used)
            rows, rows_before = _rows_of(content, used), _rows_of(before, used)
            if rows != rows_before:
                others = {row[0] for row in rows} ^ {row[0] for row in rows_before}
                included = {specimen.id for specimen in project.state.chosen("training")}
                is_marked = job.on == PLACED and others <= included  # they are used if they have all landmarks
                return "table" if not others else "landmarks" if is_marked else "specimens"
    return None


def _scans_of(scans: str, number: int) -> dict[str, tuple[str, str]]:
    """Return id and part -> file of the scan and of its landmarks, in a list of scans that a job with this number read.

    The number is removed from files that were written for the job. A file of landmarks is empty without landmarks.
    """
    return {
        f"{row['id']} {row.get('part', '')}": (
            row["file"].removeprefix(f"{number:04d}-"),
            row.get(LANDMARK_COLUMN, "").removeprefix(f"{number:04d}-"),
        )
        for row in csv.DictReader(io.StringIO(scans))
    }


@lru_cache(maxsize=256)
def _rows_of(table: str, columns: frozenset[str]) -> list[list[str]]:
    """Return the rows of a table with some of its columns, sorted; the tables of most jobs are the same."""
    header, *rows = csv.reader(io.StringIO(table))
    kept = [k for k, name in enumerate(header) if name in columns]
    return sorted([row[k] for k in kept] for row in rows)


def _used_columns(columns: Sequence[str], options: Mapping[str, Any]) -> list[str]:
    """Return the columns of the table that the options of a question name."""
    formula = f"{options.get('--formula', '')} {options.get('--covariates', '')}"
    texts = [value for value in options.values() if isinstance(value, str)]
    used = {part.strip() for text in texts for part in (text, *re.split(r"[,!?=]", text))}
    return [column for column in columns if column in used or _in_formula(column, formula)]


def _in_formula(column: str, formula: str) -> bool:
    words = "".join(c if c.isalnum() or c == "_" else " " for c in formula).split()
    return column in words or f"`{column}`" in formula


def _option_arguments(forms: Forms, kind: str, options: Mapping[str, Any]) -> list[str]:
    """Return the options as arguments.

    Raises:
        InputError: the kind has no such option, or a value is none.
    """
    known = {option["flag"]: option for option in forms.get(kind, {}).get("options", ())}
    arguments: list[str] = []
    for flag, value in options.items():
        if flag not in known:
            raise InputError(f"The action {kind[:30]!r} has no option {str(flag)[:40]!r}; reload the page.")
        if known[flag]["kind"] == "flag":
            arguments += [flag] if value else []
        elif value is not None and (text := str(value).strip()):
            # One argument, so that a value that begins with a dash is not taken for an option.
            option, _, setting = str(known[flag]["argument"]).partition(" ")
            arguments += [option, f"{setting}={text}"] if setting else [f"{option}={text}" if option else text]
    return arguments


def _require_specimens(specimens: Sequence[Specimen], purpose: str, least: int) -> Sequence[Specimen]:
    if len(specimens) < least:
        raise InputError(f"There {'is no included specimen' if not specimens else 'is one specimen'} {purpose}.")
    return specimens


def _surfaces(project: Project, before: Job) -> list[str]:
    """Return the folder in correspondence, or the surfaces of the included training specimens if it has others.

    A surface without a specimen is that of a removed one, unless a specimen without a surface may be a renamed one.
    """
    chosen = _specimens_of(project, None, {})
    included, there = _surface_files(project, before, chosen), _surface_names(project, before)
    others = there.intersection(specimen.id for specimen in project.state.specimens).difference(included)
    if len(included) == len(chosen):
        others = there.difference(included)
    if not others:
        return [before.output]
    if len(included) < 2:
        raise InputError("Fewer than two included specimens are in correspondence; include more.")
    return list(included.values())


def _surface_names(project: Project, shapes: Job) -> set[str]:
    """Return the names of the specimens with a surface in correspondence, also of one that still runs."""
    if shapes.kind == "correspond" and shapes.status in ("waiting", "running"):
        return {specimen.id for specimen in project.state.chosen("training")}
    with suppress(FileNotFoundError):
        names = [path.name for path in (project.folder / shapes.output).iterdir()]
        ending = CorrespondRecord.SURFACE
        return {name.removesuffix(ending) for name in names if name.endswith(ending)}
    return set()


def _surface_files(project: Project, shapes: Job, specimens: Sequence[Specimen]) -> dict[str, str]:
    """Return id -> path in the project's folder of the surface in correspondence, of the specimens that have one."""
    there = _surface_names(project, shapes)
    return {
        specimen.id: f"{shapes.output}/{specimen.id}{CorrespondRecord.SURFACE}"
        for specimen in specimens
        if specimen.id in there
    }


def _model_ending(name: str) -> str:
    from shapespace.formats.registry import MODEL_FORMATS

    if not name:
        return ".h5"
    if name not in MODEL_FORMATS:
        raise InputError(f"There is no format {name[:30]!r}; choose one of {', '.join(MODEL_FORMATS)}.")
    return next(iter(MODEL_FORMATS[name].suffixes), "")
