"""The studio's sentences have the labels of its forms, and no words of the terminal or of Python."""

import ast
import html
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from test_studio_server import FORMS, own_home, state, studio

import shapespace
from shapespace.viewer.studio.job_commands import OptionLabels

__all__ = ["own_home"]  # a fixture

SOURCE = Path(shapespace.__file__).parent
TERMINAL = re.compile(r"(?<![\w-])--\w|\bin Python\b|=(?:True|False|None|yes|no|drop)\b|NAME\.|\bexit (?:code|with)\b")
PLACES = re.compile(r"[A-Z]{2,}[,=][A-Z]|:[A-Z]{2,}|\bCSV\b|\bJSON\b|can be repeated|name,vertex|\bverify\b")
"""Placeholders of values and files on the command line."""
EXAMPLE = re.compile(r"such as |\bdefault:? (?:\d|[a-z]+\b)|: \w+, ")
FILES = re.compile(r"\.(?:npz|json|h5)\b|\bNone\b|\bDATA\b")
COMMAND_LINES = (
    "cli",
    "viewer/studio/job_commands.py",
    "viewer/studio/project.py",
    "statistics/shape_tests/test_table.py",
)
"""Modules whose texts with dashes are arguments, or examples of the command line."""
LABELS = OptionLabels(FORMS)


def in_words(text: str) -> str:
    """Return the text of an HTML page that is read, without its commands."""
    text = re.sub(r"<(script|style|pre|code)\b.*?</\1>", "", text, flags=re.DOTALL)
    return html.unescape(re.sub(r"<[^>]*>", " ", text))


def messages(tree: ast.Module) -> Iterator[str]:
    """Yield the texts of a module that are no docstrings, with a word in place of each value."""
    aside = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    aside |= {id(part) for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for part in node.values}
    for node in ast.walk(tree):
        if id(node) in aside:
            continue
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value
        elif isinstance(node, ast.JoinedStr):
            yield "".join(str(part.value) if isinstance(part, ast.Constant) else "x1" for part in node.values)


OPTION = re.compile(r"(?<![\w-])--[a-z]")
MESSAGES = sorted(
    {
        text
        for path in SOURCE.rglob("*.py")
        if not path.relative_to(SOURCE).as_posix().startswith(COMMAND_LINES)
        and OPTION.search(source := path.read_text("utf-8"))  # parsing all would take a tenth of the collection
        for text in messages(ast.parse(source))
        if OPTION.search(text) and " " in text
    }
)


def test_all_messages_that_name_options_are_found() -> None:
    assert len(MESSAGES) > 150
    assert any("--set missing=drop" in text for text in MESSAGES)


@pytest.mark.parametrize("text", MESSAGES)
def test_no_message_has_words_of_the_terminal(text: str) -> None:
    sentence = LABELS.sentence(text)
    assert TERMINAL.search(sentence) is None, sentence
    assert sentence.count("(") == sentence.count(")") or text.count("(") != text.count(")"), sentence


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("x: give landmarks (--landmarks).", "x: give landmarks (option “Landmarks”)."),
        ("fix the scale (--scale fixed), or", "fix the scale (option “Scale”: fixed), or"),
        ("compare shapes with --set gauge=shape.", "compare shapes with the option “Size handling”: shape."),
        ("name the subjects with --set subject=COLUMN.", "name the subjects with the option “Subject”."),
        ("or use fewer --jobs.", "or use fewer “Parallel computations”."),
        ("Wrong. --min-seen is too large.", "Wrong. The option “Minimum observed share” is too large."),
        ("already; leave --unit out.", "already; leave the option “Unit” out."),
        ("with --keep-shapes (keep_shapes), which", "with the option “Keep aligned shapes”, which"),
        ("give a template with --template.", "give a template with the command-line option “Template”."),
        ("run shapespace correspond again.", "run “Correspondence” again."),
        ("again with shapespace fit --stages", "again with “Fit the model” and the option “Stages for figures”"),
        ("shapespace build: error: argument --modes: 'x' is wrong", "The option “Number of modes”: 'x' is wrong"),
        ("shapespace fit: error: argument --timeout: must be above 0", "The option “Time limit (s)” must be above 0"),
        ("shapespace compare: error: argument --set: gauge is 'x'", "The option “Size handling” is 'x'"),
        ("done\nnext: shapespace build x -o m.h5\n", "done\n"),
        ("Use --variances unequal.", "Use the option “Variances of classes”: unequal."),
        ("model-2.h5: 3 modes, gauge shape", "model-2.h5: 3 modes, size handling: shape"),
        ("a dash -- as here, and 3--4 of them", "a dash -- as here, and 3--4 of them"),
    ],
)  # fmt: skip
def test_options_become_labels(text: str, sentence: str) -> None:
    assert LABELS.sentence(text) == sentence


