from pathlib import Path
from typing import Any

import numpy as np
import pytest
from packs import SIZE, manifest, write_cable, write_manifest

from vibench import RequestError, create
from vibench.packs import read_model_pack
from vibench.packs.writer import write_pack

FORCE = {"name": "force", "unit": "N", "lam": "outputs.npz:lam"}


def write(folder: Path, outputs: list[dict[str, Any]]) -> Path:
    write_manifest(write_cable(folder), manifest({"outputs": outputs}))
    np.savez(folder / "outputs.npz", u=np.arange(SIZE, dtype=float), lam=np.ones(SIZE), short=np.ones(SIZE - 1))
    return folder


def test_a_pack_names_linear_outputs(tmp_path: Path) -> None:
    both = {"name": "both", "u": "outputs.npz:u", "lam": "outputs.npz:lam"}
    pack = read_model_pack(write(tmp_path / "cable", [FORCE, both]))
    assert [(output.name, output.unit, output.linear) for output in pack.outputs] == [
        ("force", "N", True), ("both", "1", True),
    ]  # fmt: skip
    u, lam = np.full((SIZE, 1), 2.0), np.full((SIZE, 1), 3.0)
    values = [float(output.values(np.array([[4.0, 0.2]]), u, lam)[0]) for output in pack.outputs]
    assert values == [3.0 * SIZE, SIZE * (SIZE - 1.0) + 3.0 * SIZE]


def test_a_mistake_is_named(tmp_path: Path) -> None:
    for outputs, words in (
        ([{"name": "s"}], "outputs.0: give coefficients of 'u', of 'lam', or of both"),
        ([FORCE, FORCE], "outputs: two of them have the same name: force, force"),
        ([{"name": "s", "u": "outputs.npz:short"}], "outputs.0.u: 11; expected 12"),
        ([{"name": "s", "lam": "outputs.npz:no"}], "outputs.0.lam"),
        ([{"name": "s", "function": "u.max()"}], "no key is called 'function'"),
    ):
        with pytest.raises(RequestError, match=words):
            read_model_pack(write(tmp_path / f"cable {words}", outputs))


def test_the_linear_outputs_of_a_problem_are_written(tmp_path: Path) -> None:
    problem = create("problem", "hertz", {"resolution": "coarse"})
    write_pack(problem, tmp_path / "hertz", name="hertz", source="", validation=1, seed=0)
    pack, linear = create("problem", "pack", {"path": str(tmp_path / "hertz")}), problem.outputs[::2]
    assert [(one.name, one.unit) for one in pack.outputs] == [(one.name, one.unit) for one in linear]
    mus, u, lam = np.array([[1.0]]), np.arange(problem.V.dim)[:, None] + 0.5, np.arange(problem.W.dim)[:, None] + 0.5
    for mine, theirs in zip(pack.outputs, linear, strict=True):
        assert mine.values(mus, u, lam) == theirs.values(mus, u, lam)
