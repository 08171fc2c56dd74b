"""methods.txt: each fact comes from the record of the analysis, and every analysis writes it."""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from shapespace.cohort.cohort import Cohort, ShapeSource
from shapespace.report.analyses.analysis_report import METHODS_FILE, cohort_report
from shapespace.report.analyses.methods_section import alignment_text, citations_of, methods_parts, methods_text
from shapespace.schemas import AlignRecord, Analysis, Dispersion, Methods, TestScheme, TextPart
from shapespace.statistics.compare_shapes import CompareConfig, compare
from shapespace.statistics.methods import REDUCED_OF_EACH_TERM, methods_of
from shapespace.statistics.shape_tests.groups import compare_disparity
from shapespace.version import __version__

SCHEME = TestScheme(tested=("sex",), reduced_model=("age",), unit="shape", arrangements=1000)
METHODS = Methods(
    subjects=30, shapes=40, vertices=12, coordinates=2, source="landmarks", tangent=True, dimensions=20, unit="",
    tests=(SCHEME,), effect_size="box-cox", r2_strata=("",),
)  # fmt: skip


def text_of(methods: Methods = METHODS, question: str = "compare", **settings: Any) -> str:
    versions = {"shapespace": "9.9", "numpy": "8.8", "python": "7.7"}
    return methods_text(Analysis(question=question, methods=methods, settings=settings, versions=versions))


@pytest.mark.parametrize(
    "words",
    [
        "shapespace 9.9, numpy 8.8, python 7.7",
        "40 shapes of 30 subjects, with 12 landmarks in 2 dimensions each",
        "generalised Procrustes analysis with scaling",
        "tangent space at their mean",
        "20 dimensions",
        "1,000 arrangements, the observed data among them: of sex (F) by residuals of shape ~ age permuted between",
        "seed 0",
        "type of sums of squares II",
        "level of significance is 0.05",
        "Box-Cox",
    ],
)
def test_the_paragraph_states_counts_versions_settings_and_what_is_permuted(words: str) -> None:
    text = text_of(seed=0, squares="II", blocks=None, rate=False, shapes=40)
    assert words in text and "blocks" not in text and "rate" not in text


def test_it_is_one_paragraph_without_advice_followed_by_references() -> None:
    unequal = Dispersion(
        variable="sex", groups=("f", "m"), counts=(20, 20), stddev=(1.0, 2.0), f=9.0, p=0.001, arrangements=1000,
        equal=False, smaller_is_more_variable=None,
    )  # fmt: skip
    paragraph, head, *references = text_of(msgspec.structs.replace(METHODS, dispersions=(unequal,))).split("\n\n")
    assert head == "References" and len(references) == 1 and "\n" not in paragraph
    assert "--" not in paragraph and "Warning" not in paragraph and "sex (p = 0.001)" in paragraph


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"source": "surfaces"}, "12 vertices in 2 dimensions"),
        ({"gauge": "form"}, "without scaling"),
        ({"tangent": False}, "(gauge shape). The"),
        ({"source": "coefficients", "modes": 7, "explained_variance_ratio": 0.9}, "frame of the shape model"),
        ({"dimensions": None}, "displacements of landmarks"),
        ({"unit": "mm"}, "Lengths are in mm"),
        ({"tests": (msgspec.structs.replace(SCHEME, resampling="sign flips"),)}, "signs flipped by shape"),
        ({"tests": (msgspec.structs.replace(SCHEME, resampling="bootstrap"),)}, "bootstrap of shapes"),
    ],
)  # fmt: skip
def test_each_fact_follows_the_record(change: dict[str, Any], words: str) -> None:
    changed = msgspec.structs.replace(METHODS, **change)
    assert words in text_of(changed) and words not in text_of()


def test_the_report_and_the_file_describe_the_data_by_the_same_sentence() -> None:
    part = next(methods_parts(METHODS))
    assert isinstance(part, TextPart) and part.text[0] in text_of()


def test_citations_are_those_of_the_methods_that_were_used() -> None:
    def named(methods: Methods, question: str, *own: str) -> str:
        return " ".join(citations_of(Analysis(question=question, methods=methods, citations=own)))

    cited = named(METHODS, "compare", "Own (2020).")
    assert all(name in cited for name in ("Gower", "Rohlf", "Goodall", "Freedman", "RRPP", "Sekora", "Own (2020)"))
    assert "Quan" not in cited and "Winkler" not in cited and "Klingenberg" not in cited
    fits = msgspec.structs.replace(METHODS, source="coefficients", effect_size="", tests=())
    cited = named(fits, "asymmetry")
    assert "Quan" in cited and "Klingenberg" in cited and "Gower" not in cited and "Freedman" not in cited
    flips = msgspec.structs.replace(METHODS, tests=(msgspec.structs.replace(SCHEME, resampling="sign flips"),))
    assert "Winkler" in named(flips, "change") and "Freedman" not in named(flips, "change")


