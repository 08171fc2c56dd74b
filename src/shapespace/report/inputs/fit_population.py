"""Large sets of fits as columns, with the metadata of their list and unusual fits, read in one stream.

Some forty bytes and the coefficients (float32) of each fit stay in memory, not its record and not its surface.
"""

from __future__ import annotations

import heapq
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Literal

import numpy as np
import numpy.typing as npt

from shapespace.errors import InputError
from shapespace.report.blocks.wording import ORDER_OF_CONCERN
from shapespace.store.results import Results, modes_of
from shapespace.store.rows import META
from shapespace.types import FloatArray

MEASURES: Mapping[str, str] = {
    "expected_error_mm": "expected vertex error (mm)",
    "to_scan_mm": "mean, model to scan (mm)",
    "to_model_mm": "mean, scan to model (mm)",
    "seen_percent": "model that the scan shows (%)",
}
"""Measures of each fit, with their labels."""

MOST_LEVELS, MOST_BINS = 24, 40  # layout: rows of a table and bins of a figure
FEWEST = 20
"""Fits of a level or an interval below which it is not reported."""

_MOST_VALUES = 500  # distinct texts of a column that counts as a category
_FEWEST_NUMBERS = 12  # distinct values of a column that counts as numeric
# limits above which a group differs: standard errors, share of the typical value, and shift in sd of the coefficients
_SIGNS, _LEAST_SHARE, _LEAST_SHIFT = 4.0, 0.1, 0.3
_NUMBERS = re.compile(r"\d+(?:[.,]\d+)*")
_NAMES = re.compile(r"\S*[\\/.]\S*[^\s.,;:]")
_MOST_REASONS = 5000  # limit on memory


