"""The bilinear model: what is a product of identity and expression is told apart again."""

import sys
from pathlib import Path

import numpy as np
import pytest

from shapespace.errors import InputError

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "studies"))
from bilinear import BilinearModel


def made(seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    core = rng.standard_normal((3, 4, 12))
    people, shown = rng.standard_normal((20, 3)), rng.standard_normal((4, 4))
    return np.einsum("si,xj,ijk->sxk", people, shown, core), people, shown


def test_a_bilinear_table_is_reconstructed_by_its_ranks() -> None:
    table, _, _ = made()
    model = BilinearModel.fit(table, 4, 4)  # the mean takes one more
    again = np.stack([[model.decode(a, e) for e in model.expressions] for a in model.identities])
    assert np.allclose(again, table, atol=1e-8)


def test_fewer_ranks_lose_something() -> None:
    table, _, _ = made()
    model = BilinearModel.fit(table, 1, 1)
    again = np.stack([[model.decode(a, e) for e in model.expressions] for a in model.identities])
    assert np.abs(again - table).max() > 0.1


def test_coefficients_are_explained_by_a_person_and_an_expression() -> None:
    table, _, _ = made()
    model = BilinearModel.fit(table, 4, 4)
    z = table[:, 2]
    identity, expression = model.encode(z, np.full(z.shape, 0.05), iterations=60)
    again = np.stack([model.decode(a, e) for a, e in zip(identity, expression, strict=True)])
    assert np.abs(again - z).mean() < 0.05 * np.abs(z - model.mean).mean()


def test_tables_and_ranks_that_cannot_be_are_refused() -> None:
    table, _, _ = made()
    with pytest.raises(InputError, match="ranks up to 20 and 4 only"):
        BilinearModel.fit(table, 21, 4)
    table[3, 1] = np.nan
    with pytest.raises(InputError, match="every expression of every person"):
        BilinearModel.fit(table, 3, 4)
    with pytest.raises(InputError, match=r"Give \(n, 12\)"):
        BilinearModel.fit(made()[0], 3, 4).encode(np.zeros((2, 11)), np.ones((2, 11)))
