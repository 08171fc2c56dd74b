"""Make docs/images/demo.png from the results of `shapespace demo`: python tools/make_readme_picture.py DEMO_FOLDER."""

import io
import json
import sys
from pathlib import Path

from PIL import Image

from shapespace.io.files import write_bytes
from shapespace.report.figures import encode_webp, portrait_figure
from shapespace.report.saved import Folder, read_fit, staged_fit

TARGET = Path(__file__).resolve().parents[1] / "docs" / "images" / "demo.png"
MOST_ROWS = 2


def main(folder: Path) -> None:
    cases = json.loads((folder / "demo.json").read_text(encoding="utf-8"))["experiment2"]["cases"][:MOST_ROWS]
    home = Folder(folder)
    fits = [staged_fit(home, read_fit(home, case["fit"])) for case in cases]
    figure = portrait_figure(fits, [case["short"] for case in cases], title="A raw scan becomes a short vector")
    data, _ = encode_webp(figure, lossless=True)
    picture = Image.open(io.BytesIO(data)).convert("RGB")
    png = io.BytesIO()
    picture.save(png, "PNG", optimize=True)
    write_bytes(TARGET, png.getvalue())
    print(f"{TARGET}: {len(png.getvalue()) // 1024} KiB")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
