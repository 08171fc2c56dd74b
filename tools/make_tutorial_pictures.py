"""Draw the pictures of docs/tutorial-spleens.md and docs/tutorial-volumes.md by what the tutorials type.

python tools/make_tutorial_pictures.py [--out docs/images]
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from PIL import Image, ImageDraw, ImageFont

import shapespace as ss
from shapespace.cli import main as shapespace
from shapespace.geometry.similarity import fit_similarity
from shapespace.report.render.renderer import Camera, Layer, render
from shapespace.report.render.thumbnails import checker_layer, checker_places
from shapespace.types import FloatArray, Mesh

SHOWN, SIZE, HEIGHT_MM, BAND = 5, (300, 240), 122.0, 34


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("docs/images"))
    out = parser.parse_args().out.absolute()
    with TemporaryDirectory() as folder:
        spleens(Path(folder), out)
        volumes(Path(folder), out)


def spleens(folder: Path, out: Path) -> None:
    scans, same = folder / "spleens", folder / "same"
    run("data", "organs", "-o", scans, "--count", 10)
    run("correspond", scans, "-o", same, "--vertices", 4000)
    run("build", same, "-o", folder / "spleens.h5", "--gauge", "form")
    raw = [ss.read_mesh(path) for path in sorted(scans.glob("*.ply"))[:SHOWN]]
    model = ss.ShapeModel.load(folder / "spleens.h5")
    turn = upright(model.mean_vertices)
    modes = [(0, -2.0), (0, 2.0), (0, 0.0), (1, -2.0), (1, 2.0)]
    rows = {
        "as they came: any pose, triangles of their own": [picture(mesh, np.eye(3)) for mesh in raw],
        "in correspondence: the same squares on all of them": checked(same, model.mesh()),
        "the shape space: first mode at -2 and 2 standard deviations, the mean, second mode at -2 and 2": [
            picture(model.mesh(z * model.stddev[k] * np.eye(model.n_modes)[k]), turn) for k, z in modes
        ],
    }
    save(rows, out / "tutorial-spleens.png")


def volumes(folder: Path, out: Path) -> None:
    masks, surfaces, stairs, same = (folder / name for name in ("masks", "surfaces", "stairs", "same-masks"))
    run("data", "organs", "-o", masks, "--count", 6, "--volumes")
    run("surface", masks, "-o", surfaces)
    run("surface", masks, "-o", stairs, "--smooth", 0)
    run("correspond", surfaces, "-o", same, "--vertices", 4000)
    run("build", same, "-o", folder / "organs.h5", "--gauge", "form")
    rows = {
        title: [picture(ss.read_mesh(path), np.eye(3)) for path in sorted(made.glob("*.ply"))[:SHOWN]]
        for title, made in (("voxels, 1.5 x 1.5 x 2.5 mm", stairs), ("surfaces of label 1", surfaces))
    }
    mean = ss.ShapeModel.load(folder / "organs.h5").mesh()
    rows["in correspondence: the same squares on all of them"] = checked(same, mean)
    save(rows, out / "tutorial-volumes.png")


def run(*arguments: object) -> None:
    if shapespace([*map(str, arguments), "--quiet"]):
        raise SystemExit(f"shapespace {' '.join(map(str, arguments))} failed.")


def checked(same: Path, mean: Mesh) -> list[np.ndarray]:
    """Return pictures of the surfaces in the pose of the mean, under squares that are the same vertices on all."""
    turn = upright(mean.vertices)
    places = checker_places(placed(mean, turn))
    out: list[np.ndarray] = []
    for path in sorted(same.glob("*.corresponding.ply"))[:SHOWN]:
        mesh = ss.read_mesh(path)
        there = np.isfinite(mesh.vertices).all(axis=1)
        T = fit_similarity(mesh.vertices[there], mean.vertices[there], with_scale=False)
        out.append(drawn(checker_layer(placed(mesh.with_vertices(T.apply(mesh.vertices)), turn), places)))
    return out


def upright(points: FloatArray) -> FloatArray:
    """Return the rotation (3, 3) that takes the longest axis to x and the shortest to z."""
    axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]
    axes[2] *= np.sign(np.linalg.det(axes))
    return axes


def placed(mesh: Mesh, turn: FloatArray) -> Mesh:
    return mesh.with_vertices((mesh.vertices - np.nanmean(mesh.vertices, axis=0)) @ turn.T)


def picture(mesh: Mesh, turn: FloatArray) -> np.ndarray:
    return drawn(Layer(placed(mesh, turn)))


def drawn(layer: Layer) -> np.ndarray:
    return np.asarray(render(layer, camera=Camera(np.zeros(3), HEIGHT_MM), size=SIZE))


def save(rows: dict[str, Sequence[np.ndarray]], path: Path) -> None:
    parts: list[np.ndarray] = []
    for pictures in rows.values():
        row = np.concatenate(list(pictures), axis=1)
        parts += [np.full((BAND, row.shape[1], 3), 255, dtype=np.uint8), row]
    image = Image.fromarray(np.concatenate(parts))
    pen, font = ImageDraw.Draw(image), ImageFont.load_default(size=19)
    for k, title in enumerate(rows):
        pen.text((12, k * (BAND + SIZE[1]) + 8), title, fill=(40, 40, 40), font=font)
    image.save(path, optimize=True)


if __name__ == "__main__":
    main()
