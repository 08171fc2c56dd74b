"""A trained classifier and its file: one .skops archive that holds data alone, and is checked before it is read.

skops writes the pipeline as a schema in JSON and arrays in .npy. Beside them stands `shapespace.json`: the format, the
model's hash, the classes, how it was trained. Nothing in the file is run: types that are not in `TRUSTED` are refused.
"""

from __future__ import annotations

import io
import json
import math
import warnings
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.lib import format as npy

from shapespace.errors import FileFormatError, InputError
from shapespace.io.files import read_bytes, write_bytes
from shapespace.recognise.classifiers import CLASSIFIERS
from shapespace.recognise.learn import Pipeline, skops_io
from shapespace.recognise.scores import calibrated
from shapespace.types import FloatArray
from shapespace.version import __version__

FORMAT = "shapespace classifier"
FORMAT_VERSION = 1
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
"""The types that a classifier's file may hold."""
_LOADERS = frozenset({"DictNode", "JsonNode", "ListNode", "NdArrayNode", "ObjectNode", "TupleNode", "TypeNode"})

_OURS = sorted(name for name in TRUSTED if name.startswith("shapespace."))
_LARGEST_BYTES = 2**28
_LARGEST_JSON = 2**24
_MOST_MEMBERS = 4096
_AGAIN = "train it again with shapespace recognise train"
_PROBE_TOLERANCE = 1e-6


@dataclass(frozen=True, eq=False)
class SavedClassifier:
    """A trained classifier with all that its use needs.

    Args:
        pipeline: of scikit-learn, fitted.
        classifier: its name in `CLASSIFIERS`.
        model_hash: content hash of the model whose coefficients it takes.
        modes: number of leading coefficients that it sees.
        relative_to_neutral: whether it takes coefficients relative to the subject's neutral face.
        neutral: the label of neutral faces.
        classes: C names, in the order of the probabilities.
        confidence: probability below which the answer is "unsure".
        temperature: that calibrates the pipeline's probabilities.
        training: counts of what it was trained on and of what was left out.
        cross_validation: how it did on people left out, or why that is not known.
        versions: of the software that trained it.
        projection: (Ke, K) from the model's coefficients to those of expression, which it then sees alone; None sees
            the model's own.
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

    @property
    def width(self) -> int:
        """Number of the model's coefficients that it asks for."""
        return self.modes if self.projection is None else self.projection.shape[1]

    def probabilities(self, z: FloatArray) -> FloatArray:
        """Return calibrated probabilities (n, C) for finite coefficients `z` (n, K or more), in standard deviations.

        They must be relative to neutral if `relative_to_neutral` says so.

        Raises:
            InputError: fewer coefficients than the classifier sees, or values that are not finite.
        """
        enough = z.ndim == 2 and (z.shape[1] >= self.width if self.projection is None else z.shape[1] == self.width)
        if not enough or not np.isfinite(z).all():
            least = "at least " if self.projection is None else ""
            raise InputError(
                f"This classifier takes (n, K) finite coefficients with K {least}{self.width}, not {z.shape}."
            )
        z = z if self.projection is None else z @ self.projection.T
        pipeline: Any = self.pipeline
        return calibrated(np.asarray(pipeline.predict_proba(z[:, : self.modes])), self.temperature)

    def refuse_other_model(self, model_hash: str) -> None:
        """Raise unless `model_hash` is that of the model it was trained with.

        Raises:
            InputError: it is another one.
        """
        if model_hash != self.model_hash:
            raise InputError(
                f"This classifier was trained on coefficients of the model {self.model_hash[:12]}, and these are of "
                f"{model_hash[:12]}, where they mean something else; fit the scans with the classifier's model, or "
                "train another one."
            )

    def facts(self) -> dict[str, Any]:
        """Return what the JSON part of the file says."""
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

    def save(self, path: Path) -> None:
        """Write it to one file, whole or not at all.

        Raises:
            InputError: the name does not end in .skops.
            FileError: the folder cannot be written, or the disk is full.
        """
        if path.suffix.lower() != ".skops":
            raise InputError(f"{path}: give the classifier's file a name that ends in .skops.")
        buffer = io.BytesIO(skops_io.dumps(self.pipeline))
        # What the pipeline answers here tells another version, or a damaged file, that it answers something else.
        facts = {**self.facts(), "probe": self.probabilities(_probe(self.width)).tolist()}
        with zipfile.ZipFile(buffer, "a") as archive:
            if self.projection is not None:
                array = io.BytesIO()
                np.save(array, self.projection, allow_pickle=False)
                archive.writestr(_PROJECTION, array.getvalue())
            archive.writestr(FACTS, json.dumps(facts, indent=1, allow_nan=False) + "\n")
        write_bytes(path, buffer.getvalue())


