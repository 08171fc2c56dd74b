"""False positives and power of the tests of parts and of their relative pose, by simulation."""

import numpy as np
import pytest

from jointed_parts import knees, sexes
from shapespace.cohort.cohort import Cohort
from shapespace.statistics.compare_shapes import CompareConfig, compare
from shapespace.types import FloatArray

pytest.importorskip("formulaic", reason="the extra `statistics` is not installed")

PARTS = {"femur": 24, "tibia": 20}
STUDIES, SUBJECTS, LEVEL = 400, 16, 0.05


def p_values(studies: int, **effect: float) -> FloatArray:
    """Return p (studies, 5) of all together, femur, tibia and relative pose, and the least p of all parts."""
    found: list[list[float]] = []
    for study in range(studies):
        subjects = knees(SUBJECTS, 1000 + study, parts=PARTS, **effect)
        columns = {"sex": sexes(SUBJECTS)}
        cohort = Cohort.of_shapes(np.stack([mesh.vertices for mesh in subjects]), columns, gauge="form", parts=PARTS)
        result = compare(cohort, "~ sex", CompareConfig(permutations=200, maps=False, seed=study))
        p = [test.test.p for test in result.part_tests]
        found.append([result.tests[0].p, *p, min(test.p_family for test in result.part_tests)])
    return np.array(found)


@pytest.mark.long
def test_groups_that_do_not_differ_are_found_to_differ_in_five_percent_of_studies() -> None:
    """Two groups of 8 knees that bend by 0 to 40 degrees; the interval is that of a binomial share, 99.8 %."""
    shares = (p_values(STUDIES) <= LEVEL).mean(axis=0)
    most = LEVEL + 3.1 * np.sqrt(LEVEL * (1 - LEVEL) / STUDIES)
    assert (shares <= most).all(), shares
    assert (shares[:4] >= 2 * LEVEL - most).all(), shares


@pytest.mark.long
def test_differences_of_pose_and_of_a_part_are_found_where_they_are() -> None:
    bent = (p_values(60, bend=20.0) <= LEVEL).mean(axis=0)
    assert bent[3] > 0.7 and max(bent[1:3]) < 0.2, bent
    wide = (p_values(60, widen=0.2) <= LEVEL).mean(axis=0)
    assert wide[2] > 0.7 and max(wide[1], wide[3]) < 0.2, wide
