"""Scans that the studio makes: surfaces of dropped label volumes, and groomed scans, both by recorded commands."""

from pathlib import Path

import httpx
import nibabel
import numpy as np
import pytest
from test_studio_project import tetrahedron
from test_studio_server import ended, own_home, state, studio, until, upload

from shapespace.datasets.bones import Bone
from shapespace.datasets.organs import raw_surface
from shapespace.errors import InputError
from shapespace.geometry.mirror_plane import mirror_image
from shapespace.geometry.normals import faces_of
from shapespace.geometry.volume_surface import count_labels
from shapespace.io.meshes.mesh_io import read_mesh, write_mesh
from shapespace.io.volume_io import read_volume
from shapespace.types import LabelVolume, Mesh, Segment
from synthetic_shapes import sphere, twisted

__all__ = ["own_home"]


def balls(*labels: int) -> np.ndarray:
    """Return a volume with a ball of each label next to each other."""
    x, y, z = np.meshgrid(np.arange(20 * len(labels)), np.arange(20), np.arange(20), indexing="ij")
    values = np.zeros(x.shape, dtype=np.int16)
    for k, label in enumerate(labels):
        values[np.hypot(np.hypot(x - 20 * k - 10, y - 10), z - 10) < 7 - k] = label
    return values


def nifti(path: Path, values: np.ndarray) -> Path:
    nibabel.save(nibabel.Nifti1Image(values, np.eye(4)), path)
    return path


def drop(client: httpx.Client, volume: Path) -> str:
    answer = client.put("/api/volumes", params={"name": volume.name}, content=volume.read_bytes())
    assert answer.status_code == 201, answer.text
    return answer.json()["file"]


def run(client: httpx.Client, kind: str, options: dict[str, object]) -> int:
    answer = client.post("/api/jobs", json={"kind": kind, "options": options})
    assert answer.status_code == 201, answer.text
    return answer.json()["number"]


def test_labels_are_counted_and_named() -> None:
    values = balls(3, 5)
    counts = count_labels(LabelVolume(values, np.eye(4)))
    assert [(count.choice, count.voxels) for count in counts] == [
        (str(label), int((values == label).sum())) for label in (3, 5)
    ]
    segments = (Segment("bone", 3, 0, "Segment_1"), Segment("left, upper", 5, 0, "Segment_2"))
    named = count_labels(LabelVolume(values, np.eye(4), "head.seg.nrrd", segments=segments))
    assert [(count.choice, count.name) for count in named] == [("bone", "bone"), ("Segment_2", "left, upper")]


@pytest.mark.parametrize("kind", ["grey values", "grey values of a byte", "no label"])
def test_a_volume_that_is_no_segmentation_is_rejected_in_a_sentence(tmp_path: Path, kind: str) -> None:
    rng = np.random.default_rng(0)
    x, y, z = np.meshgrid(*(np.linspace(-1, 1, 60),) * 3, indexing="ij")
    body = np.hypot(np.hypot(x, y), z) < 0.7
    values = (
        np.where(body, 40, -1000) + rng.normal(0, 12, body.shape) if kind.startswith("grey") else np.zeros((9, 9, 9))
    )
    values = np.where(np.hypot(x, y) > 0.95, -1024, values) if kind.startswith("grey") else values
    if kind.endswith("byte"):
        values = np.clip((values + 160) / 400 * 255, 0, 255)
    volume = read_volume(nifti(tmp_path / "scan.nii.gz", values.astype(np.int16)))
    with pytest.raises(InputError, match=r"scan\.nii\.gz: (most neighbouring voxels differ|all its voxels are 0)"):
        count_labels(volume)


