"""Pictures in two columns end at about the same height."""

import pytest

from shapespace.report.blocks.blocks import Cell, Figure, Group, Head, Image, Table
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


@pytest.mark.parametrize(
    ("cells", "texts"),
    [
        ([Cell("25.4", 25.4), Cell("62.6", 62.61), Cell("88", 87.99)], ["25.4", "62.6", "88.0"]),
        ([Cell("0.79", 0.794), Cell("−13.8", -13.81), Cell("105", 105.2)], ["0.79", "−13.81", "105.20"]),
        ([Cell("-0.608", -0.608), Cell("12", 12.04), Cell("–", float("nan"))], ["-0.608", "12.040", "–"]),
        ([Cell("2.5e-07", 2.5e-7), Cell("0.00012", 0.00012), Cell("25", 25.0)], ["2.5e-07", "0.00012", "25.000"]),
        ([Cell("3", 3.0), Cell("1,200", 1200.0)], ["3", "1,200"]),
        ([Cell("12", None), Cell("0.853", None)], ["12", "0.853"]),
        ([Cell("12.5 %", 0.125), Cell("3 %", 0.03)], ["12.5 %", "3 %"]),
        ([], []),
    ],
)
def test_numbers_of_a_column_have_equal_decimals(cells: list[Cell], texts: list[str]) -> None:
    table = Table([Head("x")], [[cell] for cell in cells], "")
    assert [row[0].text for row in table.aligned_rows] == texts
