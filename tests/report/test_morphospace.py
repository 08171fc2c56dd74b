"""The report of an ordination: its files, its figure, its payload, and refusals of damaged files."""

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec import structs

from shapespace.cli import main
from shapespace.cohort.cohort import Cohort
from shapespace.errors import FileFormatError, InputError
from shapespace.io.tables.table_io import write_rows
from shapespace.report import figures
from shapespace.report.analyses.morphospace_report import morphospace_part, morphospace_report
from shapespace.report.figures.landmark_figures import ellipse, hull, morphospace_figure
from shapespace.report.pages.write_html import write_report
from shapespace.report.render.scene import pack_morphospace
from shapespace.schemas import MorphospacePart, TablePart
from shapespace.statistics.compare_shapes import CompareConfig, compare
from shapespace.statistics.shape_tests.ordination import ordinate
from synthetic_shapes import blob, sphere

PLANAR = np.random.default_rng(3).normal(size=(7, 2))


def planar(n: int = 18, groups: int = 3) -> Cohort:
    rng = np.random.default_rng(5)
    shapes, means = np.zeros((n, 7, 3)), 0.2 * rng.normal(size=(groups, 7, 2))
    shapes[:, :, :2] = PLANAR + 0.1 * rng.normal(size=(n, 7, 2)) + means[np.arange(n) % groups]
    return Cohort.of_shapes(shapes, {"kind": [f"k{k % groups}" for k in range(n)], "x": list(range(n))}, unit="")


