"""Artefacts: whole or not there, and only those of this machine."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from vibench import store as module
from vibench.store import Artefact, History, Store
from vibench.timing import Seconds

TIME = Seconds(1.5, 2.5)
HISTORY = History({"stage": "pod"}, "error", (1.0, 0.5))


def files(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_what_is_put_is_got_by_another_process(tmp_path: Path) -> None:
    Store(tmp_path / "new").put("key", np.arange(3.0), TIME, (HISTORY,))
    found = Store(tmp_path / "new").get("key")
    assert found is not None
    np.testing.assert_array_equal(found.value, [0.0, 1.0, 2.0])
    assert (found.seconds, found.histories) == (TIME, (HISTORY,))
    assert files(tmp_path / "new") == ["key.pickle"]


def test_what_was_never_put_is_missing(tmp_path: Path) -> None:
    assert Store(tmp_path).get("key") is None
    assert Store(tmp_path / "nowhere").get("key") is None


def test_what_was_missing_is_found_later(tmp_path: Path) -> None:
    reader = Store(tmp_path)
    assert reader.get("key") is None
    Store(tmp_path).put("key", 1, TIME, ())
    found = reader.get("key")
    assert found is not None
    assert found.value == 1


def test_an_artefact_of_another_machine_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "machine", lambda: "there")
    Store(tmp_path).put("key", 1, TIME, ())
    assert Store(tmp_path).get("key") is not None
    monkeypatch.setattr(module, "machine", lambda: "here")
    assert Store(tmp_path).get("key") is None
    Store(tmp_path).put("key", 2, TIME, ())
    found = Store(tmp_path).get("key")
    assert found is not None
    assert (found.value, found.machine) == (2, "here")


def test_what_cannot_be_written_leaves_nothing_behind(tmp_path: Path) -> None:
    with pytest.raises((pickle.PicklingError, AttributeError)):
        Store(tmp_path).put("key", lambda: 0, TIME, ())
    assert files(tmp_path) == []


def test_what_cannot_be_written_leaves_the_earlier_artefact(tmp_path: Path) -> None:
    Store(tmp_path).put("key", 1, TIME, ())
    with pytest.raises((pickle.PicklingError, AttributeError)):
        Store(tmp_path).put("key", lambda: 0, TIME, ())
    found = Store(tmp_path).get("key")
    assert found is not None
    assert found.value == 1


def test_an_artefact_is_not_seen_before_it_is_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A process that dies while it writes leaves no file under the key."""

    class Killed(BaseException):
        pass

    def die(*_: object, **__: object) -> None:
        assert Store(tmp_path).get("key") is None
        raise Killed

    monkeypatch.setattr(module.pickle, "dump", die)
    with pytest.raises(Killed):
        Store(tmp_path).put("key", 1, TIME, ())
    assert files(tmp_path) == []


@pytest.mark.parametrize(
    "damage",
    [
        lambda path: path.write_bytes(b""),
        lambda path: path.write_bytes(path.read_bytes()[:-20]),
        lambda path: path.write_bytes(b"nonsense"),
        lambda path: path.write_bytes(pickle.dumps({"value": 1})),
    ],
    ids=["empty", "cut off", "nonsense", "another object"],
)
def test_a_damaged_artefact_counts_as_missing(damage: Callable[[Path], object], tmp_path: Path) -> None:
    Store(tmp_path).put("key", list(range(100)), TIME, ())
    damage(tmp_path / "key.pickle")
    assert Store(tmp_path).get("key") is None


def test_many_artefacts_are_all_found(tmp_path: Path) -> None:
    """More than are kept in memory at a time."""
    store = Store(tmp_path)
    for k in range(200):
        store.put(f"key-{k}", k, TIME, ())
    for _ in range(2):
        for k in range(200):
            found = store.get(f"key-{k}")
            assert isinstance(found, Artefact)
            assert found.value == k
