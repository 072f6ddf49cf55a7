"""Artefacts: whole or not there, and only those of this machine."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vibench.errors import NumericalError, RequestError, StorageError
from vibench.stages import artefacts as module
from vibench.stages.artefacts import Artefact, History, Store, encoded
from vibench.timing import Seconds

TIME = Seconds(1.5, 2.5)
HISTORY = History("pod", "error", (1.0, 0.5), 0)


def files(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@given(st.one_of(st.text(st.characters()), st.integers(), st.none()), st.lists(st.integers() | st.floats()))
def test_a_history_holds_numbers_under_a_printable_name(quantity: object, values: list[float]) -> None:
    try:
        found = History.of("enrichment", quantity, np.array(values, dtype=object), 2)
    except OverflowError:
        assert max(map(abs, values)) > 1e308
        return
    assert found.quantity.isprintable()
    assert all(type(value) is float for value in found.values)
    np.testing.assert_array_equal(found.values, [float(value) for value in values])
    assert (found.stage, found.first_step) == ("enrichment", 2)


@pytest.mark.parametrize("values", [["many"], [None], [1.0, 1j], [[1.0, 2.0]]])
def test_a_history_of_anything_else_is_refused(values: list[Any]) -> None:
    with pytest.raises((TypeError, ValueError)):
        History.of("enrichment", "steps", values)


def test_what_is_put_is_got_by_another_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, reader = tmp_path / "new", Store(tmp_path / "new")
    assert reader.get("key") is None
    monkeypatch.setattr(module, "machine", lambda: "there")
    Store(folder).put("key", np.arange(3.0), TIME, (HISTORY,))
    monkeypatch.setattr(module, "machine", lambda: "here")
    found = reader.get("key")
    assert found is not None
    np.testing.assert_array_equal(found.value, [0.0, 1.0, 2.0])
    assert (found.seconds, found.histories, found.machine) == (TIME, (HISTORY,), "there")
    assert files(folder) == ["key.artefact"]


def test_what_cannot_be_written_leaves_the_earlier_artefact(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(NumericalError, match=r"type builtins\.function cannot be stored"):
        Store(tmp_path).put("key", lambda: 0, TIME, ())
    assert files(tmp_path) == []
    Store(tmp_path).put("key", 1, TIME, ())
    with pytest.raises(NumericalError, match=r"type builtins\.function cannot be stored"):
        Store(tmp_path).put("key", lambda: 0, TIME, ())

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(module.os, "fsync", full)
    with pytest.raises(StorageError, match=f"artefacts cannot be written to '{tmp_path}': No space left on device"):
        Store(tmp_path).put("key", 2, TIME, ())
    found = Store(tmp_path).get("key")
    assert found is not None
    assert found.value == 1
    assert files(tmp_path) == ["key.artefact"]


def test_an_artefact_is_not_seen_before_it_is_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A process that dies while it writes leaves no file under the key."""

    class Killed(BaseException):
        pass

    def die(*_: object, **__: object) -> None:
        assert Store(tmp_path).get("key") is None
        raise Killed

    monkeypatch.setattr(module.os, "fsync", die)
    with pytest.raises(Killed):
        Store(tmp_path).put("key", 1, TIME, ())
    assert files(tmp_path) == []


def flip_a_bit(path: Path) -> None:
    """In the numbers."""
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(bytes(content))


@pytest.mark.parametrize(
    "damage",
    [
        lambda path: path.write_bytes(b""), lambda path: path.write_bytes(path.read_bytes()[:-20]),
        lambda path: path.write_bytes(b"nonsense"),
        lambda path: path.write_bytes(encoded("other", Store(path.parent).get("key"))),
        lambda path: path.write_bytes(encoded("key", {"value": 1})),
        lambda path: path.write_bytes(encoded("key", Artefact(1, 1.5, (), "here"))),
        lambda path: path.write_bytes(encoded("key", Artefact(1, TIME, (1,), "here"))),
        lambda path: path.write_bytes(encoded("key", Artefact(1, TIME, (), ["here"]))), flip_a_bit,
    ],
    ids=["empty", "cut off", "nonsense", "renamed", "another object", "seconds", "histories", "machine", "one bit"],
)  # fmt: skip
def test_a_damaged_artefact_counts_as_missing(damage: Callable[[Path], object], tmp_path: Path) -> None:
    Store(tmp_path).put("key", list(range(100)), TIME, ())
    damage(tmp_path / "key.artefact")
    assert Store(tmp_path).get("key") is None


def test_artefacts_are_kept_up_to_so_many_bytes_and_those_used_long_ago_go_first(tmp_path: Path) -> None:
    for name, size in (("one", 1000), ("two", 1000), ("three", 1000), ("large", 4000)):
        Store(tmp_path).put(name, np.zeros(size), TIME, ())
    store = Store(tmp_path, cached_bytes=20_000)  # two of them, and their descriptions
    first, second = store.get("one"), store.get("two")
    assert store.get("one") is first
    assert store.get("two") is second
    store.get("one")
    store.get("three")  # for which the second has to go
    assert store.get("one") is first
    assert store.get("two") is not second
    large = store.get("large")
    assert large is not None
    assert len(large.value) == 4000
    assert store.get("large") is not large


def test_stored_artefacts_are_counted_and_cleared_unless_in_use(tmp_path: Path) -> None:
    store = Store(tmp_path)
    store.put("podstage-1", 1, TIME, ())
    store.put("conestage-1", list(range(1000)), TIME, ())
    (tmp_path / "vibench-left by a killed run.part").write_bytes(b"12345")
    counted = {sort: size for sort, size, _ in store.contents()}
    assert counted == {path.name.split("-")[0]: path.stat().st_size for path in tmp_path.glob("*.artefact")}
    assert store.clear(older_than=3600.0) == 5
    assert store.clear() == sum(counted.values())
    assert store.contents() == []
    assert Store(tmp_path / "nowhere").clear() == 0
    one, two = Store(tmp_path), Store(tmp_path)
    one.put("key", 1, TIME, ())
    with one.used(), two.used(), pytest.raises(RequestError, match="a run uses the artefacts in"):
        two.clear()
    assert one.get("key") is not None
