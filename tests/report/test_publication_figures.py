"""Figures for papers: size, type, fonts and bytes of the files, named views, and pictures of landmarks."""

import base64
import io
import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from fontTools.ttLib import TTFont
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import BboxImage
from matplotlib.text import Text
from PIL import Image

from shapespace.cohort.orientation import find_orientation, view_rotation
from shapespace.errors import FileFormatError, InputError, ShapespaceError
from shapespace.report import figures
from shapespace.report.analyses.analysis_report import AnalysisReport, scree_part, tangent_part
from shapespace.report.figures.analysis_figures import views_of
from shapespace.report.figures.draw import ONE_COLUMN_MM, TWO_COLUMNS_MM, charts, finish, legend, legend_columns
from shapespace.report.pages.write_html import FigureConfig, write_figures
from shapespace.schemas import CurvePart, DeformationPart, NamedView, Orientation, Series, SurfaceMapPart, TextPart
from shapespace.types import FloatArray, Mesh

DORSAL = NamedView(name="dorsal", toward_viewer=(0.0, 0.0, 2.0), up=(1.0, 0.0, 0.5))


def curves() -> Figure:
    x = [0.0, 1.0, 2.5]
    series = [("female", x, [0.0, 1.2, 2.0]), ("male & µ", x, [1.0, 2.1, 3.0]), ("", x[:2], [0.0, 1.0])]
    return figures.curve_figure(
        series, x="log centroid size (mm)", y="regression score", title="Score", dots=[True, True, False],
        groups=[0, 1, 0],
    )  # fmt: skip


def millimetres(figure: Figure) -> float:
    return float(figure.get_figwidth()) * 25.4


def printed_texts(figure: Figure) -> list[Text]:
    return [text for text in figure.findobj(Text) if isinstance(text, Text) and text.get_visible() and text.get_text()]


def ring(n: int = 12) -> FloatArray:
    turn = np.linspace(0, 2 * np.pi, n, endpoint=False)
    return np.stack([2 * np.cos(turn), np.sin(turn) + 0.2 * np.cos(2 * turn), 0 * turn], axis=1)


def test_charts_have_one_column_and_pictures_two_with_legible_type_and_no_title(head: Callable[..., Mesh]) -> None:
    mesh = head(6)
    with figures.publication_style(100):
        chart = curves()
        row = figures.surface_map_figure(mesh, mesh.vertices[:, 1], unit="mm")
    assert millimetres(chart) == pytest.approx(ONE_COLUMN_MM, abs=0.2)
    assert millimetres(row) == pytest.approx(TWO_COLUMNS_MM, abs=0.2)
    for figure in (chart, row):
        assert min(float(text.get_fontsize()) for text in printed_texts(figure)) >= 6.0
    assert not [text for text in printed_texts(chart) if text.get_text() == "Score"]
    assert [text for text in printed_texts(curves()) if text.get_text() == "Score"]
    assert millimetres(curves()) > 150


def test_surfaces_have_the_resolution_of_the_file(tmp_path: Path, head: Callable[..., Mesh]) -> None:
    mesh = head(6)
    with figures.publication_style(200):
        figure = figures.surface_map_figure(mesh, mesh.vertices[:, 1], unit="mm")
    panel = figure.findobj(BboxImage)[0]
    assert isinstance(panel, BboxImage)
    inches = panel.get_window_extent().width / figure.dpi
    assert np.asarray(panel.get_array()).shape[1] == pytest.approx(200 * inches, abs=1.5)
    [path] = figures.save_figure(figure, tmp_path / "map", ["png"], 200)
    with Image.open(path) as image:
        assert image.size[0] == pytest.approx(200 * TWO_COLUMNS_MM / 25.4, abs=2)
        assert image.info["dpi"][0] == pytest.approx(200, abs=0.1)


def test_nothing_of_a_chart_is_cut_in_one_column() -> None:
    with figures.publication_style():
        bars = figures.histogram_figure(np.arange(9.0), [("all", [9] * 8)], x="F", observed=7.5, observed_label="here")
        tall = np.random.default_rng(0).normal(size=(12, 3)) * [1.0, 3.0, 0.3]
        for figure in (curves(), bars, figures.landmark_vectors_figure(tall, 1.1 * tall, ("a", "b"))):
            box, (width, height) = figure.get_tightbbox(), figure.get_size_inches()
            assert box.x0 > -0.01 and box.y0 > -0.01 and box.x1 < width + 0.01 and box.y1 < height + 0.01
            assert max(axes.title.get_window_extent().y1 for axes in figure.axes) < height * figure.dpi
        shares = figures.histogram_figure([0, 1, 2], [("", [0.5, 0.5])], x="score", y="share")
        assert [one.axes[0].get_ylabel() for one in (bars, shares)] == ["count", "share"]
        [axes] = bars.axes
        assert axes.transData.inverted().transform(axes.get_legend().get_window_extent())[0, 1] > 9


