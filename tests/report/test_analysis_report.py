"""The report of an analysis: every kind of part drawn, each damaged in turn, alone and as sections beside fits."""

import itertools
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from report_page import Page
from test_recognition_report import EVIL, words_under

from shapespace.errors import FileFormatError, InputError
from shapespace.geometry.normals import vertex_normals
from shapespace.report import figures
from shapespace.report.analyses.analysis_report import AnalysisReport
from shapespace.report.pages.study_page import MOST_ANALYSES
from shapespace.report.pages.write_html import LARGEST_REPORT_BYTES, write_report
from shapespace.report.render.scene import pack_morph
from shapespace.schemas import (
    Counts,
    CurvePart,
    HistogramPart,
    MorphPart,
    Part,
    Series,
    SurfaceMapPart,
    TextPart,
)
from shapespace.types import Mesh

PARTS: dict[str, Part] = {
    "text": TextPart(title="What was done", level=2, text="Nothing."),
    "surface_map": SurfaceMapPart(title="Where", arrays="a.npz", mask="mask", unit=f"mm {EVIL}"),
    "morph": MorphPart(title="From low to high", arrays="a.npz", low_label=EVIL, high_label="old", times=2.0),
    "histogram": HistogramPart(
        title="Permutations", edges=(0.0, 1.0, 2.0), series=(Counts(counts=(5.0, 3.0), label=EVIL),), x="F",
        observed=3.5, observed_label="observed",
    ),
    "curve": CurvePart(
        title="DET", x="false accepts", y="false rejects", x_scale="probit", y_scale="probit", diagonal=True,
        series=(
            Series(x=(0.001, 0.1, 0.5), y=(0.5, 0.1, 0.0), low=(0.4, None, 0.0), high=(0.6, None, 0.1), label=EVIL),
            Series(x=(0.01, 0.2), y=(0.3, 0.2), points=True),
        ),
    ),
}  # fmt: skip
NOTE = "3 of 40 fits are left out, which are doubtful (a, b, c)."


def save(folder: Path, mesh: Mesh, parts: dict[str, Part] = PARTS, **known: Any) -> Path:
    up = mesh.vertices[:, 1]
    arrays = {
        "vertices": mesh.vertices, "faces": mesh.faces, "values": np.where(up > 80, np.nan, up), "mask": up > 0,
        "low": mesh.vertices, "high": 1.1 * mesh.vertices, "cut": up[:-1],
    }  # fmt: skip
    given = {"summary": ("They differ.",), "notes": (NOTE,), "settings": {"seed": 3}, **known}
    AnalysisReport(
        "compare", f"Do they differ {EVIL}", parts=tuple(parts.values()), arrays={"a.npz": arrays}, **given
    ).save(folder)
    return folder


def report(folder: Path, **options: Any) -> str:
    return write_report(folder, folder.parent / "page.html", **options).read_text(encoding="utf-8")


@pytest.fixture
def analysis(tmp_path: Path, head: Callable[..., Mesh]) -> Path:
    return save(tmp_path / "compared", head(8))


