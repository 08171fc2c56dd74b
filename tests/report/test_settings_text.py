"""Settings of fits are read as sentences, and the numbers of a method with what each of them is."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

import numpy as np
import pytest

import shapespace as ss
from shapespace.fit.fit_scan import FitConfig
from shapespace.fit.paper.paper_method import Paper
from shapespace.fit.robust.robust_settings import DenseSettings, ResidualSettings, RobustSettings
from shapespace.report.blocks.blocks import Block, Facts, Folded, Table
from shapespace.report.blocks.sections import EVIDENCE, described, evidence_facts, settings_blocks
from synthetic_shapes import blob_model, raw_scan


def told(blocks: Sequence[Block]) -> str:
    out: list[str] = []
    for block in blocks:
        if isinstance(block, Facts):
            out += [f"{name}: {value}" for name, value in block.rows]
        elif isinstance(block, Folded):
            out += [block.summary, told(block.body)]
        elif isinstance(block, Table):
            out += [" | ".join(cell.text for cell in row) for row in block.rows]
    return "\n".join(out)


def config(**settings: Any) -> Mapping[str, Any]:
    return json.loads(json.dumps(FitConfig(**settings).as_dict()))


def test_choices_are_sentences_and_numbers_say_what_they_are() -> None:
    words = told(settings_blocks([config(dense=True)], [("Report", "shapespace")]))
    assert "Unit of the scans: found from the size of each scan" in words
    assert "Method: robust: parts of the scan that do not match the model are excluded" in words
    assert "beyond share | 0.2 | smallest share of the residuals' variance outside the model" in words
    assert "all | 20,000 | 1,500 | triangles | 15 | 0.05" in words
    assert "All numbers of the dense stage" in words and "local share | 0.03 | variance of the local modes" in words


def test_what_differs_between_fits_is_said() -> None:
    words = told(settings_blocks([config(), config(unit="cm", max_iterations=9)], []))
    assert "found from the size of each scan; of others: cm, as given" in words
    assert "at most 500 in each phase; of others: at most 9 in each phase" in words
    assert "dense stage" not in words.replace("Dense stage: not made", "")


@pytest.mark.parametrize("settings", [RobustSettings, DenseSettings, ResidualSettings, Paper])
def test_every_number_is_described(settings: type) -> None:
    meaning = described(settings)
    assert {field.name for field in fields(settings)} <= set(meaning) and all(meaning.values())


@pytest.mark.parametrize("damaged", [{}, {"method": 3}, {"method": "robust", "robust": 7}, {"robust": {"levels": [1]}}])
def test_damaged_settings_break_nothing(damaged: Mapping[str, Any]) -> None:
    assert "Method" in told(settings_blocks([damaged, config()], []))


def test_all_that_the_verdict_goes_by_is_told_in_words() -> None:
    result = ss.fit_scan(blob_model(), raw_scan(np.array([1.0, -1.0, 0.5, 0.0, 0.3]), vertices=900).scan)
    assert set(result.evidence.to_dict()) <= set(EVIDENCE), (
        "a new key needs its words in report/blocks/evidence_text.py"
    )
    told = evidence_facts({**result.evidence.to_dict(), "key_of_later": 2.5}, "Evidence").rows
    assert len(told) == len(result.evidence.to_dict()) + 1 and told[-1] == ("key of later", "2.5")
    assert not any("_" in what or what.endswith(" mm") for what, _ in told)
