"""The documents say what the code does: their examples run, their links and names exist, their tables are complete."""

import ast
import contextlib
import importlib
import inspect
import io
import os
import re
import runpy
import shlex
import shutil
import subprocess
import sys
import tomllib
import webbrowser
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest
from PIL import Image

from shapespace import cli
from shapespace.cli.command_table import COHORT_SETTINGS, COMMANDS, JSON, QUIET, SET, CommandSpec

ROOT = Path(__file__).resolve().parents[2]
DOCUMENTS = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "CHANGELOG.md",
    ROOT / "benchmarks" / "README.md",
    ROOT / "studies" / "README.md",
    *sorted((ROOT / "docs").glob("*.md")),
    *sorted((ROOT / "docs" / "cli").glob("*.md")),
]
PUBLIC_NAMES = runpy.run_path(str(ROOT / "tools" / "public_api.py"))["names"]
CLI_PAGES = [ROOT / "docs" / "cli.md", *(ROOT / "docs" / "cli").glob("*.md")]
NEEDS_DATA = "<!-- needs data -->"
OUTPUT = "<!-- output of the commands above -->"
"""Before a block whose lines the commands since the last Python block print, in this order."""
OUTPUT_BUT_NUMBERS = "<!-- output of the commands above; numbers differ between processors -->"
"""Before such a block whose numbers are not compared, since processors round differently."""
# The demo takes minutes, viewer and studio run until they are stopped; all have tests. Here they are parsed.
PARSED_ONLY = ("demo", "studio", "view")
BESIDE = ("dask",)
"""Programs that go on while the commands after them run."""


@dataclass(frozen=True)
class Block:
    """A fenced block of a document."""

    language: str
    text: str
    line: int
    needs_data: bool
    is_output: bool = False
    has_exact_numbers: bool = True


