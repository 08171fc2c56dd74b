"""How the studio bears a large project: 500 specimens of 100,000 triangles, with all of them in correspondence.

    python benchmarks/studio.py --specimens 500 --triangles 100000 --folder FOLDER

Writes the project once into FOLDER, opens it in Chromium without a GPU at 1440 by 900 pixels, and prints: seconds to
the first picture of a specimen, to the first surface in correspondence and to all twelve, frames a second while twelve
turn, and the memory of the server and of the page.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from playwright.sync_api import sync_playwright
from scipy.spatial import ConvexHull

from shapespace.io.files import make_folder, sha256_of_file, write_text
from shapespace.io.meshes.mesh_io import write_mesh
from shapespace.schemas import CorrespondenceRecord, CorrespondRecord, json_text
from shapespace.types import FloatArray, Mesh
from shapespace.viewer.studio.jobs import Job
from shapespace.viewer.studio.project import Project, Specimen, State

RESULT, FRAMES = "correspondence-1", 40
FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]


def sphere(count: int) -> tuple[FloatArray, np.ndarray]:
    """Return (V, 3) directions spread evenly, and the triangles between them, outward."""
    k = np.arange(count)
    z, angle = 1.0 - (2.0 * k + 1.0) / count, k * np.pi * (3.0 - np.sqrt(5.0))
    d = np.column_stack([np.sqrt(1.0 - z * z) * np.cos(angle), np.sqrt(1.0 - z * z) * np.sin(angle), z])
    faces = ConvexHull(d).simplices.astype(np.int32)
    inward = np.linalg.det(d[faces]) < 0
    faces[inward] = faces[inward][:, ::-1]
    return d, faces


def shape(directions: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return a random smooth shape (V, 3), mm."""
    radius = np.full(len(directions), 60.0)
    for _ in range(6):
        at = rng.standard_normal(3)
        radius += rng.normal(0.0, 8.0) * np.exp((directions @ (at / np.linalg.norm(at)) - 1.0) / 0.1)
    return radius[:, None] * directions * [1.0, 1.2, 0.9]


