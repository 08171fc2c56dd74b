"""Landmarks as other tools write them: 3D Slicer, tpsDig, IDAV Landmark, Morphologika, MorphoJ, Amira."""

import json
from pathlib import Path

import numpy as np
import pytest

from refusals import refusal_of
from shapespace.cli import main
from shapespace.errors import FileFormatError, InputError
from shapespace.io.landmarks.configuration_io import is_configurations, read_configurations
from shapespace.io.landmarks.landmark_io import read_landmarks

POINTS = np.arange(18.0).reshape(6, 3) ** 1.5


def markup(points: np.ndarray, label: str, kind: str = "Fiducial") -> dict[str, object]:
    controls = [
        {"id": str(k), "label": f"{label}{k}", "position": point, "positionStatus": "defined"}
        for k, point in enumerate(points.tolist(), 1)
    ]
    return {"type": kind, "coordinateSystem": "LPS", "controlPoints": controls}


def save(path: Path, *markups: dict[str, object]) -> None:
    path.write_text(json.dumps({"markups": markups}))


def test_default_labels_of_slicer_are_matched_by_number(tmp_path: Path) -> None:
    save(tmp_path / "s0.mrk.json", markup(POINTS, "F-"))
    other = markup(POINTS + 1, "F_1-")
    other["controlPoints"].reverse()  # pyright: ignore[reportAttributeAccessIssue]
    save(tmp_path / "s1.mrk.json", other)
    found = read_configurations(tmp_path)
    assert found.landmarks == tuple(f"F-{k}" for k in range(1, 7))
    assert any("matched by number" in note and "s1.mrk.json" in note for note in found.notes)
    np.testing.assert_array_equal(found.points, [POINTS, POINTS + 1])


@pytest.mark.parametrize(("label", "count"), [("nose", 6), ("F_1-", 5)])
def test_other_labels_or_numbers_are_refused(label: str, count: int, tmp_path: Path) -> None:
    save(tmp_path / "s0.mrk.json", markup(POINTS, "F-"))
    save(tmp_path / "s1.mrk.json", markup(POINTS[:count], label))
    with pytest.raises(Exception, match="same landmarks to all files"):
        read_configurations(tmp_path)


@pytest.mark.parametrize(("kind", "sliders"), [
    ("Curve", [[6, 7, 8], [7, 8, 9]]), ("ClosedCurve", [[6, 7, 8], [7, 8, 9], [8, 9, 6]]),
])  # fmt: skip
@pytest.mark.parametrize("own_file", [False, True])
def test_curves_of_slicer_are_semilandmarks(
    kind: str, sliders: list[list[int]], own_file: bool, tmp_path: Path
) -> None:
    for k in range(2):
        points, curve = markup(POINTS + k, "L"), markup(POINTS[:4] - k, "C-", kind)
        if own_file:
            save(tmp_path / f"s{k}_landmarks.mrk.json", points)
            save(tmp_path / f"s{k}_curve.mrk.json", curve)
        else:
            save(tmp_path / f"s{k}.mrk.json", points, curve)
    found = read_configurations(tmp_path)
    assert found.names == ("s0", "s1")
    np.testing.assert_array_equal(found.curve_sliders, sliders)
    np.testing.assert_array_equal(found.points[1], [*(POINTS + 1), *(POINTS[:4] - 1)])
    assert any("joined" in note for note in found.notes) == own_file


def test_repeated_ids_of_tps_give_way_to_images(write) -> None:
    block = "LM=2\n1 2\n3 4\nIMAGE={}.jpg\nID={}\n"
    found = read_configurations(write("a.tps", block.format("a", 0) + block.format("b", 0)))
    assert found.names == ("a", "b") and any("IMAGE=" in note for note in found.notes)
    with pytest.raises(InputError, match="two specimens"):
        read_configurations(write("b.tps", block.format("a", 0) * 2))


def test_outlines_alone_are_closed_curves_with_equal_numbers_of_points(write) -> None:
    square = "LM=0\nOUTLINES=1\nPOINTS=4\n0 0\n1 0\n1 1\n0 1\nID=a\n"
    finer = "LM=0\nOUTLINES=1\nPOINTS=6\n0 0\n1 0\n2 0\n2 2\n1 2\n0 2\nID=b\n"
    found = read_configurations(write("a.tps", square + finer))
    np.testing.assert_allclose(found.points, [[[0, 0], [1, 0], [1, 1], [0, 1]], [[0, 0], [2, 0], [2, 2], [0, 2]]])
    np.testing.assert_array_equal(found.curve_sliders, [[0, 1, 2], [1, 2, 3], [2, 3, 0]])
    assert any("resampled to 4 points" in note for note in found.notes)
    same = read_configurations(write("b.tps", square + square.replace("ID=a", "ID=b")))
    assert not any("resampled" in note for note in same.notes) and same.points.shape == (2, 4, 2)


