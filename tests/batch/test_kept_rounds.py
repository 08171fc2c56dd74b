"""Rounds of correspondence on disk: nothing is done twice, and it does not matter where it is done."""

from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from raw_blobs import marked, raw_blob
from shapespace.batch.executors import ExecutionConfig
from shapespace.batch.parallel_rounds import RoundRunner
from shapespace.correspondence.groupwise import correspond
from shapespace.correspondence.harmonics import Harmonics
from shapespace.correspondence.register import ElasticSettings
from shapespace.correspondence.registration import (
    PoseScores,
    RegistrationTask,
    RoundContext,
    ScanRegistration,
)
from shapespace.correspondence.settings import CorrespondConfig
from shapespace.correspondence.template import PoseModel, resample
from shapespace.types import Mesh, Similarity
from synthetic_shapes import blob_model

QUICK = ElasticSettings(harmonics=60, points=500, iterations=10)
SETTINGS = CorrespondConfig(vertices=400, rounds=2, mirror="never", first=QUICK, next=QUICK)
FIRST = replace(SETTINGS, rounds=1)


@pytest.fixture(scope="module")
def scans() -> list[Mesh]:
    return [raw_blob(k, points=1200).scan for k in range(3)]


@pytest.fixture
def placed(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The scans that were worked on, in order."""
    done: list[int] = []
    register: Callable[[RoundContext, RegistrationTask], ScanRegistration] = RoundContext.register

    def counted(self: RoundContext, task: RegistrationTask) -> ScanRegistration:
        done.append(task.index)
        return register(self, task)

    monkeypatch.setattr(RoundContext, "register", counted)
    return done


def kept(folder: Path, jobs: int = 1, on_done: Callable[[], None] = lambda: None) -> RoundRunner:
    return RoundRunner(folder, ExecutionConfig(jobs=jobs), True, on_done)


def test_what_was_done_before_an_interruption_is_not_done_again(
    scans: list[Mesh], placed: list[int], tmp_path: Path
) -> None:
    whole = correspond(scans, SETTINGS, run=kept(tmp_path / "whole"))
    assert placed == [0, 1, 2] * 2
    placed.clear()
    left = iter(range(4))

    def stop_at_the_fourth() -> None:
        if next(left) == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        correspond(scans, SETTINGS, run=kept(tmp_path / "cut", on_done=stop_at_the_fourth))
    again = correspond(scans, SETTINGS, run=kept(tmp_path / "cut"))
    assert placed == [0, 1, 2] * 2
    for one, other in zip(whole.scans, again.scans, strict=True):
        np.testing.assert_array_equal(one.vertices, other.vertices)


@pytest.mark.long
def test_a_damaged_file_is_made_again(scans: list[Mesh], placed: list[int], tmp_path: Path) -> None:
    correspond(scans, SETTINGS, run=kept(tmp_path))
    placed.clear()
    file = max(tmp_path.glob("*.npz"))
    file.write_bytes(file.read_bytes()[:500])
    correspond(scans, SETTINGS, run=kept(tmp_path))
    assert len(placed) == 1


@pytest.mark.long
def test_other_settings_find_nothing(scans: list[Mesh], placed: list[int], tmp_path: Path) -> None:
    one = CorrespondConfig(vertices=400, rounds=1, mirror="never", first=QUICK)
    correspond(scans, one, run=kept(tmp_path))
    placed.clear()
    other = ElasticSettings(harmonics=60, points=500, iterations=11)
    correspond(scans, CorrespondConfig(vertices=400, rounds=1, mirror="never", first=other), run=kept(tmp_path))
    assert placed == [0, 1, 2]


def test_processes_give_what_one_process_gives(scans: list[Mesh], tmp_path: Path) -> None:
    here = correspond(scans, SETTINGS, run=kept(tmp_path / "here"))
    there = correspond(scans, SETTINGS, run=kept(tmp_path / "there", jobs=2))
    for one, other in zip(here.scans, there.scans, strict=True):
        np.testing.assert_allclose(one.vertices, other.vertices, atol=1e-9)


def test_what_poses_are_found_with_is_part_of_a_task(scans: list[Mesh], placed: list[int], tmp_path: Path) -> None:
    mesh = resample(scans[0], 400)
    harmonics, task = Harmonics.of(mesh, 60), RegistrationTask(0, scans[1], None, None, QUICK)
    alone, taught = PoseModel.of(mesh), PoseModel.of(mesh, np.stack([mesh.vertices, 1.1 * mesh.vertices**2 / 100.0]))
    for pose_model in (alone, taught, alone):
        list(kept(tmp_path)(RoundContext(mesh, harmonics, (pose_model,), 0), [task]))
    assert placed == [0, 0]


def test_with_other_landmarks_what_they_do_not_touch_is_kept(placed: list[int], tmp_path: Path) -> None:
    one = [marked(raw_blob(k, points=1200)) for k in range(3)]
    correspond(one, FIRST, template=one[0], run=kept(tmp_path))
    placed.clear()
    other = replace(one[1], landmarks={name: point + 1.0 for name, point in one[1].landmarks.items()})
    correspond([one[0], other, one[2]], FIRST, template=one[0], run=kept(tmp_path))
    assert placed == [1]
    placed.clear()
    correspond(one, replace(FIRST, landmark_uncertainty=0.05), template=one[0], run=kept(tmp_path))
    assert placed == [0, 1, 2]


def test_a_model_and_landmarks_guide_in_other_processes_as_in_this_one(tmp_path: Path) -> None:
    scans, model = [marked(raw_blob(k, points=1200)) for k in range(3)], blob_model()
    here = correspond(scans, SETTINGS, model=model, run=kept(tmp_path / "here"))
    elsewhere = correspond(scans, SETTINGS, model=model, run=kept(tmp_path / "elsewhere", jobs=2))
    for one, other in zip(here.scans, elsewhere.scans, strict=True):
        np.testing.assert_array_equal(one.vertices, other.vertices)


def test_no_field_of_a_result_is_lost(scans: list[Mesh], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    mesh = resample(scans[0], 400)
    count, T = len(mesh.vertices), Similarity(1.5, np.eye(3), np.ones(3))
    stored = ScanRegistration(
        index=3, vertices=np.array(mesh.vertices), T_scan_template=T, observed=np.ones(count, np.bool_), covered=0.9,
        distance=(1.0, 2.0, 3.0, 4.0), cpu_s=5.0, reason="why", mirrored=True, scores=PoseScores(0.1, 0.2),
        posed_by_landmarks=True, stretch=0.3, bent=True, colours=np.full((count, 3), 8, np.uint8), relief_gap=0.4,
        symmetries=np.zeros((2, count), np.int32),
    )  # fmt: skip
    usual = {field.name: field.default for field in fields(ScanRegistration)}
    assert not [name for name in usual if name != "alternatives" and getattr(stored, name) is usual[name]]
    monkeypatch.setattr(RoundContext, "register", lambda *_: replace(stored, alternatives=(stored, stored)))
    context = RoundContext(mesh, Harmonics.of(mesh, 60), (PoseModel.of(mesh),), 0)
    task = RegistrationTask(3, scans[1], None, None, QUICK)
    for _ in range(2):  # computed, and read again
        [read] = kept(tmp_path)(context, [task])
        for one in (read, *read.alternatives):
            for name in usual.keys() - {"alternatives", "T_scan_template"}:
                np.testing.assert_array_equal(getattr(one, name), getattr(stored, name), err_msg=name)
            np.testing.assert_array_equal(one.T_scan_template.apply(np.eye(3)), T.apply(np.eye(3)))


def test_each_field_of_a_task_is_part_of_its_key(scans: list[Mesh], placed: list[int], tmp_path: Path) -> None:
    mesh, task = resample(scans[0], 400), RegistrationTask(0, scans[1], Similarity.identity(), None, QUICK)
    context = RoundContext(mesh, Harmonics.of(mesh, 60), (PoseModel.of(mesh),), 0)
    colours = np.zeros((len(scans[1].vertices), 3), np.uint8)
    known = replace(task, is_start_known=True)
    others = [known, replace(known, scan=replace(scans[1], colours=colours)), replace(known, bent=True)]
    others += [replace(known, from_all_poses=True), replace(known, other_pose=Similarity.identity())]
    for one in others * 2:
        list(kept(tmp_path)(context, [one]))
    assert len(placed) == len(others)


@pytest.mark.long
def test_colours_and_subjects_reach_other_processes(scans: list[Mesh], tmp_path: Path) -> None:
    painted = [replace(scan, colours=np.uint8(255) * (scan.vertices > scan.vertices.mean(axis=0))) for scan in scans]
    here = correspond(painted, SETTINGS, subjects=["a", "a", "b"])
    elsewhere = correspond(painted, SETTINGS, subjects=["a", "a", "b"], run=kept(tmp_path / "there", jobs=2))
    for one, other in zip(here.scans, elsewhere.scans, strict=True):
        np.testing.assert_allclose(one.vertices, other.vertices, atol=1e-9)
