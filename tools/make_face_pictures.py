"""Draw the pictures of faces in the documents: modes, a fit, and fits that go wrong beside the truth.

python tools/make_face_pictures.py [--out docs/images]
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

import shapespace as ss
from shapespace.datasets.simulated_scan import Cut, Hair, Hole, SimulatedScan, random_similarity
from shapespace.report.render.palette import SEQUENTIAL
from shapespace.report.render.renderer import Camera, Layer, render
from shapespace.types import FloatArray, Mesh

SIZE, BAND, HEIGHT_MM, LIMIT_MM = (300, 330), 40, 320.0, 5.0
PEOPLE, TRIANGLES = 40, 20_000
MODES = ((0, -2.5), (0, 2.5), (0, 0.0), (1, -2.5), (1, 2.5))
SCAN = (0.80, 0.45, 0.33)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("docs/images"))
    out = parser.parse_args().out
    faces, rng = ss.load_faces(), np.random.default_rng(5)
    people = [faces.face(faces.draw_person(rng)) for _ in range(PEOPLE)]
    model = ss.ShapeModel.fit(people, modes=None, landmarks=faces.landmarks)
    stranger = faces.face(faces.draw_person(rng))
    mouth = faces.face(faces.draw_person(rng), faces.draw_expression("surprise", 1.0, rng))
    wide = faces.face(faces.draw_person(rng, wide=True))
    middle = stranger.vertices.mean(axis=0)
    cases = {
        "half": ss.simulate_scan(stranger, rng, triangles=TRIANGLES, crop=[Cut(middle, (1.0, 0.0, 0.0))]),
        "hair": ss.simulate_scan(stranger, rng, triangles=TRIANGLES, hair=Hair()),
        "mouth": ss.simulate_scan(mouth, rng, triangles=TRIANGLES),
        "narrow": ss.simulate_scan(wide, rng, triangles=TRIANGLES),
    }
    shapes = [model.mesh(z * model.stddev[k] * np.eye(model.n_modes)[k]) for k, z in MODES]
    titles = [f"mode {k + 1} at {z:+g} sd" if z else "the mean" for k, z in MODES]
    row([Layer(shape) for shape in shapes], titles, model.mean_vertices).save(out / "face-modes.png", optimize=True)
    pose = random_similarity(rng, max_angle_deg=25.0, scale_range=(1.0, 1.0), translation_mm=20.0)
    holes = [Hole(12.0), Hole(15.0)]
    steps(model, ss.simulate_scan(stranger, rng, triangles=TRIANGLES, holes=holes, T_scan_model=pose)).save(
        out / "face-fit.png", optimize=True
    )
    for name, case in cases.items():
        wrong(model, case).save(out / f"wrong-{name}.png", optimize=True)


def steps(model: ss.ShapeModel, case: SimulatedScan) -> Image.Image:
    """Return the scan, the model at each moment of the fit over it, and the distance at the end."""
    result = ss.fit_scan(model, case.scan)
    over = Layer(case.scan, colour=SCAN)
    moments = [[Layer(result.surface(model, stage)), over] for stage in ("before", "initial", "final")]
    layers = [Layer(case.scan), *moments, coloured(result.surface(), result.distances.model_to_scan_mm)]
    titles = [
        "the scan",
        "centred",
        "after the search",
        "fitted",
        f"median {result.distances.model_to_scan.median:.2f} mm",
    ]
    return row(layers, titles, case.truth_vertices)


def wrong(model: ss.ShapeModel, case: SimulatedScan) -> Image.Image:
    """Return the scan, the fit coloured by its distance from the scan, and by its distance from the truth."""
    result = ss.fit_scan(model, case.scan)
    fitted = result.surface()
    to_scan = result.distances.model_to_scan_mm
    to_truth = np.linalg.norm(fitted.vertices - case.truth_vertices, axis=1)
    titles = (
        f"the scan; the fit: {result.status}",
        f"to the scan: median {np.median(to_scan):.1f} mm",
        f"to the truth: mean {to_truth.mean():.1f} mm",
    )
    return row([Layer(case.scan), coloured(fitted, to_scan), coloured(fitted, to_truth)], titles, case.truth_vertices)


def row(layers: Sequence[Layer | Sequence[Layer]], titles: Sequence[str], points: FloatArray) -> Image.Image:
    """Return pictures side by side, each below its title, seen from where all `points` (V, 3) are in sight."""
    camera = Camera(points.mean(axis=0), HEIGHT_MM, 25.0)
    groups = [[layer] if isinstance(layer, Layer) else layer for layer in layers]
    pictures = np.concatenate([np.asarray(render(*group, camera=camera, size=SIZE)) for group in groups], axis=1)
    image = Image.fromarray(np.concatenate([np.full((BAND, pictures.shape[1], 3), 255, dtype=np.uint8), pictures]))
    pen, font = ImageDraw.Draw(image), ImageFont.load_default(size=19)
    for k, title in enumerate(titles):
        pen.text(((k + 0.5) * SIZE[0], BAND / 2), title, fill=(40, 40, 40), font=font, anchor="mm")
    return image.quantize(128, dither=Image.Dither.FLOYDSTEINBERG)


def coloured(mesh: Mesh, distances_mm: FloatArray) -> Layer:
    return Layer(mesh, scalars=distances_mm, colormap=SEQUENTIAL, vmax=LIMIT_MM)


if __name__ == "__main__":
    main()