def test_a_segmentation_of_thin_and_of_many_parts_is_no_image() -> None:
    x, y, z = np.meshgrid(*(np.arange(60),) * 3, indexing="ij")
    radius = np.hypot(np.hypot(x - 30, y - 30), z - 30)
    parcels = np.where((radius > 22) & (radius < 24.5), 1 + x // 6 + 10 * (y // 6) + 100 * (z // 6), 0)
    assert len(count_labels(LabelVolume(parcels, np.eye(4)))) > 200
    whole = np.ones((9, 9, 9), dtype=np.uint8)
    assert count_labels(LabelVolume(whole, np.eye(4)))[0].voxels == 9**3


def test_dropped_volumes_become_specimens_by_a_recorded_command(tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    with studio(tmp_path / "p") as client:
        files = [
            drop(client, nifti(tmp_path / "anna.nii.gz", balls(1, 2))),
            drop(client, nifti(tmp_path / "ben.nii.gz", balls(1))),
            drop(client, nifti(tmp_path / "other" / "anna.nii.gz", balls(2))),
            drop(client, tmp_path / "other" / "anna.nii.gz"),
        ]
        assert files == ["scans/anna.nii.gz", "scans/ben.nii.gz", "scans/anna-2.nii.gz", "scans/anna-2.nii.gz"]
        again = client.put("/api/volumes", params={"name": "z.nii.gz"}, content=(tmp_path / "ben.nii.gz").read_bytes())
        assert again.json() == {"file": "scans/ben.nii.gz", "same_as": "ben.nii.gz"}
        assert len(list((tmp_path / "p" / "scans").iterdir())) == 3
        values = balls(2)
        values[0, 0, 0] = 3  # another volume with the same surface of label 2
        files[3] = drop(client, nifti(tmp_path / "other" / "anna.nii.gz", values))
        assert files[3] == "scans/anna-3.nii.gz"
        assert state(client)["specimens"] == []
        labels = [client.post("/api/labels", json={"file": file}).json() for file in files]
        assert [[label["choice"] for label in one] for one in labels] == [["1", "2"], ["1"], ["2"], ["2", "3"]]
        run(client, "surface", {"files": files, "set": "new", "--label": "2", "--smooth": "0.8"})
        project = until(client, lambda now: ended(now) and len(now["specimens"]) == 2)
        (job,) = project["jobs"]
        assert job["status"] == "done" and job["partly"]
        assert "ben.nii.gz" in job["message"] and "it has no label 2; choose from 1" in job["message"]
        assert "--label=2 --smooth=0.8" in job["command"]
        assert {(one["id"], one["set"]) for one in project["specimens"]} == {("anna", "new"), ("anna-2", "new")}
        assert job["message"].endswith("anna-3 is the same surface as anna-2; it was not added.")
        assert "making" not in job["message"] and job["message"].startswith("scans/ben.nii.gz: ")
        project = until(client, lambda now: all(one["state"] == "ready" for one in now["specimens"]))
        assert 10 < project["specimens"][0]["extent"] < 14
        client.post("/api/undo", json={"revision": project["revision"]})
        assert state(client)["specimens"] == []
        history = (tmp_path / "p" / "history.sh").read_text()
        assert '"$PROJECT"/scans/anna.nii.gz' in history and '-o "$PROJECT"/surfaces/0001' in history
    with studio(tmp_path / "p") as client:  # what was undone is not taken again
        assert state(client)["specimens"] == []


def test_volumes_that_cannot_be_used_are_rejected_and_those_without_a_choice_are_removed(tmp_path: Path) -> None:
    with studio(tmp_path / "p") as client:
        broken = tmp_path / "broken.nii.gz"
        broken.write_bytes(nifti(tmp_path / "good.nii.gz", balls(1)).read_bytes()[:200])
        files = [drop(client, broken), drop(client, tmp_path / "good.nii.gz")]
        answer = client.post("/api/labels", json={"file": files[0]})
        assert answer.status_code == 422 and answer.json()["error"].startswith(("Cannot read broken", "broken"))
        assert str(tmp_path) not in answer.json()["error"]
        for file in ("scans/../project.json", "project.json", "/etc/passwd", 5, None):
            assert client.post("/api/labels", json={"file": file}).status_code == 422
        for names in (files[0], 5, None, [], ["scans/s0.ply"]):
            answer = client.post("/api/jobs", json={"kind": "surface", "options": {"files": names}})
            assert answer.status_code == 422 and "volume" in answer.json()["error"]
        assert client.put("/api/volumes", params={"name": "a.mhd"}, content=b"x").status_code == 415
        run(client, "surface", {"files": files[1:]})
        assert client.request("DELETE", "/api/volumes", json={"files": files}).status_code == 200
        assert [path.name for path in (tmp_path / "p" / "scans").iterdir()] == ["good.nii.gz"]
        until(client, ended)


def dirty(path: Path) -> Mesh:
    """Write a ball with a second, smaller one; return the ball alone."""
    points, faces = sphere(200)
    small = 0.2 * points + [5.0, 0.0, 0.0]
    write_mesh(path, Mesh(np.concatenate([points, small]), np.concatenate([faces, faces + 200]).astype(np.int32)))
    return Mesh(points, faces)


def test_groomed_scans_replace_scans_until_they_are_undone(tmp_path: Path) -> None:
    ball = dirty(tmp_path / "ball.ply")
    with studio(tmp_path / "p") as client:
        upload(client, tmp_path, 1)
        client.put("/api/specimens", params={"name": "ball.ply"}, content=(tmp_path / "ball.ply").read_bytes())
        client.post("/api/edit", json={
            "what": "unit", "ids": ["ball"], "unit": "cm", "revision": state(client)["revision"],
        })  # fmt: skip
        run(client, "groom", {"ids": ["ball"], "--largest": True})
        project = until(client, lambda now: ended(now) and any(one["groomed"] for one in now["specimens"]))
        tetra, groomed = sorted(project["specimens"], key=lambda one: -len(one["id"]))[::-1]
        assert (groomed["file"], groomed["unit"]) == ("groomed/0001/ball.ply", "cm") and not tetra["groomed"]
        written = read_mesh(tmp_path / "p" / groomed["file"])
        assert np.array_equal(written.vertices, ball.vertices) and np.array_equal(faces_of(written), faces_of(ball))
        # A crop that misses: the job fails with the reason, and the specimen stays as it was.
        run(client, "groom", {"ids": ["ball"], "--crop": "sphere:99,0,0,1"})
        project = until(client, ended)
        assert project["jobs"][-1]["status"] == "failed" and "leaves 0 of its 200" in project["jobs"][-1]["message"]
        # One of two: the other one is groomed, and the message is about the first.
        run(client, "groom", {"ids": ["ball", "s0"], "--crop": "outside:0,0,0,0.9"})
        project = until(client, ended)
        assert project["jobs"][-1]["partly"] and "s0.ply" in project["jobs"][-1]["message"]
        by_id = {one["id"]: one["file"] for one in project["specimens"]}
        assert by_id == {"ball": "groomed/0003/ball.ply", "s0": "scans/s0.ply"}
        client.post("/api/undo", json={"revision": project["revision"]})
        client.post("/api/undo", json={"revision": project["revision"] + 1})
        assert {one["file"] for one in state(client)["specimens"]} == {"scans/ball.ply", "scans/s0.ply"}
        assert client.post("/api/jobs", json={"kind": "groom", "options": {"ids": ["s0"]}}).status_code == 422
        answer = client.post("/api/jobs", json={"kind": "groom", "options": {"ids": ["s0"], "--unit": "cm"}})
        assert answer.status_code == 422 and "has no option" in answer.json()["error"]


def test_a_groomed_scan_can_be_replaced_by_its_original_after_a_restart(tmp_path: Path) -> None:
    dirty(tmp_path / "ball.ply")
    with studio(tmp_path / "p") as client:
        client.put("/api/specimens", params={"name": "ball.ply"}, content=(tmp_path / "ball.ply").read_bytes())
        for option in ("--largest", "--outer"):
            number = run(client, "groom", {"ids": ["ball"], option: True})
            until(client, lambda now, n=number: now["specimens"][0]["file"] == f"groomed/{n:04d}/ball.ply")
    with studio(tmp_path / "p") as client:
        project = state(client)
        assert project["undo"] is None and project["specimens"][0]["groomed"]
        again = client.put("/api/specimens", params={"name": "x.ply"}, content=(tmp_path / "ball.ply").read_bytes())
        assert again.json() == {"id": "ball", "same_as": "ball"}
        client.post("/api/edit", json={"what": "original", "ids": ["ball"], "revision": project["revision"]})
        (ball,) = state(client)["specimens"]
        assert ball["file"] == "scans/ball.ply" and not ball["groomed"]


def test_a_result_of_the_scan_before_it_was_groomed_is_outdated(tmp_path: Path) -> None:
    from test_studio_project import Done

    from shapespace.viewer.studio.project import Project

    project = Project.open(tmp_path / "p", create=True)
    for k, name in enumerate("abc"):
        project.add(tetrahedron(project.new_file(f"{name}.ply"), 1.0 + k), "training")
    done = Done(project)
    done.run("correspond")
    assert not done.outdated
    project.take_groomed({"scans/a.ply": "groomed/0002/a.ply", "scans/unknown.ply": "groomed/0002/unknown.ply"})
    assert project.undo_text == "groom a" and done.outdated == {1: "specimens"}
    project.undo(project.revision)
    assert not done.outdated


def test_a_mirrored_specimen_is_named_before_the_correspondence_until_it_is_mirrored(tmp_path: Path) -> None:
    with studio(tmp_path / "p") as client:
        for k in range(10):
            bone = twisted(raw_surface(Bone.draw(np.random.default_rng(k)), np.random.default_rng(k), 600))
            scan = tmp_path / f"bone{k}.ply"
            write_mesh(scan, mirror_image(bone) if k == 4 else bone)
            client.put("/api/specimens", params={"name": scan.name}, content=scan.read_bytes())
        project = until(client, lambda now: all(one["state"] == "ready" for one in now["specimens"]))
        question = {"kind": "correspond", "options": {}}
        warnings = [check["text"] for check in client.post("/api/checks", json=question).json()[1:]]
        assert len(warnings) == 1 and warnings[0].startswith("bone4: Probably a mirror image of most others")
        mirror = {"what": "mirror", "ids": ["bone4"], "mirrored": True, "revision": project["revision"]}
        client.post("/api/edit", json=mirror)
        assert len(client.post("/api/checks", json=question).json()) == 1


def test_a_specimen_in_another_unit_is_named_before_the_correspondence_until_its_unit_is_set(tmp_path: Path) -> None:
    with studio(tmp_path / "p") as client:
        for k in range(6):
            bone = raw_surface(Bone.draw(np.random.default_rng(k)), np.random.default_rng(k), 600)
            scan = tmp_path / f"bone{k}.ply"
            write_mesh(scan, bone.with_vertices(bone.vertices * (0.1 if k == 4 else 1.0)))
            client.put("/api/specimens", params={"name": scan.name}, content=scan.read_bytes())
        project = until(client, lambda now: all(one["state"] == "ready" for one in now["specimens"]))
        (odd,) = project["odd"]
        assert (odd["id"], odd["unit"]) == ("bone4", "cm") and "in cm it would have their size" in odd["text"]
        checks = client.post("/api/checks", json={"kind": "correspond", "options": {}}).json()
        assert [check["level"] for check in checks] == ["ok", "warning"] and checks[1]["text"].startswith("bone4: ")
        client.post("/api/edit", json={
            "what": "unit", "ids": ["bone4"], "unit": "cm", "revision": project["revision"],
        })  # fmt: skip
        assert state(client)["odd"] == []
        client.post("/api/undo", json={"revision": project["revision"] + 1})
        assert len(state(client)["odd"]) == 1
        client.post("/api/edit", json={
            "what": "include", "ids": ["bone4"], "included": False, "revision": project["revision"] + 2,
        })  # fmt: skip
        assert state(client)["odd"] == []
