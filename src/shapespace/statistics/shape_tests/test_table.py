"""Table of the tests of shape: what each computes, what it permutes, its source, and the options of its command.

The command line imports this module for its help, so it imports nothing that takes time.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal


@dataclass(frozen=True, kw_only=True)
class ShapeTest:
    """A test of shape.

    Args:
        name: word after `shapespace test`.
        summary: what it does, without a capital and a full stop.
        module: of the function, in `statistics.shape_tests`.
        function: takes a cohort and the options by name.
        statistics: what is computed, in words.
        permuted: what is permuted, as `TestScheme.unit`.
        resampling: how p values are computed.
        references: citations of the method.
        example: a command line.
        options: field of the function -> name of its value in the help; empty for a flag or a choice.
        required: fields without which there is no test.
    """

    name: str
    summary: str
    module: str
    function: str
    statistics: str
    permuted: str
    resampling: Literal["permutation", "sign flips", "bootstrap", "none"] = "permutation"
    references: tuple[str, ...] = ()
    example: str = ""
    options: Mapping[str, str] = field(default_factory=dict[str, str])
    required: tuple[str, ...] = ()


SHAPE_TESTS: tuple[ShapeTest, ...] = (
    ShapeTest(
        name="disparity",
        summary="compare the disparity (Procrustes variance) of groups, in total or about a model",
        module="groups",
        function="compare_disparity",
        statistics="Procrustes variance of each group, and the absolute difference of each pair",
        permuted="shape",
        references=(
            "Zelditch, Swiderski and Sheets (2012) Geometric Morphometrics for Biologists, 2nd edition, Academic.",
        ),
        example="shapespace test disparity people.csv --group species -o disparity",
        options={"group": "COLUMN", "formula": "FORMULA", "partial": ""},
        required=("group",),
    ),
)
"""All tests, in the order of the commands and the page."""


def shape_test(name: str) -> ShapeTest:
    """Return the test of a name, which exists."""
    return next(test for test in SHAPE_TESTS if test.name == name)
