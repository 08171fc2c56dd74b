"""Measure who-is-it on simulated people of ICT-FaceKit: raw scans, fitted by models that did not see these people.

The people, their scans and their fits are those of the study of recognition (studies/recognition.py): a folder of it is
used if there is one, or made. Harder scans of the same people are made and fitted here. In each fold the people of that
fold are tested; what is learned is learned from the others. Studies of several seeds are pooled: people meet those of
their own fold alone.

    python benchmarks/identity.py --quick
    python benchmarks/identity.py --study out/s2007 out/s11 --harder harder/s2007 harder/s11 --json identity.json
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from identity_scans import CONDITIONS, fit_harder, people_there, read_harder, study_config

from shapespace.model.additive import AdditiveModel
from shapespace.statistics.identity.identify import Searches, identification_rates, joined, search
from shapespace.statistics.identity.rates import Pairs, RateEstimate, Sweep, people_drawn
from shapespace.statistics.identity.scores import SCORES, Samples
from shapespace.statistics.identity.verify import VerificationRates, cllr, verification_rates
from shapespace.types import FloatArray, IntArray
from simulated import StudyConfig, prepare_folder, run_fits
from study_fits import STATUSES, model_path, person_path, read_fits
from study_people import StudyPeople

AS_EXACT = "plda, errors of fits ignored"
MODES = (1, 2, 3, 5, 10, 20, 40, 80, 160)
STUDY = "10 % missing"


@dataclass(frozen=True, eq=False)
class Fold:
    """One fold of one study, and one condition: samples by its model, and number of person of those tested."""

    training: Samples
    gallery: Samples
    probes: Samples
    group: int


def samples(model: AdditiveModel, z: FloatArray, z_stddev: FloatArray, subjects: Sequence[str]) -> Samples:
    """Return the identity of fits by a model."""
    k = model.shape.n_modes
    turn = model.rotation[: model.n_identity]
    z, variance = z[:, :k], z_stddev[:, :k] ** 2
    return Samples(
        z @ turn.T, variance @ (turn**2).T, z * model.shape.stddev, tuple(subjects), len(model.shape.mean_vertices)
    )


def folds_of(
    study: Path, harder: Path | None, condition: str, number: int, doubtful: bool
) -> tuple[list[Fold], dict[str, int]]:
    """Return the folds of a study under a condition, and how many fits there are of each status."""
    config = study_config(study)
    people, fold_of = range(config.people.people), config.fold_of()
    models = [AdditiveModel.load(model_path(study, fold)) for fold in range(config.folds)]
    fits = read_fits([person_path(study, p) for p in people], max(model.shape.n_modes for model in models))
    good = [STATUSES.index(name) for name in ("converged", "max_iterations", *(["doubtful"] if doubtful else []))]
    taught = np.array([config.taught(int(p))[s] >= 0 for p, s in zip(fits.person, fits.shown, strict=True)])
    hard = read_harder(harder, config, condition) if harder is not None and condition != STUDY else None
    counts = dict.fromkeys(STATUSES, 0)
    out: list[Fold] = []

    def of(rows: IntArray, z: FloatArray, stddev: FloatArray, person: IntArray, model: AdditiveModel) -> Samples:
        return samples(model, z[rows], stddev[rows], [f"{number}:{p}" for p in person[rows]])

    for fold, model in enumerate(models):
        own = fold_of[fits.person] == fold
        usable = np.isin(fits.status[fold], good)
        z, stddev = fits.z[fold], fits.z_stddev[fold]
        gallery = np.flatnonzero(own & usable & (fits.shown == 0))
        probes = np.flatnonzero(own & usable & (fits.shown > 0))
        training = of(np.flatnonzero(~own & usable & taught), z, stddev, fits.person, model)
        statuses = fits.status[fold][own]
        if hard is None:
            pair = (of(gallery, z, stddev, fits.person, model), of(probes, z, stddev, fits.person, model))
        else:
            mine, fine = fold_of[hard.person] == fold, np.isin(hard.status, good)
            rows = [np.flatnonzero(mine & fine & (hard.shown == 0)), np.flatnonzero(mine & fine & (hard.shown > 0))]
            found = [of(row, hard.z, hard.z_stddev, hard.person, model) for row in rows if len(row)]
            statuses = hard.status[mine]
            pair = (found[0] if len(found) == 2 else of(gallery, z, stddev, fits.person, model), found[-1])
        for status in statuses:
            counts[STATUSES[int(status)]] += 1
        out.append(Fold(training, *pair, group=number * 100 + fold))
    return out, counts


def score_matrices(folds: Sequence[Fold], name: str, modes: int | None) -> list[FloatArray]:
    """Return the (G, P) scores of each fold."""
    out: list[FloatArray] = []
    for fold in folds:
        parts = [part.leading(None if modes is None else min(modes, part.x.shape[1]))
                 for part in (fold.training, fold.gallery, fold.probes)]  # fmt: skip
        if name == AS_EXACT:
            parts = [replace(part, variance=np.zeros_like(part.x)) for part in parts]
        scorer = SCORES["plda" if name == AS_EXACT else name](parts[0])
        out.append(scorer(parts[1], parts[2]))
    return out


def measured(folds: Sequence[Fold], names: Sequence[str], modes: Sequence[int], draws: int) -> dict[str, Any]:
    """Return the figures of each score over all folds."""
    people = sorted({who for fold in folds for part in (fold.gallery, fold.probes) for who in part.subjects})
    place = {who: k for k, who in enumerate(people)}
    group = np.zeros(len(people), dtype=np.int32)
    rows: list[tuple[IntArray, IntArray]] = []
    for fold in folds:
        g, p = (np.array([place[who] for who in part.subjects], dtype=np.int32) for part in (fold.gallery, fold.probes))
        group[g], group[p] = fold.group, fold.group
        rows.append((g, p))
    one = np.concatenate([np.repeat(g, len(p)) for g, p in rows])
    other = np.concatenate([np.tile(p, len(g)) for g, p in rows])
    pairs = Pairs(one, other, np.column_stack([one, other]))
    drawn = people_drawn(np.ones(len(people), dtype=np.bool_), draws, 0)
    out: dict[str, Any] = {}
    for name in names:
        matrices = score_matrices(folds, name, None)
        curve: dict[int, float] = {}
        if name != "distance":
            for k in modes:
                flat = np.concatenate([m.ravel() for m in score_matrices(folds, name, k)])
                curve[k] = Sweep(flat, pairs.same).roc().eer
        rates = verification_rates(
            name, np.concatenate([m.ravel() for m in matrices]), pairs, group, drawn, curve=curve
        )
        found: list[Searches] = [search(m, *row) for m, row in zip(matrices, rows, strict=True)]
        ranks = identification_rates(name, joined(found), min(len(np.unique(g)) for g, _ in rows), drawn)
        out[name] = row_of(rates) | {"rank_1": estimate_values(ranks.rank_1)}
        out[name] |= {f"fnir_at_fpir_{rate:g}": estimate_values(ranks.fnir[rate]) for rate in ranks.fnir}
        least = float(rates.score[pairs.same].min() - rates.score[~pairs.same].max()) / float(
            rates.score[~pairs.same].std()
        )
        out[name]["margin"] = least
        if name.startswith("plda"):
            # The score is a difference of log likelihoods, so its cost as it stands can be compared.
            out[name]["cllr_of_the_score"] = cllr(rates.score, pairs.same)
    out["pairs"] = {"people": len(people), "genuine": int(pairs.same.sum()), "impostor": int((~pairs.same).sum())}
    return out


def row_of(rates: VerificationRates) -> dict[str, Any]:
    """Return the figures of a score as JSON has them."""
    return {
        "eer": estimate_values(rates.eer),
        **{f"tar_at_far_{far:g}": estimate_values(one) for far, one in rates.tar.items()},
        "cllr": estimate_values(rates.cllr),
        "cllr_min": rates.cllr_min,
        "eer_by_modes": {str(k): value for k, value in rates.curve.items()},
    }


def estimate_values(one: RateEstimate) -> list[float | None]:
    return [one.value, one.low, one.high]


def table(found: Mapping[str, Any]) -> str:
    """Return the figures as lines of Markdown."""
    lines = [
        "| condition | score | EER, % | TAR at FAR 1e-3, % | Cllr, bits | rank 1, % | FNIR at FPIR 1e-2, % |",
        "|---|---|---|---|---|---|---|",
    ]
    for condition, scores in found.items():
        for name, row in scores["scores"].items():
            if name == "pairs":
                continue
            cells = [percent(row[key]) for key in ("eer", "tar_at_far_0.001")]
            cost = "" if row["cllr"][0] is None else f"{row['cllr'][0]:.4f}"
            cells += [cost, *(percent(row[key]) for key in ("rank_1", "fnir_at_fpir_0.01"))]
            lines.append(f"| {condition} | {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


def percent(values: Sequence[float | None]) -> str:
    value, low, high = values
    if value is None:
        return "too few pairs"
    return f"{100 * value:.2f}" + (
        f" ({100 * low:.2f} to {100 * high:.2f})" if low is not None and high is not None else ""
    )


def quick_study(folder: Path) -> Path:
    """Make a small study and return its folder."""
    people = StudyPeople(people=8, expressions=("smile", "surprise"), levels=(1.0,), triangles=4_000)
    config = StudyConfig(people, folds=2, taught_levels=1, strangers=0)
    prepare_folder(folder, config)
    run_fits(folder, config, workers=1, on_progress=print_progress)
    return folder


def full_study(folder: Path, seed: int, workers: int) -> Path:
    """Make a study of 100 people and return its folder."""
    config = StudyConfig(StudyPeople(seed=seed), strangers=0)
    prepare_folder(folder, config)
    run_fits(folder, config, workers=workers, on_progress=print_progress)
    return folder


def print_progress(name: str, done: int, total: int) -> None:
    print(f"{name}: {done} of {total}", file=sys.stderr, flush=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--study", type=Path, nargs="+", help="folders of the study that there are")
    parser.add_argument(
        "--harder", type=Path, nargs="+", help="folders of harder fits, one for each study; used as they are"
    )
    parser.add_argument("--conditions", nargs="*", default=list(CONDITIONS), help="that are harder")
    parser.add_argument("--work", type=Path, default=Path("identity-work"), help="where studies are made")
    parser.add_argument("--seeds", type=int, nargs="+", default=[2007], help="of studies to make")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--draws", type=int, default=1000, help="of people, for intervals")
    parser.add_argument("--doubtful", action="store_true", help="take doubtful fits too")
    parser.add_argument("--json", type=Path, help="where all figures are written")
    parser.add_argument("--quick", action="store_true", help="eight people, coarser scans, two minutes")
    chosen = parser.parse_args()
    if chosen.quick:
        studies = [quick_study(chosen.work / "quick")]
    else:
        studies = chosen.study or [full_study(chosen.work / f"s{seed}", seed, chosen.jobs) for seed in chosen.seeds]
    harder = chosen.harder or [study / "harder" for study in studies]
    since = time.process_time()
    found: dict[str, Any] = {}
    for condition in (STUDY, *chosen.conditions):
        used: list[Fold] = []
        counts = dict.fromkeys(STATUSES, 0)
        for number, (study, other) in enumerate(zip(studies, harder, strict=False)):
            config = study_config(study)
            if condition != STUDY:
                if chosen.harder is None:
                    fit_harder(study, other, config, [condition], workers=chosen.jobs)
                if not people_there(other, config, condition):
                    continue
            folds, own = folds_of(study, other, condition, number, doubtful=chosen.doubtful or chosen.quick)
            used += folds
            counts = {name: counts[name] + own[name] for name in counts}
        if used:
            curve = MODES if condition in (STUDY, "40 % missing") else ()
            names = [*list(SCORES)[:1], AS_EXACT, *list(SCORES)[1:]]
            scores = measured(used, names, [k for k in MODES if k in curve], chosen.draws)
            found[condition] = {"fits": counts, "scores": scores}
            print_progress(condition, len(found), 1 + len(chosen.conditions))
    print(table(found))
    print(f"{time.process_time() - since:.0f} CPU seconds for the figures", file=sys.stderr)
    if chosen.json:
        chosen.json.write_text(json.dumps(found, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