def software_versions() -> dict[str, str]:
    """Return the versions of what trains a classifier."""
    return {"shapespace": __version__, **{name: version(name) for name in ("scikit-learn", "skops", "numpy")}}


def load_classifier(path: Path) -> SavedClassifier:
    """Read a classifier that `SavedClassifier.save` wrote, without running anything that the file holds.

    Raises:
        FileError: it cannot be read.
        FileFormatError: it is damaged, of another version, not a classifier, or holds types that are not trusted.
    """
    path = Path(path)
    content = read_bytes(path)
    if len(content) > _LARGEST_BYTES:
        raise FileFormatError(f"{path} is too large for a classifier ({len(content) / 2**20:.0f} MiB).")
    members = _members(path, content)
    facts = _facts(path, members)
    _check_types(path, _json(path, members, _SCHEMA))
    try:
        with warnings.catch_warnings():
            # Another version of scikit-learn is found out by the probe, which looks at the answers.
            warnings.simplefilter("ignore")
            pipeline: Any = skops_io.loads(content, trusted=_OURS)
    except Exception as error:  # a damaged schema may raise anything at all
        raise FileFormatError(f"{path} holds a classifier that cannot be read; {_AGAIN}.") from error
    saved = _saved(path, pipeline, facts, members.get(_PROJECTION))
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            answer = saved.probabilities(_probe(saved.width))
            told = np.asarray(facts["probe"], dtype=np.float64)
            same = answer.shape == told.shape and bool(np.abs(answer - told).max() <= _PROBE_TOLERANCE)
            same = same and tuple(str(name) for name in pipeline.classes_) == saved.classes
    except Exception as error:  # whatever stands in its arrays
        raise FileFormatError(f"{path} holds a classifier that does not work; {_AGAIN}.") from error
    if not same:
        made, here = saved.versions.get("scikit-learn", "unknown"), version("scikit-learn")
        why = f"(scikit-learn {made} then, {here} now)" if made != here else "(the file is damaged)"
        raise FileFormatError(f"{path} answers otherwise than when it was trained {why}; {_AGAIN}.")
    return saved


def _probe(modes: int) -> FloatArray:
    """Return fixed coefficients (4, modes) on which a classifier is tried."""
    return 2.0 * np.sin(np.arange(1.0, 4 * modes + 1).reshape(4, modes) ** 2)


