"""Turn any raw 3-D surface into a short vector that means something."""

from importlib import import_module
from typing import TYPE_CHECKING

from shapespace.version import __version__

if TYPE_CHECKING:
    from shapespace.correspondence.rounds import CorrespondSettings, correspond
    from shapespace.datasets.faces import load_faces
    from shapespace.datasets.simulated_scan import simulate_scan
    from shapespace.errors import ShapespaceError
    from shapespace.fit.fit import FitConfig, fit_scan
    from shapespace.fit.paper_method import Paper
    from shapespace.fit.result import FitResult
    from shapespace.fit.robust_method import Robust
    from shapespace.geometry.distance import surface_distances
    from shapespace.geometry.volume_surface import VolumeSurface, surface_of_volume
    from shapespace.io.beside import as_mesh
    from shapespace.io.landmarks import read_landmarks
    from shapespace.io.meshes import read_mesh, write_mesh
    from shapespace.io.volumes import read_volume
    from shapespace.model.additive import AdditiveModel
    from shapespace.model.quality import ModelQuality, QualitySettings, measure_quality
    from shapespace.model.shape_model import ShapeModel
    from shapespace.recognise.classifiers import CLASSIFIERS
    from shapespace.recognise.predict import train_classifier
    from shapespace.recognise.shape_space import ShapeSpace
    from shapespace.statistics.compare import CompareOptions, Comparison, compare
    from shapespace.store.results import Results
    from shapespace.types import LabelVolume, Mesh, Similarity

__all__ = [
    "CLASSIFIERS",
    "AdditiveModel",
    "CompareOptions",
    "Comparison",
    "CorrespondSettings",
    "FitConfig",
    "FitResult",
    "LabelVolume",
    "Mesh",
    "ModelQuality",
    "Paper",
    "QualitySettings",
    "Results",
    "Robust",
    "ShapeModel",
    "ShapeSpace",
    "ShapespaceError",
    "Similarity",
    "VolumeSurface",
    "__version__",
    "as_mesh",
    "compare",
    "correspond",
    "fit_scan",
    "load_faces",
    "measure_quality",
    "read_landmarks",
    "read_mesh",
    "read_volume",
    "simulate_scan",
    "surface_distances",
    "surface_of_volume",
    "train_classifier",
    "write_mesh",
]

_HOMES = {
    "AdditiveModel": "model.additive",
    "CLASSIFIERS": "recognise.classifiers",
    "CompareOptions": "statistics.compare",
    "Comparison": "statistics.compare",
    "CorrespondSettings": "correspondence.rounds",
    "FitConfig": "fit.fit",
    "FitResult": "fit.result",
    "LabelVolume": "types",
    "Mesh": "types",
    "ModelQuality": "model.quality",
    "Paper": "fit.paper_method",
    "QualitySettings": "model.quality",
    "Results": "store.results",
    "Robust": "fit.robust_method",
    "ShapeModel": "model.shape_model",
    "ShapeSpace": "recognise.shape_space",
    "ShapespaceError": "errors",
    "Similarity": "types",
    "as_mesh": "io.beside",
    "compare": "statistics.compare",
    "correspond": "correspondence.rounds",
    "VolumeSurface": "geometry.volume_surface",
    "fit_scan": "fit.fit",
    "load_faces": "datasets.faces",
    "measure_quality": "model.quality",
    "read_landmarks": "io.landmarks",
    "read_mesh": "io.meshes",
    "read_volume": "io.volumes",
    "simulate_scan": "datasets.simulated_scan",
    "surface_distances": "geometry.distance",
    "surface_of_volume": "geometry.volume_surface",
    "train_classifier": "recognise.predict",
    "write_mesh": "io.meshes",
}


def __getattr__(name: str) -> object:
    # SciPy takes most of a second to import, and `shapespace --help` needs none of it.
    if name not in _HOMES:
        raise AttributeError(f"module 'shapespace' has no attribute {name!r}")
    return getattr(import_module(f"shapespace.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
