"""Trained classifiers and their file: one .skops archive without executable content, checked before it is loaded.

skops writes the pipeline as a schema in JSON and arrays in .npy. The archive also contains `shapespace.json`: the
format, the model's hash, the classes and the training. Nothing in the file is run: types not in `TRUSTED` are rejected.
"""

from __future__ import annotations

import io
import json
import math
import warnings
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, cast

import numpy as np

from shapespace.errors import FileFormatError, InputError
from shapespace.io.containers.archives import npy_array, zip_members
from shapespace.io.containers.json_files import check_file, plain_json
from shapespace.io.files import read_bytes, write_bytes
from shapespace.recognise.classifiers import CLASSIFIERS
from shapespace.recognise.learn import SVC, Pipeline, skops_io
from shapespace.recognise.predictions import calibrated
from shapespace.reprs import short_repr
from shapespace.types import FloatArray
from shapespace.version import __version__

FORMAT = "shapespace classifier"
FORMAT_VERSION = 1  # increase when files of an older version cannot be read any more
FACTS = "shapespace.json"
_SCHEMA = "schema.json"
_PROJECTION = "projection.npy"

TRUSTED = frozenset(
    {
        "shapespace.recognise.classifiers.CalibratedSVC",
        "shapespace.recognise.classifiers.NearestMeanDirection",
        "shapespace.recognise.classifiers.ShrinkageLDA",
        "shapespace.recognise.classifiers.ShrinkageQDA",
        "sklearn.linear_model._logistic.LogisticRegression",
        "sklearn.neighbors._classification.KNeighborsClassifier",
        "sklearn.pipeline.Pipeline",
        "sklearn.preprocessing._data.StandardScaler",
        "sklearn.svm._classes.SVC",
        "builtins.dict",
        "builtins.list",
        "builtins.tuple",
        "builtins.str",
        "numpy.ndarray",
        "numpy.float64",
        "numpy.int64",  # up to scikit-learn 1.7
    }
)
"""Types that the file of a classifier may contain."""
_LOADERS = frozenset({"DictNode", "JsonNode", "ListNode", "NdArrayNode", "ObjectNode", "TupleNode", "TypeNode"})

# C classes, K modes, P pairs of classes, O = C - 1; any other letter is one size in all arrays of a classifier.
_SHAPES: Mapping[str, Mapping[str, str]] = {
    "mean-direction": {"directions_": "CK"},
    "knn": {"_fit_X": "NK", "_y": "N"},
    "lda": {"coef_": "CK", "intercept_": "C"},
    "qda": {"means_": "CK", "whiten_": "CKK", "offsets_": "C"},
    "logistic": {"coef_": "RK", "intercept_": "R"},
    "svm": {
        "classes_": "C", "support_": "S", "support_vectors_": "SK", "_n_support": "C", "_dual_coef_": "OS",
        "_intercept_": "P",
    },
}  # fmt: skip
_SETTINGS: Mapping[str, Mapping[str, Any]] = {
    "knn": {
        "weights": "distance", "metric": "minkowski", "effective_metric_": "euclidean", "n_jobs": None,
        "_fit_method": "brute",
    },
    "svm": {"kernel": "rbf", "_sparse": False},
}  # fmt: skip
"""Settings that must have these values, because scikit-learn's compiled code does not check them."""
_OURS = sorted(name for name in TRUSTED if name.startswith("shapespace."))
_LARGEST_BYTES = 2**28  # 256 MiB
_LARGEST_JSON = 2**24  # 16 MiB
_AGAIN = "train it again with shapespace recognise train"
_PROBE_TOLERANCE = 1e-6  # probabilities recomputed by another version of the libraries


