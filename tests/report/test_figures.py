import io
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import BboxImage
from PIL import Image

from shapespace.errors import InputError
from shapespace.fit.fit_scan import FitConfig, fit_scan
from shapespace.fit.iteration_state import UNSEEN
from shapespace.model.shape_model import ShapeModel
from shapespace.report import figures
from shapespace.report.figures import draw
from shapespace.report.inputs.saved_fits import Moment, StagedFit
from shapespace.types import Mesh, Similarity
from synthetic_shapes import blob_model, raw_scan

MakeHead = Callable[..., Mesh]
NASTY = "a $x^ \\frac $ 你\x00\x1b[31m\n<b>\u202e" + "wide " * 40 + "W" * 300


def make_fit(head: Mesh, *, dense: bool = False, cloud: bool = False, modes: int = 4, **changes: object) -> StagedFit:
    """A fit of known distances: 20 mm off before, 4 mm after phase 1, within 1 mm at the end; some vertices unseen."""
    rng = np.random.default_rng(0)
    stages = {"before": 20.0, "initial": 4.0, "final": 1.0} | ({"dense": 0.1} if dense else {})
    V = len(head.vertices)
    backward = {stage: rng.normal(0, size, V) for stage, size in stages.items()}
    for values in backward.values():
        values[: V // 5] = np.nan
    z = rng.normal(0, 1, modes)
    regions = (np.arange(V) // 40 % 4).astype(np.int32)
    fit = StagedFit(
        name="one",
        label="one",
        status="converged",
        reason="It stood still.",
        scan=Mesh(head.vertices * 1.01, None if cloud else head.faces),
        surfaces={stage: head.with_vertices(head.vertices + np.array([size, 0, 0])) for stage, size in stages.items()},
        model_to_scan_mm={
            stage: np.where(regions == UNSEEN, np.nan, rng.uniform(-size, size, V)) for stage, size in stages.items()
        },
        scan_to_model_mm=backward,
        regions=regions,
        b=z * np.linspace(40, 10, modes),
        z=z,
        b_stddev=np.full(modes, 2.0),
        shrinkage=np.linspace(1, 0.2, modes),
        history=tuple(Moment(1 + k // 5, k % 5, 20.0 / (k + 1), z, Similarity.identity()) for k in range(10)),
    )
    return replace(fit, **changes)


def decoded(figure: Figure) -> np.ndarray:
    with draw.without_glyph_warnings():
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
    return np.asarray(canvas.buffer_rgba())[:, :, :3]


def words(figure: Figure) -> str:
    found = [text.get_text() for text in figure.texts]
    for axes in figure.axes:
        found += [text.get_text() for text in axes.texts]
        legend = axes.get_legend()
        found += [text.get_text() for text in legend.get_texts()] if legend else []
    return "\n".join(found).replace(r"\$", "$")


def pictures(figure: Figure) -> list[np.ndarray]:
    return [np.asarray(panel.get_array()) for panel in figure.artists if isinstance(panel, BboxImage)]


OF_ONE_FIT = [
    figures.stages_figure,
    figures.overlay_figure,
    figures.signed_maps,
    figures.threshold_figure,
    figures.distance_histograms,
    figures.history_figure,
    figures.coefficients_figure,
    figures.regions_figure,
]


@pytest.fixture(scope="module")
def model() -> ShapeModel:
    return blob_model()


@pytest.mark.parametrize("draw_it", OF_ONE_FIT)
@pytest.mark.parametrize("kind", [{}, {"dense": True, "cloud": True}, {"modes": 1}])
def test_every_figure_of_a_fit_is_drawn_for_every_kind_of_fit(
    head: MakeHead, draw_it: Callable[..., Figure], kind: dict[str, bool]
) -> None:
    picture = decoded(draw_it(make_fit(head(10), **kind)))
    assert picture.shape[1] == draw.WIDTH
    assert (picture < 250).any(axis=2).mean() > 0.02


@pytest.mark.parametrize("draw_it", OF_ONE_FIT)
def test_labels_that_are_long_or_hold_what_cannot_be_printed_stay_within_the_figure(
    head: MakeHead, draw_it: Callable[..., Figure], monkeypatch: pytest.MonkeyPatch
) -> None:
    def blank(count: int, size: tuple[int, int]) -> list[np.ndarray]:
        return [np.full((size[1], size[0], 3), 255, dtype=np.uint8)] * count

    monkeypatch.setattr(figures.fit_figures, "render", lambda *_, size, **__: blank(1, size)[0])
    monkeypatch.setattr(figures.fit_figures, "render_series", lambda pictures, size, **_: blank(len(pictures), size))
    picture = decoded(draw_it(make_fit(head(6), label=NASTY)))
    assert (picture[:, -2:] == 255).all() and (picture[:, :2] == 255).all() and (picture < 128).any()


def test_a_result_goes_into_a_figure_as_a_notebook_would_do_it(model: ShapeModel) -> None:
    result = fit_scan(model, raw_scan(np.full(5, 0.3)).scan, FitConfig(method="paper", max_iterations=3))
    figure = figures.signed_maps(StagedFit.of(model, result))
    assert "From the scan to the model" in words(figure)
    assert len(pictures(figure)) == 6


def test_stages_come_in_order_with_their_mean_distances(head: MakeHead) -> None:
    fit = make_fit(head(8), dense=True)
    told = words(figures.stages_figure(fit))
    places = [told.index(word) for word in ("\nscan\n", "\nbefore", "\nphase 1", "\nphase 2", "\ndense")]
    assert places == sorted(places)
    for stage in fit.surfaces:
        assert draw.mm(float(np.nanmean(np.abs(fit.model_to_scan_mm[stage])))) in told


@pytest.mark.parametrize("draw_it", [figures.stages_figure, figures.overlay_figure])
def test_a_start_that_was_near_is_not_cut_and_one_far_away_makes_nothing_small(
    head: MakeHead, draw_it: Callable[..., Figure]
) -> None:
    fit = make_fit(head(10))
    for panel in pictures(draw_it(fit)):
        assert (panel[:, [0, -1]] == 255).all()
    final = fit.surfaces["final"]
    away = final.with_vertices(final.vertices + np.array([5000.0, 0, 0]))
    far, near = (
        (pictures(draw_it(one))[2] < 250).any(axis=2).mean()
        for one in (replace(fit, surfaces={**fit.surfaces, "before": away}), fit)
    )
    assert far > near


def test_a_single_stage_is_drawn_from_both_sides_next_to_each_other(head: MakeHead) -> None:
    fit = make_fit(head(10))
    alone = replace(fit, surfaces={"final": fit.surfaces["final"]})
    figure = figures.overlay_figure(alone)
    front, side = pictures(figure)
    assert front.shape == side.shape and 2 * front.shape[1] <= draw.WIDTH
    assert (front != side).any()
    assert words(figure).count("phase 2") == 2


def test_distances_in_front_and_behind_have_opposite_colours_on_one_scale(head: MakeHead) -> None:
    mesh = head(10)
    for sign, channel in ((1.0, 0), (-1.0, 2)):
        distances = {stage: np.full(len(mesh.vertices), 2.0 * sign) for stage in ("before", "initial", "final")}
        fit = replace(make_fit(mesh), model_to_scan_mm=distances, scan_to_model_mm=distances)
        figure = figures.signed_maps(fit, limit_mm=2.5)
        for image in pictures(figure)[:6]:
            middle = image[image.shape[0] // 2, image.shape[1] // 2].astype(int)
            assert middle[channel] > middle[2 - channel] + 40
        bar = next(axes for axes in figure.axes if "mm" not in axes.get_label() and axes.get_xlim() == (-2.5, 2.5))
        assert bar is not None
    assert "mm" in words(figure)


def test_points_beyond_the_rim_are_grey_and_their_share_is_told(head: MakeHead) -> None:
    mesh = head(10)
    nothing = {stage: np.full(len(mesh.vertices), np.nan) for stage in ("before", "initial", "final")}
    figure = figures.signed_maps(replace(make_fit(mesh), scan_to_model_mm=nothing))
    assert "on the scan: beyond the model's rim, not counted (100 %)" in words(figure) and "no point counted" in words(
        figure
    )
    image = pictures(figure)[3].astype(int)
    middle = image[image.shape[0] // 2, image.shape[1] // 2]
    assert np.ptp(middle) < 12 and middle.mean() < 220


def test_a_stage_that_the_fit_lacks_is_refused(head: MakeHead) -> None:
    with pytest.raises(InputError, match="no stage 'dense'; choose one of before, initial, final"):
        figures.signed_maps(make_fit(head(6)), "dense")
    with pytest.raises(InputError, match="must be positive"):
        figures.signed_maps(make_fit(head(6)), limit_mm=0.0)


def test_thresholds_state_the_share_of_vertices_within_them(head: MakeHead) -> None:
    mesh = head()
    far = np.full(len(mesh.vertices), 3.0)
    far[: len(far) // 4] = -9.0
    distances = dict.fromkeys(("before", "initial", "final"), far)
    figure = figures.threshold_figure([replace(make_fit(mesh), model_to_scan_mm=distances)])
    told = [text.get_text() for text in figure.texts]
    shares = told[told.index("2 mm") : told.index("2 mm") + 10]
    assert dict(zip(shares[::2], shares[1::2], strict=True)) == {
        "2 mm": "0 %", "4 mm": "75 %", "6 mm": "75 %", "8 mm": "75 %", "10 mm": "100 %",
    }  # fmt: skip
    middles = [image[image.shape[0] // 2, image.shape[1] // 2].astype(int) for image in pictures(figure)]
    blue = [middle[2] > middle[0] for middle in middles]
    assert blue[-1] and not blue[0]


def test_regions_are_drawn_in_their_own_colours_with_nothing_between(head: MakeHead) -> None:
    mesh = head()
    half = (mesh.vertices[:, 1] > 0).astype(np.int32) * 3
    figure = figures.regions_figure(make_fit(mesh, regions=half))
    told = words(figure)
    assert f"followed ({draw.percent(float((half == 0).mean()))})" in told
    assert "not shown by the scan (50 %)" in told and "rejected" not in told and "border (" not in told
    # Codes 0 and 3: the colours of 1 and 2, red and yellow, appear nowhere along the seam.
    image = pictures(figure)[1].astype(int)
    assert not ((image[..., 0] > image[..., 2] + 40) & (image[..., 0] > 120)).any()


def test_histograms_count_every_point_even_when_all_distances_are_zero_or_none_are_counted(head: MakeHead) -> None:
    mesh = head(8)
    zero = {stage: np.zeros(len(mesh.vertices)) for stage in ("before", "initial", "final")}
    none = {stage: np.full(len(mesh.vertices), np.nan) for stage in zero}
    figure = figures.distance_histograms(replace(make_fit(mesh), model_to_scan_mm=zero, scan_to_model_mm=none))
    assert len(figure.axes) == 3
    for axes in figure.axes:
        total = sum(abs(patch.get_data().values.sum()) for patch in axes.patches if patch.get_fill())
        assert total == pytest.approx(100.0)
    assert words(figure).count("no point counted") == 3


def test_a_fit_without_iterations_says_so(head: MakeHead) -> None:
    assert "No iteration was saved." in words(figures.history_figure(make_fit(head(6), history=())))
    flat = tuple(replace(moment, rms_mm=0.0) for moment in make_fit(head(6)).history)
    decoded(figures.history_figure(make_fit(head(6), history=flat)))


def test_the_interval_of_a_coefficient_is_in_the_units_of_its_bar(head: MakeHead) -> None:
    z, stddev = np.array([1.0, -2.0, 0.0]), np.array([30.0, 10.0, 5.0])
    fit = make_fit(head(6), modes=3, z=z, b=z * stddev, b_stddev=0.1 * stddev)
    np.testing.assert_allclose(figures.fit_figures.z_stddev(fit)[:2], 0.1)
    figure = figures.coefficients_figure(fit)
    (bars,) = figure.axes[0].collections[-1:]
    ends = np.array([segment[:, 1] for segment in bars.get_segments()])
    np.testing.assert_allclose(ends, z[:2, None] + [-0.196, 0.196])


def test_a_population_of_another_model_is_refused(head: MakeHead) -> None:
    with pytest.raises(InputError, match="must have 4 coefficients"):
        figures.coefficients_figure(make_fit(head(6)), population=np.zeros((10, 3)))


@pytest.mark.parametrize("modes", [1, 5])
def test_every_figure_of_a_model_is_drawn(model: ShapeModel, modes: int) -> None:
    small = model.truncate(modes)
    for figure in (figures.mean_figure(small), figures.modes_figure(small), figures.spectrum_figure(small)):
        picture = decoded(figure)
        assert picture.shape[1] == draw.WIDTH and (picture < 250).any(axis=2).mean() > 0.02
    assert len(pictures(figures.modes_figure(small, modes=9))) == 4 * modes
    told = words(figures.modes_figure(small, modes=1)) + words(figures.spectrum_figure(small))
    assert ("Effect of the one mode" in told and "in the one mode" in told) == (modes == 1)
    assert ("the first of 5 modes on" in told) == (modes == 5)
    assert modes == 1 or "the first 3 of 5 modes on" in words(figures.modes_figure(small, modes=3)).replace("\n", " ")
    decoded(figures.modes_figure(replace(small, faces=None), modes=1))


def test_a_mode_moves_the_mean_by_its_standard_deviations_to_both_sides(model: ShapeModel) -> None:
    move = figures.model_figures.mode_displacement(model, 1, 3.0)
    np.testing.assert_allclose(np.linalg.norm(move), 3 * model.stddev[1])
    assert draw.mm(float(np.linalg.norm(move, axis=1).max())) in words(figures.modes_figure(model))
    low, middle, high, _ = pictures(figures.modes_figure(model, modes=1))[:4]
    assert (low != middle).any() and (high != middle).any() and (low != high).any()
    with pytest.raises(InputError, match="no mode with index 99"):
        figures.mode_animation(model, 99)
    with pytest.raises(InputError, match="nothing to draw"):
        figures.modes_figure(model, modes=0)


def test_an_animation_sways_from_one_end_to_the_other_and_back(model: ShapeModel) -> None:
    data = figures.mode_animation(model, 0, frames=8, width=120)
    with Image.open(io.BytesIO(data)) as film:
        assert film.n_frames == 8 and film.info["loop"] == 0
        shots = []
        for k in range(8):
            film.seek(k)
            shots.append(np.asarray(film.convert("RGB")).astype(int))
    apart = [np.abs(shot - shots[0]).mean() for shot in shots]
    assert np.argmax(apart) == 4
    np.testing.assert_allclose(apart[1:4], apart[:4:-1], atol=3.0)
    with pytest.raises(InputError, match="4 frames"):
        figures.mode_animation(model, 0, frames=2)


def test_the_spectrum_names_the_modes_for_each_share(model: ShapeModel) -> None:
    stddev = np.sqrt([60.0, 31.0, 5.0, 2.5, 0.4])
    told = words(figures.spectrum_figure(replace(model, stddev=stddev, total_variance=100.0)))
    for line in ("90 %: 2 modes", "95 %: 3 modes", "98 %: 4 modes", "99 %: more than 5 modes"):
        assert line in told


def test_the_quality_of_a_model_shows_what_is_there_and_refuses_what_is_none() -> None:
    figure = figures.quality_figure({"compactness": [0.5, 0.9, 1.0], "specificity": {"mean": [1, 2], "stddev": [0, 1]}})
    assert len(figure.axes) == 2
    decoded(figure)
    for wrong in (
        {},
        {"compactness": None},
        {"compactness": "abc"},
        {"generalisation": {"mean": [1], "modes": [1, 2]}},
    ):
        with pytest.raises(InputError):
            figures.quality_figure(wrong)


@pytest.mark.parametrize("count", [1, 400])
def test_error_curves_reach_their_quantiles(head: MakeHead, count: int) -> None:
    fit = make_fit(head(6))
    figure = figures.error_curves([fit] * count)
    far = np.abs(fit.model_to_scan_mm["final"])
    assert f"50 % within {draw.mm(float(np.quantile(np.tile(far, count), 0.5)))}" in words(figure)
    line = figure.axes[0].lines[0]
    at, share = np.asarray(line.get_xdata(), dtype=float), np.asarray(line.get_ydata(), dtype=float)
    for limit in (0.2, 0.5, 0.9):
        assert share[at <= limit][-1] == pytest.approx(100 * (far <= limit).mean(), abs=0.5)
    with pytest.raises(InputError, match="without fits"):
        figures.error_curves([])
    with pytest.raises(InputError, match="'dense'"):
        figures.error_curves([fit], stage="dense")


def nothing_seen(fit: StagedFit) -> StagedFit:
    none = {stage: np.full(len(fit.regions), np.nan) for stage in fit.surfaces}
    return replace(
        fit, model_to_scan_mm=none, scan_to_model_mm=none, regions=np.full(len(fit.regions), UNSEEN, dtype=np.int32)
    )


OF_MANY_FITS = [
    figures.portrait_figure,
    figures.distance_maps,
    figures.aligned_grid,
    figures.error_curves,
    figures.threshold_figure,
]


@pytest.mark.parametrize("cloud", [False, True])
@pytest.mark.parametrize("draw_it", [*OF_ONE_FIT, *OF_MANY_FITS])
def test_a_fit_of_which_the_scan_shows_nothing_is_drawn_without_a_number(
    head: MakeHead, draw_it: Callable[..., Figure], cloud: bool
) -> None:
    fit = nothing_seen(make_fit(head(8), dense=True, cloud=cloud))
    figure = draw_it([fit] if draw_it in OF_MANY_FITS else fit)
    decoded(figure)
    told = words(figure)
    assert "nan" not in told and "0.00 mm" not in told


def test_curves_leave_out_a_fit_of_which_nothing_is_seen(head: MakeHead) -> None:
    fit = make_fit(head(8))
    alone, both = figures.error_curves([fit]), figures.error_curves([nothing_seen(fit), fit])
    assert len(both.axes[0].lines) == len(alone.axes[0].lines)
    assert "No vertex of a model is shown" in words(figures.error_curves([nothing_seen(fit)]))


@pytest.mark.parametrize(
    "draw_it", [figures.signed_maps, figures.threshold_figure, figures.portrait_figure, figures.distance_maps]
)
def test_vertices_that_the_scan_does_not_show_are_grey_and_the_key_says_so(
    head: MakeHead, draw_it: Callable[..., Figure]
) -> None:
    fit = make_fit(head(10))
    argument = [fit] if draw_it in OF_MANY_FITS else fit
    assert "not shown by the scan" in words(draw_it(argument))
    seen = replace(fit, model_to_scan_mm={stage: np.nan_to_num(d) for stage, d in fit.model_to_scan_mm.items()})
    told = words(draw_it([seen] if draw_it in OF_MANY_FITS else seen))
    assert "not shown by the scan" not in told

    def greys(figure: Figure) -> int:
        count = 0
        for image in pictures(figure):
            pixels = image.astype(int)
            count += int(((np.ptp(pixels, axis=2) < 14) & (pixels.max(axis=2) < 200)).sum())
        return count

    assert greys(draw_it(argument)) > 1.3 * greys(draw_it([seen] if draw_it in OF_MANY_FITS else seen)) + 100


def test_shares_means_and_histograms_count_only_what_the_scan_shows(head: MakeHead) -> None:
    mesh = head()
    far = np.full(len(mesh.vertices), np.nan)
    far[:100], far[100:200] = 3.0, -9.0
    distances = dict.fromkeys(("before", "initial", "final"), far)
    fit = replace(make_fit(mesh), model_to_scan_mm=distances)
    told = words(figures.threshold_figure(fit))
    assert "4 mm\n50 %\n6 mm\n50 %" in told and "vertices that the scan shows" in told
    for figure in (figures.stages_figure(fit), figures.overlay_figure(fit), figures.distance_maps([fit])):
        assert "6.00 mm" in words(figure)
        assert "of the vertices that the scan shows" in words(figure).replace("\n", " ")
    figure = figures.distance_histograms(fit)
    total = sum(patch.get_data().values.clip(0).sum() for patch in figure.axes[0].patches if patch.get_fill())
    assert total == pytest.approx(100.0)
    assert "mean 6.00 mm" in words(figure) and "vertices that the scan shows" in words(figure).replace("\n", " ")


SIGNS = "scan inside (−) or outside (+) of the model"


@pytest.mark.parametrize("draw_it", [figures.signed_maps, figures.portrait_figure])
def test_signs_are_named_in_one_way_and_those_of_distances_to_points_are_not_drawn(
    head: MakeHead, draw_it: Callable[..., Figure]
) -> None:
    mesh = head(10)

    def drawn(sign: float, cloud: bool) -> Figure:
        distances = {stage: np.full(len(mesh.vertices), 2.0 * sign) for stage in ("before", "initial", "final")}
        fit = replace(make_fit(mesh, cloud=cloud), model_to_scan_mm=distances, scan_to_model_mm=distances)
        return draw_it([fit] if draw_it in OF_MANY_FITS else fit)

    surface, cloud = drawn(1.0, False), drawn(1.0, True)
    assert SIGNS in words(surface) and "distance to the points" not in words(surface)
    assert SIGNS not in words(cloud) and "distance to the points" in words(cloud)

    def alike(one: Figure, other: Figure) -> bool:
        return all((a == b).all() for a, b in zip(pictures(one), pictures(other), strict=True))

    assert alike(cloud, drawn(-1.0, True)) and not alike(surface, drawn(-1.0, False))


def test_rows_of_surfaces_and_points_share_a_scale_without_signs(head: MakeHead) -> None:
    told = words(figures.portrait_figure([make_fit(head(8)), make_fit(head(8), cloud=True)]))
    assert SIGNS not in told and "distance from the model to the scan (mm)" in told
    assert "That to a point cloud is to its points." in told.replace("\n", " ")
    assert "to the points" in figures.distance_histograms(make_fit(head(8), cloud=True)).axes[-1].get_xlabel()


def test_the_words_of_a_histogram_stand_clear_of_its_bars(head: MakeHead) -> None:
    figure = figures.distance_histograms(make_fit(head(10), dense=True))
    decoded(figure)
    for axes in figure.axes:
        up = axes.transData.inverted()
        bars = np.concatenate([patch.get_data().values for patch in axes.patches if patch.get_fill()])
        boxes = [up.transform(text.get_window_extent()) for text in axes.texts]
        assert len(boxes) == 2
        for box in boxes:
            low, high = sorted(box[:, 1])
            assert low > bars.max() or high < bars.min()


def test_a_first_bar_that_towers_is_explained(head: MakeHead) -> None:
    fit = make_fit(head(10))
    even = {stage: np.geomspace(0.1, 10.0, len(fit.regions)) for stage in fit.surfaces}
    fit = replace(fit, model_to_scan_mm=even, scan_to_model_mm=even)
    said = "The first bar contains all distances below"
    assert said not in words(figures.distance_histograms(fit))
    near = fit.model_to_scan_mm["final"].copy()
    near[: len(near) // 2] = 1e-5
    touching = replace(fit, model_to_scan_mm={**fit.model_to_scan_mm, "final": near})
    assert said in words(figures.distance_histograms(touching)).replace("\n", " ")


@pytest.mark.parametrize(("fall", "scale"), [(0.05, "log"), (0.9, "linear")])
def test_the_history_says_its_scale_and_its_ends_where_they_hide_nothing(
    head: MakeHead, fall: float, scale: str
) -> None:
    fit = make_fit(head(6))
    rms = np.linspace(10.0, 10.0 * fall, 10)
    history = tuple(replace(moment, rms_mm=float(v)) for moment, v in zip(fit.history, rms, strict=True))
    figure = figures.history_figure(replace(fit, history=history))
    decoded(figure)
    (axes,) = figure.axes
    assert axes.get_ylabel() == f"RMS distance (mm, {scale} scale)" and axes.get_yscale() == scale
    told = words(figure)
    assert f"ends at {draw.mm(float(rms[4]))}" in told and f"ends at {draw.mm(float(rms[9]))}" in told
    legend = axes.get_legend()
    assert legend is not None and not axes.texts
    assert legend.get_window_extent().y0 >= axes.get_window_extent().y1 - 1
    assert legend.get_window_extent().x1 <= draw.WIDTH


@pytest.mark.parametrize("modes", [1, 2, 4, 30])
def test_modes_are_counted_from_1_to_the_last_in_whole_numbers(head: MakeHead, model: ShapeModel, modes: int) -> None:
    drawn = [figures.coefficients_figure(make_fit(head(6), modes=modes)).axes[0]]
    drawn += figures.quality_figure({"compactness": [1.0] * modes, "specificity": [2.0] * modes}).axes
    if modes <= 5:
        drawn.append(figures.spectrum_figure(model.truncate(modes)).axes[0])
    for axes in drawn:
        ticks = list(axes.get_xticks())
        assert ticks[0] == 1 and ticks[-1] == modes and all(tick == round(tick) for tick in ticks)
        assert modes > 22 or len(ticks) == modes
        low, high = axes.get_xlim()
        assert low < 1 and high > modes and low + high == pytest.approx(1 + modes)
        assert high - low > 5
    title = words(figures.coefficients_figure(make_fit(head(6), modes=modes))).replace("\n", " ")
    assert ("its coefficient, with uncertainty" in title) == (modes == 1)


def scans(z: np.ndarray, expression: str, stddev: np.ndarray) -> list[figures.Coefficients]:
    return [figures.Coefficients(f"{expression}{k}", expression, (k + 1) / 4, v * stddev, v) for k, v in enumerate(z)]


def test_lines_of_the_b_plot_pass_through_neutral_along_the_expressions() -> None:
    stddev, neutral_z = np.array([30.0, 8.0, 2.0]), np.array([0.5, -1.0, 0.2])
    direction = np.array([1.0, -2.0, 0.5])
    points = neutral_z + np.arange(1, 5)[:, None] * direction
    neutral = figures.Coefficients("neutral", "", 0, neutral_z * stddev, neutral_z)
    figure = figures.b_plane(scans(points, "fear", stddev), neutral=neutral)
    line = next(line for line in figure.axes[0].lines if len(line.get_xdata()) == 2)
    ends = np.stack([line.get_xdata(), line.get_ydata()], axis=1).astype(float)
    np.testing.assert_allclose(ends[0], (neutral_z * stddev)[:2], atol=1e-9)
    step = ends[1] - ends[0]
    np.testing.assert_allclose(step / step[0], (direction * stddev)[:2] / (direction * stddev)[0])
    decoded(figures.b_space(scans(points, "fear", stddev), neutral=neutral))


def test_without_a_neutral_face_no_lines_are_drawn() -> None:
    points = scans(np.random.default_rng(0).normal(size=(4, 3)), "fear", np.ones(3))
    figure = figures.b_plane(points)
    assert not [line for line in figure.axes[0].lines if len(line.get_xdata()) == 2]


@pytest.mark.parametrize("labels", [[""], ["a", "b"], [f"$label_{k}" for k in range(20)]])
@pytest.mark.parametrize("modes", [1, 2, 6])
def test_coefficients_are_scattered_for_any_number_of_labels_and_modes(labels: list[str], modes: int) -> None:
    rng = np.random.default_rng(0)
    points = [scans(rng.normal(size=(3, modes)), label, np.ones(modes)) for label in labels]
    every = [point for some in points for point in some]
    figure = figures.scatter_matrix(every)
    assert (decoded(figure)[:, -1] == 255).all()
    told = words(figure) + "".join(text.get_text() for legend in figure.legends for text in legend.get_texts())
    assert ("and 4 more" in told) == (len(labels) == 20)
    if modes >= 3:
        decoded(figures.b_space(every))
    else:
        with pytest.raises(InputError, match="three coefficients"):
            figures.b_space(every)


@pytest.mark.parametrize("size_mm", [3.0, 300.0, 20000.0])
@pytest.mark.parametrize("labels", [1, 5, 6, 20])
def test_nothing_is_cut_or_covered_in_space(labels: int, size_mm: float) -> None:
    rng = np.random.default_rng(1)
    names = [f"surprise_mouth_open_{k}" for k in range(labels)]
    points = [point for name in names for point in scans(rng.normal(size=(2, 3)), name, np.full(3, size_mm))]
    figure = figures.b_space(points, neutral=figures.Coefficients("", "", 0, np.zeros(3), np.zeros(3)))
    picture = decoded(figure)
    (legend,) = figure.legends
    boxes = [legend.get_window_extent()]
    assert boxes[0].x0 >= 0 and boxes[0].x1 <= draw.WIDTH and boxes[0].y0 >= 0
    for axes in figure.axes:
        boxes += [axis.label.get_window_extent() for axis in (axes.xaxis, axes.yaxis, axes.zaxis)]
        low, high = axes.get_zlim()
        upright = axes.transData.transform(np.transpose(axes.zaxis.line.get_data()))[:, 0]
        for tick in axes.zaxis.get_major_ticks():
            if low <= tick.get_loc() <= high and tick.label1.get_visible():
                boxes.append(tick.label1.get_window_extent())
                assert boxes[-1].x0 > upright.max() or boxes[-1].x1 < upright.min()
    assert len(boxes) >= 9
    for k, one in enumerate(boxes):
        assert one.x0 >= 0 and one.x1 <= picture.shape[1]
        assert not any(one.overlaps(other) for other in boxes[:k])


def test_coefficients_that_do_not_go_together_are_refused() -> None:
    one, other = (figures.Coefficients("a", "", 0, np.ones(k), np.ones(k)) for k in (2, 3))
    with pytest.raises(InputError, match="different models"):
        figures.scatter_matrix([one, other])
    with pytest.raises(InputError, match="no scans, so there are no coefficients"):
        figures.b_space([])
    with pytest.raises(InputError, match="two coefficients"):
        figures.b_plane(scans(np.ones((3, 1)), "a", np.ones(1)))


def test_pictures_are_shown_pixel_for_pixel(head: MakeHead) -> None:
    figure = figures.faces_grid([head(6)] * 5, list("abcde"), title="t", columns=3)
    panels = figure.findobj(BboxImage)
    assert len(panels) == 5
    for panel in panels:
        assert isinstance(panel, BboxImage)
        box, image = panel.get_window_extent(), np.asarray(panel.get_array())
        np.testing.assert_allclose((box.height, box.width), image.shape[:2], atol=0.01)
        top = figure.bbox.height - box.y1
        assert top == pytest.approx(round(top), abs=0.01)


def test_what_is_not_there_cannot_be_drawn(head: MakeHead) -> None:
    for make in (
        lambda: figures.faces_grid([], [], title="Nobody"),
        lambda: figures.threshold_figure([]),
        lambda: figures.portrait_figure([]),
        lambda: figures.distance_maps([]),
        lambda: figures.aligned_grid([]),
    ):
        with pytest.raises(InputError):
            make()


def test_grids_of_many_fits_are_drawn(head: MakeHead) -> None:
    fits = [make_fit(head(8), label=f"fit {k}", cloud=k == 1) for k in range(3)]
    for figure in (figures.portrait_figure(fits), figures.aligned_grid(fits), figures.distance_maps(fits)):
        assert "fit 2" in words(figure)
        decoded(figure)


def test_a_share_just_below_all_is_not_called_all() -> None:
    assert draw.percent(1.0) == "100 %"
    assert draw.percent(0.99999) == "99.9 %"
    assert draw.percent(0.5) == "50 %"
    assert draw.percent(0.0) == "0 %"
    assert draw.percent(1e-6) == "0.1 %"


def test_wrapped_lines_fit_their_width_and_nothing_is_lost_but_what_the_dots_say() -> None:
    text = "How far the scan and the fitted model of this very long name lie from each other, both ways"
    lines = draw.wrap(text, 420, draw.TITLE, bold=True).split("\n")
    assert " ".join(lines) == text
    assert max(draw.measured(line, draw.TITLE, bold=True) for line in lines) <= 420
    cut = draw.wrap("W" * 500, 300, draw.TEXT).split("\n")
    assert len(cut) == 4 and cut[-1].endswith("…")
    assert max(draw.measured(line, draw.TEXT) for line in cut) <= 300


def test_characters_that_cannot_be_printed_are_replaced() -> None:
    assert draw.plain("a\x00b\x1b\u202ec\td") == "a\ufffdb\ufffd\ufffdc d"
    assert draw.short("one\ntwo " * 30, 12) == "one two one…"


def test_a_figure_is_encoded_as_it_is_drawn(head: MakeHead) -> None:
    figure = figures.faces_grid([head(6)], ["a"], title="t")
    for lossless, most in ((True, 0), (False, 6)):
        data, size = figures.encode_webp(figure, lossless=lossless)
        picture = np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))
        assert picture.shape == (size[1], size[0], 3)
        assert np.abs(picture.astype(int) - decoded(figure)).mean() <= most


def test_the_smallest_type_is_legible_on_a_phone() -> None:
    pixels = draw.SMALL * draw.DPI / 72 * 340 / draw.WIDTH
    assert pixels > 7


def test_the_package_loads_no_window_toolkit() -> None:
    assert "pyplot" not in Path(figures.__file__).read_text()


@pytest.mark.parametrize(("count", "bars"), [(3, False), (9, False), (10, True)])
def test_a_few_values_are_dots_and_no_histogram(count: int, bars: bool) -> None:
    rng = np.random.default_rng(5)
    scans = [figures.Coefficients(f"{k}", "", 0.0, *2 * (rng.normal(size=2),)) for k in range(count)]
    matrix = figures.scatter_matrix(scans)
    assert any(axes.patches for axes in matrix.axes) == bars
    drawn = sum(len(np.asarray(line.get_xdata())) for axes in matrix.axes for line in axes.lines)
    assert bars or drawn == 2 * count


def test_pictures_are_copied_as_matplotlib_draws_them(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    panels = [rng.integers(0, 255, (61, 47, 3)).astype(np.uint8) for _ in range(3)]

    def pixels() -> np.ndarray:
        canvas = FigureCanvasAgg(draw.grid([draw.Row(panels, ["a", "b", "c"])], title="Three", note="all"))
        canvas.draw()
        return np.array(canvas.buffer_rgba())

    copied = pixels()
    monkeypatch.delattr(draw._Panel, "make_image")
    np.testing.assert_array_equal(pixels(), copied)
