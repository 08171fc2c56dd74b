"""Statistical shape models from raw 3-D scans: correspondence, model building, robust fitting and shape statistics.

The names of the main path are here; the packages in `_PACKAGES` have the others. A name is imported on first use.
"""

from importlib import import_module
from typing import TYPE_CHECKING

from shapespace.lazy import lazy_names
from shapespace.version import __version__

if TYPE_CHECKING:
    from shapespace import correspondence as correspondence
    from shapespace import datasets as datasets
    from shapespace import fit as fit
    from shapespace import geometry as geometry
    from shapespace import io as io
    from shapespace import model as model
    from shapespace import recognise as recognise
    from shapespace import statistics as statistics
    from shapespace import store as store
    from shapespace.cohort.cohort import Cohort
    from shapespace.cohort.read import CohortConfig, read_cohort, write_cohort_file
    from shapespace.correspondence.groupwise import correspond
    from shapespace.correspondence.settings import CorrespondConfig
    from shapespace.datasets.faces import load_faces
    from shapespace.datasets.simulated_scan import simulate_scan
    from shapespace.errors import ShapespaceError
    from shapespace.fit.completion.complete import CompletionConfig, complete
    from shapespace.fit.fit_scan import FitConfig, fit_scan
    from shapespace.fit.result import FitResult
    from shapespace.geometry.closest import surface_distances
    from shapespace.io.interop import as_mesh
    from shapespace.io.meshes.mesh_io import read_mesh, write_mesh
    from shapespace.model.build_model import BuildConfig, build_model
    from shapespace.model.shape_model import ShapeModel
    from shapespace.recognise.predict import ShapeSpace, train_classifier
    from shapespace.types import Mesh

__all__ = [
    "BuildConfig",
    "Cohort",
    "CohortConfig",
    "CompletionConfig",
    "CorrespondConfig",
    "FitConfig",
    "FitResult",
    "Mesh",
    "ShapeModel",
    "ShapeSpace",
    "ShapespaceError",
    "__version__",
    "as_mesh",
    "build_model",
    "complete",
    "correspond",
    "fit_scan",
    "load_faces",
    "read_cohort",
    "read_mesh",
    "simulate_scan",
    "surface_distances",
    "train_classifier",
    "write_cohort_file",
    "write_mesh",
]

_PACKAGES = ("correspondence", "datasets", "fit", "geometry", "io", "model", "recognise", "statistics", "store")
"""Packages with public names of their own."""
_name, __dir__ = lazy_names(
    __name__,
    {
        "cohort.cohort": ("Cohort",),
        "cohort.read": ("CohortConfig", "read_cohort", "write_cohort_file"),
        "correspondence.groupwise": ("correspond",),
        "correspondence.settings": ("CorrespondConfig",),
        "datasets.faces": ("load_faces",),
        "datasets.simulated_scan": ("simulate_scan",),
        "errors": ("ShapespaceError",),
        "fit.completion.complete": ("CompletionConfig", "complete"),
        "fit.fit_scan": ("FitConfig", "fit_scan"),
        "fit.result": ("FitResult",),
        "geometry.closest": ("surface_distances",),
        "io.interop": ("as_mesh",),
        "io.meshes.mesh_io": ("read_mesh", "write_mesh"),
        "model.build_model": ("BuildConfig", "build_model"),
        "model.shape_model": ("ShapeModel",),
        "recognise.predict": ("ShapeSpace", "train_classifier"),
        "types": ("Mesh",),
    },
)


def __getattr__(name: str) -> object:
    if name in _PACKAGES:
        return import_module(f"shapespace.{name}")
    return _name(name)
