"""Shape space as a scikit-learn transformer: meshes or fits to whitened coefficients."""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any, Literal, TypeAlias, cast

import numpy as np

from shapespace.errors import InputError, ShapespaceError
from shapespace.fit.fit_scan import FitConfig, fit_scan
from shapespace.fit.result import FitResult
from shapespace.geometry.procrustes import Gauge
from shapespace.io.interop import MeshLike, as_mesh, as_meshes
from shapespace.model.pca import Modes
from shapespace.model.shape_model import ShapeModel
from shapespace.recognise.labelled_scans import from_record
from shapespace.recognise.learn import BaseEstimator, TransformerMixin, check_is_fitted
from shapespace.schemas import FIT_AGAIN, FitRecord, read
from shapespace.types import FloatArray, IntArray, Mesh

Surface: TypeAlias = MeshLike | FitResult | FitRecord | Mapping[str, Any]
"""A mesh or what `as_mesh` takes, the result of a fit, or its record, typed or as the content of NAME.fit.json."""
Surfaces: TypeAlias = Sequence[Surface] | FloatArray | str | PathLike[str]
"""Several of them; (n, V, 3) vertices; or the folder of meshes in correspondence."""
_COUNT = re.compile(r"\d+ (of \d+ )?(vertex is|vertices are) (missing|taken)")  # sentences on missing vertices