@pytest.fixture
def undrawn(worded: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(figures, "encode_webp", lambda *_, **__: (b"webp", (10, 10)))


def change(folder: Path, **keys: Any) -> Path:
    content = json.loads((folder / "analysis.json").read_text())
    (folder / "analysis.json").write_text(json.dumps({**content, **keys}))
    return folder


def test_every_kind_of_part_is_drawn_and_says_who_was_left_out(analysis: Path) -> None:
    steps: list[str] = []
    page = report(analysis, on_step=lambda what, _: steps.append(what))
    parsed = Page(page)
    assert 'class="broken"' not in page and len(page.encode()) < LARGEST_REPORT_BYTES
    titles = [part.title for part in PARTS.values()]
    assert parsed.headings == [f"Do they differ {EVIL}", "Summary", *titles, "Settings, versions and hashes"]
    assert NOTE in words_under(page, "Summary") and "Results of an analysis of shapes." in parsed.words
    assert len(parsed.images()) == 4 == len(steps)
    assert all(len(image["alt"] or "") > 20 for image in parsed.images())
    assert 'data-widget="morph"' in page and "2 times as large" in words_under(page, "From low to high")
    levels = [int(tag[1]) for tag, _ in parsed.tags if re.fullmatch("h[1-6]", tag)]
    assert all(after <= before + 1 for before, after in itertools.pairwise(levels))


def test_no_folder_of_this_machine_gets_into_a_report(analysis: Path, undrawn: None) -> None:
    noted = change(analysis, notes=["5 rows of /home/anna/secret/people.csv are left out."])
    words = words_under(report(noted), "Summary")
    assert "5 rows of people.csv are left out" in words and "anna" not in words


def test_names_that_are_scripts_stay_text(analysis: Path) -> None:
    page = report(analysis)
    assert EVIL not in page and "<script>alert" not in page and Page(page).words.count(EVIL) >= 4


def test_charts_that_follow_each_other_stand_side_by_side_and_maps_have_the_whole_width(
    tmp_path: Path, head: Callable[..., Mesh], undrawn: None
) -> None:
    maps = {"a": PARTS["surface_map"], "b": SurfaceMapPart(title="The other", arrays="a.npz", signed=False)}
    page = report(save(tmp_path / "maps", head(8), maps))
    assert 'class="beside"' not in page and page.index("Where") < page.index("The other")
    charts = {"a": PARTS["histogram"], "b": PARTS["curve"]}
    page = report(save(tmp_path / "charts", head(8), charts))
    beside = page[page.index('class="beside"') :]
    assert beside.index("Permutations") < beside.index("DET") < beside.index("Settings")


def test_a_title_stands_once_above_a_map_and_not_in_its_picture(
    tmp_path: Path, head: Callable[..., Mesh], monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[list[str]] = []

    def encode(figure: Figure, **_: object) -> tuple[bytes, tuple[int, int]]:
        drawn.append([text.get_text() for text in figure.texts])
        return b"", (960, 300)

    monkeypatch.setattr("shapespace.report.figures.encode_webp", encode)
    page = report(save(tmp_path / "maps", head(8), {key: PARTS[key] for key in ("surface_map", "morph")}))
    assert len(drawn) == 2 and not [text for texts in drawn for text in texts if text in ("Where", "From low to high")]
    assert Page(page).words.count("Where") == 1


@pytest.mark.parametrize(
    ("kind", "key", "value"),
    [
        ("surface_map", "arrays", "../../elsewhere.npz"),
        ("surface_map", "arrays", "absent.npz"),
        ("surface_map", "arrays", "analysis.json"),
        ("surface_map", "values", "nothing"),
        ("surface_map", "values", "cut"),
        ("surface_map", "values", "faces"),
        ("surface_map", "vertices", "values"),
        ("surface_map", "faces", "vertices"),
        ("surface_map", "mask", "low"),
        ("surface_map", "mask", "cut"),
        ("surface_map", "limit", -1),
        ("surface_map", "limit", "wide"),
        ("morph", "high", "cut"),
        ("morph", "high", "values"),
        ("morph", "faces", "low"),
        ("morph", "arrays", None),
        ("morph", "times", "twice"),
        ("histogram", "edges", [0.0, 2.0, 1.0]),
        ("histogram", "edges", [0.0]),
        ("histogram", "series", []),
        ("histogram", "series", [{"counts": [1.0]}]),
        ("histogram", "series", [{"counts": [-1.0, 2.0]}]),
        ("histogram", "observed", "much"),
        ("curve", "x_scale", "square"),
        ("curve", "series", [{"x": [0.1, 3.0], "y": [0.1, 0.2]}]),
        ("curve", "series", [{"x": [0.1, 0.2], "y": [0.1, 0.2], "low": [0.1], "high": [0.2]}]),
        ("curve", "series", [{"x": [], "y": []}]),
        ("curve", "series", [{"x": [0.1], "y": [0.1]}] * 100),
    ],
)
def test_a_damaged_part_says_so_in_its_place_and_costs_no_other(
    tmp_path: Path, head: Callable[..., Mesh], monkeypatch: pytest.MonkeyPatch, kind: str, key: str, value: object
) -> None:
    monkeypatch.setattr(figures, "encode_webp", lambda *_, **__: (b"webp", (10, 10)))
    folder = save(tmp_path / "compared", head(5), {"own": PARTS[kind], "text": TextPart(title="Other", text="Here.")})
    content = json.loads((folder / "analysis.json").read_text())
    content["parts"][0][key] = value
    page = report(change(folder, parts=content["parts"]))
    assert page.count('class="broken"') == 1 and "Here." in words_under(page, "Other")
    told = words_under(page, str(PARTS[kind].title))
    assert "could not be made" in told and str(tmp_path) not in told


def test_vertices_without_extent_or_beyond_all_measure_are_no_surface(head: Callable[..., Mesh]) -> None:
    mesh = head(5)
    for vertices in (0 * mesh.vertices, 1e300 * mesh.vertices):
        with pytest.raises(InputError, match="no surface to draw"):
            figures.upright_views(mesh.with_vertices(vertices))


def test_a_curve_without_a_place_on_its_scale_is_refused() -> None:
    for scale, values in (("log", [0.0, -1.0]), ("probit", [0.5, 1.5])):
        with pytest.raises(InputError, match="scale needs"):
            figures.curve_figure([("a", [1.0, 2.0], values)], x="x", y="y", scales=("linear", scale))
    figures.curve_figure([("a", [0.0, 1.0], [0.0, 1.0])], x="x", y="y", scales=("probit", "probit"), diagonal=True)


@pytest.mark.parametrize("value", [None, 3, [None], [{"kind": "dream"}], {"a": 1}])
@pytest.mark.parametrize("key", ["summary", "notes", "parts", "settings", "question"])
def test_a_key_of_another_kind_never_stops_the_report(analysis: Path, undrawn: None, key: str, value: object) -> None:
    page = report(change(analysis, **{key: value}))
    assert "Settings, versions and hashes" in Page(page).headings


def test_an_analysis_of_another_format_is_refused_by_its_own_name(analysis: Path) -> None:
    with pytest.raises(FileFormatError, match="not the result of an analysis"):
        report(change(analysis, format="shapespace recognition"))
    with pytest.raises(InputError, match="contains an analysis without fits; omit --model"):
        report(change(analysis, format="shapespace analysis"), model=analysis / "m.h5")
    (analysis / "analysis.json").write_text('{"format": ')
    with pytest.raises(FileFormatError, match="run the analysis again"):
        report(analysis)


def test_a_report_of_fits_gains_sections_of_the_analyses_in_and_below_it(
    fits: Path, head: Callable[..., Mesh], undrawn: None
) -> None:
    save(fits, head(5))
    save(fits / "asymmetry", head(5), {"text": TextPart(title="Mirrored", text="Nothing.")})
    save(fits / "deep" / "er", head(5))
    page = report(fits)
    headings = Page(page).headings
    at = [headings.index(text) for text in ("The fits", "Analysis", "Where", "Analysis asymmetry", "Mirrored")]
    assert at == sorted(at) and "Analysis deep" not in headings and 'class="broken"' not in page
    assert page.count(NOTE) == 2 and "shapespace report FOLDER/asymmetry" in Page(page).words
    (fits / "asymmetry" / "analysis.json").write_text("[]")
    damaged = report(fits)
    assert "does not contain a JSON object" in words_under(damaged, "Analysis asymmetry")
    assert str(fits.parent) not in damaged


def test_analyses_beyond_the_most_are_named_and_links_are_not_followed(
    fits: Path, head: Callable[..., Mesh], undrawn: None, tmp_path: Path
) -> None:
    for k in range(MOST_ANALYSES + 2):
        save(fits / f"study{k:02}", head(5), {})
    outside = save(tmp_path / "outside", head(5), {})
    (fits / "linked").symlink_to(outside, target_is_directory=True)
    words = Page(report(fits)).words
    assert "its own report: study12 and study13" in words and "linked" not in words


def test_an_analysis_too_large_for_a_page_leaves_out_parts_and_says_so(
    tmp_path: Path, head: Callable[..., Mesh], sketched: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(figures, "encode_webp", lambda *_, **__: (b"w" * 400_000, (10, 10)))
    page = report(save(tmp_path / "compared", head(5), {str(k): PARTS["histogram"] for k in range(20)}))
    assert len(page.encode()) < LARGEST_REPORT_BYTES and "larger than 8 MB" in page


def test_the_two_ends_of_a_morph_are_those_that_were_given(head: Callable[..., Mesh]) -> None:
    low = head(10)
    high = low.with_vertices(low.vertices + 3 * vertex_normals(low))
    arrays = unpacked(pack_morph(low, high, ("a", "b")))
    mean, half = arrays["mean"], arrays["modes"][0]
    for end, sign in ((low, -1), (high, 1)):
        told = mean + sign * half
        gaps = np.linalg.norm(told[:, None] - end.vertices[None], axis=2).min(axis=1)
        assert gaps.max() < 0.05


def unpacked(payload: bytes) -> dict[str, np.ndarray]:
    """Return the arrays of a payload, as `Shapespace.unpack` decodes them."""
    length = int.from_bytes(payload[:4], "little")
    header = json.loads(payload[4 : 4 + length])
    start, out = 4 + length + -(4 + length) % 8, {}
    for name, spec in header["arrays"].items():
        shape, columns = spec["shape"], spec["shape"][-1]
        count = int(np.prod(shape))
        data = np.frombuffer(payload, np.uint8, 2 * count, start + spec["offset"])
        planes = data.reshape(columns, 2, -1).transpose(0, 2, 1).copy().view("<u2")[:, :, 0].T.astype(np.int64)
        steps = np.where(planes % 2, -(planes + 1) // 2, planes // 2)
        values = np.cumsum(steps, axis=0).astype(np.uint16)
        signed = values.astype(np.int16 if spec["dtype"] == "int16" else np.uint16).reshape(shape).astype(float)
        out[name] = signed * np.array(spec.get("scale", 1.0)).reshape(-1, *[1] * (len(shape) - 1))
    return out


def test_a_surface_that_lies_is_turned_upright_and_one_that_stands_stays() -> None:
    t, a = np.meshgrid(
        np.linspace(0.05, np.pi - 0.05, 20), np.linspace(0, 2 * np.pi, 24, endpoint=False), indexing="ij"
    )
    standing = np.stack([10 * np.sin(t) * np.cos(a), 80 * np.cos(t), 14 * np.sin(t) * np.sin(a)], -1).reshape(-1, 3)
    at = np.arange(20 * 24).reshape(20, 24)
    one, two, three, four = at[:-1], np.roll(at, -1, 1)[:-1], at[1:], np.roll(at, -1, 1)[1:]
    faces = np.concatenate([np.stack(f, -1).reshape(-1, 3) for f in ((one, two, three), (two, four, three))])
    turn, sides = figures.upright_views(Mesh(standing, faces))
    assert np.array_equal(turn, np.eye(3)) and len(sides) == 4
    lying = Mesh(standing[:, [1, 2, 0]], faces)
    turn, _ = figures.upright_views(lying)
    assert np.ptp(lying.vertices @ turn.T, axis=0).argmax() == 1


def test_what_is_marked_keeps_its_colour_and_the_rest_is_paler(head: Callable[..., Mesh]) -> None:
    mesh = head(14)
    values = np.full(len(mesh.vertices), 2.0)
    half = mesh.vertices[:, 1] > 0
    plain, marked = (
        np.asarray(figure_pixels(figures.surface_map_figure(mesh, values, unit="mm", limit=2.0, mask=mask)))
        for mask in (None, half)
    )
    height = min(len(plain), len(marked)) // 2
    assert np.abs(plain[: height // 2].astype(int) - marked[: height // 2]).mean() < 1
    assert (marked.astype(int).sum() - plain[: len(marked)].astype(int).sum()) > 0
    assert "Pale" in figure_texts(figures.surface_map_figure(mesh, values, unit="mm", mask=half))


def figure_pixels(figure: Any) -> np.ndarray:
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[:, :, :3]


def figure_texts(figure: Any) -> str:
    return " ".join(text.get_text() for text in figure.texts)
