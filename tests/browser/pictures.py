"""Whether a picture shows anything, and whether it still looks as the one that is kept."""

import io
import os
from pathlib import Path

import numpy as np
from PIL import Image

IMAGES = Path(__file__).resolve().parents[2] / "docs" / "images"
UPDATE = os.environ.get("SHAPESPACE_UPDATE_PICTURES") == "1"
"""Set to keep what a run shows as the new pictures of the README."""

_COARSE = 24
_ALIKE = 12.0


def pixels(png: bytes | Path) -> np.ndarray:
    """Return (height, width, 3) of a PNG."""
    source = io.BytesIO(png) if isinstance(png, bytes) else png
    return np.asarray(Image.open(source).convert("RGB"), dtype=np.float64)


def drawn_share(png: bytes | Path) -> float:
    """Return the share of pixels that differ from the most common colour: the background."""
    image = pixels(png).astype(np.uint32)
    code = (image[..., 0] << 16) | (image[..., 1] << 8) | image[..., 2]
    values, counts = np.unique(code, return_counts=True)
    background = image.reshape(-1, 3)[np.flatnonzero(code.ravel() == values[counts.argmax()])[0]].astype(float)
    return float((np.abs(image - background).max(axis=2) > 8).mean())


def change(before: bytes, after: bytes) -> float:
    """Return the share of pixels that differ between two pictures of one size."""
    return float((np.abs(pixels(before) - pixels(after)).max(axis=2) > 8).mean())


def same_as_kept(name: str, png: Path, *, width: int | None = None, fonts: bool = True) -> None:
    """Compare a picture with docs/images/`name`, coarsely: processors differ in the last pixel.

    A screenshot has `fonts`, which differ between machines and move its lines, so there the browser of the build
    machine decides. With SHAPESPACE_UPDATE_PICTURES=1 it becomes the one that is kept, `width` pixels wide.
    """
    picture = Image.open(png).convert("RGB")
    if width is not None and picture.width > width:
        picture = picture.resize((width, round(picture.height * width / picture.width)), Image.Resampling.LANCZOS)
    kept = IMAGES / name
    if UPDATE:
        picture.quantize(256, dither=Image.Dither.FLOYDSTEINBERG).save(kept, optimize=True)
        return
    assert drawn_share(png) > 0.1
    if fonts and os.environ.get("SHAPESPACE_BROWSER") != "required":
        return
    assert kept.is_file(), f"{name} is not kept; run once with SHAPESPACE_UPDATE_PICTURES=1."
    then = Image.open(kept).convert("RGB")
    assert abs(then.width / then.height - picture.width / picture.height) < 0.05, f"{name} has another form."
    size = (_COARSE, round(_COARSE * then.height / then.width))
    a, b = (np.asarray(i.resize(size, Image.Resampling.BOX), dtype=np.float64) for i in (then, picture))
    worst = float(np.abs(a - b).max())
    assert worst < _ALIKE, (
        f"{name} no longer shows what the program draws (a part differs by {worst:.0f} of 255); "
        "look at the new one and keep it with SHAPESPACE_UPDATE_PICTURES=1."
    )
