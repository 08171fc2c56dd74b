"""Make docs/images/demo.png from the results of `shapespace demo`: python tools/make_readme_picture.py DEMO_FOLDER."""

import io
import json
import sys
from pathlib import Path

from PIL import Image

from shapespace.io.files import write_bytes
from shapespace.report.figures import STAGE_TITLES, StagedFit, encode_webp, portrait_figure
from shapespace.report.saved import Folder, read_fit, surfaces_of

TARGET = Path(__file__).resolve().parents[1] / "docs" / "images" / "demo.png"
MOST_ROWS = 2


def main(folder: Path) -> None:
    cases = json.loads((folder / "demo.json").read_text(encoding="utf-8"))["experiment2"]["cases"][:MOST_ROWS]
    home, fits = Folder(folder), []
    for case in cases:
        scan, surfaces, forward, backward = surfaces_of(home, read_fit(home, case["fit"]), list(STAGE_TITLES))
        fits.append(StagedFit(case["fit"]["name"], scan, surfaces, forward, backward))
    figure = portrait_figure(fits, [case["short"] for case in cases], title="A raw scan becomes a short vector")
    data, _ = encode_webp(figure, lossless=True)
    picture = Image.open(io.BytesIO(data)).convert("RGB")
    png = io.BytesIO()
    picture.save(png, "PNG", optimize=True)
    write_bytes(TARGET, png.getvalue())
    print(f"{TARGET}: {len(png.getvalue()) // 1024} KiB")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
