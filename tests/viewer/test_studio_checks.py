"""The checks of a question before its run find what its command would reject, and nothing else."""

import re
from pathlib import Path

import numpy as np
import pytest
from test_studio_project import join_table, tetrahedron

from shapespace.cli import main
from shapespace.cli.command_table import summaries_and_options
from shapespace.cli.forms import forms
from shapespace.io.meshes.mesh_io import write_mesh
from shapespace.report.analyses.analysis_report import histogram_part
from shapespace.schemas import CorrespondenceRecord, CorrespondRecord, json_text
from shapespace.viewer.studio.job_commands import QUESTIONS, OptionLabels, checks, order
from shapespace.viewer.studio.jobs import Job
from shapespace.viewer.studio.project import Project, change_of
from synthetic_shapes import training_meshes

FORMS = forms(summaries_and_options())
COUNT = 24
DONE = [Job(number=1, kind="correspond", arguments=("x",), output="correspondence-1", status="done")]
GOOD: dict[str, dict[str, str]] = {
    "compare": {"--formula": "~ group"}, "change": {"--subject": "person", "--time": "visit"},
    "asymmetry": {"--subject": "person"}, "regress": {"--target": "age"}, "score": {"--reference": "group=a"},
    "morphospace": {"--group": "group"}, "disparity": {"--group": "group"}, "equality": {"--group": "group"},
    "equivalence": {"--group": "group", "--margin": "5"}, "power": {"--group": "group"},
    "discriminant": {"--group": "group"}, "pairwise": {"--formula": "~ group + age", "--group": "group"},
    "trajectory": {"--group": "group", "--points": "stage"}, "allometry": {"--group": "group"},
    "repeatability": {"--subject": "person"}, "pls": {"--columns": "age,visit"},
    "signal": {"--tree": "tree.nwk"}, "pgls": {"--tree": "tree.nwk", "--formula": "~ age"},
    "integration": {"--modules": "modules.csv"}, "modularity": {"--modules": "modules.csv"},
}  # fmt: skip
"""Question -> options that its command accepts."""
BAD: tuple[tuple[str, dict[str, str], str], ...] = (
    ("compare", {"--permutations": "19"}, "permutations"),
    ("compare", {"--formula": "~ group*person"}, "residual|degrees of freedom|parameters|shapes"),
    ("compare", {"--formula": "~ nothing"}, "nothing"),
    ("compare", {"--level": "2"}, "level"),
    ("compare", {"--blocks": "group"}, "group"),
    ("compare", {"--error": "group=nothing"}, "nothing"),
    ("compare", {"--error": "group"}, "TERM=ERROR|Error terms"),
    ("compare", {"--random": "nonsense"}, "random|Random"),
    ("change", {"--subject": "once"}, "two visits"),
    ("change", {"--time": "when", "--order": "pre,post"}, "order|pre"),
    ("change", {"--group": "site"}, "site"),
    ("change", {"--time": "when", "--order": "before,after", "--rate": "1"}, "Rates need times"),
    ("change", {"--region": "x"}, "NAME=FILE"),
    ("asymmetry", {"--seed": "-1"}, "negative|0 or more"),
    ("regress", {"--target": "group"}, "group"),
    ("regress", {"--folds": "100"}, "fold"),
    ("regress", {"--target": "", "--along": "age", "--at": "1000"}, "1000|range"),
    ("regress", {"--target": "", "--along": "age", "--covariates": "nothing"}, "nothing"),
    ("score", {"--modes": "500"}, "modes"),
    ("score", {"--seed": "-1"}, "negative|0 or more"),
    ("score", {"--reference": "person=p1"}, "people|subjects|reference"),
    ("disparity", {"--group": "alone"}, "alone"),
    ("disparity", {"--permutations": "0"}, "permutation"),
    ("equality", {"--components": "500"}, "components"),
    ("equivalence", {"--margin": ""}, "margin"),
    ("equivalence", {"--margin": "-1"}, "margin"),
    ("power", {"--effect": "big"}, "big"),
    ("power", {"--sizes": "1"}, "sizes|size"),
    ("discriminant", {"--components": "100"}, "components"),
    ("pairwise", {"--null": "~ nothing"}, "nothing"),
    ("trajectory", {"--points": "site", "--group": "person"}, "person|site|shapes"),
    ("trajectory", {"--order": "a,b"}, "order|stage"),
    ("allometry", {"--covariate": "group"}, "group"),
    ("repeatability", {"--subject": "once"}, "once|replicates|scans|shapes"),
    ("pls", {"--columns": "age,site"}, "site"),
    ("signal", {"--tree": "other.nwk"}, "tree|tip|phylogeny"),
    ("pgls", {"--tree": "none.nwk"}, "none.nwk"),
    ("morphospace", {"--axes": "1,99"}, "axes|axis|99"),
    ("morphospace", {"--method": "paca"}, "phylogen|tree"),
)
"""Question, options that replace good ones, and words of the reason."""


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Project:
    """Twelve people with two visits each, in correspondence, with a phylogeny."""
    made = Project.open(tmp_path_factory.mktemp("checks") / "p", create=True)
    (made.folder / "correspondence-1").mkdir()
    rows = ["id,group,site,age,person,visit,when,stage,once,alone"]
    for k, mesh in enumerate(training_meshes(COUNT, 150)):
        name = f"s{k:02}"
        write_mesh(made.folder / "correspondence-1" / f"{name}{CorrespondRecord.SURFACE}", mesh)
        made.add(tetrahedron(made.new_file(f"{name}.ply"), 1.0 + k), "training")
        rows.append(
            f"{name},{'ab'[k % 2]},g{k % 3},{20 + 3 * (k % 11)},p{k // 2},{1 + k % 2},{('before', 'after')[k % 2]},"
            f"t{k // 2 % 2},q{k},{'u' if k else 'v'}"
        )
    join_table(made, "\n".join(rows).encode())
    (made.folder / "tree.nwk").write_text(f"({','.join(f's{k:02}:{1 + k % 3}' for k in range(COUNT))});")
    (made.folder / "other.nwk").write_text("(x:1,y:1);")
    return made