def named(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def blocks(document: Path) -> list[Block]:
    found: list[Block] = []
    lines = document.read_text("utf-8").splitlines()
    start, before = None, ""
    for number, line in enumerate(lines):
        if line.startswith("```"):
            if start is None:
                start = number
            else:
                language = lines[start][3:].strip()
                text = "\n".join(lines[start + 1 : number])
                is_output = before in (OUTPUT, OUTPUT_BUT_NUMBERS)
                found.append(
                    Block(language, text, start + 1, before == NEEDS_DATA, is_output, before != OUTPUT_BUT_NUMBERS)
                )
                start, before = None, ""
        elif start is None and line.strip():
            before = line.strip()
    assert start is None, f"{named(document)}: the block in line {(start or 0) + 1} is never closed"
    return found


def commands(block: Block) -> list[str]:
    """Return what a reader types: the lines after `$` in a console, all lines of a bash block."""
    if block.language == "console":
        return [line[2:] for line in block.text.splitlines() if line.startswith("$ ")]
    if block.language == "bash":
        return [line for line in block.text.splitlines() if line.strip() and not line.startswith("#")]
    return []


def arguments(command: str) -> list[str]:
    """Return the arguments after `shapespace` as a shell would give them."""
    out: list[str] = []
    for word in shlex.split(command, comments=True)[1:]:
        # A pattern without files stays as it is, as in a shell.
        out += (sorted(map(str, Path().glob(word))) if "*" in word else []) or [word]
    return out


@contextlib.contextmanager
def going_on(command: list[str]) -> Iterator[None]:
    """Run a command of this environment until the block ends."""
    program = Path(sys.executable).with_name(command[0])
    with subprocess.Popen([program, *command[1:]], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        try:
            yield
        finally:
            process.terminate()


def run(document: Path, *, with_data: bool, instead: Mapping[str, Callable[[], None]] = MappingProxyType({})) -> int:
    """Run the examples of `document` in order in the current folder, and return how many there were.

    Args:
        document: the document.
        with_data: whether to run those that need open data.
        instead: what to do for some commands.
    """
    with contextlib.ExitStack() as beside:
        return _run(document, beside, with_data=with_data, instead=instead)


def _run(
    document: Path, beside: contextlib.ExitStack, *, with_data: bool, instead: Mapping[str, Callable[[], None]]
) -> int:
    namespace: dict[str, Any] = {"__name__": "__main__"}
    count, printed = 0, ""
    for block in blocks(document):
        if block.needs_data and not with_data:
            continue
        where = f"{named(document)}, line {block.line}"
        if block.is_output:
            check_output(block, printed, where)
        if block.language == "python":
            printed = ""
            # Padding makes the line numbers of a traceback those of the document.
            exec(compile("\n" * block.line + block.text, str(document), "exec"), namespace)
            count += 1
        for command in commands(block):
            program = shlex.split(command, comments=True)[0]
            if program in BESIDE and command.endswith(" &"):
                beside.enter_context(going_on(shlex.split(command.removesuffix(" &"))))
                continue
            if program != "shapespace":
                continue
            if command in instead:
                instead[command]()
                continue
            argv = arguments(command)
            if argv[0] in PARSED_ONLY:
                cli.parser().parse_args(argv)
                count += 1
                continue
            said = io.StringIO()
            with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
                assert cli.main(argv) == 0, f"{where}: {command}"
            printed += said.getvalue()
            count += 1
    return count


def check_output(block: Block, printed: str, where: str) -> None:
    """Check that the lines of a block are printed in its order, whatever is printed between them."""

    def compared(line: str) -> str:
        return line.rstrip() if block.has_exact_numbers else re.sub(r"[-+]?\d[\d.]*", "0", line.rstrip())

    lines = iter(compared(line) for line in printed.splitlines())
    for quoted in block.text.splitlines():
        assert compared(quoted) in lines, f"{where}: {quoted!r} is not printed; this is:\n{printed}"


@pytest.fixture
def workplace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty current folder, without open data unless a test names them."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(webbrowser, "open", lambda _: True)
    # The meshes need not be split for so many, which takes four times as long as all the rest of a scan.
    monkeypatch.setattr("shapespace.datasets.simulated_scan.PLAIN_TRIANGLES", 16_000)
    # Workers that start for three scans take longer than the scans; what they do is tested in tests/batch.
    monkeypatch.setattr("shapespace.batch.executors.cores", lambda: 1)
    for name in ("SHAPESPACE_DATA", "SHAPESPACE_DATA_URL"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("SHAPESPACE_CACHE", str(tmp_path / "cache"))
    return tmp_path


def check_pictures(document: Path, workplace: Path) -> None:
    """Check that each picture PAGE-NAME.png of a tutorial is the NAME.png that its run made; renew them if asked to."""
    for name in re.findall(rf"\(images/{document.stem}-(\w+\.png)\)", document.read_text(encoding="utf-8")):
        [made] = workplace.rglob(name)
        kept = document.parent / "images" / f"{document.stem}-{name}"
        if os.environ.get("SHAPESPACE_UPDATE_PICTURES"):
            with Image.open(made) as picture:
                full = picture.convert("RGB")
                full.quantize(palette=full.quantize(256), dither=Image.Dither.FLOYDSTEINBERG).save(kept, optimize=True)
        with Image.open(made) as picture, Image.open(kept) as known:
            # Other processors round otherwise, which moves what is drawn by some pixels.
            near = np.allclose(picture.size, known.size, rtol=0.03)
            assert near, f"{kept} is not of this run; SHAPESPACE_UPDATE_PICTURES=1 renews it"


def has_examples(document: Path, *, needing_data: bool) -> bool:
    chosen = [b for b in blocks(document) if b.needs_data == needing_data]
    return any(b.language == "python" or any(c.startswith("shapespace") for c in commands(b)) for b in chosen)


LONG = (
    "asymmetry.md",
    "change.md",
    "compare.md",
    "completion.md",
    "correspondence.md",
    "dense.md",
    "identity.md",
    "index.md",
    "howto-own-model.md",
    "landmarks.md",
    "missing.md",
    "quality.md",
    "recognise.md",
    "regress.md",
    "report.md",
    "scale.md",
    "tutorial-bones.md",
    "tutorial-faces.md",
    "tutorial-groups.md",
    "tutorial-identity.md",
    "tutorial-landmarks.md",
    "tutorial-recognition.md",
    "tutorial-spleens.md",
    "tutorial-surfaces-and-landmarks.md",
    "tutorial-volumes.md",
)
"""Documents whose examples take long."""
MARKS: dict[str, Any] = dict.fromkeys(LONG, pytest.mark.long)
FEWER: Mapping[str, Mapping[str, str]] = {
    "tutorial-recognition.md": {"--subjects 25": "--subjects 8", "--folds 5": "--folds 4"},
    "tutorial-identity.md": {"--subjects 12": "--subjects 6"},
}
"""With which a tutorial takes a third or half of its time, where it is not run as it stands."""
MARKS |= {name: [pytest.mark.long, pytest.mark.pairs] for name in FEWER}
BEGINNINGS = (
    "shapespace data faces -o people --subjects 12",
    "shapespace build people -o model.h5 --variance 0.95",
    "shapespace data faces -o scans --subjects 1 --seed 7 --raw",
)
"""Commands that several pages begin with: they are run once for all of them."""


def beginnings(home: Path) -> None:
    with contextlib.chdir(home), contextlib.redirect_stdout(io.StringIO()):
        for command in BEGINNINGS:
            assert cli.main(arguments(command)) == 0, command


def copied(source: Path) -> None:
    if source.is_dir():
        shutil.copytree(source, source.name)
    else:
        shutil.copy(source, source.name)


@pytest.mark.parametrize(
    "document",
    [
        pytest.param(document, marks=MARKS.get(document.name, ()))
        for document in DOCUMENTS
        if has_examples(document, needing_data=False)
    ],
    ids=named,
)
def test_examples_run_as_they_stand(
    document: Path, workplace: Path, made_once: Callable[[Callable[[Path], None]], Path]
) -> None:
    instead: dict[str, Callable[[], None]] = {}
    typed = {command for block in blocks(document) for command in commands(block)}
    if typed.issuperset(BEGINNINGS[:2]):
        home = made_once(beginnings)
        for command in BEGINNINGS:
            words = arguments(command)
            instead[command] = partial(copied, home / words[words.index("-o") + 1])
    assert run(document, with_data=False, instead=instead) > 0
    check_pictures(document, workplace)


@pytest.mark.long
@pytest.mark.parametrize("name", FEWER)
def test_tutorials_of_many_scans_go_with_fewer_people(name: str, workplace: Path) -> None:
    document, fewer = ROOT / "docs" / name, FEWER[name]

    def with_fewer(command: str, many: str) -> Callable[[], None]:
        def do() -> None:
            with contextlib.redirect_stdout(io.StringIO()):
                assert cli.main(arguments(command.replace(many, fewer[many]))) == 0

        return do

    typed = [command for block in blocks(document) for command in commands(block)]
    instead = {command: with_fewer(command, many) for command in typed for many in fewer if many in command}
    assert len(instead) == len(fewer)
    assert run(document, with_data=False, instead=instead) > 5
    check_pictures(document, workplace)


@pytest.mark.parametrize(
    "document",
    [
        pytest.param(document, marks=pytest.mark.long if document.name == "tutorial-broken-femur.md" else ())
        for document in DOCUMENTS
        if has_examples(document, needing_data=True)
    ],
    ids=named,
)
def test_examples_with_open_data_run_too(
    document: Path, workplace: Path, shared_data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SHAPESPACE_DATA", str(shared_data))
    assert run(document, with_data=True) > 0
    check_pictures(document, workplace)


@pytest.mark.long
def test_the_tutorial_on_raw_scans_goes_with_real_spleens(workplace: Path, shared_data: Path) -> None:
    spleens = sorted((shared_data / "spleens").glob("*.ply"))[:7]
    if not spleens:
        pytest.skip("no spleens there")

    def copy(some: list[Path], folder: str) -> Callable[[], None]:
        def put() -> None:
            Path(folder).mkdir()
            for path in some:
                shutil.copy(path, folder)

        return put

    instead = {
        "shapespace data organs -o spleens --count 8": copy(spleens[:6], "spleens"),
        "shapespace data organs -o new --count 1 --seed 99": copy(spleens[6:], "new"),
    }
    assert run(ROOT / "docs" / "tutorial-spleens.md", with_data=False, instead=instead) > 8


@pytest.mark.long
def test_the_tutorial_on_label_volumes_goes_with_real_hippocampi(workplace: Path, shared_data: Path) -> None:
    nibabel = pytest.importorskip("nibabel", reason="the extra `volumes` is not installed")
    masks = sorted((shared_data / "hippocampus").glob("*.nii.gz"))[:7]
    if not masks:
        pytest.skip("no hippocampi there")

    def join_labels(some: list[Path], folder: str) -> Callable[[], None]:
        def put() -> None:
            Path(folder).mkdir()
            for number, path in enumerate(some):
                image = nibabel.load(path)
                whole = (np.asarray(image.dataobj) > 0).astype(np.uint8)
                nibabel.save(nibabel.Nifti1Image(whole, image.affine), f"{folder}/organ_{number:03d}.nii.gz")

        return put

    instead = {
        "shapespace data organs -o masks --count 7 --volumes": join_labels(masks[:6], "masks"),
        "shapespace data organs -o new-masks --count 1 --seed 99 --volumes": join_labels(masks[6:], "new-masks"),
    }
    assert run(ROOT / "docs" / "tutorial-volumes.md", with_data=False, instead=instead) > 8


@pytest.mark.parametrize("document", DOCUMENTS, ids=named)
def test_make_lines_name_targets_of_the_makefile(document: Path) -> None:
    targets = set(re.findall(r"^([a-z][a-z-]*):", (ROOT / "Makefile").read_text("utf-8"), re.MULTILINE))
    text = document.read_text("utf-8")
    asked = set(re.findall(r"`make ([a-z-]+)", text))
    for block in blocks(document):
        for command in commands(block):
            words = shlex.split(command, comments=True)
            if words[0] == "make":
                asked |= {word for word in words[1:] if "=" not in word}
    assert asked <= targets


def test_readme_gives_the_two_commands() -> None:
    typed = [command for block in blocks(ROOT / "README.md") for command in commands(block)]
    assert {"make demo", "make test"} <= {command.split("#")[0].strip() for command in typed}


# Links, pictures, paths


def links(document: Path) -> list[tuple[str, str]]:
    """Return (text, target) of every link and picture outside fenced blocks."""
    text = re.sub(r"^```.*?^```", "", document.read_text("utf-8"), flags=re.MULTILINE | re.DOTALL)
    return re.findall(r"\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^()\s]+)\)", text)


def anchors(document: Path) -> set[str]:
    headings = re.findall(r"^#+ (.*)$", document.read_text("utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("document", DOCUMENTS, ids=named)
def test_links_and_pictures_lead_somewhere(document: Path) -> None:
    for _, target in links(document):
        if re.match(r"(https|mailto):", target):
            continue
        path, _, anchor = target.partition("#")
        file = (document.parent / path).resolve() if path else document
        assert file.exists(), f"{named(document)} points at {target}, which does not exist"
        assert file.is_relative_to(ROOT), f"{named(document)} points out of the repository: {target}"
        if anchor:
            assert anchor in anchors(file), f"{named(document)} points at {target}, but there is no such heading"


@pytest.mark.parametrize("document", DOCUMENTS, ids=named)
def test_no_document_names_a_path_of_one_machine(document: Path) -> None:
    text = document.read_text("utf-8")
    absolute = re.findall(r"(?:(?<=[\s`\"'(=])|^)/[a-z]\w*/[\w.]+", text, re.MULTILINE)
    assert not absolute and not re.search(r"\b[A-Z]:\\", text)


def code_links(document: Path) -> Iterator[tuple[str, Path]]:
    """Yield (name, file) of every link whose text is code and whose target is a Python file."""
    for text, target in links(document):
        if target.endswith(".py") and text.startswith("`") and not text.endswith((".py`", "/`")):
            yield text.strip("`").removesuffix("()"), (document.parent / target).resolve()


@cache
def names_in(file: Path) -> set[str]:
    """Return the functions, classes, methods, fields and constants that a file defines, dotted."""
    found: set[str] = set()

    def walk(nodes: list[ast.stmt], prefix: str) -> None:
        for node in nodes:
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                found.add(prefix + node.name)
                if isinstance(node, ast.ClassDef):
                    walk(node.body, f"{prefix}{node.name}.")
            elif isinstance(node, ast.Assign | ast.AnnAssign):
                targets = node.targets if isinstance(node, ast.Assign) else [node.target]
                found.update(prefix + target.id for target in targets if isinstance(target, ast.Name))

    walk(ast.parse(file.read_text("utf-8")).body, "")
    return found


@pytest.mark.parametrize("document", DOCUMENTS, ids=named)
def test_code_that_is_linked_to_is_in_that_file(document: Path) -> None:
    for name, file in code_links(document):
        assert name in names_in(file), f"{named(document)} names {name}, but {file.name} has no such thing"
        if file.is_relative_to(ROOT / "src"):
            module = importlib.import_module(".".join(file.relative_to(ROOT / "src").with_suffix("").parts))
            owner: Any = module
            for part in name.split("."):
                known = hasattr(owner, part) or part in getattr(owner, "__dataclass_fields__", ())
                assert known, f"{named(document)} names {name}, which {module.__name__} does not have"
                owner = getattr(owner, part, None)


# Tables


def rows(document: Path, heading: str) -> list[list[str]]:
    """Return the cells of the first table under `heading`, without its head."""
    text = document.read_text("utf-8")
    match = re.search(rf"^#+ {re.escape(heading)}$(.*?)(?=^#+ |\Z)", text, re.MULTILINE | re.DOTALL)
    assert match, f"{named(document)} has no heading {heading!r}"
    lines = [line for line in match[1].splitlines() if line.startswith("|")]
    assert len(lines) > 2, f"{named(document)} has no table under {heading!r}"
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]


def code_in(cell: str) -> list[str]:
    return re.findall(r"`([^`]+)`", cell)


def project() -> Mapping[str, Any]:
    return tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))


def test_the_paper_map_covers_every_equation_and_figure_with_code_and_a_test() -> None:
    document = ROOT / "docs" / "paper-map.md"
    for heading, last in (("Equations", 19), ("Figures", 11)):
        covered: list[int] = []
        for first, _, code, test in rows(document, heading):
            numbers = [int(n) for n in re.findall(r"\d+", first)]
            covered += range(numbers[0], numbers[-1] + 1)
            assert "../src/" in code, f"{heading} {first} has no code"
            assert "../tests/" in test, f"{heading} {first} has no test"
        assert sorted(set(covered)) == list(range(1, last + 1))


def test_the_layers_are_those_that_are_enforced() -> None:
    (block,) = [b for b in blocks(ROOT / "docs" / "architecture.md") if b.language == "layers"]
    written = [line.split("  ")[0].strip() for line in block.text.splitlines()]
    assert written == project()["tool"]["importlinter"]["contracts"][0]["layers"]


def test_every_dependency_has_its_line_and_every_line_its_dependency() -> None:
    declared = project()["project"]
    extras = {f"Extra {name}": of for name, of in declared["optional-dependencies"].items() if name != "all"}
    groups = {f"Group {name}": of for name, of in project()["dependency-groups"].items() if name != "dev"}
    for heading, wanted in {"Needed to run": declared["dependencies"], **extras, **groups}.items():
        names = sorted(re.split(r"[<>=~\[;]", requirement)[0].strip() for requirement in wanted)
        table = rows(ROOT / "docs" / "dependencies.md", heading)
        assert sorted(code_in(row[0])[0] for row in table) == names
        assert all(len(row) == 4 and all(row) for row in table)


def test_every_extension_point_is_where_the_document_says_with_its_choices_and_its_test() -> None:
    document = ROOT / "docs" / "extending.md"
    table = rows(document, "Extension points")
    for point, home, choices, test in table:
        (name,) = code_in(point)
        module = importlib.import_module(code_in(home)[0])
        assert sorted(code_in(choices)) == sorted(getattr(module, name)), f"{name} has other choices"
        assert "../tests/" in test
        file = (document.parent / re.findall(r"\(([^)]+\.py)\)", test)[0]).resolve()
        assert name in file.read_text("utf-8"), f"{named(file)} does not read {name}"
        assert f"## {name}" in document.read_text("utf-8")
    found = set()
    for file in (ROOT / "src").rglob("*.py"):
        for node in ast.parse(file.read_text("utf-8")).body:
            if isinstance(node, ast.AnnAssign) and "Mapping[str, Callable" in ast.unparse(node.annotation):
                found |= {node.target.id} if isinstance(node.target, ast.Name) else set()
    assert found and found <= {code_in(row[0])[0] for row in table}, "an extension point is missing from the table"


def test_the_pages_of_commands_are_those_of_the_parser() -> None:
    wanted = runpy.run_path(str(ROOT / "tools" / "make_cli_reference.py"))["pages"]()
    pages = [*CLI_PAGES, ROOT / "docs" / "morphometrics.md"]
    found = {path.relative_to(ROOT / "docs").as_posix(): path.read_text("utf-8") for path in pages}
    assert found == wanted, "run: python tools/make_cli_reference.py"


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command.name)
def test_the_reference_has_every_option_of_the_parser_and_no_other(command: CommandSpec) -> None:
    text = (ROOT / "docs" / "cli" / f"{command.name.replace(' ', '-')}.md").read_text("utf-8")
    cells = [line.split(" | ")[0] for line in text.splitlines() if line.startswith("| `-")]
    of_all = (JSON, QUIET, SET)  # the index describes them
    shown = [option for option in command.options if not option.is_positional and option not in of_all]
    settings = [option.names for option in command.settings if option not in COHORT_SETTINGS]
    assert [name for cell in cells for name in re.findall(r"`(-[\w-]+)", cell) if name != "--set"] == [
        name for option in sorted(shown, key=lambda option: not option.basic) for name in option.spellings
    ]
    assert re.findall(r"^\| `--set (\w+)=", text, re.MULTILINE) == settings


def test_the_reference_lists_every_key_of_a_fit_record() -> None:
    from shapespace.batch.fit_records import fit_record
    from shapespace.fit.fit_scan import fit_scan
    from shapespace.schemas import File
    from synthetic_shapes import blob_model, raw_scan

    model = blob_model()
    record = fit_record(
        fit_scan(model, raw_scan(0.5 * model.stddev / model.stddev).scan), File(name="a"), File(name="b")
    )
    written = [key for row in rows(ROOT / "docs" / "fit-results.md", "NAME.fit.json") for key in code_in(row[0])]
    assert sorted(written) == sorted(record.to_json())


def test_the_reference_lists_every_column_of_the_table(tmp_path: Path) -> None:
    from shapespace.batch.fit_records import write_coefficients

    write_coefficients(tmp_path / "c.csv", [], 2)
    header = (tmp_path / "c.csv").read_text().strip().split(",")
    written: list[str] = []
    for row in rows(ROOT / "docs" / "fit-results.md", "coefficients.csv"):
        for name in code_in(row[0]):
            if name.startswith("..."):
                written += [f"{way}{name.removeprefix('...')}" for way in ("model_to_scan", "scan_to_model")]
            elif name.startswith("meta_"):
                continue  # of lists with such columns alone
            else:
                written.append(name.replace("K", "2"))
    assert sorted(written) == sorted(header)


def test_the_model_file_holds_what_its_document_lists(tmp_path: Path) -> None:
    import h5py

    from shapespace.types import SurfaceLandmarks
    from synthetic_shapes import blob_model

    model, document = blob_model(), ROOT / "docs" / "model-file.md"
    always, of_training, of_landmarks = (
        {code_in(row[0])[0] for row in rows(document, f"Datasets{what}")}
        for what in ("", " of training shapes", " of landmarks")
    )
    model.save(tmp_path / "model.h5")
    with h5py.File(tmp_path / "model.h5") as file:
        assert sorted(always | of_training | of_landmarks) == sorted(file)
        assert sorted(code_in(row[0])[0] for row in rows(document, "Attributes")) == sorted(file.attrs)
    replace(model, training=None).save(tmp_path / "shared.h5")
    with h5py.File(tmp_path / "shared.h5") as file:
        assert set(file) == always | of_landmarks
    replace(model, landmarks=SurfaceLandmarks()).save(tmp_path / "plain.h5")
    with h5py.File(tmp_path / "plain.h5") as file:
        assert set(file) == always | of_training


def test_public_names_are_in_the_reference() -> None:
    text = (ROOT / "docs" / "api.md").read_text("utf-8")
    assert set(re.findall(r"^- `(\w+)`:", text, re.MULTILINE)) == set(PUBLIC_NAMES()) - {"__version__"}


def test_the_python_reference_is_up_to_date() -> None:
    wanted = runpy.run_path(str(ROOT / "tools" / "make_api_reference.py"))["page"]()
    assert (ROOT / "docs" / "api.md").read_text("utf-8") == wanted, "run: python tools/make_api_reference.py"
    for name, signature in re.findall(r"^- `(\w+)`: .*\n  `(\w+)", wanted, re.MULTILINE):
        assert name == signature


def test_public_names_have_docstrings() -> None:
    for name, value in PUBLIC_NAMES().items():
        assert inspect.getdoc(value), name


def test_the_sizes_of_the_bundled_faces_are_those_stated() -> None:
    from shapespace.datasets.faces import EXPRESSIONS, load_faces

    faces = load_faces()
    text = " ".join((ROOT / "docs" / "data.md").read_text("utf-8").split())
    assert f"{len(faces.template.vertices):,} vertices and {len(faces.template.faces):,} triangles" in text
    assert f"{len(faces.landmarks)} landmarks" in text
    assert f"{len(faces.unit_names)} expression units" in text
    assert f"made of them: {', '.join(EXPRESSIONS)}." in text
