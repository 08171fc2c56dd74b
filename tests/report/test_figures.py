from collections.abc import Callable

import numpy as np
import pytest

from shapespace.errors import InputError
from shapespace.report import figures
from shapespace.types import Mesh

MakeHead = Callable[..., Mesh]


def scans(z: np.ndarray, expression: str, stddev: np.ndarray) -> list[figures.Coefficients]:
    return [figures.Coefficients(f"{expression}{k}", expression, (k + 1) / 4, v * stddev, v) for k, v in enumerate(z)]


def test_lines_of_the_b_plot_pass_through_neutral_along_the_expressions() -> None:
    stddev, neutral_z = np.array([30.0, 8.0, 2.0]), np.array([0.5, -1.0, 0.2])
    direction = np.array([1.0, -2.0, 0.5])
    points = neutral_z + np.arange(1, 5)[:, None] * direction
    figure = figures.b_plane(
        scans(points, "fear", stddev), title="t", neutral_b=neutral_z * stddev, neutral_z=neutral_z
    )
    line = next(line for line in figure.axes[0].lines if len(line.get_xdata()) == 2)
    ends = np.stack([line.get_xdata(), line.get_ydata()], axis=1).astype(float)
    np.testing.assert_allclose(ends[0], (neutral_z * stddev)[:2], atol=1e-9)
    step = ends[1] - ends[0]
    np.testing.assert_allclose(step / step[0], (direction * stddev)[:2] / (direction * stddev)[0])


def test_without_a_neutral_face_no_lines_are_drawn() -> None:
    stddev = np.ones(3)
    figure = figures.b_plane(
        scans(np.random.default_rng(0).normal(size=(4, 3)), "fear", stddev), title="t", neutral_b=None, neutral_z=None
    )
    assert not [line for line in figure.axes[0].lines if len(line.get_xdata()) == 2]


def test_the_spectrum_names_the_modes_for_each_share() -> None:
    cumulative = np.array([0.6, 0.9, 0.96, 0.985, 0.9875])
    figure = figures.spectrum_figure(cumulative, title="t")
    text = figure.axes[0].texts[0].get_text()
    assert text.split("\n") == [
        "90 %: 2 modes",
        "95 %: 3 modes",
        "98 %: 4 modes",
        "98.5 %: 4 modes",
        "99 %: more than 5 modes",
    ]


def test_thresholds_state_the_share_of_vertices_within_them(head: MakeHead) -> None:
    mesh = head()
    far = np.full(len(mesh.vertices), 3.0)
    far[: len(far) // 4] = 9.0
    same = dict.fromkeys(figures.STAGE_TITLES, mesh)
    distances = dict.fromkeys(figures.STAGE_TITLES, far)
    figure = figures.threshold_figure([figures.StagedFit("a", mesh, same, distances, distances)], title="t")
    captions = [text.get_text() for text in figure.texts]
    for wanted in ("≤ 2 mm: 0 %", "≤ 4 mm: 75 %", "≤ 8 mm: 75 %", "≤ 10 mm: 100 %"):
        assert wanted in captions
    shown = [np.asarray(axes.images[0].get_array())[130:150, 100:118] for axes in figure.axes]
    blue = [picture[..., 2].mean() > picture[..., 0].mean() for picture in shown]
    assert blue[-1] and not blue[0]


def test_a_share_just_below_all_is_not_called_all() -> None:
    assert figures._percent(1.0) == "100 %"
    assert figures._percent(0.99999) == "99.9 %"
    assert figures._percent(0.5) == "50 %"


def test_histograms_count_every_point_even_when_all_distances_are_zero_or_none_are_counted(head: MakeHead) -> None:
    mesh = head()
    same = dict.fromkeys(figures.STAGE_TITLES, mesh)
    zero = {stage: np.zeros(len(mesh.vertices)) for stage in figures.STAGE_TITLES}
    none = {stage: np.zeros(0) for stage in figures.STAGE_TITLES}
    figure = figures.distance_histograms(figures.StagedFit("a", mesh, same, zero, none), title="t")
    for axes in figure.axes:
        assert sum(patch.get_data().values.sum() for patch in axes.patches[:1]) == pytest.approx(100.0)
    assert len(figures.encode_webp(figure)[0]) > 1000


def test_labels_with_dollars_backslashes_and_rare_scripts_are_drawn_as_they_are(head: MakeHead) -> None:
    mesh = head(6)
    figure = figures.faces_grid([mesh], ["a $x^ \\frac $ \u4f60\n<b>"], title="$\\bad{")
    data, size = figures.encode_webp(figure)
    assert len(data) > 500 and min(size) > 100


def test_pictures_are_shown_pixel_for_pixel(head: MakeHead) -> None:
    figure = figures.faces_grid([head(6)] * 5, list("abcde"), title="t", columns=3)
    sizes = {
        (round(axes.get_position().width * figure.get_figwidth() * figure.dpi),
         round(axes.get_position().height * figure.get_figheight() * figure.dpi))
        for axes in figure.axes
    }  # fmt: skip
    assert sizes == {(280, 360)} and len(figure.axes) == 5


def test_a_grid_without_faces_is_refused() -> None:
    with pytest.raises(InputError, match="0 meshes"):
        figures.faces_grid([], [], title="Nobody")


def test_scans_without_triangles_are_drawn_as_points(head: MakeHead) -> None:
    mesh = head()
    cloud = Mesh(mesh.vertices)
    same = dict.fromkeys(figures.STAGE_TITLES, mesh)
    zero = {stage: np.zeros(len(mesh.vertices)) for stage in figures.STAGE_TITLES}
    figure = figures.portrait_figure([figures.StagedFit("a", cloud, same, zero, zero)], ["a"], title="t")
    assert (np.asarray(figure.axes[0].images[0].get_array()) < 250).any()
