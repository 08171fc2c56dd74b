"""Figures for papers: size of print, embedded fonts, and files that are the same for the same figure."""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from html import unescape
from importlib import import_module
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib import font_manager
from matplotlib.figure import Figure

from shapespace.errors import InputError
from shapespace.io.files import write_bytes
from shapespace.report.figures.draw import DPI, LAYOUT, Layout, without_glyph_warnings

FORMATS = ("svg", "pdf", "png")
"""Formats of figures for papers."""
ONE_COLUMN_MM, TWO_COLUMNS_MM = 85.0, 174.0
"""Widths of charts, and of rows of pictures, mm: the columns of most journals (Elsevier 90 and 190, Nature 89 and 183,
PLOS 83 and 173)."""
_PRINT_SCALE = 0.72  # type of 6.8 to 8 points instead of 9.5 to 11, above the 6 that journals ask for
_LEAST_DPI, _MOST_DPI = 72, 1200  # legible, and what a rendered panel holds in memory


@contextmanager
def publication_style(dpi: int = 300) -> Generator[None]:
    """Return a context in which figures have the size and type of print, and no title.

    Args:
        dpi: resolution of rendered surfaces, pixels per inch.

    Raises:
        InputError: a resolution below 72 or above 1200.
    """
    if not _LEAST_DPI <= dpi <= _MOST_DPI:
        raise InputError(f"The resolution of a figure is {_LEAST_DPI} to {_MOST_DPI} dpi, not {dpi}.")
    one, two = (round(width / 25.4 * DPI) for width in (ONE_COLUMN_MM, TWO_COLUMNS_MM))
    token = LAYOUT.set(Layout(one, two, _PRINT_SCALE, dpi / DPI, has_titles=False))
    try:
        yield
    finally:
        LAYOUT.reset(token)


def save_figure(
    figure: Figure, path: Path, formats: Sequence[str] = ("pdf",), dpi: float | None = None
) -> tuple[Path, ...]:
    """Write a figure in one or more formats, each file whole or not at all, and return their paths.

    Fonts are embedded: as TrueType in PDF, as a subset in SVG, whose text can be searched and edited.

    Args:
        figure: to write.
        path: of the files, without an ending.
        formats: of `FORMATS`.
        dpi: resolution of PNG and of pictures inside the others; None for that of the figure.

    Raises:
        FileError: the folder cannot be written, or the disk is full.
        InputError: another format.
    """
    unknown = [kind for kind in formats if kind not in FORMATS]
    if unknown:
        raise InputError(f"Figures cannot be written as {unknown[0]!r}; choose from {', '.join(FORMATS)}.")
    paths: list[Path] = []
    # Neither date nor random names: the same figure is the same file.
    undated: dict[str, dict[str, None]] = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}
    for kind in formats:
        stream = io.BytesIO()
        with (
            matplotlib.rc_context({"svg.hashsalt": "shapespace", "svg.fonttype": "none", "pdf.fonttype": 42}),
            without_glyph_warnings(),
        ):
            figure.savefig(stream, format=kind, metadata=undated.get(kind, {}), dpi=dpi or "figure")
        data = stream.getvalue()
        paths.append(path.with_name(f"{path.name}.{kind}"))
        write_bytes(paths[-1], _with_fonts(data) if kind == "svg" else data)
    return tuple(paths)


def _with_fonts(svg: bytes) -> bytes:
    """Return an SVG with the letters that it uses as embedded fonts."""
    text = svg.decode("utf-8")
    runs = re.findall(r"<text[^>]*>(.*?)</text>", text, re.DOTALL)
    letters = "".join(sorted(set(unescape(re.sub("<[^>]*>", "", "".join(runs))))))
    rules = [
        f"@font-face{{font-family:'DejaVu Sans';font-weight:{weight};src:url(data:font/woff;base64,"
        f"{base64.b64encode(_subset(weight, letters)).decode()}) format('woff')}}"
        for weight in ((400, 700) if re.search(r"<text[^>]*\b(700|bold)\b", text) else (400,))
    ]
    return text.replace("<defs>", f"<defs>\n  <style>{''.join(rules)}</style>", 1).encode()


def _subset(weight: int, letters: str) -> bytes:
    """Return the font of all figures, WOFF, with some letters alone."""
    subset: Any = import_module("fontTools.subset")
    options = subset.Options(flavor="woff", recalc_timestamp=False, layout_features=[], notdef_outline=True)
    options.drop_tables += ["FFTM"]
    path = font_manager.findfont(font_manager.FontProperties(family="DejaVu Sans", weight=weight))
    font: Any = subset.load_font(path, options)
    subsetter: Any = subset.Subsetter(options)
    subsetter.populate(text=letters)
    subsetter.subset(font)
    stream = io.BytesIO()
    subset.save_font(font, stream, options)
    font.close()
    return stream.getvalue()
