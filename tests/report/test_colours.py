import itertools

import numpy as np
import pytest

from shapespace.errors import InputError
from shapespace.report.render import palette as colours

# Machado, Oliveira and Fernandes 2009: what those without one kind of cone see, in linear RGB.
BLIND = {
    "protanopia": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "deuteranopia": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
    "tritanopia": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]],
}
KINDS = [None, *BLIND]


def seen(srgb: np.ndarray, kind: str | None) -> np.ndarray:
    if kind is None:
        return colours.oklab(srgb)
    linear = np.clip(np.asarray(srgb) ** 2.2 @ np.array(BLIND[kind]).T, 0, 1)
    return colours.oklab(linear ** (1 / 2.2))


@pytest.mark.parametrize("kind", KINDS)
def test_the_sequential_map_darkens_all_the_way_for_every_reader(kind: str | None) -> None:
    lightness = seen(colours.SEQUENTIAL, kind)[:, 0]
    assert (np.diff(lightness) < 0).all() and lightness[0] - lightness[-1] > 0.6


@pytest.mark.parametrize("kind", KINDS)
def test_the_arms_of_the_diverging_map_are_told_apart_by_every_reader(kind: str | None) -> None:
    lab = seen(colours.DIVERGING, kind)
    apart = np.linalg.norm(lab - lab[::-1], axis=1)[:128]
    assert (apart[:100] > 0.08).all()


def test_the_arms_of_the_diverging_map_are_equally_light_and_its_middle_is_the_lightest() -> None:
    lightness = colours.oklab(colours.DIVERGING)[:, 0]
    np.testing.assert_allclose(lightness, lightness[::-1], atol=0.03)
    assert (np.diff(lightness[:128]) > 0).all() and lightness[127] > 0.93


@pytest.mark.parametrize("name", ["SEQUENTIAL", "DIVERGING"])
def test_equal_steps_of_a_map_look_equal(name: str) -> None:
    colour_map = getattr(colours, name)
    assert colour_map.shape == (256, 3) and colour_map.min() >= 0 and colour_map.max() <= 1
    step = np.linalg.norm(np.diff(colours.oklab(colour_map), axis=0), axis=1)
    step = np.delete(step, 127) if name == "DIVERGING" else step
    assert step.max() < 1.35 * step.min()


@pytest.mark.parametrize("kind", KINDS)
def test_regions_and_categories_are_told_apart_by_every_reader(kind: str | None) -> None:
    regions = seen(np.array(list(colours.REGION_COLOURS.values())), kind)
    for (a, one), (b, other) in itertools.combinations(enumerate(regions), 2):
        assert np.linalg.norm(one - other) > 0.06, (a, b)
    categories = seen(np.array(colours.CATEGORIES), kind)
    assert min(np.linalg.norm(a - b) for a, b in itertools.combinations(categories, 2)) > 0.04
    parts = seen(np.array(colours.PARTS), kind)
    assert min(np.linalg.norm(a - b) for a, b in itertools.combinations(parts[:7], 2)) > 0.085
    assert min(np.linalg.norm(a - b) for a, b in itertools.combinations(parts, 2)) > 0.065


def test_the_maps_cannot_be_changed_by_accident() -> None:
    with pytest.raises(ValueError, match="read-only"):
        colours.SEQUENTIAL[0] = 0


def test_a_list_for_javascript_goes_from_the_first_colour_to_the_last() -> None:
    listed = colours.as_list(colours.DIVERGING, 5)
    np.testing.assert_allclose(listed[0], colours.DIVERGING[0], atol=1e-4)
    np.testing.assert_allclose(listed[-1], colours.DIVERGING[-1], atol=1e-4)
    assert len(colours.as_list(colours.SEQUENTIAL)) == 64 and isinstance(listed[0][0], float)
    assert colours.as_hex((1.0, 0.5, 0.0)) == "#ff8000"


@pytest.mark.parametrize(("colour_map", "n"), [(np.zeros((4, 3)), 1), (np.zeros(5), 4), (np.zeros((4, 4)), 4)])
def test_what_is_no_map_is_refused(colour_map: np.ndarray, n: int) -> None:
    with pytest.raises(InputError, match="colour map"):
        colours.as_list(colour_map, n)