def write_project(folder: Path, specimens: int, triangles: int) -> None:
    """Write a project whose specimens are in correspondence."""
    directions, faces = sphere(triangles // 2)
    rng = np.random.default_rng(0)
    scans, result = make_folder(folder / "scans"), make_folder(folder / RESULT)
    make_folder(result / "template")
    write_mesh(result / CorrespondenceRecord.MEAN, Mesh(60.0 * directions * [1.0, 1.2, 0.9], faces, name="mean"))
    names = [f"s{number:03d}" for number in range(specimens)]
    for name in names:
        mesh = Mesh(shape(directions, rng), faces, name=name)
        write_mesh(result / f"{name}{CorrespondRecord.SURFACE}", mesh)
        write_mesh(scans / f"{name}.ply", mesh)
        record = CorrespondRecord(
            name=name, path=f"../scans/{name}.ply", hash=sha256_of_file(scans / f"{name}.ply"), status="converged",
            seen_share=1.0, covered_share=1.0, area_share=1.0, distance_mean=0.2, distance_p95=0.5, distance_p99=1.0,
            distance_max=3.0, scale=1.0, folded_share=0.0, area_factor=1.0, moved_share=[0.05, 0.012], cpu_s=[2.0, 1.0],
        )  # fmt: skip
        write_text(result / f"{name}{CorrespondRecord.ENDING}", json_text(record))
    summary = CorrespondenceRecord(
        template="s000 is the first template.", vertices=len(directions), rounds=[0.05, 0.012], corresponding=names,
        set_aside={}, settings={"rounds": 2, "settled": 0.002}, version="0.1.0",
    )  # fmt: skip
    write_text(result / CorrespondenceRecord.FILE, json_text(summary))
    state = State(name=folder.name, specimens=tuple(Specimen(id=name, file=f"scans/{name}.ply") for name in names))
    job = Job(number=1, kind="correspond", arguments=("correspond", "scans", "-o", RESULT), output=RESULT)
    make_folder(folder / "jobs" / "0001")
    write_text(folder / "jobs" / "0001" / "job.json", json_text(job))
    write_text(folder / "jobs" / "0001" / "exit.json", json.dumps({"code": 0, "seconds": 1.0, "cancelled": False}))
    write_text(folder / Project.FILE, json_text(state))


def memory_mb(pid: int) -> float:
    """Return the memory of a process and its children, MB."""
    total, waiting = 0.0, [pid]
    while waiting:
        one = waiting.pop()
        try:
            status = Path(f"/proc/{one}/status").read_text()
            waiting += [int(word) for word in Path(f"/proc/{one}/task/{one}/children").read_text().split()]
        except OSError:
            continue
        total += next((float(line.split()[1]) for line in status.splitlines() if line.startswith("VmRSS")), 0.0) / 1024
    return total


def until(page: object, expression: str, seconds: float = 300.0) -> float:
    """Wait until `expression` is true on a page; return the seconds."""
    began = time.monotonic()
    while not page.evaluate(expression):
        if time.monotonic() - began > seconds:
            raise SystemExit(f"not within {seconds:.0f} s: {expression}")
        time.sleep(0.02)
    return time.monotonic() - began


PICTURED = (
    """[...document.querySelectorAll('[data-testid^=card-] img')].some((one) => one.complete && one.naturalWidth)"""
)
TURN = """() => new Promise((done) => {
  const cells = window.shapespaceCells, times = [];
  let left = FRAMES;
  const step = (now) => {
    times.push(now);
    cells[0].view.camera = { yaw: 0.05 * left };
    if (left-- > 0) requestAnimationFrame(step); else done(times);
  };
  requestAnimationFrame(step);
})""".replace("FRAMES", str(FRAMES))


def measure(folder: Path) -> None:
    """Open the project and print the figures."""
    shutil.rmtree(folder / "checks", ignore_errors=True)
    command = [sys.executable, "-m", "shapespace", "studio", str(folder), "--no-open"]
    environment = {**os.environ, "XDG_STATE_HOME": str(folder)}
    server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)
    assert server.stdout is not None
    address = server.stdout.readline().rpartition(" ")[2].strip()
    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))))
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=FLAGS)
        page = browser.new_page(viewport={"width": 1440, "height": 900})
        began = time.monotonic()
        page.goto(address)
        until(page, PICTURED)
        print(f"first picture of a specimen: {time.monotonic() - began:.1f} s")
        began = time.monotonic()
        page.evaluate("document.querySelector('[data-testid=tab-correspondence]').click()")
        until(page, "!!(window.shapespaceCells && window.shapespaceCells[0].positions)")
        print(f"first surface in correspondence: {time.monotonic() - began:.1f} s")
        until(page, "document.querySelector('[data-testid=pane]').dataset.ready === 'true'")
        print(f"all on the page: {time.monotonic() - began:.1f} s")
        time.sleep(2.0)
        times = page.evaluate(f"({TURN})()")
        print(f"frames a second while 12 turn: {1000 * (len(times) - 6) / (times[-1] - times[5]):.1f}")
        heap = page.evaluate("performance.memory.usedJSHeapSize / 2 ** 20")
        browser_mb = memory_mb(os.getpid()) - memory_mb(server.pid) - own_mb()
        print(f"page: JavaScript heap {heap:.0f} MB, all processes of the browser {browser_mb:.0f} MB")
        print(f"server and its processes: {memory_mb(server.pid):.0f} MB")
        browser.close()
    server.terminate()
    server.wait()


def own_mb() -> float:
    """Return the memory of this process alone, MB."""
    status = Path("/proc/self/status").read_text()
    return next(float(line.split()[1]) for line in status.splitlines() if line.startswith("VmRSS")) / 1024


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--specimens", type=int, default=500)
    parser.add_argument("--triangles", type=int, default=100_000)
    parser.add_argument("--folder", type=Path, required=True)
    arguments = parser.parse_args()
    if not (arguments.folder / Project.FILE).is_file():
        write_project(arguments.folder, arguments.specimens, arguments.triangles)
    measure(arguments.folder)