def test_idav_landmark_is_read_with_missing_points(write) -> None:
    text = "1 2L 6 1 9999 DIM=3\r\ns0.ply s1.ply\r\n1 2 3\r\n4 5 6\r\n9999 9999 9999\r\n7 8 9\r\n"
    path = write("a.dta", text)
    found = read_configurations(path)
    assert found.names == ("s0", "s1") and is_configurations(path)
    np.testing.assert_array_equal(found.points, [[[1, 2, 3], [4, 5, 6]], [[np.nan] * 3, [7, 8, 9]]])


MORPHOLOGIKA = (
    "\ufeff[Individuals]\r\n2\r\n[landmarks]\r\n2\r\n[dimensions]\r\n2\r\n[names]\r\nfirst one\r\nb, 2\r\n"
    "[labels]\r\nsex age\r\n[labelvalues]\r\nF 1\r\nM 2\r\n[groups]\r\nold 1 new 1\r\n"
    "[rawpoints]\r\n'#1\r\n1 2\r\n3 4.5\r\n\r\n'#2\r\nNA NA\r\n7 8\r\n[wireframe]\r\n1 2\r\n"
)


@pytest.mark.parametrize("decimal", [".", ","])
def test_morphologika_is_read_with_names_labels_and_groups(decimal: str, write) -> None:
    path = write("a.txt", MORPHOLOGIKA.replace("4.5", f"4{decimal}5"))
    found = read_configurations(path)
    assert found.names == ("first one", "b, 2") and is_configurations(path)
    assert dict(found.columns) == {"sex": ("F", "M"), "age": ("1", "2"), "group": ("old", "new")}
    np.testing.assert_array_equal(found.points, [[[1, 2], [3, 4.5]], [[np.nan] * 2, [7, 8]]])
    assert "declares 3 individuals" in refusal_of(
        read_configurations, write("b.txt", MORPHOLOGIKA.replace("]\r\n2", "]\r\n3", 1))
    )


def raw_table(count: int) -> str:
    return "\t".join(["Identifier", *(f"RawCoord{k}" for k in range(1, count + 1))]) + "\n" + "\t".join(
        ["spec 0", *map(str, range(count))]
    ) + "\n"  # fmt: skip


@pytest.mark.parametrize(("count", "width"), [(8, 2), (10, 2), (9, 3), (15, 3)])
def test_raw_coordinates_of_morphoj_are_read(count: int, width: int, write) -> None:
    found = read_configurations(write("a.txt", raw_table(count)))
    assert found.names == ("spec 0",)
    np.testing.assert_array_equal(found.points[0], np.arange(count).reshape(-1, width))


@pytest.mark.parametrize("count", [5, 7, 12])
def test_raw_coordinates_of_two_or_three_dimensions_are_refused(count: int, write) -> None:
    sentence = refusal_of(read_configurations, write("a.txt", raw_table(count)))
    assert "MorphoJ" in sentence and "x1, y1" in sentence


AMIRA = (
    '# Avizo 3D ASCII 2.0\n\n\ndefine Markers 2\n\nParameters {\n    NumSets 1,\n    ContentType "LandmarkSet"\n}\n\n'
    "Markers { float[3] Coordinates } @1\n\n# Data section follows\n@1\n1.5 2e0 3 \n4 5 6\n\n"
)


