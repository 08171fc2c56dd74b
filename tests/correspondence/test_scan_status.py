"""The status of scans in correspondence: surfaces that the shapes of the others contradict are doubtful."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_published_correspondence import bone, drawn

import shapespace as ss
from raw_blobs import raw_blob
from shapespace.cli import main
from shapespace.correspondence import groupwise
from shapespace.correspondence.groupwise import FinishedCorrespondence, add_scans, correspond
from shapespace.correspondence.register import ElasticSettings
from shapespace.correspondence.scan_status import Judgement, SurfaceEvidence, judge
from shapespace.correspondence.settings import CorrespondConfig
from shapespace.geometry.mirror_plane import mirror_image
from shapespace.io.meshes.mesh_io import write_mesh
from shapespace.report.inputs.correspondence_folder import Corresponded

QUICK = ElasticSettings(harmonics=60, points=500, iterations=10)
CONFIG = CorrespondConfig(vertices=300, rounds=2, mirror="never", first=QUICK, next=QUICK)
BLOBS = [raw_blob(k, points=700) for k in range(6)]
MIRRORED = 2
DOUBTED = 0.9  # probability of a right surface below which it is doubtful
SURE = SurfaceEvidence(relief_agreement=1.3, usual_relief_agreement=1.3, consensus_deg=3.0)


def test_a_surface_that_nothing_contradicts_has_converged() -> None:
    judgement = judge(SURE)
    assert judgement.status == "converged" and judgement.doubt == "" and judgement.probability > 0.98


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"consensus_deg": 178.0, "relief_agreement": 1.2}, "rotated by 178 degrees"),
        ({"relief_agreement": 0.5}, "correlate with those of the others by 0.46 (usual: 0.86)"),
    ],
)
def test_each_kind_of_evidence_makes_a_surface_doubtful_and_is_named(change: dict[str, float], words: str) -> None:
    judgement = judge(replace(SURE, **change))
    assert judgement.status == "doubtful" and judgement.probability < DOUBTED
    assert words in judgement.doubt


def test_what_all_scans_have_in_common_does_not_make_them_doubtful() -> None:
    assert judge(replace(SURE, relief_agreement=0.2, usual_relief_agreement=0.2)).status == "converged"


@pytest.mark.long
def test_a_mirrored_scan_whose_file_is_trusted_is_doubtful_and_no_other() -> None:
    bones = drawn(bone, 5).scans
    made = correspond([mirror_image(one) if k == MIRRORED else one for k, one in enumerate(bones)], CONFIG)
    assert [scan.status == "doubtful" for scan in made.scans] == [k == MIRRORED for k in range(len(bones))]
    assert made.scans[MIRRORED].probability < 0.1


@pytest.mark.long
def test_an_added_scan_has_a_status_of_its_own() -> None:
    made = correspond(drawn(bone, 5).scans, CONFIG)
    finished = FinishedCorrespondence(made.template, made.landmarks, made.meshes())
    new = drawn(bone, 8).scans
    right, mirrored = add_scans(finished, [new[0], mirror_image(new[1])], CONFIG).scans
    assert right.status == "converged"
    assert mirrored.status == "doubtful" or mirrored.reason


def test_build_leaves_doubtful_surfaces_out_with_a_note_and_includes_them_on_request(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    # Rounding differs between platforms, so the status is set here; how it is determined is tested above.
    seen: list[SurfaceEvidence] = []

    def judge_one(evidence: SurfaceEvidence) -> Judgement:
        seen.append(evidence)
        return judge(replace(SURE, relief_agreement=0.3)) if len(seen) == MIRRORED + 1 else judge(SURE)

    monkeypatch.setattr(groupwise, "judge", judge_one)
    (tmp_path / "scans").mkdir()
    for one in BLOBS:
        write_mesh(tmp_path / "scans" / f"{one.scan.name}.ply", one.scan)
    same = str(tmp_path / "same")
    given = ["--vertices", "200", "--rounds", "1", "--jobs", "1", "--quiet", "--mirror", "never"]
    assert main(["correspond", str(tmp_path / "scans"), "-o", same, *given]) == 0
    output = capsys.readouterr()
    summary = json.loads((tmp_path / "same" / "correspondence.json").read_text())
    doubtful = summary["doubtful"]
    assert len(doubtful) == 1 and set(doubtful) <= set(summary["corresponding"])
    assert f"({len(doubtful)} doubtful)" in output.out
    reviews = {record.name: record.review for record in Corresponded(tmp_path / "same").corresponding}
    codes = {
        name: [*(["doubtful"] if name in doubtful else []), *(r.code for r in own)] for name, own in reviews.items()
    }
    assert summary["needs_review"] == {name: own for name, own in codes.items() if own}
    assert f"{len(summary['needs_review'])} of {len(BLOBS)} surfaces need" in output.out
    for scan in (one.scan for one in BLOBS):
        record = json.loads((tmp_path / "same" / f"{scan.name}.correspond.json").read_text())
        assert (record["status"] == "doubtful") == (scan.name in doubtful) == (record["probability"] < DOUBTED)
        assert (f"{scan.name} is doubtful: {record['doubt']}" in output.err + output.out) == (scan.name in doubtful)
    assert main(["build", same, "-o", str(tmp_path / "m.h5"), "--quiet"]) == 0
    assert (
        f"{len(doubtful)} of {len(BLOBS)} surfaces are doubtful and excluded ({doubtful[0]}" in capsys.readouterr().err
    )
    assert ss.ShapeModel.load(tmp_path / "m.h5").n_training == len(BLOBS) - len(doubtful)
    assert main(["build", same, "-o", str(tmp_path / "all.h5"), "--quiet", "--with-doubtful"]) == 0
    assert ss.ShapeModel.load(tmp_path / "all.h5").n_training == len(BLOBS)


def test_limbs_that_can_be_assigned_otherwise_make_a_surface_doubtful() -> None:
    assert judge(replace(SURE, relief_gap=0.5)).status == "converged"
    judgement = judge(replace(SURE, relief_gap=0.1))
    assert judgement.status == "doubtful" and "limbs may be exchanged" in judgement.doubt


def test_a_relief_that_agrees_well_is_no_doubt_where_others_agree_even_better() -> None:
    usual, well, less = np.arctanh([0.97, 0.92, 0.8]).tolist()
    assert judge(SurfaceEvidence(relief_agreement=well, usual_relief_agreement=usual)).status == "converged"
    assert judge(SurfaceEvidence(relief_agreement=less, usual_relief_agreement=usual)).status == "doubtful"
