"""Pictures in two columns end at about the same height."""

import pytest

from shapespace.report.blocks.blocks import Figure, Group, Image
from shapespace.report.blocks.sections import in_columns


def picture(height: int) -> Figure:
    return Figure(Image(b"", (960, height), ""), f"{height}")


@pytest.mark.parametrize("heights", [[1500, 500, 480], [400, 800, 500, 1400, 600, 300, 700, 900], [900, 100]])
def test_columns_are_as_even_as_they_can_be_and_keep_the_order(heights: list[int]) -> None:
    made = in_columns(*map(picture, heights))
    assert isinstance(made, Group) and len(made.body) == 2
    sides: list[list[int]] = []
    for column in made.body:
        assert isinstance(column, Group)
        sides.append([int(block.caption) for block in column.body if isinstance(block, Figure)])
    assert sorted(sides[0] + sides[1]) == sorted(heights) and sides[0][0] == heights[0]
    for side in sides:
        at = [heights.index(height) for height in side]
        assert at == sorted(at)
    # No picture can change sides and leave a smaller hole.
    hole = abs(sum(sides[0]) - sum(sides[1]))
    captions = 2 * 0.14 * 960
    assert all(
        abs(sum(sides[0]) - sum(sides[1]) - 2 * sign * one) >= hole - 2 * captions
        for sign, side in ((1, sides[0][1:]), (-1, sides[1]))
        for one in side
    )


def test_a_single_picture_has_the_whole_width() -> None:
    one = picture(300)
    assert in_columns(one) is one