def test_fonts_are_embedded_and_the_text_of_svg_can_be_searched(tmp_path: Path) -> None:
    with figures.publication_style():
        svg, pdf = figures.save_figure(curves(), tmp_path / "curve", ["svg", "pdf"])
    assert svg.name == "curve.svg" and b"/FontFile2" in pdf.read_bytes() and b"/Type3" not in pdf.read_bytes()
    text = svg.read_text("utf-8")
    assert ">regression score</text>" in text and "male &amp; µ" in text
    fonts = re.findall(r"font-weight:400;src:url\(data:font/woff;base64,([^)]*)\)", text)
    known = TTFont(io.BytesIO(base64.b64decode(fonts[0]))).getBestCmap()
    assert {ord(letter) for letter in "regression score male & µ"} <= set(known) and len(known) < 80


@pytest.mark.parametrize("kind", ["svg", "pdf", "png"])
def test_the_same_figure_is_the_same_file(tmp_path: Path, kind: str) -> None:
    written = []
    for name in ("a", "b"):
        with figures.publication_style():
            written += figures.save_figure(curves(), tmp_path / name, [kind])
    assert written[0].read_bytes() == written[1].read_bytes()
    assert not re.search(rb"CreationDate|<dc:date>", written[0].read_bytes())


def test_other_formats_and_resolutions_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="choose from svg, pdf, png"):
        figures.save_figure(Figure(), tmp_path / "a", ["gif"])
    with pytest.raises(InputError, match="choose from svg, pdf, png"):
        FigureConfig(formats=("tiff",))
    for dpi in (10, 10_000):
        with pytest.raises(InputError, match="dpi"):
            FigureConfig(dpi=dpi)
        with pytest.raises(InputError, match="dpi"), figures.publication_style(dpi):
            pass


def test_series_of_a_group_share_colour_and_marker_and_are_named_once() -> None:
    axes = curves().axes[0]
    first, second = (collection.get_facecolor()[0] for collection in axes.collections)
    assert not np.allclose(first, second)
    assert axes.lines[0].get_color() == pytest.approx(tuple(first[:3]))
    legend = axes.get_legend()
    assert legend is not None and [text.get_text() for text in legend.get_texts()] == ["female", "male & µ"]
    paths = [collection.get_paths()[0].vertices.shape for collection in axes.collections]
    assert paths[0] != paths[1]


def analysis(folder: Path, mesh: Mesh, **known: object) -> Path:
    arrays = {
        "a.npz": {"vertices": mesh.vertices, "faces": mesh.faces, "values": mesh.vertices[:, 1],
                  "low": ring(), "high": 1.1 * ring(), "line": np.repeat(ring()[:1], 12, axis=0)},
    }  # fmt: skip
    score = CurvePart(title="Score", x="x", y="y", series=(Series(x=(0.0, 1.0), y=(0.0, 1.0)),))
    parts = (
        SurfaceMapPart(title="Where it differs", arrays="a.npz"),
        TextPart(title="sex F to M", level=2, text="Nothing."),
        score,
        DeformationPart(title="From low to high", arrays="a.npz", drawing="grid", times=3.0, low_label="F"),
        TextPart(title="age", level=2, text="Nothing."),
        score,
        DeformationPart(title="On a line", arrays="a.npz", low="line", high="line", drawing="grid"),
    )
    AnalysisReport("compare", "Title", ("They differ.",), parts, arrays=arrays, **known).save(folder)  # type: ignore[arg-type]
    return folder


def test_all_figures_of_an_analysis_are_files_named_after_their_titles(
    tmp_path: Path, head: Callable[..., Mesh]
) -> None:
    paths, notes = write_figures(analysis(tmp_path, head(6)), FigureConfig(formats=("png", "svg"), dpi=80))
    stems = ["where-it-differs", "sex-f-to-m-score", "from-low-to-high", "age-score"]
    assert [path.name for path in paths] == [f"{stem}.{kind}" for stem in stems for kind in ("png", "svg")]
    assert len(notes) == 1 and "'On a line' could not be drawn" in notes[0]
    captions = (tmp_path / "figures" / "captions.txt").read_text()
    assert "from-low-to-high: From low to high. Thin-plate splines" in captions and "3 times as large" in captions
    before = {path: path.read_bytes() for path in paths}
    write_figures(tmp_path, FigureConfig(formats=("png",), dpi=80))
    assert before == {path: path.read_bytes() for path in paths}


