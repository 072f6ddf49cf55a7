from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import broken_variants
import numpy as np
import pytest
import scipy.sparse as sp
from fake_plugins import Wire
from hypothesis import given
from hypothesis import strategies as st
from numerics import Varying
from running import Register

from vibench import NumericalError, Problem, VariationalInequality
from vibench.interfaces.validation import Fingerprint, ReferenceAssembly, fingerprint
from vibench.model.error_bounds import REFERENCE
from vibench.plugins.plugin import Plugin
from vibench.stages import snapshots
from vibench.stages.artefacts import Store
from vibench.stages.base import build_problem
from vibench.stages.snapshots import SnapshotStage, fingerprint_here, gather, solution_stages
from vibench.study.parameter_sets import OWN_TRAINING, ParameterSet
from vibench.testing.checks import call_in_other_process

REASONS: Mapping[str, str] = {
    "SkewStiffness": "A at mu = [0.25, 0.05] is not symmetric",
    "IndefiniteSomewhere": "is not positive definite",
    "ConstantStiffness": "a member declared `constant` depends on mu: row",
    "ConstantConstraint": "a member declared `constant` depends on mu: row",
    "SingularDualNorm": "the Gram matrix",
    "NoisyLoad": "two assemblies at one parameter are not the same, as in another process: row",
    "NotANumberInACorner": "g has entries that are not finite at mu = [",
    "LoadOnAllNodes": "f has shape (49,) at mu = [1.0]; the spaces V and W require (25,)",
    "ComplexStiffness": "at mu = [0.25, 0.05]: A is complex",
    "DependsOnTheCallBefore": "two assemblies at one parameter are not the same",
    "ShiftsTheParameter": "ValueError: output array is read-only",
}


VALIDATION = ParameterSet("validation", 8, 3)


def swept(name: str, folder: Path) -> None:
    build_problem.cache_clear()
    fingerprint_here.cache_clear()
    store = Store(folder / "artefacts")
    chunks = solution_stages(Plugin("problem", name, "{}", ""), OWN_TRAINING)
    for chunk in chunks:
        found = chunk.run(store)
        store.put(chunk.key, found.value, found.seconds, found.histories)
    gather(store, chunks)


@pytest.mark.parametrize("name", REASONS)
def test_a_run_names_the_mistake_and_the_command_that_says_more(name: str, register: Register, tmp_path: Path) -> None:
    register(("vibench.problems", "it", f"broken_variants:{name}"))
    with pytest.raises(NumericalError) as caught:
        swept("it", tmp_path)
    assert REASONS[name] in str(caught.value)
    assert str(caught.value).endswith("; run `vibench check problem:it`")


@pytest.mark.parametrize("value", ["broken_variants:Bar", "broken_variants:Option", "broken_variants:Cube"])
def test_what_is_right_is_swept(value: str, register: Register, tmp_path: Path) -> None:
    register(("vibench.problems", "it", value))
    swept("it", tmp_path)


def fingerprint_of(create: type[Problem]) -> Fingerprint:
    problem = create()
    return fingerprint(problem, mu := problem.training_set()[0], problem.assemble(mu))


def test_fingerprints_show_numbering_permutations_and_shapes(monkeypatch: pytest.MonkeyPatch) -> None:
    for create, same in ((broken_variants.Bar, True), (broken_variants.NamesOfNodes, False)):
        there = call_in_other_process(fingerprint_of, create, seconds=60.0)
        assert (not list(there.deviations(fingerprint_of(create)))) == same
    wire = Varying()
    vi = wire.assemble(mu := wire.training_set()[0])
    swap = np.arange(wire.V.dim)
    swap[[3, 7]] = swap[[7, 3]]
    other = VariationalInequality(sp.csr_array(vi.A[swap][:, swap]), vi.f, vi.B, vi.g)
    (text,) = fingerprint(wire, mu, other).deviations(fingerprint(wire, mu, vi))
    assert text.endswith("of A differs")
    small, large, nan = (Fingerprint({"g": g}, {"g": 1.0}) for g in (np.ones(2), np.ones(3), np.array([1.0, np.nan])))
    assert list(small.deviations(large)) == ["g has 2 rows against 3"]
    assert list(nan.deviations(small)) == ["row 1 of g differs"]
    bar = broken_variants.Bar()
    reference = ReferenceAssembly(bar)
    products: list[object] = []
    monkeypatch.setattr("vibench.interfaces.validation._probed", products.append)
    vi = bar.assemble(np.array([3.0]))
    again = VariationalInequality(vi.A, vi.f, reference._vi.B, reference._vi.g)
    reference.refuse_false_declarations(np.array([3.0]), again)
    assert products == []