def cohort(n: int = 12, **known: Any) -> Cohort:
    rng = np.random.default_rng(3)
    points = np.stack([3 * np.cos(np.arange(9)), 2 * np.sin(np.arange(9)), np.arange(9.0)], axis=1)
    shapes = points + 0.1 * rng.normal(size=(n, 9, 3))
    columns = {"sex": ["f", "m"] * (n // 2), "subject": [f"s{k // 2}" for k in range(n)]}
    return Cohort.of_shapes(shapes, columns, **known)


def test_the_tangent_space_and_the_dimensions_are_those_of_the_coordinates() -> None:
    in_tangent = methods_of(cohort(), 12)
    assert in_tangent.tangent and in_tangent.coordinates == 3 and in_tangent.dimensions == 11
    assert not methods_of(cohort(gauge="form"), 12).tangent
    aligned = np.stack([cohort().vertices(k) for k in range(12)])
    aligned -= aligned.mean(axis=1, keepdims=True)
    on_sphere = aligned / np.linalg.norm(aligned, axis=(1, 2), keepdims=True)
    assert not methods_of(Cohort.of_shapes(on_sphere, {}, align=False), 12).tangent
    flat = np.random.default_rng(4).normal(size=(30, 4, 2)) * 0.05 + np.array([[0, 0], [3, 0], [3, 2], [0, 2]])
    assert methods_of(Cohort.of_shapes(np.pad(flat, ((0, 0), (0, 0), (0, 1))), {}), 30).dimensions == 4


def test_answers_write_their_methods_beside_the_analysis(tmp_path: Path) -> None:
    compare(cohort(), "~ sex", CompareConfig(permutations=20, maps=False)).save(tmp_path / "compare")
    compare_disparity(cohort(), group=("sex",), permutations=20).save(tmp_path / "test")
    for name, citation in (("compare", "Freedman"), ("test", "Zelditch")):
        text = (tmp_path / name / METHODS_FILE).read_text("utf-8")
        assert "12 shapes of" in text and "20 arrangements" in text and "seed 0" in text and citation in text
        assert f"shapespace {__version__}" in text


def test_reports_of_landmarks_do_not_call_them_vertices(tmp_path: Path) -> None:
    landmarks = replace(cohort(), source=ShapeSource("landmarks"))
    for name, used in (("landmarks", landmarks), ("points", cohort())):
        compare(used, "~ sex", CompareConfig(permutations=20)).save(tmp_path / name)
        content = json.loads((tmp_path / name / "analysis.json").read_text())
        texts = [*content["summary"], *content["notes"], (tmp_path / name / METHODS_FILE).read_text()]
        texts += [str(part.get(key)) for part in content["parts"] for key in ("title", "note", "text")]
        assert bool(re.search("[Vv]ert(ices|ex)", " ".join(texts))) is (name == "points")
        kinds = [part["kind"] for part in content["parts"]]
        assert "deformation" in kinds and "morph" not in kinds


def test_answers_without_tests_state_their_data(tmp_path: Path) -> None:
    cohort_report(
        "recognise verify", "Title", (), cohort(), methods=methods_of(cohort(), 6), summary=(),
        settings={"subject": "subject", "draws": 50, "seed": 4},
    ).save(tmp_path)  # fmt: skip
    text = (tmp_path / METHODS_FILE).read_text("utf-8")
    assert "12 shapes of 6 subjects" in text and "bootstrap draws 50" in text and "Brümmer" in text


def test_an_alignment_states_semilandmarks_and_estimates() -> None:
    record = AlignRecord(
        specimens=40, landmarks=25, dimensions=2, gauge="shape", estimated=3, iterations=4, version="9.9",
        settings={"curve_semilandmarks": 11, "surface_semilandmarks": 0, "slide_by": "bending-energy", "tangent": True},
    )  # fmt: skip
    text = alignment_text(record)
    for words in ("40 specimens with 25 landmarks in 2", "11 semilandmarks on curves", "bending energy", "3 missing",
                  "thin-plate spline", "4 iterations", "orthogonally", "Gunz"):  # fmt: skip
        assert words in text
    plain = AlignRecord(specimens=4, landmarks=5, dimensions=3, gauge="form", version="9.9")
    assert "without scaling." in alignment_text(plain) and "semilandmarks" not in alignment_text(plain)


@pytest.mark.parametrize(
    ("scheme", "words"),
    [
        (TestScheme(tested=("K",), statistic="K of shape", unit="shape", reduced_model=None, arrangements=99),
         ": of K of shape by permutation of shapes."),
        (TestScheme(tested=("individual",), unit="mean of a side", reduced_model=None, arrangements=99),
         ": of individual (F) by permutation of means of a side."),
        (TestScheme(tested=("F",), statistic="F of each term", unit="shape", reduced_model=REDUCED_OF_EACH_TERM,
                    arrangements=99),
         ": of F of each term by residuals of the reduced model of each term permuted between shapes."),
        (TestScheme(tested=("dose",), unit="cell within a subject", reduced_model=None, arrangements=99),
         ": of dose (F) by permutation of cells within subjects."),
    ],
)  # fmt: skip
def test_what_is_permuted_is_named_in_plain_words(scheme: TestScheme, words: str) -> None:
    text = text_of(msgspec.structs.replace(METHODS, tests=(scheme,)))
    assert words in text
    assert ("all groups" in text) == (scheme.reduced_model is not None)
