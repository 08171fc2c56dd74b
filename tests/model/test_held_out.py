"""What shapes left out have along modes made without them: what brute force says, whole groups at a time."""

import numpy as np
import pytest

from shapespace.model.new_shapes import held_out_shapes


def by_brute_force(data: np.ndarray, groups: list[str], modes: int, centred: bool) -> tuple[np.ndarray, float]:
    squares, left = np.zeros(modes), 0.0
    names = list(dict.fromkeys(groups))
    for part in range(min(25, len(names))):
        out = np.array([names.index(g) % 25 == part for g in groups])
        mean = data[~out].mean(axis=0) if centred else np.zeros(data.shape[1])
        basis = np.linalg.svd(data[~out] - mean, full_matrices=False)[2][:modes]
        along = (data[out] - mean) @ basis.T
        squares += (along**2).sum(axis=0)
        left += ((data[out] - mean - along @ basis) ** 2).sum()
    return squares, left / len(data)


@pytest.mark.parametrize("people", [9, 60])
@pytest.mark.parametrize("centred", [True, False])
def test_they_are_those_of_leaving_a_part_of_the_groups_out(centred: bool, people: int) -> None:
    rng = np.random.default_rng(3)
    data = rng.standard_normal((2 * people, 40)) * 1.2 ** -np.arange(40) + 5.0
    groups = [f"g{k // 2}" for k in range(len(data))]
    found = held_out_shapes(data @ data.T, groups, 12, centred=centred)
    wanted, wanted_left = by_brute_force(data, groups, 12, centred)
    assert np.allclose(found.squares, wanted, rtol=1e-6) and (found.seen == 1).all()
    assert found.left_mm2 == pytest.approx(wanted_left, rel=1e-6)
    assert (found.shapes, found.groups) == (len(data), people)


def test_modes_that_are_not_there_without_a_part_are_seen_less() -> None:
    data = np.random.default_rng(5).standard_normal((6, 30))
    found = held_out_shapes(data @ data.T, [str(k) for k in range(6)], 5, centred=True)
    assert found.seen.tolist() == [1, 1, 1, 1, 0] and found.squares[4] == 0


def test_of_one_group_nothing_is_seen() -> None:
    data = np.random.default_rng(5).standard_normal((4, 30))
    found = held_out_shapes(data @ data.T, ["one"] * 4, 3, centred=True)
    assert not found.seen.any() and not found.squares.any() and found.left_mm2 == 0
