"""Report of completions: the surfaces, their uncertainty as colour, samples as morphs, and intervals of quantities."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from shapespace.fit.completion.complete import ESTIMATED, OBSERVED, UNKNOWABLE, Completion, CompletionConfig
from shapespace.geometry.closest import build_engine
from shapespace.report.analyses.analysis_report import AnalysisReport, Column, ResultTable
from shapespace.report.render.scene import decimate
from shapespace.reprs import first_names
from shapespace.schemas import MorphPart, Part, SurfaceMapPart, TextPart
from shapespace.types import FloatArray, Mesh

_MOST_SURFACES = 12  # scans whose surfaces are drawn; the files have all
_MOST_SENTENCES, _MOST_ROWS = 12, 60
_MOST_TRIANGLES = 20_000  # of a scan in the report
_MORPH_STDDEV = 2.0  # ends of the morph, in standard deviations
_FILE = "completion.npz"
_CITATIONS = (
    "Albrecht T., Luthi M., Gerig T., Vetter T. (2013) Posterior shape models. Medical Image Analysis 17, 959-973.",
    "Barber R.F., Candes E.J., Ramdas A., Tibshirani R.J. (2021) Predictive inference with the jackknife+. Annals of "
    "Statistics 49, 486-507.",
    "Rubin D.B. (1987) Multiple imputation for nonresponse in surveys. Wiley, New York.",
)


@dataclass(eq=False)
class CompletionReport:
    """Collects the content of the report on each completion, so that completions need not stay in memory.

    Args:
        config: settings of the completions.
    """

    config: CompletionConfig
    _rows: list[tuple[Any, ...]] = field(default_factory=list[tuple[Any, ...]], init=False)
    _estimates: list[tuple[Any, ...]] = field(default_factory=list[tuple[Any, ...]], init=False)
    _landmarks: list[tuple[Any, ...]] = field(default_factory=list[tuple[Any, ...]], init=False)
    _summary: list[str] = field(default_factory=list[str], init=False)
    _notes: dict[str, list[str]] = field(default_factory=dict[str, list[str]], init=False)
    _parts: list[Part] = field(default_factory=list[Part], init=False)
    _arrays: dict[str, npt.NDArray[Any]] = field(default_factory=dict[str, npt.NDArray[Any]], init=False)
    _hashes: set[str] = field(default_factory=set[str], init=False)
    _calibrated_on: int = field(default=0, init=False)

    def add(self, name: str, completion: Completion) -> None:
        """Add a completion with the name of its files."""
        shares = [float((completion.knowledge == code).mean()) for code in (OBSERVED, ESTIMATED, UNKNOWABLE)]
        missing = ~completion.observed
        rms_mm = float(np.sqrt((completion.stddev_mm[missing] ** 2).mean())) if missing.any() else 0.0
        estimates = completion.estimates()
        noise_mm = completion.posterior.noise_mm * completion.fit.mm_per_scan_unit * completion.T_scan_model.scale
        self._rows.append((name, completion.status, *shares, rms_mm, noise_mm))
        self._estimates += [
            (name, e.name, e.unit, e.value, e.mean, e.stddev, e.low, e.high, e.calibrated_on) for e in estimates
        ]
        self._calibrated_on = estimates[0].calibrated_on
        mm = completion.fit.mm_per_scan_unit
        places = completion.surface().landmarks
        self._landmarks += [
            (name, landmark, *(places[landmark] * mm), *stddev)
            for landmark, stddev in completion.landmark_stddev_mm().items()
        ]
        self._hashes.add(completion.fit.model_hash)
        for note in completion.notes:
            self._notes.setdefault(note, []).append(name)
        first = estimates[0]
        self._summary.append(
            f"{name}: {completion.status}; the scan shows {100 * shares[0]:.0f} % of the vertices, the others have a "
            f"standard deviation of {rms_mm:.2f} mm; {first.name} {_number(first.value)} {first.unit} (95 % interval "
            f"{_number(first.low)} to {_number(first.high)}, {_source(first.calibrated_on)})."
        )
        if completion.status == "doubtful":
            self._notes.setdefault(completion.reason, []).append(name)
        if len(self._rows) <= _MOST_SURFACES:
            self._draw(name, completion)

    @property
    def count(self) -> int:
        """Number of completions."""
        return len(self._rows)

    def report(self, failed: int) -> AnalysisReport:
        """Return the report; `failed` scans have no completion."""
        settings = {"samples": self.config.samples, "seed": self.config.seed, "mirror": self.config.mirror,
                    "part": self.config.part, "with_doubtful": self.config.with_doubtful}  # fmt: skip
        count = len(self._rows)
        scans = ResultTable(
            title="Scans",
            columns=(
                Column("scan", field="scan"), Column("status", field="status"),
                *(Column(name, "percent", f"{name}_share") for name in ("observed", "estimated", "unknowable")),
                Column("SD of missing vertices, mm", "number", "missing_stddev_mm"),
                Column("noise, mm", "number", "noise_mm"),
            ),
            rows=self._rows,
            shown=range(_MOST_ROWS),
            note="Observed: the scan shows the vertex. Estimated: it is predicted better than by the mean shape. "
            "Unknowable: it is not.",
            file="completions.csv",
        )  # fmt: skip
        quantities = ResultTable(
            title="Quantities",
            columns=(
                Column("scan", field="scan"), Column("quantity", field="quantity"), Column("unit", field="unit"),
                Column("completed surface", "number", "value"), Column(field="mean"), Column("SD", "number", "stddev"),
                Column("95 % from", "number", "low_95"), Column("to", "number", "high_95"),
                Column(field="calibrated_on"),
            ),
            rows=self._estimates,
            shown=range(_MOST_ROWS),
            note=f"95 % intervals, {_source(self._calibrated_on)}. All quantities are in estimates.csv.",
            file="estimates.csv",
        )  # fmt: skip
        fields = ("scan", "landmark", *(f"{axis}_mm" for axis in "xyz"), *(f"stddev_{axis}_mm" for axis in "xyz"))
        landmarks = [ResultTable.of_fields("landmarks.csv", fields, self._landmarks)] if self._landmarks else []
        method = TextPart(title="Method", level=2, text=self._method())
        return AnalysisReport.of(
            "complete",
            f"Completion of {count} partial scan{'' if count == 1 else 's'}",
            [scans, quantities, *self._parts, method, *landmarks],
            summary=tuple(self._summary[:_MOST_SENTENCES]),
            arrays={_FILE: self._arrays},
            notes=tuple(self._note(note, names, count) for note, names in self._notes.items())
            + ((f"{failed} scan{' has' if failed == 1 else 's have'} no completion.",) if failed else ()),
            settings=settings,
            model_hashes=tuple(sorted(self._hashes)),
            citations=_CITATIONS,
        )

    def methods_text(self) -> str:
        """Return the paragraph for methods.txt."""
        return "\n\n".join([" ".join(self._method()), "References", *_CITATIONS]) + "\n"

    def _method(self) -> tuple[str, ...]:
        mirror = {
            "never": (),
            "combined": (
                "Missing vertices were also moved towards the mirror image of the observed side, weighted by their "
                "variance and by the asymmetry of pairs with two observed sides.",
            ),
            "alone": ("Missing vertices with an observed mirror image were taken from it.",),
        }[self.config.mirror]
        return (
            "Partial scans were completed by the posterior of pose, coefficients and off-model variation of a shape "
            "model given the scan (Albrecht et al. 2013), linearised at its mean.",
            "The prior variances were those of new shapes, and the variance of the off-model variation was estimated "
            "from each scan.",
            f"Standard deviations and intervals are {_source(self._calibrated_on)}"
            + (
                ": each training shape was observed as the scan was and completed by the model of the others."
                if self._calibrated_on
                else ", since the model does not contain its training shapes."
            ),
            "Where the scan shows the surface, the completed surface follows the scan.",
            *mirror,
            "Intervals of quantities are cross-conformal (Barber et al. 2021)."
            if self._calibrated_on
            else "Intervals of quantities are those of the model.",
            f"The {self.config.samples} samples of the complete shape (seed {self.config.seed}) are multiple "
            "imputations (Rubin 1987).",
        )

    def _note(self, note: str, names: list[str], count: int) -> str:
        if len(names) == count and count > 1:
            return f"All scans: {note}"
        return f"{first_names(names, 3)}: {note}"

    def _draw(self, name: str, completion: Completion) -> None:
        """Add the maps and the morph of a completion, in mm of the scan."""
        k, mm, model = len(self._rows), completion.fit.mm_per_scan_unit, completion.model
        vertices = completion.vertices * mm
        turn = completion.T_scan_model.scale * mm * completion.T_scan_model.rotation
        mode: FloatArray = _MORPH_STDDEV * completion.posterior.main_mode() @ turn.T
        arrays = {
            "vertices": vertices, "stddev": completion.stddev_mm, "missing": ~completion.observed,
            "low": vertices - mode, "high": vertices + mode,
        }  # fmt: skip
        scan = decimate(completion.fit.scan, _MOST_TRIANGLES)[0]
        if scan.faces is not None:
            # The completed surface has no values, and is drawn grey below the scan.
            distance_mm = build_engine(Mesh(completion.vertices, model.faces)).query(scan.vertices).distance * mm
            arrays |= {
                "both": np.concatenate([vertices, scan.vertices * mm]),
                "both_faces": np.concatenate([np.asarray(model.faces), scan.faces + len(vertices)]),
                "distance": np.concatenate([np.full(len(vertices), np.nan), distance_mm]),
            }
        self._arrays.setdefault("faces", np.asarray(model.faces))
        self._arrays.update({f"{key}_{k}": value.astype(np.float32) if value.dtype == np.float64 else value
                             for key, value in arrays.items()})  # fmt: skip
        self._parts += [
            TextPart(title=name, level=2, text=(completion.reason,)),
            *(
                [] if scan.faces is None else [SurfaceMapPart(
                    title="Scan on the completed surface", arrays=_FILE, vertices=f"both_{k}", faces=f"both_faces_{k}",
                    values=f"distance_{k}", unit="mm", signed=False,
                    note="Distance of the scan from the completed surface; the completed part is grey.",
                )]
            ),
            SurfaceMapPart(
                title="Standard deviation of the vertices", arrays=_FILE, vertices=f"vertices_{k}",
                values=f"stddev_{k}", mask=f"missing_{k}", unit="mm", signed=False,
                note="The observed part is pale.",
            ),
            MorphPart(
                title="Main uncertainty", arrays=_FILE, low=f"low_{k}", high=f"high_{k}",
                low_label=f"-{_MORPH_STDDEV:g} SD", high_label=f"+{_MORPH_STDDEV:g} SD",
                note="The first principal component of the samples.",
            ),
        ]  # fmt: skip


def _source(calibrated_on: int) -> str:
    """Return how intervals are calibrated."""
    return f"from {calibrated_on} training shapes held out in turn" if calibrated_on else "not calibrated"


def _number(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}"
