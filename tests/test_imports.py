import re
from graphlib import TopologicalSorter
from importlib import metadata
from pathlib import Path

import grimp

import shapespace
from shapespace.version import __version__


def test_no_modules_import_each_other_in_a_circle_not_even_for_their_types() -> None:
    graph = grimp.build_graph("shapespace", exclude_type_checking_imports=False, cache_dir=None)
    # The package itself names what it offers for type checkers, and loads none of it.
    modules = graph.modules - {"shapespace"}
    assert len(modules) > 100
    TopologicalSorter({name: graph.find_modules_directly_imported_by(name) for name in modules}).prepare()


def test_the_version_of_the_files_is_that_of_the_package() -> None:
    assert metadata.version("shapespace") == __version__


def test_no_module_loads_all_distributions_of_scipy_as_it_is_imported() -> None:
    # scipy.stats takes half a second, and a process that fits needs four functions, which are in scipy.special too.
    source = Path(shapespace.__file__).parent
    loads = re.compile(r"^(from scipy\.stats|import scipy\.stats|from scipy import .*\bstats\b)", re.MULTILINE)
    assert [str(path) for path in source.rglob("*.py") if loads.search(path.read_text(encoding="utf-8"))] == []
