from dataclasses import FrozenInstanceError
from pathlib import Path

import pytest

from shapespace.datasets import expression_sets as sets
from shapespace.datasets.expression_sets import EXPRESSIONS, KINDS, ScanEntry, find_scans, scan_set
from shapespace.datasets.faces import EXPRESSIONS as FACE_EXPRESSIONS
from shapespace.datasets.faces import write_faces
from shapespace.errors import FileError, InputError


def put(folder: Path, *names: str) -> None:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"")


def refusal(folder: Path, **options: object) -> str:
    with pytest.raises((InputError, FileError)) as caught:
        find_scans(folder, **options)
    text = str(caught.value)
    assert text.endswith(".") and "\n" not in text and folder.name in text and len(text) < 600
    return text


def left(folder: Path) -> dict[str, str]:
    return {left.name: left.why for left in scan_set(folder).left_out}


def test_the_words_are_those_of_the_bundled_faces():
    assert set(EXPRESSIONS) == set(FACE_EXPRESSIONS)
    assert set(sets.BU3DFE_EXPRESSIONS.values()) == set(EXPRESSIONS)
    assert set(sets.BOSPHORUS_EXPRESSIONS.values()) == set(EXPRESSIONS) - {"neutral"}
    assert set(sets.BOSPHORUS_KINDS.values()) == set(KINDS)
    assert set(sets.LABEL_WORDS.values()) < set(EXPRESSIONS)
    assert not set(sets.LABEL_WORDS) & set(EXPRESSIONS)


# BU-3DFE

CODES = {"AN": "anger", "DI": "disgust", "FE": "fear", "HA": "smile", "SA": "sadness", "SU": "surprise"}
LEVELS = {"01": 0.25, "02": 0.5, "03": 0.75, "04": 1.0}


@pytest.mark.parametrize("subject", ["F0001", "M0044"])
@pytest.mark.parametrize("ancestry", ["AE", "AM", "BL", "IN", "LA", "WH"])
def test_a_whole_person_of_bu3dfe_is_25_scans(tmp_path: Path, subject: str, ancestry: str):
    names = {f"{subject}_NE00{ancestry}": ("neutral", 0.0)}
    names |= {f"{subject}_{c}{n}{ancestry}": (word, size) for c, word in CODES.items() for n, size in LEVELS.items()}
    for name in names:
        put(tmp_path, *(f"{subject}/{name}_{rest}" for rest in ("F3D.wrl", "RAW.wrl", "F3D.bnd", "F2D.bmp", "RAW.pse")))
    found = find_scans(tmp_path)
    assert len(found) == 25
    for scan in found:
        name = scan.path.name.removesuffix("_F3D.wrl")
        assert (scan.expression, scan.intensity) == names.pop(name)
        assert scan.subject == subject
        assert scan.kind == ("neutral" if scan.expression == "neutral" else "expression")
    assert not names
    assert set(left(tmp_path).values()) == {"another file of the same scan"}
    assert len(left(tmp_path)) == 25
    assert scan_set(tmp_path).layout == "BU-3DFE"


def test_the_cut_out_face_in_vrml_is_preferred_then_what_is_left(tmp_path: Path):
    order = ["F3D.wrl", "F3D.ply", "F3D.pcd", "RAW.wrl", "RAW.obj", "RAW.xyz"]
    put(tmp_path, *(f"F0001/F0001_AN01WH_{rest}" for rest in order))
    for rest in order:
        (scan,) = find_scans(tmp_path)
        assert scan.path.name == f"F0001_AN01WH_{rest}"
        scan.path.unlink()


def test_a_name_without_a_part_comes_between(tmp_path: Path):
    put(tmp_path, "F0001_AN01WH.wrl", "F0001_AN01WH_RAW.wrl")
    assert find_scans(tmp_path)[0].path.name == "F0001_AN01WH.wrl"
    put(tmp_path, "F0001_AN01WH_F3D.wrl")
    assert find_scans(tmp_path)[0].path.name == "F0001_AN01WH_F3D.wrl"


def test_names_may_be_in_small_letters(tmp_path: Path):
    put(tmp_path, "f0001/f0001_ha04wh_f3d.WRL")
    (scan,) = find_scans(str(tmp_path))
    assert scan == ScanEntry(scan.path, "F0001", "smile", 1.0, "expression")


@pytest.mark.parametrize(
    "name",
    ["F0001_AN00WH", "F0001_NE01WH", "F0001_AN05WH", "F0001_XX01WH", "F0001_AN01XX", "F001_AN01WH", "X0001_AN01WH",
     "F0001_AN01WH_F4D", "F0001_AN1WH", "bs000_E_BORED_0", "bs000_N_X_0", "bs000_X_Y_0", "bs000_E_HAPPY", "b000_N_N_0"],
)  # fmt: skip
def test_names_that_say_nothing_known_are_reported(tmp_path: Path, name: str):
    put(tmp_path, f"sub/{name}.wrl")
    assert "no labelled scans" in refusal(tmp_path)
    put(tmp_path, "F0009_NE00WH_F3D.wrl")
    assert left(tmp_path) == {f"sub/{name}.wrl": "a name of unknown form"}
    assert f"a name of unknown form: sub/{name}.wrl." in scan_set(tmp_path).summary()


