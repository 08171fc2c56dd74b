"""Install the wheel where there is no checkout, and try it: alone, with each extra, with all, as a new user would.

For developers, before a release; needs the package index and some minutes.

    python tools/try_wheel.py dist
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import venv
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
MOST_CORE_MB = 450
PREPARE = (
    "data faces -o faces --subjects 6",
    "build faces -o model.h5 --modes 4",
    "data faces -o scans --subjects 6 --seed 7",
    "fit model.h5 scans -o out",
)
TRIES = {
    "cluster": ["fit model.h5 scans -o with-dask --set executor=dask --jobs 1"],
    "recognise": ["recognise train out --labels labels.csv -o people.skops"],
    "remote": ["fit model.h5 zip://subject_000_neutral.ply::scans.zip -o from-zip"],
    "report": ["report out"],
    "statistics": ["compare labels.csv --shapes out '~ label' --set maps=no --permutations 20 -o compared"],
    "store": ["fit model.h5 scans -o with-store --store"],
    "view": ["view model.h5 --port 99999"],
    "volumes": ["data organs -o masks --count 1 --volumes", "surface masks -o surfaces"],
}
"""By extra, what needs it; without it each first command ends in a sentence with the command of pip."""
ENDS_OTHERWISE = {"view": "Port 99999 cannot be used"}
"""What a command says that cannot succeed here, once its packages are there."""


class Place:
    """An environment in a folder of its own, and a folder to work in."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.python = folder / ("Scripts/python.exe" if os.name == "nt" else "bin/python")

    def run(self, *arguments: str | Path, at: Path, well: bool = True) -> str:
        """Run Python with `arguments`, and return all that was printed."""
        clean = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "SHAPESPACE"))}
        done = subprocess.run([self.python, *arguments], cwd=at, env=clean, capture_output=True, text=True, timeout=900)
        output = done.stdout + done.stderr
        if (done.returncode == 0) != well or "Traceback" in output:
            sys.exit(f"{shlex.join(map(str, arguments))}: code {done.returncode}\n{output[-3000:]}")
        return output

    def megabytes(self) -> float:
        """Return what the packages take on disk, without pip and what it compiled."""
        [packages] = [found for found in self.folder.rglob("site-packages") if found.is_dir()]
        files = (file for file in packages.rglob("*") if file.is_file() and "__pycache__" not in file.parts)
        return sum(file.stat().st_size for file in files if file.relative_to(packages).parts[0] != "pip") / 1e6


def main(dist: Path) -> None:
    """Try the one wheel in `dist`."""
    [wheel] = dist.resolve().glob("*.whl")
    with tempfile.TemporaryDirectory(prefix="try wheel ") as temporary:
        work = Path(temporary) / "work"
        work.mkdir()
        venv.create(Path(temporary) / "core", with_pip=True)
        core = Place(Path(temporary) / "core")
        core.run("-m", "pip", "install", "--quiet", "--no-compile", wheel, at=work)
        core.run("-m", "pip", "check", at=work)
        size = core.megabytes()
        print(f"wheel {wheel.stat().st_size / 1e6:.2f} MB; core install {size:.0f} MB", flush=True)
        for command in PREPARE:
            core.run("-m", "shapespace", *shlex.split(command), at=work)
        rows = [f"{file.name},{'ab'[number % 2]}" for number, file in enumerate(sorted((work / "scans").glob("*.ply")))]
        (work / "labels.csv").write_text("\n".join(["file,label", *rows]) + "\n", encoding="utf-8")
        shutil.make_archive(str(work / "scans"), "zip", work / "scans")
        for extra, commands in TRIES.items():
            output = core.run("-m", "shapespace", *shlex.split(commands[0]), at=work, well=False)
            if not re.search(rf"pip install \S*shapespace\[{extra}\]", output):
                sys.exit(f"without {extra} {commands[0]!r} says no command to install it: {output}")
            one = Place(Path(temporary) / extra)
            _copy(core.folder, one.folder)
            one.run("-m", "pip", "install", "--quiet", f"{wheel}[{extra}]", at=work)
            for command in commands:
                otherwise = ENDS_OTHERWISE.get(extra, "")
                printed = one.run("-m", "shapespace", *shlex.split(command), at=work, well=not otherwise)
                if otherwise not in printed:
                    sys.exit(f"{command}: {printed}")
            print(f"extra {extra}: {one.megabytes() - size:+.0f} MB, works alone", flush=True)
            shutil.rmtree(one.folder)
        core.run("-m", "pip", "install", "--quiet", f"{wheel}[all]", at=work)
        core.run("-m", "pip", "check", at=work)
        print(f"all extras: {core.megabytes():.0f} MB", flush=True)
        new = Path(temporary) / "new user"
        new.mkdir()
        for command in [*_readme(), "demo --quick --out demo-out"]:
            core.run("-m", "shapespace", *shlex.split(command), at=new)
            print(f"shapespace {command}", flush=True)
    if size > MOST_CORE_MB:
        sys.exit(f"The core takes {size:.0f} MB, more than {MOST_CORE_MB}.")


def _copy(source: Path, target: Path) -> None:
    """Copy an environment by links, which is quick; pip replaces files and does not write into them."""
    shutil.copytree(source, target, symlinks=True, copy_function=os.link)


def _readme() -> Sequence[str]:
    text = (ROOT / "README.md").read_text("utf-8")
    return [line for line in re.findall(r"^\$ shapespace (.*)$", text, re.MULTILINE) if not line.startswith("view")]


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "dist"))