@pytest.mark.parametrize("decimal", [".", ","])
def test_amira_landmarks_are_read(decimal: str, write) -> None:
    path = write("a.landmarkAscii", AMIRA.replace("1.5", f"1{decimal}5"))
    np.testing.assert_array_equal(list(read_landmarks(path).values()), [[1.5, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(read_configurations(path).points, [[[1.5, 2, 3], [4, 5, 6]]])
    refused = {"2 sets": AMIRA.replace("Sets 1", "Sets 2"), "declares 3": AMIRA.replace("Markers 2", "Markers 3")}
    for why, text in refused.items():
        assert why in refusal_of(read_landmarks, write("b.landmarkAscii", text))


def test_raw_coordinates_that_fit_both_are_read_with_the_dimensions(write) -> None:
    path = write("a.txt", raw_table(12))
    for dimensions in (2, 3):
        found = read_configurations(path, dimensions=dimensions)
        np.testing.assert_array_equal(found.points[0], np.arange(12).reshape(-1, dimensions))
    assert "--dimensions 2 (or 3)" in refusal_of(read_configurations, path)
    for count, dimensions, said in ((9, 2, "not a multiple of 2"), (8, 3, "not a multiple of 3"), (7, 2, "neither")):
        name = write(f"{count}.txt", raw_table(count))
        with pytest.raises(FileFormatError, match=said):
            read_configurations(name, dimensions=dimensions)
    with pytest.raises(InputError, match="has landmarks in 2-D; omit --dimensions 3"):
        read_configurations(write("a.tps", "LM=2\n1 2\n3 4\n"), dimensions=3)


def test_the_dimensions_of_a_morphoj_table_lead_to_an_analysis(write, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(0)
    header = ["Id", *(f"Raw coord {k}" for k in range(1, 13)), "sex"]
    rows = [[f"s{k}", *(f"{x:.4f}".replace(".", ",") for x in np.arange(12) ** 1.3 + rng.normal(size=12)), "fm"[k % 2]]
            for k in range(10)]  # fmt: skip
    path = write("a.txt", "\n".join("\t".join(row) for row in [header, *rows]) + "\n")
    out = path.parent
    assert main(["align", str(path), "-o", str(out / "b")]) == 2 and "--dimensions" in capsys.readouterr().err
    assert main(["align", str(path), "-o", str(out / "b"), "--dimensions", "3"]) == 0
    assert main(["landmarks", "convert", str(path), "-o", str(out / "c.csv"), "--dimensions", "2"]) == 0
    assert read_configurations(out / "c.csv").points.shape == (10, 6, 2)
    for data in ("b", "c.csv"):
        compare = ["compare", str(out / data), "~ sex", "-o", str(out / "d"), "--permutations", "99"]
        assert main(compare) == 0


def test_other_writings_of_morphologika_are_read(write) -> None:
    lines = MORPHOLOGIKA.replace("\r\n", "\n").removeprefix("\ufeff")
    sections = ["[" + part for part in lines.split("[")[1:]]
    for text in (
        "".join(sections[::-1]), lines.replace("]\n2", "] 2"), lines.replace("[", "[ ").replace("]", " ]").upper(),
        lines.replace("'#", "#"), lines.replace(" ", "\t").replace("first\tone", "first one").replace("b,\t2", "b, 2"),
    ):  # fmt: skip
        found = read_configurations(write("a.txt", text))
        assert [name.lower() for name in found.names] == ["first one", "b, 2"]
        np.testing.assert_array_equal(found.points, [[[1, 2], [3, 4.5]], [[np.nan] * 2, [7, 8]]])
    spaced = lines.replace("sex age", "sex\tplace").replace("F 1", "F\tNew York").replace("M 2", "M\tRome")
    assert read_configurations(write("b.txt", spaced)).columns["place"] == ("New York", "Rome")


@pytest.mark.parametrize("folder", ["C:\\data\\", "data/"])
def test_specimens_are_called_as_their_files_without_folders(folder: str, write) -> None:
    block = "LM=2\n1 2\n3 4\nIMAGE={}\nID=0\n"
    both = [f"{folder}a.jpg", f"{folder}b.jpg"]
    assert read_configurations(write("a.tps", "".join(map(block.format, both)))).names == ("a", "b")
    twins = ["left/a.jpg", "right/a.jpg"]
    assert read_configurations(write("b.tps", "".join(map(block.format, twins)))).names == ("left/a", "right/a")
    idav = f"1 2L 6 0 DIM=3\n{folder}a.PLY {folder}b.ply.gz\n1 2 3\n4 5 6\n0 0 0\n7 8 9\n"
    assert read_configurations(write("a.dta", idav)).names == ("a", "b")


@pytest.mark.parametrize(("system", "sign"), [
    ("RAS", -1), (" ras ", -1), ("0", -1), (0, -1), ("right-anterior-superior", -1), ("LPS", 1), (1, 1),
    ("left-posterior-superior", 1),
])  # fmt: skip
def test_the_frame_of_slicer_has_several_writings(system: object, sign: int, tmp_path: Path) -> None:
    save(tmp_path / "a.mrk.json", {**markup(POINTS[:1] + 1, "L"), "coordinateSystem": system})
    np.testing.assert_array_equal(read_landmarks(tmp_path / "a.mrk.json")["L1"], (POINTS[0] + 1) * (sign, sign, 1))


@pytest.mark.parametrize(("unit", "mm"), [("mm", 1), ("cm", 10), ("m", 1000), (["um", "um", "um"], 1e-3), ("ell", 0)])
def test_the_unit_of_slicer_is_converted_to_millimetres(unit: object, mm: float, tmp_path: Path) -> None:
    save(tmp_path / "a.mrk.json", {**markup(POINTS[2:3], "L"), "coordinateUnits": unit})
    if not mm:
        assert "coordinate units are 'ell'" in refusal_of(read_landmarks, tmp_path / "a.mrk.json")
    else:
        np.testing.assert_allclose(read_landmarks(tmp_path / "a.mrk.json")["L1"], mm * POINTS[2], rtol=1e-12)
