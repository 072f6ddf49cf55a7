from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp
from numerics import Varying

from vibench.errors import NumericalError
from vibench.interfaces.parameters import ParameterBox
from vibench.interfaces.problem import VariationalInequality
from vibench.interfaces.validation import checked_assembly

BOX = ParameterBox(("a", "b"), np.array([0.0, -1.0]), np.array([1.0, 3.0]), ("1", "m"))


def test_parameters_of_a_box_are_in_grids_samples_and_unit_cubes() -> None:
    grid = BOX.grid(2, 3)
    assert grid.tolist() == [[0, -1], [0, 1], [0, 3], [1, -1], [1, 1], [1, 3]]
    box = ParameterBox(("a", "b", "c"), np.array([-2.0, 1.0, 3.0]), np.array([4.0, 5.0, 3.0]), ("1",) * 3)
    places = np.array([[0.0, 0.25, 0.0], [1.0, 0.75, 0.0]])
    assert np.allclose(box.to_unit(box.from_unit(places)), places, atol=1e-15)  # the width of a point is not zero
    assert np.allclose(box.to_unit(np.array([1.0, 2.0, 3.0])), [0.5, 0.25, 0.0])
    sample = BOX.sample(50, seed=7)
    assert np.all((sample >= BOX.lower) & (sample <= BOX.upper))
    assert np.array_equal(sample, BOX.sample(50, seed=7))
    assert not np.array_equal(sample, BOX.sample(50, seed=8))
    assert np.array_equal(sample[:10], BOX.sample(10, seed=7))


def test_right_assemblies_pass_and_wrong_ones_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = Varying()
    vi = checked_assembly(problem, np.array([0.3]))
    assert vi.B.shape == (8, 30)
    assert np.isclose(problem.multiplier_integrals().sum(), problem.W.matrix.sum())
    good = problem.assemble(np.array([0.3]))
    far = replace(good, g=np.append(good.g[:-1], 1e250), f=1e-200 * good.f)
    monkeypatch.setattr(problem, "assemble", lambda mu: far)
    assert checked_assembly(problem, np.array([0.3])) is far
    for member, wrong, message in (
        ("A", lambda vi: vi.A[:-1], r"A has shape \(29, 30\).*require \(30, 30\)"),
        ("g", lambda vi: np.append(vi.g, 1.0), r"g has shape \(9,\)"),
        ("f", lambda vi: vi.f * np.nan, "f has entries that are not finite"),
        ("B", lambda vi: sp.csr_array(vi.B * np.inf), "B has entries that are not finite"),
        ("f", lambda vi: np.where(np.arange(30) == 3, -np.inf, vi.f), "f has entries that are not finite"),
        ("g", lambda vi: vi.g * np.nan, "g has entries that are not finite"),
        ("A", lambda vi: sp.csr_array(vi.A * 1e200), "A has entries of up to .e.2.*: choose units"),
        ("B", lambda vi: sp.csr_array(vi.B * 1e-200), "B has entries of up to .e-2.*: choose units"),
        ("f", lambda vi: vi.f - 1e150, r"f has entries of up to 1e\+150 at mu = \[0.3\]; .* 1e-100 and 1e\+100"),
    ):
        problem = Varying()
        good = problem.assemble(np.array([0.3]))
        with np.errstate(invalid="ignore"):
            bad: VariationalInequality = replace(good, **{member: wrong(good)})
        monkeypatch.setattr(problem, "assemble", lambda mu, bad=bad: bad)
        with pytest.raises(NumericalError, match=message):
            checked_assembly(problem, np.array([0.3]))
