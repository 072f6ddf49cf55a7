"""Pictures: of the right solutions, the same when read back, and a reason where there is none."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from fake_plugins import Wire
from samples import SampleStore, carry_out

from vibench.arrays import Array
from vibench.errors import NumericalError
from vibench.interfaces.outputs import Picture
from vibench.plugins.plugin import Plugin
from vibench.results import pictures
from vibench.results.database import ResultsDatabase
from vibench.results.pictures import Shown
from vibench.results.sqlite import FILE
from vibench.stages import base
from vibench.stages.pictures import PictureStage

OBSTACLE = Plugin("problem", "obstacle", '{"resolution": 200}', "test")
KEYS = {"problem": "membrane", "problem_options": OBSTACLE.options}


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> tuple[tuple[str, Picture], ...]:
    store, made = SampleStore(tmp_path_factory.mktemp("pictures")), PictureStage(OBSTACLE)
    carry_out(made, store)
    return tuple(base.value_of(store, made))


def test_solutions_at_corners_and_middle_are_read(drawn: tuple[tuple[str, Picture], ...], tmp_path: Path) -> None:
    assert [title for title, _ in drawn] == [
        "scale = 0.8, centre_x = -0.05 m, centre_y = -0.05 m",
        "scale = 1, centre_x = 0 m, centre_y = 0 m",
        "scale = 1.2, centre_x = 0.05 m, centre_y = 0.05 m",
    ]
    middle = drawn[1][1]
    assert middle.values.min() < -0.02  # the membrane hangs
    assert middle.multiplier.max() > 0.0  # and rests on the obstacle
    assert np.all(middle.multiplier >= 0.0)
    journal = ResultsDatabase(tmp_path, {"name": "some"})
    for _ in range(2):  # a second run writes in place of the first
        journal.replace("pictures", [KEYS | row for row in pictures.picture_rows(drawn)], **KEYS)
    journal.close()
    found = list(pictures.read(tmp_path / FILE))
    keys = [(("membrane", OBSTACLE.options), title, "") for title, _ in drawn]
    assert [(one.key, one.title, one.reason) for one in found] == keys
    for one, (_, picture) in zip(found, drawn, strict=True):
        assert one.picture is not None
        assert (one.picture.name, one.picture.multiplier_name) == (picture.name, picture.multiplier_name)
        assert np.array_equal(one.picture.triangles, picture.triangles)
        for name in ("points", "values", "positions", "multiplier"):
            np.testing.assert_allclose(getattr(one.picture, name), getattr(picture, name), rtol=1e-6, atol=1e-12)
    journal = ResultsDatabase(tmp_path, {"name": "some"})
    journal.replace("pictures", [KEYS | {"reason": "the camera broke"}], **KEYS)
    journal.close()
    assert list(pictures.read(tmp_path / FILE)) == [Shown(("membrane", OBSTACLE.options), "", None, "the camera broke")]


class Drawing(Wire):
    """A wire that draws itself on a line, one array of the wrong shape."""

    wrong = ""
    kind: type = float
    name: object = "u [m]"

    def picture(self, mu: Array, u: Array, lam: Array) -> Picture:
        x = np.linspace(0.0, 1.0, self.V.dim)[None]
        arrays = {"points": x, "values": u, "positions": x, "multiplier": lam, "triangles": np.zeros((3, 0), int)}
        if self.wrong:
            arrays[self.wrong] = np.zeros((3, 4))
        arrays["values"] = arrays["values"].astype(self.kind)
        return Picture(**arrays, name=self.name, multiplier_name="λ [N]")  # type: ignore[arg-type]


Draws = Callable[..., tuple[tuple[str, Picture], ...]]


@pytest.fixture
def draws(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Draws:
    """Function that gives the pictures of a wire which draws itself as asked for."""
    wire = Plugin("problem", "wire", "{}", "test")
    for module in ("vibench.stages.pictures", "vibench.stages.snapshots"):
        monkeypatch.setattr(f"{module}.build_problem", lambda _: Drawing())
    store = SampleStore(tmp_path)
    carry_out(PictureStage(wire), store)

    def draw(**how: object) -> tuple[tuple[str, Picture], ...]:
        for name, value in how.items():
            monkeypatch.setattr(Drawing, name, value)
        return tuple(PictureStage(wire).run(store).value)

    return draw


def test_arrays_and_names_of_the_wrong_sort_are_named_and_names_are_one_printable_line(draws: Draws) -> None:
    assert {picture.name for _, picture in draws(name="u\n\x1b[2J\ud800")} == {r"u \u001b[2J\ud800"}
    for wrong in ("points", "values", "positions", "multiplier"):
        with pytest.raises(NumericalError, match=f"picture has .*{wrong}.* of the wrong shape"):
            draws(wrong=wrong, name="u [m]")
    for kind in (str, complex, object):
        with pytest.raises(NumericalError, match="picture has values of the wrong type"):
            draws(kind=kind, wrong="")
    for name in (None, 3, b"u"):
        with pytest.raises(NumericalError, match="picture has name of the wrong type"):
            draws(name=name, kind=float)
