"""Pictures of the renderer against those that were looked at and kept; `python tests/report/test_reference_pictures.py`
makes them anew."""

import sys
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import BboxImage
from PIL import Image

sys.path.insert(0, str(Path(__file__).parents[1]))
from shapespace.report import figures
from shapespace.report.render.palette import DIVERGING, MODEL_COLOUR, REGION_COLOURS, SCAN_COLOUR, SEQUENTIAL
from shapespace.report.render.renderer import Camera, Layer, render_series
from shapespace.types import Mesh
from synthetic_shapes import blob_model

REFERENCES = Path(__file__).parent / "reference"
SIZE = (150, 150)
# One level of 255 is rounding; a light, a map or a surface that changed moves whole areas by tens.
MOST_MEAN, MOST_CHANGED, CHANGED = 0.6, 0.004, 24


def still_life() -> dict[str, np.ndarray]:
    """Return what is compared: each kind of layer, and the panels of two figures."""
    model = blob_model()
    b = np.array([1.5, -1.0, 0.5, 0.8, -0.4]) * model.stddev
    surface, mean = model.mesh(b), model.mesh()
    height = surface.vertices[:, 1] / 10
    holed = height.copy()
    holed[surface.vertices[:, 0] > 20] = np.nan
    camera = Camera.framing(np.concatenate([surface.vertices, mean.vertices]), yaw_deg=25, aspect=1.0)
    codes = np.clip((surface.vertices[:, 1] // 40 + 2), 0, 3)
    table = np.array(list(REGION_COLOURS.values()))
    layers = {
        "clay": [Layer(surface)],
        "cloud": [Layer(Mesh(surface.vertices), SCAN_COLOUR)],
        "balls": [Layer(Mesh(surface.vertices), SCAN_COLOUR, point_radius_mm=2.0)],
        "diverging": [Layer(surface, scalars=holed, colormap=DIVERGING, vmin=-12, vmax=12)],
        "sequential": [Layer(surface, scalars=np.abs(height), colormap=SEQUENTIAL, vmax=12)],
        "regions": [Layer(surface, scalars=codes, colormap=table, vmin=-0.5, vmax=3.5, categories=True)],
        "overlay": [Layer(surface, SCAN_COLOUR), Layer(mean, MODEL_COLOUR)],
    }
    made = dict(zip(layers, render_series(list(layers.values()), camera=camera, size=SIZE), strict=True))
    panels = [np.asarray(panel.get_array()) for panel in figures.modes_figure(model, 2).findobj(BboxImage)]
    made["modes"] = np.concatenate([np.concatenate(panels[k : k + 4], axis=1)[::4, ::4] for k in (0, 4)])
    return made


def differ(seen: np.ndarray, kept: np.ndarray) -> bool:
    if seen.shape != kept.shape:
        return True
    apart = np.abs(seen.astype(int) - kept.astype(int)).max(axis=2)
    return bool(apart.mean() > MOST_MEAN or (apart > CHANGED).mean() > MOST_CHANGED)


@pytest.fixture(scope="module")
def pictures() -> dict[str, np.ndarray]:
    return still_life()


@pytest.mark.parametrize("path", sorted(REFERENCES.glob("*.png")), ids=lambda path: path.stem)
def test_a_picture_is_the_one_that_was_kept(pictures: dict[str, np.ndarray], path: Path) -> None:
    kept = np.asarray(Image.open(path).convert("RGB"))
    assert not differ(pictures[path.stem], kept)


def test_every_picture_has_its_reference(pictures: dict[str, np.ndarray]) -> None:
    assert {path.stem for path in REFERENCES.glob("*.png")} == set(pictures)


@pytest.mark.parametrize("change", ["light", "map", "camera", "place"])
def test_the_comparison_fails_when_something_changes(
    pictures: dict[str, np.ndarray], change: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    from shapespace.report.render import renderer as render

    model = blob_model()
    b = np.array([1.5, -1.0, 0.5, 0.8, -0.4]) * model.stddev
    surface, mean = model.mesh(b), model.mesh()
    points = np.concatenate([surface.vertices, mean.vertices])
    yaw = 26.5 if change == "camera" else 25.0
    if change == "light":
        lights = render._LIGHTS.copy()
        lights[0] = lights[0, [1, 0, 2]] * [-1, -1, 1]
        monkeypatch.setattr(render, "_LIGHTS", lights)
    if change == "place":
        surface = surface.with_vertices(surface.vertices + np.array([1.5, 0.0, 0.0]))
    colours = SEQUENTIAL if change == "map" else DIVERGING
    height = model.mesh(b).vertices[:, 1] / 10
    height[model.mesh(b).vertices[:, 0] > 20] = np.nan
    (seen,) = render_series(
        [[Layer(surface, scalars=height, colormap=colours, vmin=-12, vmax=12)]],
        camera=Camera.framing(points, yaw_deg=yaw, aspect=1.0),
        size=SIZE,
    )
    assert differ(seen, pictures["diverging"])


if __name__ == "__main__":
    REFERENCES.mkdir(exist_ok=True)
    for name, picture in still_life().items():
        Image.fromarray(picture).save(REFERENCES / f"{name}.png", optimize=True)