def test_the_same_scan_in_two_folders_counts_once_and_is_reported(tmp_path: Path):
    put(tmp_path, "a/F0001_AN01WH_F3D.wrl", "b/F0001_AN01WH_F3D.wrl", "c/F0001_AN01BL_F3D.wrl")
    assert [scan.path.parent.name for scan in find_scans(tmp_path)] == ["a"]
    again = "the same scan twice"
    assert left(tmp_path) == {"b/F0001_AN01WH_F3D.wrl": again, "c/F0001_AN01BL_F3D.wrl": again}


def test_people_without_a_neutral_scan_are_named(tmp_path: Path):
    put(tmp_path, "F0001_NE00WH_F3D.wrl", "F0001_AN04WH_F3D.wrl", "M0002_AN04WH_F3D.wrl")
    found = scan_set(tmp_path)
    assert found.subjects_without_neutral() == ("M0002",)
    assert found.summary().splitlines() == [
        "BU-3DFE: 3 scans of 2 subjects (neutral 1, anger 2).",
        "No neutral scan: M0002.",
    ]


# Bosphorus

TAKES = {
    "N_N_0": ("neutral", "neutral", 0.0),
    "N_N_3": ("neutral", "neutral", 0.0),
    **{
        f"E_{code}_0": (word, "expression", 1.0)
        for code, word in {
            "ANGER": "anger", "DISGUST": "disgust", "FEAR": "fear", "HAPPY": "smile", "SADNESS": "sadness",
            "SURPRISE": "surprise",
        }.items()
    },
    "E_HAPPY_1": ("smile", "expression", 1.0),
    "LFAU_12_0": ("LFAU_12", "action unit", 1.0),
    "LFAU_12L_0": ("LFAU_12L", "action unit", 1.0),
    "UFAU_1_0": ("UFAU_1", "action unit", 1.0),
    "CAU_A12A15_0": ("CAU_A12A15", "action unit", 1.0),
    "YR_R10_0": ("YR_R10", "rotation", 1.0),
    "YR_L90_0": ("YR_L90", "rotation", 1.0),
    "PR_SD_0": ("PR_SD", "rotation", 1.0),
    "CR_RD_0": ("CR_RD", "rotation", 1.0),
    "O_EYE_0": ("O_EYE", "occlusion", 1.0),
    "O_GLASSES_0": ("O_GLASSES", "occlusion", 1.0),
}  # fmt: skip


@pytest.fixture
def bosphorus(tmp_path: Path) -> Path:
    put(tmp_path, *(f"bs000/bs000_{take}{end}" for take in TAKES for end in (".bnt", ".lm3", ".lm2", ".png")))
    return tmp_path


def test_every_kind_of_bosphorus_scan_is_told_apart(bosphorus: Path):
    found = {scan.path.stem.removeprefix("bs000_"): scan for scan in find_scans(bosphorus, KINDS)}
    assert {name: (scan.expression, scan.kind, scan.intensity) for name, scan in found.items()} == TAKES
    assert {scan.subject for scan in found.values()} == {"bs000"}


def test_only_neutral_and_expressions_unless_others_are_asked_for(bosphorus: Path):
    assert {scan.kind for scan in find_scans(bosphorus)} == {"neutral", "expression"}
    assert len(find_scans(bosphorus)) == 9
    lines = scan_set(bosphorus).summary().splitlines()
    assert lines[0].startswith("Bosphorus: 9 scans of 1 subject (neutral 2, anger 1, disgust 1, fear 1, smile 2,")
    assert "Excluded, not asked for (occlusion): bs000/bs000_O_EYE_0.bnt, bs000/bs000_O_GLASSES_0.bnt." in lines
    units = next(line for line in lines if line.startswith("Excluded, not asked for (action unit): "))
    assert units.count("bs000/bs000_") == 3 and units.endswith(" and 1 more.")
    assert {scan.kind for scan in find_scans(bosphorus, ["rotation"])} == {"rotation"}


def test_kinds_that_are_none_are_refused(bosphorus: Path):
    for kinds in (["yaw"], []):
        with pytest.raises(InputError, match="choose from neutral, expression"):
            find_scans(bosphorus, kinds)


def test_a_folder_without_the_kind_asked_for_is_refused(tmp_path: Path):
    put(tmp_path, "bs000_YR_R10_0.bnt")
    assert "no scans of kind neutral or expression" in refusal(tmp_path)


def test_the_databases_are_not_mixed(tmp_path: Path):
    put(tmp_path, "bs000_N_N_0.bnt", "F0001_NE00WH_F3D.wrl")
    assert "BU-3DFE and Bosphorus" in refusal(tmp_path) or "Bosphorus and BU-3DFE" in refusal(tmp_path)