def problems(project: Project, kind: str, options: dict[str, str]) -> list[str]:
    return [one["text"] for one in checks(project, FORMS, kind, options, DONE[0]) if one["level"] == "problem"]


@pytest.mark.parametrize("kind", sorted(set(QUESTIONS) - {"identify"}))
def test_input_that_the_command_accepts_has_no_problem(project: Project, kind: str) -> None:
    assert problems(project, kind, GOOD[kind]) == []
    assert not list(project.folder.glob(f"{kind}*")) and not (project.folder / "inputs").exists()  # nothing is written


@pytest.mark.parametrize("kind", sorted(set(QUESTIONS) - {"identify"}))
def test_excluded_specimens_and_missing_values_do_not_keep_a_question_back(project: Project, kind: str) -> None:
    record = CorrespondenceRecord(
        template="x", vertices=150, rounds=[], corresponding=[f"s{k:02}" for k in range(COUNT)], set_aside={},
        settings={}, version="1",
    )  # fmt: skip
    path = project.folder / "correspondence-1" / record.FILE
    path.write_text(json_text(record))
    project.edit(None, change_of({"what": "include", "ids": ["s00", "s01"], "included": False}))
    excluded = problems(project, kind, GOOD[kind])
    project.undo(project.revision)
    project.edit(None, change_of({"what": "cells", "cells": [{"id": "s05", "column": "age", "value": ""}]}))
    emptied = problems(project, kind, {**GOOD[kind], "--missing": "drop"})
    project.undo(project.revision)
    path.unlink()
    assert excluded == emptied == []


@pytest.mark.parametrize(("kind", "options", "words"), BAD)
def test_what_the_command_rejects_is_found_before_the_run(
    project: Project,
    kind: str,
    options: dict[str, str],
    words: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> None:
    given = {flag: value for flag, value in {**GOOD[kind], **options}.items() if value}
    [reason] = problems(project, kind, given)
    assert re.search(words, reason), reason
    assert str(project.folder) not in reason and "shapespace-check" not in reason and "inputs/" not in reason, reason
    made = order(project, DONE, FORMS, kind, given, None, 2)
    made.write_files(tmp_path)
    monkeypatch.chdir(project.folder)
    arguments = [str(tmp_path / word) if word.startswith("inputs/") else word for word in made.arguments]
    arguments[arguments.index("-o") + 1] = str(tmp_path / "out")
    try:
        code = main([*arguments, "--quiet"])
    except SystemExit as error:  # of the parser
        code = error.code
    said = capsys.readouterr().err
    assert code == 2, said
    if kind != "score":  # whose reference is a file that names the shapes relative to it
        assert reason.split(": ", 1)[-1] in said.replace(str(tmp_path / "inputs" / "0002.csv"), "The table")


def test_reasons_are_sentences_with_the_labels_of_the_page(project: Project) -> None:
    labels = OptionLabels(FORMS)
    [reason] = problems(project, "pairwise", {**GOOD["pairwise"], "--permutations": "0"})
    assert labels.sentence(reason) == "The option “Permutations” must be at least 1"
    [reason] = problems(project, "compare", {**GOOD["compare"], "--imputations": "-1"})
    assert labels.sentence(reason).startswith("The option “Samples of completed shapes”")


def test_many_permutations_are_not_computed_in_a_check(project: Project) -> None:
    assert problems(project, "pairwise", {**GOOD["pairwise"], "--permutations": "100000000"}) == []


def test_values_that_differ_by_rounding_have_a_histogram() -> None:
    values = np.where(np.arange(30) % 2 == 0, 1.0, np.nextafter(1.0, 2.0))
    assert sum(histogram_part("K", {"permutations": values}, 40).series[0].counts) == 30