@dataclass(frozen=True, eq=False)
class ListedColumn:
    """A metadata column of the list of scans.

    Args:
        name: head of the column.
        kind: `time` and `number` have `values`, `level` has `codes`.
        values: (n,) float64: numbers, or seconds since 1970; NaN if unknown.
        codes: (n,) int32: index in `levels`; -1 if unknown.
        levels: distinct values in order.
    """

    name: str
    kind: Literal["time", "number", "level"]
    values: FloatArray
    codes: npt.NDArray[np.int32]
    levels: tuple[str, ...] = ()

    def groups(self) -> list[tuple[str, npt.NDArray[np.bool_], float]]:
        """Return levels, or intervals of equal length, each with its name, its fits and its centre.

        Of very many levels, those with the most fits.
        """
        if self.kind == "level":
            counts = np.bincount(self.codes[self.codes >= 0], minlength=len(self.levels))
            return [
                (self.levels[k], self.codes == k, float(k))
                for k in sorted(np.argsort(-counts, kind="stable")[:MOST_LEVELS].tolist())
                if counts[k]
            ]
        edges = self.edges()
        bin_index = np.clip(np.searchsorted(edges, self.values, side="right") - 1, 0, len(edges) - 2)
        bin_index[~np.isfinite(self.values)] = -1
        middles = (edges[1:] + edges[:-1]) / 2
        return [
            (f"{self.value_text(edges[k])} to {self.value_text(edges[k + 1])}", bin_index == k, float(middles[k]))
            for k in range(len(middles))
        ]

    def edges(self) -> FloatArray:
        """Return the edges (n + 1,) of intervals of times or numbers; integers if all numbers are integers."""
        known = self.values[np.isfinite(self.values)]
        low, high = float(known.min()), float(known.max())
        max_bins = min(MOST_BINS, max(2, len(known) // FEWEST))
        if self.kind == "number" and bool((known == np.round(known)).all()):
            step = max(1.0, float(np.ceil((high - low + 1) / max_bins)))
            return np.asarray(np.arange(low, high + step + 1, step), dtype=np.float64)
        return np.asarray(np.linspace(low, np.nextafter(high, np.inf), max_bins + 1), dtype=np.float64)

    def value_text(self, value: float) -> str:
        """Format a value as text."""
        if self.kind == "time":
            return datetime.fromtimestamp(value, UTC).strftime("%Y-%m-%d")
        return f"{value:.4g}"


@dataclass(frozen=True)
class UnusualGroup:
    """Difference between the fits of one level, or one interval, and all fits.

    Args:
        name: name of the level or interval.
        count: number of fits in the group.
        untrusted: share of the fits that failed, are doubtful or stopped at the limit.
        error_mm: median expected vertex error of the trusted fits, mm.
        error_off_mm: difference of `error_mm` from the median of all fits, mm.
        mode: number of the coefficient whose mean differs most from that of all fits, 0 for none.
        shift: difference of the mean of that coefficient, in standard deviations of the model.
        stands_out: sentences on differences that are large and more than chance.
    """

    name: str
    count: int
    untrusted: float
    error_mm: float
    error_off_mm: float
    mode: int
    shift: float
    stands_out: tuple[str, ...]


class Population:
    """The fits of a folder by column.

    Args:
        results: results of the folder.

    Raises:
        InputError: none of the fits can be read.
    """

    def __init__(self, results: Results) -> None:
        metas = [column for column in sorted(results.column_names()) if column.startswith(META)]
        n_modes = modes_of(results)
        self.names: list[str] = []
        self.n_reasons: Counter[tuple[str, str]] = Counter()
        self.origins: dict[str, Counter[str]] = {key: Counter() for key in ("method", "version", "model_name")}
        self.models: Counter[str] = Counter()
        statuses, models = bytearray(), list[npt.NDArray[np.int32]]()
        codes_of_models: dict[str, int] = {}
        measures: dict[str, list[FloatArray]] = {key: [] for key in MEASURES}
        z: list[npt.NDArray[np.float32]] = []
        coded_columns: dict[str, tuple[dict[str, int], list[npt.NDArray[np.int32]]]] = {
            column: ({}, []) for column in metas
        }
        for rows in results.iter_rows(
            (
                *("scan", "status", "reason", "model_hash", *self.origins, *_READ, *metas),
                *(f"z{k}" for k in range(1, n_modes + 1)),
            )
        ):
            self.names += rows["scan"]
            statuses += bytes(_code(status) for status in rows["status"])
            self._count_reasons(rows["status"], rows["reason"])
            for key, counts in self.origins.items():
                counts.update(value for value in rows[key] if value)
            self.models.update(value for value in rows["model_hash"] if value)
            models.append(_encode_texts(rows["model_hash"], codes_of_models, 2**31))
            numbers = {key: np.array(rows[key], dtype=np.float64) for key in _READ}
            measures["expected_error_mm"].append(numbers["expected_error_mm"])
            for key, direction in (("to_scan_mm", "model_to_scan"), ("to_model_mm", "scan_to_model")):
                overlap_distance = numbers[f"shown_{direction}_mean_mm"]
                measures[key].append(
                    np.where(np.isfinite(overlap_distance), overlap_distance, numbers[f"{direction}_mean_mm"])
                )
            measures["seen_percent"].append(100 * numbers["model_seen_share"])
            z.append(np.array([rows[f"z{k}"] for k in range(1, n_modes + 1)], dtype=np.float32).T.reshape(-1, n_modes))
            for column, (codes, chunks) in coded_columns.items():
                chunks.append(_encode_texts(rows[column], codes, _MOST_VALUES * 400))
        if not self.names:
            raise InputError(f"{results.folder}: none of its fits can be read; {'; '.join(results.problems[:1])}")
        self.status = np.frombuffer(bytes(statuses), dtype=np.uint8)
        self.measures = {key: np.concatenate(parts) for key, parts in measures.items()}
        # Coefficients of other models are not comparable.
        commonest_model = codes_of_models.get(self.models.most_common(1)[0][0], 0) if self.models else 0
        self.z = np.concatenate(z)
        self.z[np.concatenate(models) != commonest_model] = np.nan
        self.left_out: list[str] = []
        self.listed = [
            column
            for name, (codes, parts) in coded_columns.items()
            if (column := self._column(name.removeprefix(META), list(codes), np.concatenate(parts))) is not None
        ]

    def __len__(self) -> int:
        return len(self.names)

    @property
    def counts(self) -> Counter[str]:
        """Number of fits per status."""
        return Counter(
            {
                status: int(count)
                for status, count in zip(
                    ORDER_OF_CONCERN, np.bincount(self.status, minlength=len(ORDER_OF_CONCERN)), strict=True
                )
                if count
            }
        )

    @property
    def trusted(self) -> npt.NDArray[np.bool_]:
        """(n,) mask of fits that converged without problems."""
        return self.status == _code("converged")

    def median(self, measure: str) -> float:
        """Return the median of a measure over the trusted fits; NaN without values."""
        values = self.measures[measure][self.trusted]
        values = values[np.isfinite(values)]
        return float(np.median(values)) if len(values) else np.nan

    def far(self) -> FloatArray:
        """Return the root mean square (n,) of each fit's coefficients in standard deviations; NaN without any."""
        out = np.full(len(self), np.nan)
        has_coefficients = np.isfinite(self.z).any(axis=1) if self.z.shape[1] else np.zeros(len(self), dtype=bool)
        out[has_coefficients] = np.sqrt(np.nanmean(np.square(self.z[has_coefficients], dtype=np.float64), axis=1))
        return out

    def worst(self, status: str, max_count: int) -> list[str]:
        """Return names of fits of a status, sorted by expected error, largest first."""
        rows = np.flatnonzero(self.status == _code(status))
        error = self.measures["expected_error_mm"][rows]
        error = np.where(np.isfinite(error), error, self.measures["to_model_mm"][rows])
        return [
            self.names[k]
            for k in rows[np.argsort(np.where(np.isfinite(error), -error, 0.0), kind="stable")[:max_count]]
        ]

    def compared(self, column: ListedColumn) -> Iterator[UnusualGroup]:
        """Yield the difference between the fits of each level, or interval, of a column and all fits."""
        trusted, errors = self.trusted, self.measures["expected_error_mm"]
        known = errors[trusted & np.isfinite(errors)]
        middle = float(np.median(known)) if len(known) else np.nan
        all_mean = _mean(self.z[trusted])
        all_share = 1 - float(trusted.mean())
        for name, inside, _ in column.groups():
            count = int(inside.sum())
            if not count:
                continue
            group_errors = errors[inside & trusted]
            group_errors = group_errors[np.isfinite(group_errors)]
            error = float(np.median(group_errors)) if len(group_errors) else np.nan
            untrusted = 1 - float(trusted[inside].mean())
            out: list[str] = []
            if len(group_errors) >= FEWEST:
                spread = 1.2533 * float(group_errors.std()) / np.sqrt(len(group_errors))
                if abs(error - middle) > max(_SIGNS * spread, _LEAST_SHARE * middle):
                    way = "larger" if error > middle else "smaller"
                    out.append(f"the expected error is {way}: {error:.2f} mm at the median against {middle:.2f} of all")
            share_spread = np.sqrt(max(all_share * (1 - all_share), 1e-12) / count)
            if count >= FEWEST and abs(untrusted - all_share) > max(_SIGNS * share_spread, _LEAST_SHARE * all_share):
                way = "more" if untrusted > all_share else "fewer"
                out.append(f"{way} fits are not trusted: {100 * untrusted:.1f} % against {100 * all_share:.1f} of all")
            shifts = _mean(self.z[inside & trusted]) - all_mean if all_mean.size else all_mean
            mode, shift = 0, 0.0
            if len(group_errors) >= FEWEST and np.isfinite(shifts).any():
                mode = int(np.nanargmax(np.abs(shifts))) + 1
                shift = float(shifts[mode - 1])
                if abs(shift) > max(_SIGNS / np.sqrt(len(group_errors)), _LEAST_SHIFT):
                    out.append(f"z{mode} is {'higher' if shift > 0 else 'lower'} by {abs(shift):.2f} on average")
            yield UnusualGroup(
                name=name,
                count=count,
                untrusted=untrusted,
                error_mm=error,
                error_off_mm=error - middle,
                mode=mode,
                shift=shift,
                stands_out=tuple(out),
            )

    def _count_reasons(self, statuses: Sequence[str], reasons: Sequence[str | None]) -> None:
        for status, reason in zip(statuses, reasons, strict=True):
            if status == "converged":
                continue
            # Reasons differ by names and numbers, which must not split the count of a reason.
            plain = _NUMBERS.sub("…", _NAMES.sub("…", reason or "no reason given"))[:200]
            if (status, plain) not in self.n_reasons and len(self.n_reasons) >= _MOST_REASONS:
                plain = "another reason"
            self.n_reasons[status, plain] += 1

    def _column(self, name: str, texts: Sequence[str], codes: npt.NDArray[np.int32]) -> ListedColumn | None:
        """Return a column as times, numbers or levels; None if all values differ, as for identifiers."""
        if not (codes >= 0).any():
            return None
        for kind, parse in (("number", _number), ("time", _seconds)):
            values = np.array([parse(text) for text in texts])
            if np.isfinite(values).mean() > 0.95 and len(np.unique(values)) > _FEWEST_NUMBERS:
                return ListedColumn(
                    name, "number" if kind == "number" else "time", np.where(codes >= 0, values[codes], np.nan), codes
                )
        if not 1 < len(texts) <= min(_MOST_VALUES, len(codes) // 2):
            if len(texts) > 1:
                self.left_out.append(name)
            return None
        order = sorted(range(len(texts)), key=lambda k: texts[k])
        return ListedColumn(
            name,
            "level",
            np.zeros(0),
            np.where(codes >= 0, np.argsort(np.array(order))[codes], -1).astype(np.int32),
            tuple(texts[k] for k in order),
        )


def most_concerning(results: Results, max_count: int) -> list[str]:
    """Return the names of fits to review first: by status, then by the expected or measured error."""
    ranked: list[tuple[int, float, str]] = []
    columns = ("scan", "status", "expected_error_mm", "scan_to_model_mean_mm")
    for rows in results.iter_rows(columns):
        for name, status, expected, seen_share in zip(*(rows[column] for column in columns), strict=True):
            ranked.append((_code(status), -(seen_share or 0.0) if expected is None else -expected, name))
        ranked = heapq.nsmallest(max_count, ranked)
    return [name for _, _, name in ranked]


_READ = (
    "expected_error_mm", "model_seen_share", "model_to_scan_mean_mm", "scan_to_model_mean_mm",
    "shown_model_to_scan_mean_mm", "shown_scan_to_model_mean_mm",
)  # fmt: skip


def _code(status: str) -> int:
    return ORDER_OF_CONCERN.index(status) if status in ORDER_OF_CONCERN else ORDER_OF_CONCERN.index("unreadable")


def _encode_texts(texts: Sequence[str | None], codes: dict[str, int], max_levels: int) -> npt.NDArray[np.int32]:
    """Return the index of each text in `codes`, which grows; -1 for missing texts, and for
    texts beyond `max_levels` distinct texts.
    """
    out = np.full(len(texts), -1, dtype=np.int32)
    for k, text in enumerate(texts):
        if text and (text in codes or len(codes) < max_levels):
            out[k] = codes.setdefault(text, len(codes))
    return out


def _mean(z: npt.NDArray[np.float32]) -> FloatArray:
    """Return (K,) means, NaN without values."""
    known = np.isfinite(z)
    count = known.sum(axis=0)
    return np.where(count > 0, np.where(known, z, 0).sum(axis=0, dtype=np.float64) / np.maximum(count, 1), np.nan)


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return np.nan


def _seconds(text: str) -> float:
    try:
        moment = datetime.fromisoformat(text)
        return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()
    except (ValueError, OverflowError):
        return np.nan