@pytest.mark.parametrize("kind", sorted(FORMS))
def test_forms_have_labels_and_help_for_readers_of_the_page(kind: str) -> None:
    form = LABELS.forms[kind]
    labels = [option["label"] for option in form["options"]]
    assert form["label"] and len(set(labels)) == len(labels)
    for option in form["options"]:
        words = f"{option['label']}. {option['help']}"
        assert TERMINAL.search(words) is None and FILES.search(words) is None, words
        assert option["label"][0].isupper()


@pytest.mark.parametrize("kind", sorted(FORMS))
def test_helps_of_texts_have_an_example_of_what_to_type_and_no_words_for_files(kind: str) -> None:
    for option in LABELS.forms[kind]["options"]:
        flag, help_text = option["flag"], option["help"]
        assert not PLACES.search(help_text), (flag, help_text)
        if option["kind"] == "text" and not option["initial"]:
            assert EXAMPLE.search(help_text), (flag, help_text)


def test_initial_texts_of_forms_are_as_they_can_be_typed() -> None:
    initial = {(kind, one["flag"]): one["initial"] for kind, form in FORMS.items() for one in form["options"]}
    assert (initial["power", "--sizes"], initial["morphospace", "--axes"]) == ("10,20,40", "1,2")
    assert not [key for key, text in initial.items() if text and " " in text]


def test_texts_of_the_page_have_no_words_of_the_terminal() -> None:
    texts = (SOURCE / "viewer" / "assets" / "studio-texts.js").read_text("utf-8")
    assert TERMINAL.search(texts) is None and ".npz" not in texts and ".json" not in texts


def test_a_page_without_forms_has_no_labels() -> None:
    assert "fit" in OptionLabels({}).sentence("run shapespace fit again")


def test_pages_have_labels_in_their_text_and_commands_as_they_are() -> None:
    page = "<style>a{--page: 1}</style><p title='x'>Use --variances unequal.</p><pre>shapespace fit --dense</pre>"
    assert LABELS.page(page) == page.replace("--variances unequal", "the option “Variances of classes”: unequal")


def test_log_messages_reports_and_pages_of_the_server_have_labels(tmp_path: Path) -> None:
    with studio(tmp_path / "p") as client:
        for number, output in ((1, "compare-1"), (2, "fits-2")):
            folder = tmp_path / "p" / "jobs" / f"{number:04d}"
            folder.mkdir(parents=True)
            job = f'{{"number": {number}, "kind": "compare", "arguments": ["x", "--seed=1"], "output": "{output}"}}'
            (folder / "job.json").write_text(job)
            (folder / "log.txt").write_text("shapespace: x: crop it (--crop).\nnext: shapespace fit x -o y\n")
            (folder / "exit.json").write_text('{"code": 0, "seconds": 1}')
        (tmp_path / "p" / "compare-1").mkdir()
        (tmp_path / "p" / "compare-1" / "report.html").write_text("<html><p>Use --variances unequal.</p></html>")
    with studio(tmp_path / "p") as client:
        job = state(client)["jobs"][0]
        assert job["message"] == "x: crop it (option “Crop”)." and job["command"] == "shapespace x --seed=1"
        assert client.get("/api/jobs/1/log").text == "shapespace: x: crop it (option “Crop”).\n"
        report = client.get("/view/1/report/")
        assert "Use the option “Variances of classes”: unequal." in report.text
        assert "sandbox" in report.headers["content-security-policy"]
        rejected = client.post("/api/checks", json={"kind": "regress", "options": {}, "on": None}).json()
        assert not [check for check in rejected if TERMINAL.search(check["text"])]