@dataclass(frozen=True, eq=False)
class SavedClassifier:
    """A trained classifier with its class names, calibration, model hash and training summary.

    Args:
        pipeline: fitted pipeline of scikit-learn.
        classifier: name of the classifier in `CLASSIFIERS`.
        model_hash: content hash of the model whose coefficients it takes.
        modes: number of leading coefficients that it uses.
        relative_to_neutral: whether its input is coefficients relative to the subject's neutral face.
        neutral: the label of neutral faces.
        classes: names of the C classes, in the order of the probabilities.
        confidence: probability below which the answer is "unsure".
        temperature: temperature that calibrates the pipeline's probabilities.
        training: counts of the training scans and of the excluded scans.
        cross_validation: accuracy on held-out people, or the reason why it is not known.
        versions: versions of the software that trained it.
        projection: (Ke, K) matrix from the model's coefficients to those of expression, the only ones that it then
            uses; None for the model's own coefficients.

    Example:
        >>> saved, notes = ss.train_classifier(scans, classifier="knn")
        >>> saved.modes
        4
    """

    pipeline: Pipeline
    classifier: str
    model_hash: str
    modes: int
    relative_to_neutral: bool
    neutral: str
    classes: tuple[str, ...]
    confidence: float
    temperature: float
    training: Mapping[str, Any]
    cross_validation: Mapping[str, Any]
    versions: Mapping[str, str]
    projection: FloatArray | None = None

    __repr__ = short_repr

    @property
    def width(self) -> int:
        """Number of the model's coefficients that its input needs."""
        return self.modes if self.projection is None else self.projection.shape[1]

    def probabilities(self, z: FloatArray) -> FloatArray:
        """Return calibrated probabilities (n, C) for finite coefficients `z` (n, K or more), in standard deviations.

        They must be relative to neutral if `relative_to_neutral` is true.

        Raises:
            InputError: fewer coefficients than the classifier uses, or values that are not finite.
        """
        is_valid_shape = z.ndim == 2 and (
            z.shape[1] >= self.width if self.projection is None else z.shape[1] == self.width
        )
        if not is_valid_shape or not np.isfinite(z).all():
            least = "at least " if self.projection is None else ""
            raise InputError(
                f"This classifier takes (n, K) finite coefficients with K {least}{self.width}, not {z.shape}."
            )
        z = z if self.projection is None else z @ self.projection.T
        pipeline: Any = self.pipeline
        return calibrated(np.asarray(pipeline.predict_proba(z[:, : self.modes])), self.temperature)

    def refuse_other_model(self, model_hash: str) -> None:
        """Check that `model_hash` is the hash of the model that the classifier was trained with.

        Raises:
            InputError: the hash is that of another model.
        """
        if model_hash != self.model_hash:
            raise InputError(
                f"This classifier was trained on coefficients of the model {self.model_hash[:12]}, and these are of "
                f"{model_hash[:12]}, where they mean something else; fit the scans with the classifier's model, or "
                "train another classifier."
            )

    def facts(self) -> dict[str, Any]:
        """Return the JSON part of the file."""
        return {
            "format": FORMAT,
            "format_version": FORMAT_VERSION,
            "classifier": self.classifier,
            "model_hash": self.model_hash,
            "modes": self.modes,
            "coefficients": "all" if self.projection is None else "expression",
            "relative_to_neutral": self.relative_to_neutral,
            "neutral": self.neutral,
            "classes": list(self.classes),
            "confidence": self.confidence,
            "temperature": self.temperature,
            "training": dict(self.training),
            "cross_validation": dict(self.cross_validation),
            "versions": dict(self.versions),
        }

    def save(self, path: Path | str) -> None:
        """Write the classifier to one file, atomically.

        Raises:
            InputError: the name does not end in .skops.
            FileError: the folder cannot be written, or the disk is full.
        """
        path = Path(path)
        if path.suffix.lower() != ".skops":
            raise InputError(f"{path}: give the classifier's file a name that ends in .skops.")
        buffer = io.BytesIO(skops_io.dumps(self.pipeline))
        # Probabilities of fixed input show whether another version, or a damaged file, gives other answers.
        facts = {**self.facts(), "probe": self.probabilities(_probe(self.width)).tolist()}
        with zipfile.ZipFile(buffer, "a") as archive:
            if self.projection is not None:
                array = io.BytesIO()
                np.save(array, self.projection, allow_pickle=False)
                archive.writestr(_PROJECTION, array.getvalue())
            archive.writestr(FACTS, json.dumps(facts, indent=1, allow_nan=False) + "\n")
        write_bytes(path, buffer.getvalue())