def surfaces(n: int = 8) -> Cohort:
    directions, faces = sphere(300)
    rng = np.random.default_rng(1)
    shapes = np.stack([blob(directions, rng.normal(0, 1, 5)) for _ in range(n)])
    return Cohort.of_shapes(shapes, {"kind": ["a", "b"] * (n // 2)}, faces=faces)


def plot_of(part: MorphospacePart, arrays: Any) -> figures.Morphospace:
    return figures.Morphospace.of(part, arrays, FileFormatError)


def rows_of(path: Path) -> list[list[str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.reader(file))


def test_tables_hold_scores_loadings_and_eigenvalues(tmp_path: Path) -> None:
    cohort = planar()
    result = ordinate(cohort, method="cva", group=("kind",))
    morphospace_report(result).save(tmp_path)
    head, *rows = rows_of(tmp_path / "scores.csv")
    assert head == ["name", "CV1", "CV2", "kind", "CV1 leave-one-out", "CV2 leave-one-out", "predicted"]
    assert np.array([row[1:3] for row in rows], dtype=float) == pytest.approx(result.scores)
    head, *rows = rows_of(tmp_path / "loadings.csv")
    assert head == ["point", "coordinate", "CV1", "CV2", "CV1 weight", "CV2 weight"] and len(rows) == 2 * 7
    change = np.array([row[2] for row in rows], dtype=float).reshape(7, 2)
    assert change == pytest.approx((result.shape_axes[0] @ cohort.basis).reshape(7, 3)[:, :2])
    head, *rows = rows_of(tmp_path / "eigenvalues.csv")
    assert [float(row[1]) for row in rows] == pytest.approx(list(result.eigenvalues)) and float(rows[-1][3]) == 1
    text = (tmp_path / "methods.txt").read_text(encoding="utf-8")
    assert "method cva" in text and "Campbell" in text


def test_an_only_axis_is_drawn_against_the_residuals() -> None:
    result = ordinate(planar(groups=2), method="between-groups", group=("kind",))
    part, arrays = morphospace_part(result)
    assert part.axes == ("bgPC1", "residual PC1") and arrays["scores"].shape == (18, 2)
    assert abs(np.corrcoef(arrays["scores"].T)[0, 1]) < 1
    flat = arrays["shape_axes"].reshape(2, -1)
    assert flat @ flat.T == pytest.approx(np.eye(2), abs=1e-9)


def test_the_grid_moves_as_the_spline_of_the_landmarks_does() -> None:
    from shapespace.geometry.thin_plate_spline import ThinPlateSpline

    space = plot_of(*morphospace_part(ordinate(planar())))
    assert space.is_planar and space.grid[0] > 10 and space.n_landmarks == 7
    mean = space.arrays["mean"]
    moved = mean + 0.1 * space.arrays["shape_axes"][1]
    spline = ThinPlateSpline.fit(mean[:7, :2], moved[:7, :2])
    assert spline.apply(mean[7:, :2]) == pytest.approx(moved[7:, :2], abs=1e-9)


def test_ellipses_contain_95_percent_of_a_normal_group_and_hulls_all() -> None:
    part, arrays = morphospace_part(ordinate(planar(), group=("kind",)))
    space = plot_of(part, arrays)
    rng, inside = np.random.default_rng(2), []
    for _ in range(150):
        points = rng.normal(size=(7, 2)) @ np.array([[2.0, 0.5], [0.0, 1.0]])
        new = rng.normal(size=(1, 2)) @ np.array([[2.0, 0.5], [0.0, 1.0]])
        edge = ellipse(points[:6], float(space.radii[0])) - points[:6].mean(axis=0)
        # The ellipse is the unit circle of these coordinates.
        inverse = np.linalg.pinv(np.cov(points[:6].T))
        radius = np.sqrt(np.einsum("ij,jk,ik->i", edge, inverse, edge))
        assert radius == pytest.approx(np.full(len(edge), space.radii[0]))
        away = new[0] - points[:6].mean(axis=0)
        inside.append(away @ inverse @ away <= space.radii[0] ** 2)
        corners = hull(points)
        assert {tuple(corner) for corner in corners} <= {tuple(point) for point in points}
    # It is an ellipse of the group as car::dataEllipse draws it, which misses more new shapes in small groups.
    assert 0.85 < np.mean(inside) < 0.97
    assert hull(np.array([[0.0, 0], [1, 1], [2, 2]])).shape == (3, 2)


def test_groups_of_four_have_no_ellipse_and_scores_state_their_rms_per_point() -> None:
    shapes = planar().coefficients
    part, arrays = morphospace_part(ordinate(planar(), group=("kind",)))
    for count, drawn in ((4, False), (5, True)):
        codes = np.concatenate([np.zeros(count), np.ones(len(shapes) - count)])
        space = plot_of(structs.replace(part, groups=("few", "rest")), {**arrays, "groups": codes})
        assert np.isfinite(space.radii).tolist() == [drawn, True]
        lines = morphospace_figure(space).axes[0].lines
        assert len(lines) == 2 + 1 + drawn and all(np.isfinite(np.asarray(line.get_xydata())).all() for line in lines)
    assert f"{1 / np.sqrt(7):.4f} RMS per landmark." in part.note
    result = ordinate(planar())
    table = next(
        one for one in morphospace_report(result).parts if isinstance(one, TablePart) and one.title == "Eigenvalues"
    )
    scores = (result.scores[:, :1] @ result.shape_axes[:1] @ result.cohort.basis).reshape(len(shapes), 7, -1)
    rms = np.sqrt((scores**2).sum(axis=2).mean(axis=1))
    assert table.rows[0][-1] == pytest.approx(np.sqrt((rms**2).sum() / (len(shapes) - 1)), rel=1e-6)


@pytest.mark.parametrize("cohort", [planar(), surfaces()], ids=["planar", "surfaces"])
def test_the_page_has_the_plot_and_its_still(cohort: Cohort, tmp_path: Path) -> None:
    result = ordinate(cohort, group=("kind",))
    morphospace_report(result, (2, 3)).save(tmp_path)
    html = write_report(tmp_path).read_text(encoding="utf-8")
    assert 'data-widget="morphospace"' in html and "This part could not be made" not in html
    assert f"{len(cohort)} shapes in" in html and "on PC2" in html and "Scree plot" in html
    part, arrays = morphospace_part(result)
    assert len(pack_morphospace(plot_of(part, arrays))) > 1000


def test_every_comparison_has_the_morphospace_of_its_first_classes() -> None:
    from shapespace.report.analyses.compare_report import compare_report

    for formula, groups in (("~ x + kind", ("k0", "k1", "k2")), ("~ x", ())):
        report = compare_report(compare(planar(), formula, CompareConfig(permutations=20, maps=False)))
        [part] = [part for part in report.parts if isinstance(part, MorphospacePart)]
        assert part.groups == groups and part.arrays in report.arrays


def test_damaged_files_are_named_in_one_sentence() -> None:
    part, arrays = morphospace_part(ordinate(planar(), group=("kind",)))
    for change in (
        {"scores": arrays["scores"][:-1]}, {"mean": arrays["mean"] * np.nan}, {"groups": arrays["groups"] + 1},
        {"shape_axes": arrays["shape_axes"][:, :-1]}, {"edges": np.array([[0, 99]])}, {"faces": np.array([[0, 1, 7]])},
        {"scores": arrays["scores"].astype(str)},
    ):  # fmt: skip
        with pytest.raises(FileFormatError, match="morphospace"):
            plot_of(part, {**arrays, **change})
    with pytest.raises(FileFormatError, match="'mean'"):
        plot_of(part, {name: values for name, values in arrays.items() if name != "mean"})
    with pytest.raises(InputError, match="Axes 1,1"):
        morphospace_part(ordinate(planar()), (1, 1))


def test_the_command_writes_the_answer(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cohort, table, out = planar(), tmp_path / "fish.csv", tmp_path / "out"
    points = np.stack([cohort.vertices(k)[:, :2].ravel() for k in range(len(cohort))])
    heads = ("specimen", *(f"{axis}{k + 1}" for k in range(7) for axis in "xy"), "kind")
    kinds = cohort.table.texts("kind")
    write_rows(table, heads, [(f"s{k}", *map(float, row), kinds[k]) for k, row in enumerate(points)])
    command = ["morphospace", str(table), "-o", str(out), "--quiet"]
    assert main([*command, "--group", "kind", "--method", "between-groups"]) == 0
    assert "leave-one-out" in capsys.readouterr().out
    content = json.loads((out / "analysis.json").read_text(encoding="utf-8"))
    assert content["question"] == "morphospace" and content["parts"][0]["kind"] == "morphospace"
    for wrong, words in (
        ("--method=cva", "--group"),
        ("--axes=1,99", "name two different"),
        ("--axes=1", "such as 1,2"),
    ):
        try:
            code = main([*command, wrong])
        except SystemExit as stop:
            code = stop.code
        error = capsys.readouterr().err
        assert code == 2 and words in error and "Traceback" not in error
