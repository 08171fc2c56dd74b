"""Write docs/cli.md and docs/cli/COMMAND.md: the reference of the command line, from the table of commands.

A test compares the committed pages with the table, and asks for this command:

    python tools/make_cli_reference.py
"""

from __future__ import annotations

from pathlib import Path

from shapespace.cli.command_table import COHORT_SETTINGS, COMMANDS, GROUPS, JSON, QUIET, SET, CommandSpec
from shapespace.cli.options import Option
from shapespace.statistics.shape_tests.test_table import SHAPE_TESTS

DOCS = Path(__file__).resolve().parents[1] / "docs"
GENERATED = "<!-- Written by tools/make_cli_reference.py; edit src/shapespace/cli/command_table.py. -->\n\n"
TESTS_PAGE = "morphometrics.md"
BEGIN, END = "<!-- tests of shape: written by tools/make_cli_reference.py -->\n", "\n<!-- end -->"
PAGES = {
    "data faces": ["data.md"],
    "data get": ["data.md"],
    "data list": ["data.md"],
    "data organs": ["data.md"],
    "data bones": ["data.md", "tutorial-bones.md"],
    "data joints": ["structures.md"],
    "data landmarks": ["data.md", "tutorial-landmarks.md"],
    "surface": ["volumes.md", "tutorial-volumes.md"],
    "check": ["mesh-formats.md"],
    "correspond": ["correspondence.md", "landmarks.md"],
    "landmarks transfer": ("landmarks.md", "correspondence.md"),
    "landmarks convert": ["landmarks.md"],
    "landmarks check": ("landmarks.md", "correspondence.md"),
    "landmarks plot": ["landmarks.md"],
    "landmarks suggest": ("landmarks.md", "correspondence.md"),
    "build": ["model-file.md", "howto-own-model.md", "bspline.md", "missing.md", "recognise.md"],
    "quality": ["quality.md"],
    "info": ["scale.md", "model-file.md"],
    "fit": ["fit-results.md", "scale.md", "landmarks.md", "dense.md", "uncertainty.md"],
    "report": ["report.md"],
    "view": ["viewer.md"],
    "studio": ["studio.md"],
    "recognise train": ["recognise.md", "statistics.md"],
    "recognise predict": ["recognise.md"],
    "recognise transfer": ["recognise.md"],
    "recognise study": ["recognise.md", "data.md"],
    "recognise verify": ["identity.md", "statistics.md"],
    "recognise identify": ["identity.md", "statistics.md"],
    "align": ["morphometrics.md", "tutorial-landmarks.md"],
    "complete": ["completion.md"],
    "morphospace": ["morphometrics.md", "tutorial-landmarks.md"],
    "cohort": ["statistics.md"],
    "figures": ["morphometrics.md"],
    "compare": ["compare.md", "statistics.md"],
    **{f"test {test.name}": ["morphometrics.md", "statistics.md"] for test in SHAPE_TESTS},
    "change": ["change.md", "statistics.md"],
    "asymmetry": ["asymmetry.md", "statistics.md"],
    "regress": ["regress.md", "statistics.md"],
    "score": ["score.md", "statistics.md"],
    "export": ["scale.md", "interop.md"],
    "convert": ["model-file.md"],
    "cache": ["fit-results.md"],
    "demo": ["data.md", "report.md"],
}
"""Command -> pages that explain its topic."""
INTRODUCTION = """# The command line

Every command has `--help` with an example and its basic options, `--help-all` with all options and settings, `--quiet`
(no progress) and, where it prints facts, `--json` (on standard output). `--set NAME=VALUE` gives a setting, a value
that is rarely changed. Messages go to standard error. Without a terminal a step longer than five seconds writes lines
to the log in place of a progress bar. One line reports that code is being compiled, once on a machine.

A folder in place of several meshes means all meshes in it, in the order of their names; with `--recursive` it includes
those in its subfolders. Skipped folders and broken links are named.

## Commands

| command | does |
|---|---|
"""
EXIT_CODES = """
## Exit codes

| code | means |
|---|---|
| 0 | done |
| 1 | done, but some of several inputs failed or, under `--strict`, are doubtful; not of `build`, `quality`, `info` |
| 2 | the arguments are wrong, or no input could be used; one sentence on standard error, no traceback |
| 130, 143, 129 | stopped by Ctrl-C, SIGTERM or SIGHUP; files are complete, and the same command continues |

## A session

```console
$ shapespace data faces -o faces --subjects 12
$ shapespace build faces -o model.h5 --modes 5 --provenance "12 simulated people" --licence CC0-1.0
$ shapespace data faces -o scans --subjects 1 --seed 7
$ shapespace check scans
$ shapespace fit model.h5 scans -o out
$ shapespace info out/subject_000_neutral.fit.json --json
```
"""