@given(st.sampled_from(["A", "f", "B", "g"]), st.integers(0, 2**16), st.sampled_from([1e-13, 1e-6]))
def test_a_changed_entry_shows_unless_it_is_round_off(name: str, place: int, size: float) -> None:
    wire = Wire()
    vi = wire.assemble(mu := np.array([5.0]))
    before = fingerprint(wire, mu, vi)
    entries = getattr(vi, name).data if sp.issparse(getattr(vi, name)) else getattr(vi, name)
    entries[place % len(entries)] += size * np.max(np.abs(entries))
    found = list(fingerprint(wire, mu, vi).deviations(before))
    assert [text.split(" of ")[1] for text in found] == ([f"{name} differs"] if size > 1e-9 else [])


def test_references_are_verified_by_bounds(register: Register, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Training solutions are none: their error would be that of a snapshot."""
    register(("vibench.problems", "it", "broken_variants:Bar"))
    store, problem = Store(tmp_path / "artefacts"), Plugin("problem", "it", "{}", "")
    chunks = [solution_stages(problem, parameters)[0] for parameters in (OWN_TRAINING, VALIDATION)]
    training, validation = (chunk.run(store).value for chunk in chunks)
    assert training.bounds == ()
    assert len(validation.bounds) == len(validation.mu) > 0
    assert max(validation.bounds) <= REFERENCE
    monkeypatch.setattr("vibench.model.error_bounds.find_correction", lambda *given: None)
    assert set(chunks[1].run(store).value.bounds) == {np.inf}
    monkeypatch.undo()
    monkeypatch.setattr("vibench.model.error_bounds.REFERENCE", 0.0)
    monkeypatch.setattr("vibench.model.error_bounds.first_margin", np.zeros_like)
    with pytest.raises(NumericalError, match=r"at mu = \[.*\]: the error bound of the high-fidelity solution is "):
        chunks[1].run(store)


@pytest.mark.parametrize("role", ["training", "validation"])
def test_a_high_fidelity_solution_is_repeated_next_to_its_parameter(
    role: Literal["training", "validation"], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    visited, plain = list[tuple[float, ...]](), snapshots.checked_assembly
    monkeypatch.setattr(snapshots, "checked_assembly", lambda one, mu: (visited.append(tuple(mu)), plain(one, mu))[1])
    problem = Plugin("problem", "obstacle", '{"resolution": 150}', "repeats")
    snapshots._set_up.clear()  # with the set-up, beside which a training solution is repeated
    found = SnapshotStage(problem, ParameterSet(role, 6, 3), 0).run(Store(tmp_path)).value
    repeated = {mu for mu in visited if visited.count(mu) > 1}
    repeated -= {tuple(problem.create().training_set()[0])}  # where the fingerprint is taken
    for mu in repeated:  # once more for verification, when all that is timed there has been
        last = len(visited) - 1 - visited[::-1].index(mu)
        assert visited.count(mu) == 2
        assert not any(np.allclose(later, mu, rtol=0.0, atol=1e-8) for later in visited[last + 1 :])
    assert len(set(visited)) > len(found.mu)
    assert {tuple(mu) for mu in found.mu} <= set(visited)
    for mu, u, lam in zip(found.mu, found.u.T, found.lam.T, strict=True):
        vi = problem.create().assemble(mu)
        assert np.abs(vi.A @ u - vi.f + vi.B.T @ lam).max() < 1e-12 * np.abs(vi.A @ u).max()
