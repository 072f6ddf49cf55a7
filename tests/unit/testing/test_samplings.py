from collections.abc import Callable, Mapping
from functools import partial
from itertools import repeat
from typing import Any

import numpy as np
import pytest
from running import Main, failures

from vibench import AdaptiveSampling, Array, ParameterBox, RequestError, Sampling, Trainer, testing
from vibench.testing.checks import Verdict


class Uniform(Sampling):
    """Independent points; nothing is wrong with it."""

    def __init__(self, size: int, seed: int = 0) -> None:
        self.size, self.seed = size, seed

    def parameters(self, box: ParameterBox) -> Array:
        return box.sample(self.size, self.seed)


def variant(name: str, base: type[Sampling] = Uniform, **methods: Callable[..., Any]) -> type[Sampling]:
    return type(name, (base,), {**methods, "__module__": __name__, "__doc__": name})


def entropy() -> int:
    return int(np.random.default_rng().integers(2**32))


Transposed = variant("Transposed", parameters=lambda self, box: box.sample(self.size, self.seed).T)
Outside = variant("Outside", parameters=lambda self, box: box.sample(self.size, self.seed) + (box.upper - box.lower))
Twice = variant(
    "Twice", parameters=lambda self, box: box.sample((self.size + 1) // 2, self.seed).repeat(2, axis=0)[: self.size]
)
# Takes its size for that of an axis.
PerAxis = variant("PerAxis", parameters=lambda self, box: box.grid(*[self.size] * box.dim))
Unseeded = variant("Unseeded", parameters=lambda self, box: box.sample(self.size, entropy()))
Deaf = variant("Deaf", parameters=lambda self, box: box.sample(self.size, 1))


class OfHashes(Uniform):
    """Its points follow from the order of a set of texts."""

    def parameters(self, box: ParameterBox) -> Array:
        order = list({"a", "b", "c", "d", "e", "f", "g"})
        return box.sample(self.size, self.seed + int("".join(str("abcdefg".index(one)) for one in order)))


class Raises(Uniform):
    def parameters(self, box: ParameterBox) -> Array:
        raise ArithmeticError("no points today")


class Picky(Uniform):
    def parameters(self, box: ParameterBox) -> Array:
        raise RequestError("only on Sundays")


class Unpicklable(Uniform):
    def __init__(self, size: int, seed: int = 0) -> None:
        super().__init__(size, seed)
        self.rule = lambda: None


class Farthest(AdaptiveSampling):
    """The candidate farthest from the solutions; nothing is wrong with it."""

    def parameters(self, box: ParameterBox) -> Array:
        return box.grid(*[4] * box.dim)

    def train(self, box: ParameterBox, trainer: Trainer) -> None:
        trainer.solve(box.lower)
        for mu in self.parameters(box):
            if trainer.bound(mu) > 0.5:
                trainer.solve(mu, trainer.bound(mu))


Idle = variant("Idle", Farthest, train=lambda self, box, trainer: None)
Endless = variant("Endless", Farthest, train=lambda self, box, trainer: [*map(trainer.solve, repeat(box.lower))])
Beyond = variant("Beyond", Farthest, train=lambda self, box, trainer: trainer.solve(2.0 * box.upper))
Wanders = variant("Wanders", Farthest, train=lambda self, box, trainer: trainer.solve(box.sample(1, entropy())[0]))

WRONG: Mapping[type[Sampling], tuple[str, str]] = {
    Transposed: ("parameters", "1 parameter: parameters of shape (1, 5); expected (P, 1), a row for each, with P > 0"),
    Outside: ("parameters", "1 parameter: parameter 0 has 'position' = 3.91"),
    Twice: ("parameters", "1 parameter: parameter 1, ["),
    PerAxis: ("size", "2 parameters: size = 5 was asked for; there are 25 points"),
    Unseeded: ("determinism", "3 parameters: a second call gives different values of the points: entry ("),
    OfHashes: ("another process", "3 parameters: another process gives different values of the points: entry ("),
    Raises: ("parameters", "ArithmeticError: no points today (test_samplings.py, line "),
    Picky: ("parameters", "(position, height, stiffness) is accepted: only on Sundays"),
    Unpicklable: ("pickling", "the Unpicklable cannot be pickled"),
    Idle: ("training", "1 parameter: train solves nowhere; expected a training parameter at least"),
    Endless: ("training", "train does not end after 5000 solutions"),
    Beyond: ("training", "1 parameter: train: parameter 0 has 'position' = 4, outside the box [-1, 2]"),
    Wanders: ("training", "1 parameter: a second call solves at other parameters"),
}


def made(plugin: type[Sampling]) -> partial[Sampling]:
    return partial(plugin) if issubclass(plugin, Farthest) else partial(plugin, size=5)


@pytest.mark.parametrize("plugin", WRONG)
def test_a_fault_is_found_by_its_check_alone(plugin: type[Sampling]) -> None:
    found = failures(testing.examine(made(plugin)))
    assert list(found) == [WRONG[plugin][0]]
    assert WRONG[plugin][1] in found[WRONG[plugin][0]]


def test_what_is_right_passes_and_a_seed_that_changes_nothing_is_doubtful() -> None:
    testing.check(made(Uniform))
    testing.check(made(Farthest))
    (doubt,) = [one for one in testing.examine(made(Deaf)) if one.verdict is Verdict.WARNING]
    assert doubt.check == "seed"
    assert "seeds 0 to 3 give the same points" in doubt.message


def test_the_command_says_its_size_and_seed(main: Main) -> None:
    code, out, err = main("check", "sampling:latin-hypercube")
    assert (code, err) == (0, ""), out
    title = "sampling strategy 'latin-hypercube', with size = 16 and seed = 0 (--option size=… for another)\n"
    assert out.startswith(title)
    assert "passed   parameters: 1 parameter: P = 16; 2 parameters: P = 16; 3 parameters: P = 16\n" in out
    code, out, _ = main("check", "sampling:list", "--option", "points=[[0.5, 1, 5.2], [1, 2, 5.3]]")
    assert code == 0
    assert "1 parameter: refused, point 0 has 3 values" in out
