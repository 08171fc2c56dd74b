"""Make docs/images/methods.png: a scan, the paper's fit, the robust fit, and the dense surface, for two scans.

    SHAPESPACE_DATA=... python tools/make_methods_picture.py

Needs James and ICT-FaceKit. The upper row is James with a model of 200 random ICT people; the lower one an unseen ICT
person with a hole, a cut, the neck and a tenth of outliers, with a model of 60 people.
"""

import sys
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from shapespace.fit.fit_scan import FitConfig, fit_scan
from shapespace.model.shape_model import ShapeModel
from shapespace.report.render.renderer import Camera, Layer, render
from shapespace.types import Mesh

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "benchmarks"))
from cases import Bench  # noqa: E402

TITLES = ("raw scan", "the paper's method", "robust: mean and modes", "robust, --dense")
SIZE = (400, 430)


def panels(model: ShapeModel, scan: Mesh) -> np.ndarray:
    robust, paper = fit_scan(model, scan, FitConfig(dense=True)), fit_scan(model, scan, FitConfig(method="paper"))
    in_model = robust.T_scan_model.inverse().apply
    surfaces = [
        scan.with_vertices(in_model(scan.vertices)),
        scan_free(paper.T_scan_model.inverse().apply(paper.surface(model).vertices), model),
        model.mesh(robust.b),
        scan_free(in_model(robust.surface(model, "dense").vertices), model),
    ]
    camera = Camera(model.mesh(robust.b).vertices.mean(axis=0), 300.0, 25.0)
    return np.concatenate([np.asarray(render(Layer(s), camera=camera, size=SIZE)) for s in surfaces], axis=1)


def scan_free(vertices: np.ndarray, model: ShapeModel) -> Mesh:
    return Mesh(vertices, model.faces)


def draw() -> Image.Image:
    bench = Bench("dev")
    rows = [
        panels(bench.model("aligned200"), bench.scan("james", 0).mesh),
        panels(bench.model("ict60"), bench.scan("outside_holes", 1).mesh),
    ]
    picture = np.concatenate([np.full((44, rows[0].shape[1], 3), 255, dtype=np.uint8), *rows])
    image = Image.fromarray(picture)
    pen = ImageDraw.Draw(image)
    font = ImageFont.load_default(size=24)
    for i, title in enumerate(TITLES):
        pen.text((i * SIZE[0] + SIZE[0] // 2, 24), title, fill=(40, 40, 40), font=font, anchor="mm")
    return image


def main() -> None:
    draw().save(ROOT / "docs" / "images" / "methods.png", optimize=True)


if __name__ == "__main__":
    main()