class ShapeSpace(TransformerMixin, BaseEstimator):
    """Transformer of meshes or fits to coefficients in standard deviations, z, for scikit-learn pipelines.

    `fit` builds a `ShapeModel` from meshes in correspondence, or takes `model` as it is. `transform` takes a mix of:

    - meshes in the model's vertex order, which are projected (`meshes="corresponding"`), or raw scans, which are fitted
      by `fit_scan` (`meshes="scans"`); a mesh alone does not say which it is;
    - `FitResult`s and records of fits (as read from NAME.fit.json), of the same model, whose z is taken.

    A record of a failed fit, or a scan that cannot be fitted, becomes a row of NaN; it is not dropped, and a warning
    says why. A doubtful fit keeps its coefficients here: see `status` of the fit.

    Args:
        modes: as in `BuildConfig`: a number, a share of the variance, "auto" or "all". A warning states notes of the
            model, such as that the meshes determine fewer modes.
        n_components: the same by the name that scikit-learn has for it, None to use `modes`; give one of both.
        gauge: `form` or `shape`.
        align: False takes meshes as they stand, also in `transform`.
        alignment_vertices: indices that carry the alignment of the training meshes.
        model: a model, or its file, to use instead of building one; the settings above, but `align`, then mean nothing.
        meshes: what meshes given to `transform` are: "corresponding" or "scans".
        config: settings of the fits of scans; None for the usual ones.
        seed: of the choice of modes.

    Attributes:
        model_: the `ShapeModel`.
        model_hash_: its content hash.
        n_features_out_: K, the number of modes.
    """

    def __init__(
        self,
        modes: Modes = "all",
        *,
        n_components: Modes = None,
        gauge: Gauge = "shape",
        align: bool = True,
        alignment_vertices: IntArray | None = None,
        model: ShapeModel | str | PathLike[str] | None = None,
        meshes: Literal["corresponding", "scans"] = "corresponding",
        config: FitConfig | None = None,
        seed: int = 0,
    ) -> None:
        self.modes: Modes = modes
        self.n_components: Modes = n_components
        self.gauge: Gauge = gauge
        self.align = align
        self.alignment_vertices = alignment_vertices
        self.model = model
        self.meshes = meshes
        self.config = config
        self.seed = seed

    def __sklearn_clone__(self) -> ShapeSpace:
        # A model is never changed, and its read-only parts cannot be copied deeply.
        return ShapeSpace(**cast(dict[str, Any], self.get_params(deep=False)))

    def fit(self, X: Surfaces, y: Any = None) -> ShapeSpace:
        """Build the shape space of meshes in correspondence, mm, or take the ready `model`, whatever `X` is.

        Raises:
            CorrespondenceError: the meshes differ in vertices or triangles.
            InputError: something else than meshes, too few of them, no variation, unknown settings.
        """
        if self.n_components is not None and self.modes not in (None, "all", self.n_components):
            raise InputError(
                f"modes is {self.modes!r} and n_components {self.n_components!r}, but both are the number of modes; "
                "give one of them."
            )
        if self.meshes not in ("corresponding", "scans"):
            raise InputError(f"There is no kind of meshes {self.meshes!r}; choose corresponding or scans.")
        if isinstance(self.model, str | PathLike):
            self.model_ = ShapeModel.load(Path(self.model))
        else:
            self.model_ = self.model if self.model is not None else self._build(X)
        self.model_hash_ = self.model_.content_hash
        self.n_features_out_ = self.model_.n_modes
        return self

    def _build(self, X: Surfaces) -> ShapeModel:
        surfaces = _items(X)
        if any(isinstance(item, FitResult | FitRecord | Mapping) for item in surfaces):
            raise InputError("A shape space is built from meshes in correspondence; give those, or a ready model.")
        model = ShapeModel.fit(
            surfaces,
            modes=self.modes if self.n_components is None else self.n_components,
            gauge=self.gauge,
            align=self.align,
            alignment_vertices=self.alignment_vertices,
            seed=self.seed,
        )
        # Counts of missing vertices are no warnings: each fold of a cross-validation would repeat them.
        for note in [
            note
            for note in model.notes
            if not re.match(r"\d+ (of \d+ )?(vertex is|vertices are) (missing|taken)", note)
        ]:
            warnings.warn(note, stacklevel=3)
        return model

    def transform(self, X: Surfaces) -> FloatArray:
        """Return coefficients z (n, K) in standard deviations of the model; rows of failed fits are NaN.

        Raises:
            CorrespondenceError: a mesh that is not in the model's vertex order, where meshes are not scans.
            InputError: a fit of another model, or something that is neither mesh nor fit.
            FileFormatError: a record that is damaged.
        """
        check_is_fitted(self)
        rows = [self._coefficients(surface, number) for number, surface in enumerate(_items(X), 1)]
        return np.stack(rows) if rows else np.zeros((0, self.n_features_out_))

    def _coefficients(self, surface: Surface, number: int) -> FloatArray:
        model = self.model_
        if isinstance(surface, FitResult):
            self._refuse_other_model(surface.model_hash, surface.scan_name)
            return self._of_fit(surface)
        name = f"number {number}"
        if not isinstance(surface, FitRecord | Mapping):
            if self.meshes == "scans":
                return self._of_scan(surface, number)
            return model.to_z(model.project(as_mesh(surface, name), align=self.align))
        record = (
            surface
            if isinstance(surface, FitRecord)
            else read(FitRecord, cast(Mapping[str, Any], surface), f"The record of {name}", FIT_AGAIN)
        )
        scan = from_record(name, record)
        self._refuse_other_model(scan.model_hash, scan.file)
        if scan.z is None:
            return np.full(model.n_modes, np.nan)
        if scan.z.shape != (model.n_modes,):
            raise InputError(f"The record of {scan.file} has {len(scan.z)} coefficients, not {model.n_modes}.")
        return scan.z

    def _of_scan(self, scan: MeshLike, number: int) -> FloatArray:
        try:
            return self._of_fit(fit_scan(self.model_, as_mesh(scan, f"number {number}"), self.config or FitConfig()))
        except ShapespaceError as error:
            warnings.warn(f"Number {number} has no coefficients: {error}", stacklevel=4)
            return np.full(self.model_.n_modes, np.nan)

    def _of_fit(self, result: FitResult) -> FloatArray:
        return np.full(self.model_.n_modes, np.nan) if result.status == "failed" else result.z

    def _refuse_other_model(self, model_hash: str, name: str) -> None:
        if model_hash != self.model_hash_:
            raise InputError(
                f"{name} was fitted with the model {model_hash[:12]}, and this shape space is {self.model_hash_[:12]}; "
                "fit the scan with this model."
            )

    def inverse_transform(self, X: Any) -> list[Mesh]:
        """Return the shapes with coefficients `X` (n, k), in standard deviations, as meshes in the model's frame, mm.

        Raises:
            InputError: more coefficients than modes, or values that are not finite.
        """
        check_is_fitted(self)
        z = np.asarray(X, dtype=np.float64)
        if z.ndim != 2 or z.shape[1] > self.n_features_out_:
            raise InputError(f"Coefficients must be (n, k) with k at most {self.n_features_out_}, not {z.shape}.")
        return [self.model_.mesh(self.model_.to_b(row)) for row in z]

    def get_feature_names_out(self, input_features: Any = None) -> Any:
        """Return the names z1 to zK, (K,)."""
        check_is_fitted(self)
        return np.asarray([f"z{k}" for k in range(1, self.n_features_out_ + 1)], dtype=object)


def _items(X: Surfaces) -> Sequence[Any]:
    return as_meshes(X, "ShapeSpace") if isinstance(X, str | PathLike) else cast(Sequence[Any], X)