def pages() -> dict[str, str]:
    """Return the text of each page by its path in docs."""
    index = "".join(f"| {links} | {text} |\n" for links, text in index_rows())
    return {
        "cli.md": GENERATED + INTRODUCTION + index + EXIT_CODES,
        **{f"cli/{file_name(command)}": GENERATED + page(command) for command in COMMANDS},
        TESTS_PAGE: with_tests((DOCS / TESTS_PAGE).read_text(encoding="utf-8")),
    }


def index_rows() -> list[tuple[str, str]]:
    """Return links and summary of each command, or of each group of commands."""
    rows: dict[str, tuple[list[str], str]] = {}
    for command in COMMANDS:
        group, _, name = command.name.rpartition(" ")
        text = f"`{group}`: {GROUPS[group]}" if group else command.summary
        rows.setdefault(group or name, ([], text))[0].append(f"[`{name}`](cli/{file_name(command)})")
    return [(", ".join(links), text) for links, text in rows.values()]


def with_tests(text: str) -> str:
    """Return the page on tests of shape with their table between its marks."""
    before, _, rest = text.partition(BEGIN)
    rows = "".join(
        f"| [`{test.name}`](cli/test-{test.name}.md) | {test.summary} | {test.statistics} | {test.permuted} "
        f"| {' '.join(test.references)} |\n"
        for test in SHAPE_TESTS
    )
    table = "\n| test | what it does | statistics | permuted | source |\n|---|---|---|---|---|\n" + rows
    return before + BEGIN + table + END + rest.partition(END)[2]


def file_name(command: CommandSpec) -> str:
    return f"{command.name.replace(' ', '-')}.md"


def page(command: CommandSpec) -> str:
    """Return the page of a command."""
    text = f"# shapespace {command.name}\n\n{command.summary[0].upper()}{command.summary[1:]}.\n\n"
    text += f"```text\n{command.usage}\n```\n\n"
    text += "".join(f"{paragraph}\n\n" for paragraph in command.details)
    text += "Example:\n\n```text\n" + "\n".join(command.examples) + "\n```\n"
    shown = [option for option in command.options if option not in (JSON, QUIET, SET)]
    for title, some in (
        ("Arguments", [option for option in shown if option.is_positional]),
        ("Options", [option for option in shown if option.basic and not option.is_positional]),
        ("Advanced options", [option for option in shown if not option.basic]),
        ("Settings", [option for option in command.settings if option not in COHORT_SETTINGS]),
    ):
        if some:
            text += f"\n## {title}\n\n| option | does |\n|---|---|\n" + "".join(map(row, some))
    if set(command.settings) & set(COHORT_SETTINGS):
        names = ", ".join(f"`{option.names}`" for option in command.settings if option in COHORT_SETTINGS)
        text += f"\nSettings of the [cohort](cohort.md): {names}.\n"
    links = ", ".join(f"[{name.removesuffix('.md')}](../{name})" for name in PAGES[command.name])
    return f"{text}\nSee also: {links}, [all commands](../cli.md).\n"


def row(option: Option) -> str:
    """Return the row of an option in the table of its command."""
    value = option.value_name
    names = [option.metavar] if option.is_positional else [f"{name} {value}".strip() for name in option.spellings]
    if option.setting:
        names = [f"--set {option.names}={value}"]
    text = option.text
    cells = [", ".join(f"`{name}`" for name in names), text]
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |\n"


def main() -> None:
    (DOCS / "cli").mkdir(exist_ok=True)
    wanted = pages()
    for old in (DOCS / "cli").glob("*.md"):
        if f"cli/{old.name}" not in wanted:
            old.unlink()
    for name, text in wanted.items():
        (DOCS / name).write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