@pytest.mark.parametrize("results", ["fits_template", "demo_template"])
def test_the_figures_of_fits_and_of_the_demo_are_files_with_captions(
    results: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    shutil.copytree(request.getfixturevalue(results), tmp_path / "work")
    folder = tmp_path / "work" / ("out" if results == "fits_template" else "")
    paths, notes = write_figures(folder, FigureConfig(formats=("svg",), dpi=72))
    captions = (folder / "figures" / "captions.txt").read_text().splitlines()
    assert [path.stem for path in paths] == [caption.partition(":")[0] for caption in captions]
    assert {path.name for path in paths} | {"captions.txt"} == {path.name for path in (folder / "figures").iterdir()}
    assert any("distance" in caption for caption in captions) and notes == ()
    with pytest.raises(InputError, match="There is no view 'dorsal'; the views are none; give --orientation"):
        write_figures(folder, FigureConfig(views=("dorsal",)))


def test_no_legend_of_a_printed_figure_is_cut(head: Callable[..., Mesh]) -> None:
    names = ["mean", "95 % of the points", "99 %", "farthest point"]
    assert legend_columns(names, 4) == 4
    with figures.publication_style():
        assert legend_columns(names, 4) == 3
        figure, (axes,) = charts("", [3.0])
        for name in names:
            axes.plot([0, 1], [0, 1], label=name)
        legend(axes, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=4)
        finish(figure)
    FigureCanvasAgg(figure).draw()
    box = axes.get_legend().get_window_extent()
    assert box.x0 >= 0 and box.x1 <= figure.bbox.width


def test_named_views_turn_what_faces_the_viewer_to_the_front() -> None:
    turn = view_rotation(DORSAL)
    assert np.allclose(turn @ turn.T, np.eye(3)) and np.linalg.det(turn) == pytest.approx(1)
    assert turn @ np.array([0.0, 0.0, 1.0]) == pytest.approx([0.0, 0.0, 1.0])
    assert turn @ np.array([1.0, 0.0, 0.0]) == pytest.approx([0.0, 1.0, 0.0])


def test_the_views_of_an_orientation_are_those_of_all_figures_of_a_surface(head: Callable[..., Mesh]) -> None:
    mesh = head(6)
    orientation = Orientation(views=(DORSAL, NamedView(name="lateral", toward_viewer=(1, 0, 0), up=(0, 1, 0))))
    with figures.oriented(orientation):
        turn, _ = figures.upright_views(mesh)
        assert [name for name, _, _ in views_of(mesh)] == ["dorsal", "lateral"] and np.allclose(
            turn, view_rotation(DORSAL)
        )
        drawn = figures.surface_map_figure(mesh, mesh.vertices[:, 1], unit="mm")
        morph = figures.morph_figure(mesh, mesh, ("young", "old"))
        vectors = figures.landmark_vectors_figure(mesh.vertices[::9], 1.1 * mesh.vertices[::9], ("young", "old"))
    for figure, names in ((drawn, ["dorsal", "lateral"]), (morph, ["young dorsal", "old lateral"])):
        assert set(names) <= {text.get_text() for text in figure.texts}
    assert [axes.get_title() for axes in vectors.axes] == ["dorsal", "lateral"]
    assert next(name for name, _, _ in views_of(mesh)) != "dorsal"


def test_views_and_links_are_found_next_to_the_shapes(tmp_path: Path) -> None:
    assert find_orientation(None, [tmp_path]) is None
    (tmp_path / "links.csv").write_text("from,to\n1,2\n2,3\n")
    view = {"name": "dorsal", "toward_viewer": [0, 0, 1], "up": [0, 1, 0]}
    (tmp_path / "orientation.json").write_text(json.dumps({"views": [view]}))
    found = find_orientation(None, [tmp_path / "absent", tmp_path])
    assert found is not None and found.links == ((1, 2), (2, 3)) and found.views[0].name == "dorsal"


@pytest.mark.parametrize(
    ("file", "text", "words"),
    [
        ("orientation.json", "{", "is not JSON"),
        ("orientation.json", '{"views": [{"name": "dorsal"}]}', "is damaged"),
        ("orientation.json", '{"views": [{"name": "a", "toward_viewer": [0, 0, 1], "up": [0, 0, 2]}]}', "not parallel"),
        ("orientation.json", '{"links": [[0, 1]]}', "number landmarks from 1"),
        ("links.csv", "from,to\nnose,ear\n", "the row 'nose, ear'; write two landmarks"),
        ("links.csv", "from,to,by\n1,2,3\n", "the row '1, 2, 3'"),
    ],
)
def test_damaged_orientations_are_refused_in_one_sentence(tmp_path: Path, file: str, text: str, words: str) -> None:
    (tmp_path / file).write_text(text)
    with pytest.raises(FileFormatError, match=words):
        find_orientation(None, [tmp_path])


def test_links_of_landmarks_that_do_not_exist_are_refused() -> None:
    with figures.oriented(Orientation(links=((1, 99),))), pytest.raises(InputError, match="landmark 99"):
        figures.landmark_vectors_figure(ring(), ring(), ("a", "b"))


def grid_of(figure: Figure, panel: int) -> list[FloatArray]:
    return [np.asarray(line) for line in figure.axes[panel].collections[0].get_segments()]  # type: ignore[attr-defined]


def test_a_deformation_grid_is_square_for_equal_shapes_and_follows_an_affine_change() -> None:
    same = figures.deformation_grid_figure(ring(), ring(), ("a", "b"))
    steps = [np.ptp(line, axis=0).min() for line in grid_of(same, 0)]
    assert max(steps) < 1e-9
    stretched = ring() * np.array([1.2, 0.9, 1.0])
    figure = figures.deformation_grid_figure(ring(), stretched, ("a", "b"))
    low, high = (np.concatenate(grid_of(figure, k)) for k in (0, 1))
    assert np.allclose(high, low * [1.2, 0.9], atol=1e-8)


def test_landmarks_in_three_dimensions_have_no_deformation_grid() -> None:
    with pytest.raises(InputError, match="planar"):
        figures.deformation_grid_figure(ring(), ring() + np.array([0.0, 0.0, 1.0]), ("a", "b"))


def test_a_map_of_landmarks_has_one_panel_in_the_plane_and_three_in_space() -> None:
    flat = figures.landmark_map_figure(ring(), np.arange(12.0), unit="mm")
    assert len(flat.axes) == 2  # the colour bar is one
    bent = ring() + np.arange(36.0).reshape(12, 3) ** 2
    assert len(figures.landmark_map_figure(bent, np.arange(12.0), unit="mm").axes) == 4
    for values in (np.arange(11.0), np.full(12, np.nan)):
        with pytest.raises(ShapespaceError):
            figures.landmark_map_figure(ring(), values, unit="mm")


def test_the_scree_plot_shows_shares_of_the_variance() -> None:
    part = scree_part(np.array([3.0, 1.0]))
    assert part.series[0].y == (75.0, 25.0) and part.series[0].x == (1.0, 2.0)


def shapes(n: int = 9, spread: float = 0.2, seed: int = 1) -> FloatArray:
    points = ring()[:, :2] + spread * np.random.default_rng(seed).normal(size=(n, 12, 2))
    points -= points.mean(axis=1, keepdims=True)
    points /= np.linalg.norm(points, axis=(1, 2), keepdims=True)
    for _ in range(20):
        left, _, right = np.linalg.svd(np.einsum("nla,lb->nab", points, points.mean(axis=0)))
        points = points @ (left @ right)
    return points


def distances(part: CurvePart) -> tuple[FloatArray, FloatArray]:
    return np.array(part.series[0].x), np.array(part.series[0].y)


def test_the_tangent_check_recovers_shapes_from_their_orthogonal_projection() -> None:
    unit = shapes()
    flat = unit.reshape(len(unit), -1)
    pole = flat.mean(axis=0) / np.linalg.norm(flat.mean(axis=0))
    projected = (flat + np.outer(1 - flat @ pole, pole)).reshape(unit.shape)
    own, _ = distances(tangent_part(unit))
    recovered, tangent = distances(tangent_part(projected, projected=True))
    assert np.allclose(own, recovered, atol=1e-9) and (tangent < recovered + 1e-9).all()
    padded = np.concatenate([projected, np.zeros((*projected.shape[:2], 1))], axis=2)
    assert np.allclose(distances(tangent_part(padded, projected=True))[0], recovered, atol=1e-12)


def test_the_tangent_check_gives_1_for_small_variation_and_the_distances_of_scipy() -> None:
    from scipy.spatial import procrustes

    unit = shapes(5)
    x, _ = distances(tangent_part(unit))
    # scipy's disparity is the squared full Procrustes distance, the squared sine of the Riemannian one
    sines = [np.sqrt(procrustes(unit[a], unit[b])[2]) for a in range(5) for b in range(a)]
    assert np.allclose(np.sort(np.sin(x)), np.sort(sines), atol=1e-9)
    slope = re.search(r"origin ([\d.]+)", tangent_part(shapes(20, 1e-4)).note or "")
    assert slope is not None and float(slope[1]) == pytest.approx(1, abs=1e-3)
