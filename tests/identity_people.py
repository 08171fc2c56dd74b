"""People by the two-covariance model, for tests of who is it: nothing is fitted."""

import numpy as np

from shapespace.cohort.cohort import Cohort, FitDiagnostics
from shapespace.cohort.table import Table
from shapespace.statistics.identity.scores import Samples
from shapespace.types import FloatArray
from synthetic_shapes import blob_model

MODES = 6


def spreads(k: int = MODES) -> tuple[FloatArray, FloatArray]:
    """Return covariances between and within people that are not diagonal together; expressions fill two directions."""
    rng = np.random.default_rng(5)
    mix = rng.standard_normal((k, 2))
    return np.diag(np.linspace(1.0, 0.3, k)), 2.0 * mix @ mix.T + 0.01 * np.eye(k)


def people(count: int, scans: int, seed: int = 0, *, error: float = 0.0, k: int = MODES) -> Samples:
    """Return scans of people, each with an error of a standard deviation up to `error` that it states."""
    rng = np.random.default_rng(seed)
    between, within = spreads(k)
    who = np.repeat(np.arange(count), scans)
    x = rng.multivariate_normal(np.zeros(k), between, count)[who]
    x = x + rng.multivariate_normal(np.zeros(k), within, len(who))
    variance = (error * rng.uniform(0.0, 1.0, (len(who), k))) ** 2
    x = x + np.sqrt(variance) * rng.standard_normal(x.shape)
    names = tuple(f"person {seed}-{number}" for number in who)
    return Samples(x, variance, 10.0 * x, names, n_vertices=25)


def cohort(count: int = 12, scans: int = 3, seed: int = 0) -> Cohort:
    """Return fits of people, whose first scan is called neutral and whose others smile or fear."""
    model = blob_model(60, MODES)
    samples = people(count, scans, seed, error=0.2)
    shown = tuple(("neutral", "smile", "fear")[k % scans % 3] for k in range(count * scans))
    names = tuple(f"scan_{k:03d}" for k in range(count * scans))
    table = Table({"subject": samples.subjects, "expression": shown}, names, "people.csv")
    b = samples.x * model.stddev
    stated = np.sqrt(samples.variance) * model.stddev
    fitted = FitDiagnostics(model, b, stated, ("converged",) * len(b), "fits")
    return Cohort.of_fits(fitted, names, table, np.full(len(b), 100.0))


def with_columns(cohort: Cohort, **columns: tuple[str, ...]) -> Cohort:
    """Return the cohort with further columns in its table."""
    table = Table({**cohort.table.columns, **columns}, cohort.table.rows, cohort.table.where)
    return Cohort(
        cohort.names, cohort.reference, cohort.basis, cohort.coefficients, cohort.sizes_mm, table, fitted=cohort.fitted
    )