# labels.csv


def label(folder: Path, *lines: str, header: str = "file,subject,expression,intensity") -> None:
    (folder / "labels.csv").write_text("\n".join([header, *lines, ""]), "utf-8")


def test_labels_beside_the_scans_win_over_names(tmp_path: Path):
    put(tmp_path, "F0001_AN01WH_F3D.wrl", "b/c.ply", "d.obj")
    label(tmp_path, "F0001_AN01WH_F3D.wrl,anna,Happy,0.3", "b/c.ply,anna,neutral,1", "d.obj,anna,kiss,")
    found = scan_set(tmp_path)
    assert found.layout == "labels.csv"
    assert [(s.path, s.subject, s.expression, s.intensity, s.kind) for s in found.scans] == [
        (tmp_path / "b/c.ply", "anna", "neutral", 0.0, "neutral"),
        (tmp_path / "F0001_AN01WH_F3D.wrl", "anna", "smile", 0.3, "expression"),
        (tmp_path / "d.obj", "anna", "kiss", 1.0, "expression"),
    ]
    assert "Expressions of other names: kiss." in found.summary()


@pytest.mark.parametrize("word", [*sets.LABEL_WORDS, *EXPRESSIONS])
def test_other_words_for_an_expression_are_the_same(tmp_path: Path, word: str):
    put(tmp_path, "a.ply")
    label(tmp_path, f" a.ply , x , {word.upper()} ", header="\ufeffFile, Subject ,EXPRESSION")
    assert find_scans(tmp_path)[0].expression == sets.LABEL_WORDS.get(word, word)


def test_what_data_faces_writes_is_read(tmp_path: Path):
    write_faces(tmp_path / "people", subjects=2, expressions=["neutral", "smile"])
    found = scan_set(tmp_path / "people")
    assert [(s.subject, s.expression, s.intensity) for s in found.scans] == [
        ("subject_000", "neutral", 0.0), ("subject_000", "smile", 1.0),
        ("subject_001", "neutral", 0.0), ("subject_001", "smile", 1.0),
    ]  # fmt: skip
    assert found.left_out == ()


def test_lines_and_files_without_a_counterpart_are_reported(tmp_path: Path):
    put(tmp_path, "a.ply", "b.ply", "notes.txt")
    label(
        tmp_path, "a.ply,x,anger,1", "./a.ply,y,fear,1", "gone.ply,x,fear,1", "notes.txt,x,fear,1",
        f"{'n' * 5000}.ply,x,fear,1", "z\0.ply,x,fear,1",
    )  # fmt: skip
    assert len(find_scans(tmp_path)) == 1
    why = left(tmp_path)
    assert why.pop("./a.ply (line 3)") == "a second label of the same file"
    assert why.pop("notes.txt (line 5)") == "not a mesh"
    assert why.pop("b.ply") == "not in labels.csv"
    assert set(why.values()) == {"no such file"} and len(why) == 3


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("", "no column file and subject and expression"),
        ("file,subject\na.ply,x\n", "no column expression"),
        ("file,subject,expression\na.ply,,anger\n", "line 2 has no subject"),
        ("file,subject,expression\na.ply\n", "no subject and no expression"),
        ("file,subject,expression,intensity\na.ply,x,anger,2\n", "no number from 0 to 1"),
        ("file,subject,expression,intensity\na.ply,x,anger,nan\n", "no number from 0 to 1"),
        ("file,subject,expression,intensity\na.ply,x,anger,high\n", "no number from 0 to 1"),
        ("file,subject,expression\ngone.ply,x,anger\n", "names no scan"),
        ('file,subject,expression\n"a.ply,x,anger\n', "not comma-separated"),
        (b"\xff\xfe\x00", "not comma-separated"),
    ],
)
def test_labels_laid_out_otherwise_are_refused(tmp_path: Path, text: str | bytes, why: str):
    put(tmp_path, "a.ply")
    (tmp_path / "labels.csv").write_bytes(text if isinstance(text, bytes) else text.encode())
    assert why in refusal(tmp_path)


# Folders


def test_folders_that_hold_none_are_refused(tmp_path: Path):
    assert "no labelled scans" in refusal(tmp_path)
    assert "no such file" in refusal(tmp_path / "gone")
    put(tmp_path, "a.ply")
    assert "a file, not a folder" in refusal(tmp_path / "a.ply")


def test_hidden_files_and_folders_are_not_scans(tmp_path: Path):
    put(tmp_path, "F0001_NE00WH_F3D.wrl", ".F0001_AN01WH_F3D.wrl", ".old/F0001_AN01WH_F3D.wrl")
    assert len(find_scans(tmp_path)) == 1 and not left(tmp_path)


def test_entries_do_not_change(tmp_path: Path):
    put(tmp_path, "F0001_NE00WH_F3D.wrl")
    with pytest.raises(FrozenInstanceError):
        find_scans(tmp_path)[0].subject = "x"  # type: ignore[misc]
