"""Statistical shape models from raw 3-D scans: correspondence, model building, robust fitting and shape statistics."""

from importlib import import_module
from typing import TYPE_CHECKING
from warnings import warn

from shapespace.version import __version__

if TYPE_CHECKING:
    from shapespace.cohort.cohort import Cohort
    from shapespace.cohort.read import CohortConfig, read_cohort
    from shapespace.correspondence.groupwise import correspond
    from shapespace.correspondence.settings import CorrespondConfig
    from shapespace.datasets.faces import load_faces
    from shapespace.datasets.simulated_scan import simulate_scan
    from shapespace.errors import ShapespaceError
    from shapespace.fit.fit_scan import FitConfig, fit_scan
    from shapespace.fit.paper.paper_method import Paper
    from shapespace.fit.result import FitResult
    from shapespace.fit.robust.robust_method import Robust
    from shapespace.geometry.distance import surface_distances
    from shapespace.geometry.landmark_placement import place_landmarks
    from shapespace.geometry.volume_surface import VolumeSurface, surface_of_volume
    from shapespace.io.interop import as_mesh
    from shapespace.io.landmarks.landmark_io import read_landmarks
    from shapespace.io.meshes.mesh_io import read_mesh, write_mesh
    from shapespace.io.volumes.volume_io import read_volume
    from shapespace.model.additive import AdditiveModel
    from shapespace.model.model_quality import ModelQuality, QualityConfig, measure_quality
    from shapespace.model.shape_model import ShapeModel
    from shapespace.recognise.classifiers import CLASSIFIERS
    from shapespace.recognise.predict import train_classifier
    from shapespace.recognise.shape_space import ShapeSpace
    from shapespace.statistics.asymmetry import AsymmetryResult, measure_asymmetry
    from shapespace.statistics.change import change
    from shapespace.statistics.change_result import ChangeConfig, ChangeResult
    from shapespace.statistics.compare import CompareConfig, CompareResult, compare
    from shapespace.statistics.identity.identify import identify
    from shapespace.statistics.identity.trial import IdentityConfig
    from shapespace.statistics.identity.verify import verify
    from shapespace.statistics.predictor import Predictor
    from shapespace.statistics.regression import RegressionResult, regress
    from shapespace.statistics.score import ScoreConfig, ScoreResult, score
    from shapespace.store.results import Results
    from shapespace.types import LabelVolume, Mesh, Similarity, SurfaceLandmarks

__all__ = [
    "CLASSIFIERS",
    "AdditiveModel",
    "AsymmetryResult",
    "ChangeConfig",
    "ChangeResult",
    "Cohort",
    "CohortConfig",
    "CompareConfig",
    "CompareResult",
    "CorrespondConfig",
    "FitConfig",
    "FitResult",
    "IdentityConfig",
    "LabelVolume",
    "Mesh",
    "ModelQuality",
    "Paper",
    "Predictor",
    "QualityConfig",
    "RegressionResult",
    "Results",
    "Robust",
    "ScoreConfig",
    "ScoreResult",
    "ShapeModel",
    "ShapeSpace",
    "ShapespaceError",
    "Similarity",
    "SurfaceLandmarks",
    "VolumeSurface",
    "__version__",
    "as_mesh",
    "change",
    "compare",
    "correspond",
    "fit_scan",
    "identify",
    "load_faces",
    "measure_asymmetry",
    "measure_quality",
    "place_landmarks",
    "read_cohort",
    "read_landmarks",
    "read_mesh",
    "read_volume",
    "regress",
    "score",
    "simulate_scan",
    "surface_distances",
    "surface_of_volume",
    "train_classifier",
    "verify",
    "write_mesh",
]

_HOMES = {
    "AsymmetryResult": "statistics.asymmetry",
    "ChangeConfig": "statistics.change_result",
    "ChangeResult": "statistics.change_result",
    "CompareConfig": "statistics.compare",
    "CompareResult": "statistics.compare",
    "IdentityConfig": "statistics.identity.trial",
    "RegressionResult": "statistics.regression",
    "ScoreConfig": "statistics.score",
    "ScoreResult": "statistics.score",
    "AdditiveModel": "model.additive",
    "CLASSIFIERS": "recognise.classifiers",
    "Cohort": "cohort.cohort",
    "CohortConfig": "cohort.read",
    "CorrespondConfig": "correspondence.settings",
    "FitConfig": "fit.fit_scan",
    "FitResult": "fit.result",
    "LabelVolume": "types",
    "Mesh": "types",
    "ModelQuality": "model.model_quality",
    "Paper": "fit.paper.paper_method",
    "Predictor": "statistics.predictor",
    "QualityConfig": "model.model_quality",
    "Results": "store.results",
    "Robust": "fit.robust.robust_method",
    "ShapeModel": "model.shape_model",
    "ShapeSpace": "recognise.shape_space",
    "ShapespaceError": "errors",
    "Similarity": "types",
    "SurfaceLandmarks": "types",
    "as_mesh": "io.interop",
    "change": "statistics.change",
    "compare": "statistics.compare",
    "correspond": "correspondence.groupwise",
    "VolumeSurface": "geometry.volume_surface",
    "fit_scan": "fit.fit_scan",
    "identify": "statistics.identity.identify",
    "load_faces": "datasets.faces",
    "measure_asymmetry": "statistics.asymmetry",
    "measure_quality": "model.model_quality",
    "place_landmarks": "geometry.landmark_placement",
    "read_cohort": "cohort.read",
    "read_landmarks": "io.landmarks.landmark_io",
    "read_mesh": "io.meshes.mesh_io",
    "read_volume": "io.volumes.volume_io",
    "regress": "statistics.regression",
    "score": "statistics.score",
    "simulate_scan": "datasets.simulated_scan",
    "surface_distances": "geometry.distance",
    "surface_of_volume": "geometry.volume_surface",
    "train_classifier": "recognise.predict",
    "verify": "statistics.identity.verify",
    "write_mesh": "io.meshes.mesh_io",
}


_FORMER_NAMES = {
    "ChangeSettings": "ChangeConfig",
    "CohortOptions": "CohortConfig",
    "CompareOptions": "CompareConfig",
    "CorrespondSettings": "CorrespondConfig",
    "IdentityOptions": "IdentityConfig",
    "QualitySettings": "QualityConfig",
    "ScoreOptions": "ScoreConfig",
}
"""Former name -> current name, of classes in published examples."""


def __getattr__(name: str) -> object:
    if name in _FORMER_NAMES:
        warn(f"shapespace.{name} is now called {_FORMER_NAMES[name]}.", DeprecationWarning, stacklevel=2)
        name = _FORMER_NAMES[name]
    # SciPy takes most of a second to import, and `shapespace --help` needs none of it.
    if name not in _HOMES:
        raise AttributeError(f"module 'shapespace' has no attribute {name!r}")
    return getattr(import_module(f"shapespace.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