def software_versions() -> dict[str, str]:
    """Return the versions of the packages that train a classifier."""
    return {"shapespace": __version__, **{name: version(name) for name in ("scikit-learn", "skops", "numpy")}}


def load_classifier(path: Path | str) -> SavedClassifier:
    """Read a classifier that `SavedClassifier.save` wrote, without running any content of the file.

    Raises:
        FileError: the file cannot be read.
        FileFormatError: the file is damaged, of another version, not a classifier, or contains types that are not
            trusted.
    """
    path = Path(path)
    check_file(path, _LARGEST_BYTES, _AGAIN)
    content = read_bytes(path)
    members = _members(path, content)
    facts = _read_facts(path, members)
    _check_types(path, _read_json(path, members, _SCHEMA))
    try:
        with warnings.catch_warnings():
            # The probe detects another version of scikit-learn by its probabilities.
            warnings.simplefilter("ignore")
            pipeline: Any = skops_io.loads(content, trusted=_OURS)
    except Exception as error:  # a damaged schema may raise any exception
        raise FileFormatError(f"{path} contains a classifier that cannot be read; {_AGAIN}.") from error
    saved = _parse_classifier(path, pipeline, facts, members.get(_PROJECTION))
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            _check_arrays(saved)
            probabilities = saved.probabilities(_probe(saved.width))
            expected = np.asarray(facts["probe"], dtype=np.float64)
            same = probabilities.shape == expected.shape and bool(
                np.abs(probabilities - expected).max() <= _PROBE_TOLERANCE
            )
            same = same and tuple(str(name) for name in pipeline.classes_) == saved.classes
    except Exception as error:  # its arrays may have any content
        raise FileFormatError(f"{path} contains a classifier that does not work; {_AGAIN}.") from error
    if not same:
        saved_version, installed_version = saved.versions.get("scikit-learn", "unknown"), version("scikit-learn")
        cause = (
            f"(scikit-learn {saved_version} then, {installed_version} now)"
            if saved_version != installed_version
            else "(the file is damaged)"
        )
        raise FileFormatError(f"{path} gives other answers than when it was trained {cause}; {_AGAIN}.")
    return saved


def _probe(modes: int) -> FloatArray:
    """Return fixed coefficients (4, modes) for a test of a loaded classifier."""
    return 2.0 * np.sin(np.arange(1.0, 4 * modes + 1).reshape(4, modes) ** 2)


def _members(path: Path, content: bytes) -> dict[str, bytes]:
    try:
        members = zip_members(io.BytesIO(content), len(content))
    except (OSError, ValueError) as error:
        raise FileFormatError(
            f"{path} is not a classifier of shapespace, or it is cut short ({error}); {_AGAIN}."
        ) from error
    for name, data in members.items():
        if name not in (FACTS, _SCHEMA):
            try:
                npy_array(data)
            except ValueError as error:
                raise FileFormatError(f"{path}: {name[:60]!r} in it {error}; {_AGAIN}.") from error
    return members


def _read_json(path: Path, members: Mapping[str, bytes], name: str) -> Any:
    if name not in members or len(members[name]) > _LARGEST_JSON:
        raise FileFormatError(f"{path} is not a classifier of shapespace: it has no usable {name}; {_AGAIN}.")
    try:
        return plain_json(members[name])
    except ValueError as error:
        raise FileFormatError(f"{path}: {name} in it is damaged; {_AGAIN}.") from error


def _check_types(path: Path, schema: Any) -> None:
    """Check that all types that a schema names, at any depth, are trusted."""
    open_nodes: list[Any] = [schema]
    while open_nodes:
        node = open_nodes.pop()
        if isinstance(node, list):
            open_nodes += cast(list[Any], node)
        elif isinstance(node, dict):
            known = cast(dict[str, Any], node)
            if "__class__" in known or "__module__" in known:
                name = f"{known.get('__module__')}.{known.get('__class__')}"
                if name not in TRUSTED:
                    raise FileFormatError(
                        f"{path} contains the type {name[:80]!r}, which a classifier of shapespace does not need; do "
                        f"not trust this file, and {_AGAIN}."
                    )
            if str(known.get("__loader__", "DictNode")) not in _LOADERS:
                raise FileFormatError(
                    f"{path} contains a {str(known['__loader__'])[:40]!r}, which a classifier of shapespace does not "
                    f"need; do not trust this file, and {_AGAIN}."
                )
            open_nodes += known.values()