def _members(path: Path, content: bytes) -> dict[str, bytes]:
    """Return the members of the archive, none of them larger than the file may be, nor than it says."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            infos = archive.infolist()
            names = [info.filename for info in infos]
            if len(names) > _MOST_MEMBERS or len(set(names)) != len(names):
                raise FileFormatError(f"{path} is an archive with too many or repeated members; {_AGAIN}.")
            if sum(info.file_size for info in infos) > _LARGEST_BYTES:
                raise FileFormatError(f"{path} would unpack to more than a classifier needs; {_AGAIN}.")
            members = {name: archive.read(name) for name in names}
    except (zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError, EOFError, OSError, ValueError) as error:
        if isinstance(error, FileFormatError):
            raise
        raise FileFormatError(f"{path} is not a classifier of shapespace, or it is cut short; {_AGAIN}.") from error
    for name, data in members.items():
        if name not in (FACTS, _SCHEMA):
            _check_array(path, name, data)
    return members


def _check_array(path: Path, name: str, data: bytes) -> None:
    """Refuse what is no plain array, or declares more than it holds, before numpy takes memory for it."""
    stream = io.BytesIO(data)
    try:
        readers: Mapping[tuple[int, int], Any] = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
        shape, _, dtype = readers[npy.read_magic(stream)](stream)
        whole = not dtype.hasobject and math.prod(shape) * dtype.itemsize == len(data) - stream.tell()
    except Exception as error:  # numpy's own parser of headers may raise anything at all
        raise FileFormatError(f"{path}: {name[:60]!r} in it is not an array; {_AGAIN}.") from error
    if not whole:
        raise FileFormatError(f"{path}: the array {name[:60]!r} in it is cut short or holds objects; {_AGAIN}.")


def _json(path: Path, members: Mapping[str, bytes], name: str) -> Any:
    if name not in members or len(members[name]) > _LARGEST_JSON:
        raise FileFormatError(f"{path} is not a classifier of shapespace: it has no usable {name}; {_AGAIN}.")
    try:
        return json.loads(members[name])
    except (ValueError, RecursionError) as error:
        raise FileFormatError(f"{path}: {name} in it is damaged; {_AGAIN}.") from error


def _check_types(path: Path, schema: Any) -> None:
    """Refuse a schema that names any type not trusted, wherever it stands."""
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
                        f"{path} holds the type {name[:80]!r}, which a classifier of shapespace does not need; do not "
                        f"trust this file, and {_AGAIN}."
                    )
            if str(known.get("__loader__", "DictNode")) not in _LOADERS:
                raise FileFormatError(
                    f"{path} holds a {str(known['__loader__'])[:40]!r}, which a classifier of shapespace does not "
                    f"need; do not trust this file, and {_AGAIN}."
                )
            open_nodes += known.values()


def _facts(path: Path, members: Mapping[str, bytes]) -> dict[str, Any]:
    facts: Any = _json(path, members, FACTS)
    if not isinstance(facts, dict) or cast(dict[str, Any], facts).get("format") != FORMAT:
        raise FileFormatError(f"{path} is not a classifier of shapespace; {_AGAIN}.")
    known = cast(dict[str, Any], facts)
    if known.get("format_version") != FORMAT_VERSION:
        raise FileFormatError(
            f"{path} is of format version {known.get('format_version')!r}, and this shapespace reads {FORMAT_VERSION}; "
            f"{_AGAIN}."
        )
    return known


def _saved(path: Path, pipeline: Any, facts: Mapping[str, Any], projection: bytes | None) -> SavedClassifier:
    try:
        if not isinstance(pipeline, Pipeline) or (facts["coefficients"] == "expression") != (projection is not None):
            raise TypeError
        classes = tuple(_text(name) for name in cast(Sequence[Any], facts["classes"]))
        saved = SavedClassifier(
            pipeline,
            _text(facts["classifier"]),
            _text(facts["model_hash"]),
            int(facts["modes"]),
            facts["relative_to_neutral"] is True,
            _text(facts["neutral"]),
            classes,
            float(facts["confidence"]),
            float(facts["temperature"]),
            dict(facts["training"]),
            dict(facts["cross_validation"]),
            {str(name): str(number) for name, number in dict(facts["versions"]).items()},
            None if projection is None else _projection(projection),
        )
        good = (
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
    if not good:
        raise FileFormatError(f"{path}: {FACTS} in it is damaged; {_AGAIN}.")
    return saved


def _projection(content: bytes) -> FloatArray:
    array = np.load(io.BytesIO(content), allow_pickle=False)
    if array.dtype != np.float64 or array.ndim != 2 or not np.isfinite(array).all():
        raise ValueError
    return cast(FloatArray, array)


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise TypeError
    return value
