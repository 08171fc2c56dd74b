"""Every action of the studio, as the page asks for it, on scans that were never in correspondence."""

from pathlib import Path
from typing import Any

import httpx
import pytest
from test_studio_server import ended, own_home, state, studio, until
from test_studio_words import TERMINAL, in_words

from shapespace.cli import main
from shapespace.viewer.studio.job_commands import QUESTIONS

__all__ = ["own_home"]  # a fixture


def run(client: httpx.Client, kind: str, options: dict[str, Any] | None = None, on: int | None = None) -> dict:
    if kind in QUESTIONS:
        found = client.post("/api/checks", json={"kind": kind, "options": options or {}, "on": on}).json()
        assert [one for one in found if one["level"] == "problem"] == [], kind
    answer = client.post("/api/jobs", json={"kind": kind, "options": options or {}, "on": on})
    assert answer.status_code == 201, (kind, answer.text)
    number = answer.json()["number"]
    project = until(client, ended, 600)
    job = next(one for one in project["jobs"] if one["number"] == number)
    log = client.get(f"/api/jobs/{number}/log").text
    assert job["status"] == "done", (kind, log)
    files = client.get(f"/api/jobs/{number}/files").json()
    assert files, (kind, log)
    for text in (log, job["message"], *job["sentences"], job["methods"] or ""):
        assert TERMINAL.search(text) is None, (kind, text)
    for view in job["views"]:
        # A report is a page, of others the data are asked for.
        is_report = view["kind"] == "report"
        shown = client.get(view["href"] if is_report else f"{view['href']}api/about")
        assert shown.status_code == 200 and (b"<html" in shown.content) == is_report, (kind, view)
        assert TERMINAL.search(in_words(shown.text)) is None, (kind, TERMINAL.search(in_words(shown.text)))
    return job


@pytest.mark.long
def test_every_action_of_the_page_ends_with_a_result_that_is_shown(tmp_path: Path) -> None:
    """Eight subjects in two visits, and new scans, two of each subject."""
    bones = tmp_path / "bones"
    assert main(["data", "bones", "-o", str(bones), "--count", "28", "--quiet"]) == 0
    scans = sorted(bones.glob("*.ply"))
    lines = ["id,person,visit,group,age"]
    for k, scan in enumerate(scans):
        person = k // 2 if k < 16 else (k - 16) // 2
        lines.append(f"{scan.stem},p{person},{1 + k % 2 if k < 16 else 3},{'ab'[person % 2]},{20 + 3 * person}")
    with studio(tmp_path / "p", 10**8) as client:
        for k, scan in enumerate(scans):
            role = "training" if k < 16 else "new"
            answer = client.put("/api/specimens", params={"name": scan.name, "set": role}, content=scan.read_bytes())
            assert answer.status_code == 201
        revision = state(client)["revision"]
        table = client.post("/api/table", params={"revision": revision}, content="\n".join(lines))
        assert table.status_code == 200, table.text
        until(client, lambda now: all(one["state"] != "waiting" for one in now["specimens"]))
        aligned = run(client, "correspond", {"--vertices": "300"})["number"]
        landmarks = {"a": 10, "b": 120, "c": 250}
        edit = {"revision": state(client)["revision"], "what": "landmarks", "landmarks": landmarks,
                "on": f"correspondence-{aligned}"}  # fmt: skip
        assert client.post("/api/edit", json=edit).status_code == 200
        run(client, "redo", {"name": scans[3].stem})
        run(client, "build")
        run(client, "quality")
        run(client, "morphospace", {"--group": "group"})
        run(client, "compare", {"--formula": "~ group", "--permutations": "200"})
        run(client, "change", {"--subject": "person", "--time": "visit"})
        run(client, "asymmetry", {"--subject": "person"})
        run(client, "regress", {"--target": "age"})
        along = run(client, "regress", {"--along": "age", "--at": "25,30,40", "--covariates": "group"})
        assert "which were not followed" in along["sentences"][0], along["sentences"]
        for options in ({}, {"--target": "age", "--along": "age"}):
            found = client.post("/api/checks", json={"kind": "regress", "options": options, "on": None}).json()
            assert "Choose one column" in " ".join(one["text"] for one in found if one["level"] == "problem")
        fits = run(client, "fit", {"--dense": True})["number"]
        run(client, "score", {"--reference": "group=a"})
        run(client, "identify", {"--subject": "person", "--doubtful": "yes"}, fits)
        run(client, "complete", {"--samples": "10"})
        run(client, "convert", {"--to": "statismo"})
        run(client, "export")
        run(client, "report", {}, fits)
        run(client, "report", {}, aligned)
        for kind, options in {
            "disparity": {"--group": "group"}, "equality": {"--group": "group", "--components": "2"},
            "equivalence": {"--group": "group", "--margin": "5"},
            "discriminant": {"--group": "group", "--components": "2"},
            "power": {"--group": "group", "--simulations": "20", "--sizes": "8,16"}, "allometry": {"--group": "group"},
            "pairwise": {"--formula": "~ group + age", "--group": "group"}, "repeatability": {"--subject": "person"},
            "trajectory": {"--group": "group", "--points": "visit"}, "pls": {"--columns": "age,visit"},
        }.items():  # fmt: skip
            run(client, kind, options)
        study = run(client, "report")
        assert study["output"].endswith("/report.html") and study["views"]
