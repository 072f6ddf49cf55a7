import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from samples import SampleStore, carry_out

from vibench import Picture, RequestError
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


@pytest.mark.long
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
        assert (one.picture.name, one.picture.multiplier_name) == (picture.name, picture.multiplier_name)
        assert np.array_equal(one.picture.triangles, picture.triangles)
        for name in ("points", "values", "positions", "multiplier"):
            np.testing.assert_allclose(getattr(one.picture, name), getattr(picture, name), rtol=1e-6, atol=1e-12)
    journal = ResultsDatabase(tmp_path, {"name": "some"})
    journal.replace("pictures", [KEYS | {"reason": "the camera broke"}], **KEYS)
    journal.close()
    assert list(pictures.read(tmp_path / FILE)) == [Shown(("membrane", OBSTACLE.options), "", None, "the camera broke")]


LINE = Picture(np.arange(4.0)[None], np.zeros((3, 0), int), np.ones(4), "u", np.ones((1, 4)), np.ones(4), "λ [N]")
WRONG = (
    ({"points": np.zeros((3, 4))}, "points of Picture has 3 rows, expected 1 or 2"),
    ({"positions": np.zeros((3, 4))}, "positions of Picture has 3 rows, expected 1 or 2"),
    ({"values": np.zeros((3, 4))}, "values of Picture has the shape (3, 4)"),
    ({"values": np.zeros(3)}, "points of Picture has p = 4, but that of values is 3"),
    ({"values": np.ones(4, complex)}, "values of Picture is array([1.+0.j"),
    ({"multiplier": np.zeros(3)}, "positions of Picture has m = 4, but that of multiplier is 3"),
    ({"triangles": np.zeros((2, 1), int)}, "triangles of Picture has 2 rows, expected 3"),
    ({"triangles": np.array([[0], [1], [4]])}, "triangles of Picture refers to points 0 to 4; there are 4"),
    ({"name": b"u"}, "name of Picture is b'u', expected a text"),
)


def test_arrays_and_names_of_the_wrong_sort_are_named(tmp_path: Path) -> None:
    for wrong, words in WRONG:
        with pytest.raises(RequestError, match=re.escape(words)):
            replace(LINE, **wrong)
    # Beyond the numbers of single precision.
    with np.errstate(over="ignore"):
        (row,) = pictures.picture_rows([("", replace(LINE, values=1e39 * LINE.values))])
    journal = ResultsDatabase(tmp_path, {"name": "some"})
    journal.replace("pictures", [KEYS | row])
    journal.close()
    (shown,) = pictures.read(tmp_path / FILE)
    assert (shown.picture, shown.reason) == (None, "values of Picture has an entry that is not finite, first at [0]")
