"""Make report/assets/vendor/three.min.js: the part of three.js that the scripts of scenes need, as one classic script.

For developers, when three.js is updated; needs npm and the network. Users need neither.

    python tools/bundle_three.py
"""

from __future__ import annotations

import hashlib
import json
import shutil
import subprocess
import tempfile
from pathlib import Path

THREE, ESBUILD = "0.187.0", "0.25.10"
NAMES = (
    "BufferAttribute",
    "BufferGeometry",
    "DataTexture",
    "DoubleSide",
    "DynamicDrawUsage",
    "LinearFilter",
    "LineSegments",
    "Mesh",
    "PerspectiveCamera",
    "Points",
    "Raycaster",
    "REVISION",
    "Scene",
    "ShaderMaterial",
    "Sphere",
    "Vector2",
    "Vector3",
    "WebGLRenderer",
)
# The built-in materials are a third of the library and are not used; WebGLProgram itself needs these two texts.
KEPT_SHADERS = ("colorspace_pars_fragment", "tonemapping_pars_fragment")
TARGET = Path(__file__).resolve().parents[1] / "src/shapespace/report/assets/vendor"

BUILD = """
import * as esbuild from "esbuild";
const kept = new Set(%(kept)s);
await esbuild.build({
  stdin: { contents: %(entry)s, resolveDir: "." },
  bundle: true, minify: true, format: "iife", globalName: "THREE", target: "es2020",
  legalComments: "none", banner: { js: %(banner)s }, outfile: "three.min.js",
  plugins: [{ name: "no built-in shaders", setup(build) {
    build.onLoad({ filter: /shaders[\\\\/]Shader(Chunk|Lib)[\\\\/]\\w+\\.glsl\\.js$/ }, ({ path }) => {
      const name = path.split(/[\\\\/]/).pop().replace(".glsl.js", "");
      if (kept.has(name)) return undefined;
      return { contents: "export default '';export const vertex = '';export const fragment = '';" };
    });
  } }],
});
"""


def main() -> None:
    npm, node = shutil.which("npm"), shutil.which("node")
    if npm is None or node is None:
        raise SystemExit("npm and node are needed to bundle three.js; install Node.js 20 or later.")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "package.json").write_text('{"private": true, "type": "module"}', encoding="utf-8")
        subprocess.run([npm, "install", "--silent", f"three@{THREE}", f"esbuild@{ESBUILD}"], cwd=folder, check=True)
        entry = f"export {{ {', '.join(NAMES)} }} from 'three/src/Three.js';"
        licence = (folder / "node_modules/three/LICENSE").read_text(encoding="utf-8")
        # The licence must travel with every copy, and pages hold this file without its folder.
        banner = f"/* A part of three.js {THREE}, https://threejs.org\n\n{licence.strip()}\n*/"
        values = {"kept": json.dumps(KEPT_SHADERS), "entry": json.dumps(entry), "banner": json.dumps(banner)}
        (folder / "build.js").write_text(BUILD % values, encoding="utf-8")
        subprocess.run([node, "build.js"], cwd=folder, check=True)
        script = (folder / "three.min.js").read_bytes()
    TARGET.mkdir(parents=True, exist_ok=True)
    (TARGET / "three.min.js").write_bytes(script)
    (TARGET / "LICENSE").write_text(licence, encoding="utf-8")
    (TARGET / "README.md").write_text(readme(script), encoding="utf-8")
    print(f"{len(script) / 1000:.0f} kB")


def readme(script: bytes) -> str:
    return f"""# three.min.js

The part of [three.js](https://threejs.org) that `scene-*.js` use. three.js is under the MIT licence, in `LICENSE`.

| | |
|---|---|
| version | npm package `three` {THREE} |
| made by | `tools/bundle_three.py`, with `esbuild` {ESBUILD} |
| size | {len(script):,} bytes |
| SHA-256 | `{hashlib.sha256(script).hexdigest()}` |

The file is a classic script with the global `THREE`, so that it can stand inside a page that is opened from disk. It
holds only the names listed in the tool, with what they need. The shaders of the built-in materials are left out, as
`scene-material.js` has its own. Do not edit it; run the tool again.
"""


if __name__ == "__main__":
    main()