def _read_facts(path: Path, members: Mapping[str, bytes]) -> dict[str, Any]:
    facts: Any = _read_json(path, members, FACTS)
    if not isinstance(facts, dict) or cast(dict[str, Any], facts).get("format") != FORMAT:
        raise FileFormatError(f"{path} is not a classifier of shapespace; {_AGAIN}.")
    known = cast(dict[str, Any], facts)
    format_version: Any = known.get("format_version")
    if format_version != FORMAT_VERSION:
        raise FileFormatError(
            f"{path} is of format version {str(format_version)[:40]}, and this shapespace reads "
            f"{FORMAT_VERSION}; {_AGAIN}."
        )
    return known


def _parse_classifier(path: Path, pipeline: Any, facts: Mapping[str, Any], projection: bytes | None) -> SavedClassifier:
    try:
        if not isinstance(pipeline, Pipeline) or (facts["coefficients"] == "expression") != (projection is not None):
            raise TypeError
        classes = tuple(_require_text(name) for name in cast(Sequence[Any], facts["classes"]))
        saved = SavedClassifier(
            pipeline=pipeline,
            classifier=_require_text(facts["classifier"]),
            model_hash=_require_text(facts["model_hash"]),
            modes=int(facts["modes"]),
            relative_to_neutral=facts["relative_to_neutral"] is True,
            neutral=_require_text(facts["neutral"]),
            classes=classes,
            confidence=float(facts["confidence"]),
            temperature=float(facts["temperature"]),
            training=dict(facts["training"]),
            cross_validation=dict(facts["cross_validation"]),
            versions={str(name): str(number) for name, number in dict(facts["versions"]).items()},
            projection=None if projection is None else _read_projection(projection),
        )
        is_valid = (
            saved.classifier in CLASSIFIERS
            and 1 <= saved.modes <= 100_000
            and (saved.projection is None or saved.modes <= len(saved.projection))
            and 0 <= saved.confidence <= 1
            and 0 < saved.temperature < math.inf
            and len(set(classes)) == len(classes) >= 2
            and "probe" in facts
        )
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise FileFormatError(f"{path}: {FACTS} in it is damaged; {_AGAIN}.") from error
    if not is_valid:
        raise FileFormatError(f"{path}: {FACTS} in it is damaged; {_AGAIN}.")
    return saved


def _check_arrays(saved: SavedClassifier) -> None:
    """Raise ValueError if arrays do not fit together: compiled code would read, and broadcasts grow, beyond them."""
    pipeline: Any = saved.pipeline
    expected: Any = CLASSIFIERS[saved.classifier](0)
    if [type(step) for _, step in pipeline.steps] != [type(step) for _, step in expected.steps]:
        raise ValueError
    classes, fitted = len(saved.classes), pipeline.steps[-1][1]
    fitted = getattr(fitted, "machine_", fitted)
    sizes = {"C": classes, "K": saved.modes, "O": classes - 1, "P": classes * (classes - 1) // 2}
    for name, letters in _SHAPES[saved.classifier].items():
        shape = getattr(fitted, name).shape
        if len(shape) != len(letters) or any(sizes.setdefault(a, n) != n for a, n in zip(letters, shape, strict=True)):
            raise ValueError
    if any(getattr(fitted, name) != value for name, value in _SETTINGS.get(saved.classifier, {}).items()):
        raise ValueError
    if isinstance(fitted, SVC):
        counts = np.asarray(getattr(fitted, "_n_support"))  # noqa: B009  # no public name; libsvm iterates by it
        if counts.min() < 0 or counts.sum() != sizes["S"]:
            raise ValueError


def _read_projection(content: bytes) -> FloatArray:
    array = npy_array(content)
    if array.dtype != np.float64 or array.ndim != 2 or not np.isfinite(array).all():
        raise ValueError
    return cast(FloatArray, array)


def _require_text(value: Any) -> str:
    if not isinstance(value, str):
        raise TypeError
    return value
