"""Lazy imports of functions in higher layers, and of optional packages; calls that are made later.

Modules import only from lower layers. Methods of models and results, such as plots, nevertheless need functions of
higher layers, which they find in `LAZY_FUNCTIONS`, the complete list of these exceptions.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from functools import partial
from importlib import import_module
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, ParamSpec, Protocol, TypeVar, overload

from shapespace.errors import ShapespaceError

LAZY_FUNCTIONS: Mapping[str, str] = MappingProxyType(
    {
        "BuildConfig": "model.build_model",
        "build_model": "model.build_model",
        "extend_model": "model.build_model",
        "html_of_additive_model": "report.notebook",
        "html_of_analysis": "report.notebook",
        "html_of_cohort": "report.notebook",
        "html_of_correspondence": "report.notebook",
        "html_of_fit": "report.notebook",
        "html_of_model": "report.notebook",
        "html_of_predictions": "report.notebook",
        "html_of_predictor": "report.notebook",
        "html_of_quality": "report.notebook",
        "html_of_results": "report.notebook",
        "html_of_volume_surface": "report.notebook",
        "plot_fit": "report.notebook",
        "plot_model": "report.notebook",
        "plot_quality": "report.notebook",
        "save_analysis": "report.analyses.result_report",
        "save_fit": "batch.fit_work",
        "to_menpo": "io.interop",
        "to_meshio": "io.interop",
        "to_open3d": "io.interop",
        "to_pyvista": "io.interop",
        "to_trimesh": "io.interop",
        "trusted_surfaces": "store.corresponding",
        "view_fit": "viewer.notebook_viewer",
        "view_model": "viewer.notebook_viewer",
        "write_mesh": "io.meshes.mesh_io",
    }
)
"""Function -> its module, which is imported at the first use of the function."""


class OpenViewer(Protocol):
    """A viewer in a notebook or an interactive session; it runs until `close` or the end of the process."""

    @property
    def address(self) -> str:
        """Address with the token, for a browser on this machine."""
        ...

    def close(self) -> None:
        """End the viewer and remove its files; repeated calls are allowed."""
        ...


@overload
def lazy_import(name: Literal["save_analysis"]) -> Callable[[object, Path | str], Path]: ...
@overload
def lazy_import(
    name: Literal["html_of_analysis", "html_of_predictions", "html_of_predictor"],
) -> Callable[[object], str]: ...
@overload
def lazy_import(name: str) -> Callable[..., Any]: ...
def lazy_import(name: str) -> Callable[..., Any]:
    """Return the function `name` of `LAZY_FUNCTIONS`."""
    return getattr(import_module(f"shapespace.{LAZY_FUNCTIONS[name]}"), name)


def lazy_names(
    package: str, modules: Mapping[str, tuple[str, ...]]
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return `__getattr__` and `__dir__` of a package whose names are imported when they are first used.

    The import of SciPy takes most of a second, and `shapespace --help` does not need it.

    Args:
        package: name of the package.
        modules: name of a module without `shapespace.` -> names that the package exports from it.
    """
    homes = {name: module for module, names in modules.items() for name in names}

    def find(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(f"shapespace.{homes[name]}"), name)

    return find, lambda: sorted({*vars(sys.modules[package]), *homes})


def require_package(module: str, purpose: str, install: str = "") -> Any:
    """Return a module of a package that shapespace does not require.

    Args:
        module: name of the module.
        purpose: feature that needs the module, as the subject of a sentence.
        install: argument of pip install, if it differs from the name of the module.

    Raises:
        ShapespaceError: the package is not installed, or cannot be imported.
    """
    try:
        return import_module(module)
    except ImportError as error:
        package = module.partition(".")[0]
        if isinstance(error, ModuleNotFoundError) and error.name == package:
            cause = f"which is not installed; run pip install {install or package}."
        else:
            cause = f"which is installed but cannot be loaded ({error}); see its installation instructions."
        raise ShapespaceError(f"{purpose} needs {package}, {cause}") from error


P = ParamSpec("P")
T = TypeVar("T")


class Defer(Protocol):
    """Starts a call, perhaps in another process, to which function, arguments and result can be sent."""

    def __call__(self, function: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Callable[[], T]:
        """Return a function that waits for the result of the call, or raises its error."""
        ...


def call_later(function: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Callable[[], T]:
    """Return a function that makes a call in this process."""
    return partial(function, *args, **kwargs)
