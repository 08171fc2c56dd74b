"""Docstrings name what is there: arguments and fields, raised errors, and members of classes and modules."""

import ast
import builtins
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import shapespace

ROOT = Path(shapespace.__file__).parent
FOREIGN_ERRORS = {"LinAlgError", "np.linalg.LinAlgError", "ArgumentTypeError"}
ENTRY = re.compile(r"^    (\*{0,2}[\w.]+(?:, \*{0,2}[\w.]+)*)(?:: |:$)")
REFERENCE = re.compile(r"`(\w+)\.(\w+)(?:\(\))?`")

Documented = ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef


@cache
def source_trees() -> dict[Path, ast.Module]:
    return {path: ast.parse(path.read_text("utf-8")) for path in sorted(ROOT.rglob("*.py"))}


@cache
def classes() -> dict[str, ast.ClassDef]:
    trees = source_trees().values()
    return {node.name: node for tree in trees for node in ast.walk(tree) if isinstance(node, ast.ClassDef)}


def entries(docstring: str, section: str) -> list[str]:
    """Return the names that a section explains, such as those below `Args:`."""
    _, _, rest = docstring.partition(f"\n{section}:\n")
    names: list[str] = []
    for line in rest.splitlines():
        if line and not line.startswith(" "):
            break
        if match := ENTRY.match(line):
            names += [name.strip("*") for name in match[1].split(", ")]
    return names


def arguments(node: Documented) -> set[str]:
    """Return what a function or the constructor of a class is called with, and the fields of the class."""
    if isinstance(node, ast.ClassDef):
        names = members(node)
        for method in node.body:
            if isinstance(method, ast.FunctionDef) and method.name in ("__init__", "__new__"):
                names |= arguments(method)
        return names
    values = node.args
    named = [*values.posonlyargs, *values.args, *values.kwonlyargs, values.vararg, values.kwarg]
    return {value.arg for value in named if value is not None}


def members(node: ast.ClassDef) -> set[str]:
    """Return the fields, methods and constants of a class, those of its bases included."""
    names: set[str] = set()
    for part in ast.walk(node):
        if isinstance(part, ast.FunctionDef):
            names.add(part.name)
        elif isinstance(part, ast.AnnAssign | ast.Assign):
            targets = part.targets if isinstance(part, ast.Assign) else [part.target]
            names |= {name.id for target in targets for name in ast.walk(target) if isinstance(name, ast.Name)}
            names |= {name.attr for target in targets for name in ast.walk(target) if isinstance(name, ast.Attribute)}
    for base in node.bases:
        if isinstance(base, ast.Name) and base.id in classes():
            names |= members(classes()[base.id])
    return names


def documented(trees: dict[Path, ast.Module]) -> Iterator[tuple[str, Documented, str]]:
    """Yield the place, the node and the docstring of every function and class that has one."""
    for path, tree in trees.items():
        for node in ast.walk(tree):
            if isinstance(node, Documented) and (docstring := ast.get_docstring(node)):
                yield f"{path.name}:{node.lineno} {node.name}", node, docstring


def faults(trees: dict[Path, ast.Module]) -> list[str]:
    """Return a clause for each name in a docstring that is not there."""
    # Modules of commands are named as users type them, which other packages also call their functions.
    modules = {
        path.stem: tree for path, tree in source_trees().items() if path.parent.name not in ("commands", "answers")
    }
    found: list[str] = []
    for place, node, docstring in documented(trees):
        real = arguments(node)
        found += [f"{place} documents {name}" for name in entries(docstring, "Args") if name not in real]
        for error in entries(docstring, "Raises"):
            if error not in classes() and error not in FOREIGN_ERRORS and not hasattr(builtins, error):
                found.append(f"{place} raises {error}")
        for owner, name in REFERENCE.findall(docstring):
            if owner in classes() and name not in members(classes()[owner]) | vars(object).keys():
                found.append(f"{place} refers to {owner}.{name}")
            if owner in modules and owner != "__init__" and not re.search(rf"\b{name}\b", ast.unparse(modules[owner])):
                found.append(f"{place} refers to {owner}.{name}")
    return found


def test_docstrings_name_only_arguments_errors_and_members_that_exist() -> None:
    assert faults(source_trees()) == []


def test_a_wrong_name_is_found_in_each_part_of_a_docstring() -> None:
    wrong = '''
def f(a, *rest, b=0):
    """Do it as `Mesh.gone` and `types.gone` do, not `Mesh.vertices`.

    Args:
        a, gone: two.
        rest: more.
        b: one.

    Raises:
        GoneError: always.
        InputError: sometimes.
    """
'''
    assert faults({Path("x.py"): ast.parse(wrong)}) == [
        "x.py:2 f documents gone", "x.py:2 f raises GoneError", "x.py:2 f refers to Mesh.gone",
        "x.py:2 f refers to types.gone",
    ]  # fmt: skip
