"""Artefacts: whole or not there, the same to the last bit, nothing but data, and only those of this machine."""

import contextlib
import itertools
import json
import math
import struct
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.numpy
import scipy.sparse as sp
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from vibench import InnerProduct
from vibench.errors import NumericalError, RequestError, StorageError
from vibench.linalg.cholesky import SparseCholesky
from vibench.reduction.supremizers import ContactCoordinates
from vibench.stages import artefacts as module
from vibench.stages import assembly  # noqa: F401  lists what operators consist of
from vibench.stages.artefacts import Artefact, DamagedArtefactError, History, Store, dumps, encoded, loads, storable
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
    np.testing.assert_array_equal(found.value, [0.0, 1.0, 2.0])
    assert (found.seconds, found.histories, found.machine) == (TIME, (HISTORY,), "there")
    assert files(folder) == ["key.artefact"]


def test_copies_are_stored_once_but_not_those_that_scipy_sorts() -> None:
    one, zero = np.random.default_rng(0).random((40, 50)), -np.zeros((40, 50))
    matrix = sp.csr_array(one)
    alone, value = (
        len(dumps(one)),
        [one, one.copy(), one.T.copy().T, zero, zero.copy(), np.empty((0, 3)), np.float64(1)],
    )
    assert len(dumps(value)) < 3 * alone + 2000
    found = loads(dumps(value))
    assert all(np.array_equal(a, b) and a.dtype == b.dtype for a, b in zip(found, value, strict=True))
    assert found[0] is found[1]
    assert np.signbit(found[4]).all()
    again, other = loads(dumps([matrix, matrix.copy()]))
    assert not np.shares_memory(again.indices, other.indices)


def test_artefacts_are_whole_or_earlier_ones_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
    assert found.value == 1
    assert files(tmp_path) == ["key.artefact"]
    # A process that dies while it writes leaves no file under the key.

    class Killed(BaseException):
        pass

    def die(*_: object, **__: object) -> None:
        assert Store(tmp_path).get("other") is None
        raise Killed

    monkeypatch.setattr(module.os, "fsync", die)
    with pytest.raises(Killed):
        Store(tmp_path).put("other", 1, TIME, ())
    assert files(tmp_path) == ["key.artefact"]


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


def assert_same(one: Any, other: Any, *, writeable: bool = False) -> None:
    """Types, entries, order in memory; numbers to the last bit. Arrays that were read may be written to or not."""
    assert type(one) is type(other)
    if isinstance(one, np.ndarray):
        assert (one.dtype, one.shape) == (other.dtype, other.shape)
        assert one.tobytes("A") == other.tobytes("A")
        assert one.flags.c_contiguous == other.flags.c_contiguous
        assert other.flags.writeable == writeable
    elif isinstance(one, tuple | list):
        assert len(one) == len(other)
        for pair in zip(one, other, strict=True):
            assert_same(*pair)
    elif isinstance(one, dict):
        assert_same(list(one.items()), list(other.items()))
    elif isinstance(one, float):
        assert struct.pack("d", one) == struct.pack("d", other) or (math.isnan(one) and math.isnan(other))
    else:
        assert one == other


FORMATS = ("csr", "csc", "coo", "dia", "bsr", "lil", "dok")

arrays = hnp.arrays(st.sampled_from(["f8", "f4", np.intp, "i4", np.bool_, "u1"]), hnp.array_shapes(min_side=0))
numbers = st.integers() | st.floats() | st.booleans() | st.floats().map(np.float64) | st.booleans().map(np.bool_)
plain = numbers | st.text(st.characters()) | st.none() | arrays | arrays.map(np.asfortranarray)
keys = st.text() | st.integers() | st.floats(allow_nan=False)


@given(st.recursive(plain, lambda p: st.lists(p) | st.lists(p).map(tuple) | st.dictionaries(keys, p), max_leaves=6))
def test_a_value_is_read_as_it_was_written(value: Any) -> None:
    assert_same(value, loads(dumps(value)))


def test_factors_coordinates_and_unsorted_indices_stay_and_arrays_are_stored_once() -> None:
    """What a process keeps for several stages no plugin may write into."""
    whole = np.arange(60_000.0).reshape(300, 200)
    content = dumps([whole[:2, ::3], whole[3]])
    assert len(content) < 5_000
    assert_same([np.ascontiguousarray(whole[:2, ::3]), whole[3]], loads(content))
    dense, columns, matrix = loads(dumps((np.eye(3), np.asfortranarray(np.ones((2, 3))), sp.eye_array(3).tocsr())))
    for array in (dense, columns, matrix.data, matrix.indices, matrix.indptr):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1
    one = np.arange(1000.0)
    first, second = loads(dumps((one, one)))
    assert first is second
    assert len(dumps((one, one))) < 1.5 * len(dumps((one,)))
    matrix = sp.csr_array((np.ones(3), np.array([2, 0, 1]), np.array([0, 2, 3])), shape=(2, 3))
    matrix.indices, matrix.indptr = matrix.indices.astype(np.int64), matrix.indptr.astype(np.int64)
    found = loads(dumps(matrix))
    assert_same(matrix.indices, found.indices, writeable=True)
    assert_same(matrix.indptr, found.indptr, writeable=True)
    X = InnerProduct(sp.csc_array(np.diag([2.0, 3.0, 4.0, 5.0]) - np.eye(4, k=1) - np.eye(4, k=-1)))
    space = ContactCoordinates(X, np.ones((4, 1)) / X.norm(np.ones(4)), np.array([2, 3]))
    coordinates = np.arange(3.0)[:, None]
    expected = space.vectors(coordinates)
    found = loads(dumps(space))
    np.testing.assert_array_equal(found.vectors(coordinates), expected)
    np.testing.assert_array_equal(loads(dumps(X)).whiten(np.ones(4)), X.whiten(np.ones(4)))
    factor = SparseCholesky(X.matrix)
    np.testing.assert_array_equal(loads(dumps(factor)).solve_factor(np.ones(4)), factor.solve_factor(np.ones(4)))


@pytest.mark.parametrize(("kind", "box"), [*itertools.product(FORMATS, [0, 1])])
def test_sparse_matrices_of_every_format(kind: str, box: int) -> None:
    made = getattr(sp, f"{kind}_{('array', 'matrix')[box]}")
    for entries in (np.diag([1.0, -0.0, 3.0])[:, :2], np.zeros((3, 0)), np.zeros((2, 2))):
        matrix = made(entries)
        found = loads(dumps(matrix))
        assert (type(found), found.shape, found.dtype) == (type(matrix), matrix.shape, matrix.dtype)
        np.testing.assert_array_equal(found.toarray(), entries)
        for name in {"data", "indices", "indptr", "offsets"} & set(dir(matrix)) if kind not in ("lil", "dok") else ():
            written = np.asarray(getattr(matrix, name))
            assert_same(written, getattr(found, name), writeable=kind not in ("csr", "csc"))


@storable
@dataclass(frozen=True)
class Sample:
    """A dataclass of the closed list, with a cache."""

    size: int
    parts: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if self.size < 0:
            raise ValueError("a size is not negative")

    @cached_property
    def doubled(self) -> int:
        return 2 * self.size


def test_caches_are_not_stored_and_what_no_class_of_the_list_has_is_named() -> None:
    sample = Sample(3, (1.0, math.inf))
    assert sample.doubled == 6
    found = loads(dumps(sample))
    assert found == sample
    assert set(vars(found)) == {field.name for field in fields(Sample)}
    with pytest.raises(TypeError, match="two storable classes are called Sample"):
        storable(type("Sample", (), {}))
    for value, named in (
        (lambda: 0, "builtins.function"), ({"at": [Stranger(1)]}, "Stranger"), (b"bytes", "builtins.bytes"),
        ({1}, "builtins.set"), (np.array([None]), "object"), (np.array(["text"]), "<U4"), (1j, "builtins.complex"),
        (np.array([1j]), "complex128"), (np.ma.masked_array([1.0]), "MaskedArray"),
        (type("Sample", (), {})(), "Sample"),
    ):  # fmt: skip
        with pytest.raises(NumericalError, match=f"{named}.* cannot be stored"):
            dumps(value)


@dataclass
class Stranger:
    size: int


def crafted(structure: str | bytes, **arrays: Any) -> bytes:
    text = structure.encode() if isinstance(structure, str) else structure
    found = {"structure": np.frombuffer(text, np.uint8)} if text else {}
    return safetensors.numpy.save(found | {name: np.asarray(value) for name, value in arrays.items()})


def header(text: str, data: bytes = b"") -> bytes:
    return struct.pack("<Q", len(text)) + text.encode() + data


def csr(data: Any, indices: Any, indptr: Any, shape: list[Any]) -> bytes:
    parts = [{"array": str(k)} for k in range(3)]
    structure = json.dumps({"sparse": ["csr", "csr", True, shape, parts]})
    return crafted(structure, **{str(k): np.asarray(part) for k, part in enumerate((data, indices, indptr))})


HUGE = '{"a":{"dtype":"F64","shape":[%s],"data_offsets":[0,%s]}}'

DAMAGED = {
    "nothing": b"", "no file of this format": b"\xff" * 64,
    "a huge array": header(HUGE % (10**12, 8 * 10**12), bytes(8)),
    "a huge array without entries": header(HUGE % ("4294967296,4294967296,4294967296", 0)),
    "trailing bytes": dumps(1) + b"\0", "cut off": dumps(np.arange(3.0))[:-1], "no structure": crafted(b"", a=1.0),
    "another type of entries": header('{"structure":{"dtype":"BF16","shape":[1],"data_offsets":[0,2]}}', bytes(2)),
    "no JSON": crafted("{"), "no text": crafted(b"\xff"), "NaN": crafted("NaN"), "infinite": crafted("-Infinity"),
    "a plain list": crafted("[1]"), "an empty description": crafted("{}"),
    "two sorts": crafted('{"list": [], "tuple": []}'), "an unknown sort": crafted('{"module": "os"}'),
    "an unknown class": crafted('{"object": ["Popen", {"args": "id"}]}'),
    "a class of Python": crafted('{"object": ["object", {}]}'),
    "a dataclass that is not on the list": crafted('{"object": ["Stranger", {"size": 1}]}'),
    "unknown fields": crafted('{"object": ["Sample", {"size": 1, "parts": {"tuple": []}, "doubled": 3}]}'),
    "missing fields": crafted('{"object": ["Sample", {"size": 1}]}'),
    "a field twice": crafted('{"object": ["Sample", {"size": 1, "size": 2, "parts": {"tuple": []}}]}'),
    "refused by its class": crafted('{"object": ["Sample", {"size": -1, "parts": {"tuple": []}}]}'),
    "an unknown member": crafted('{"member": ["Kind", "OTHER"]}'),
    "a member of no enumeration": crafted('{"member": ["Sample", "size"]}'),
    "an enumeration as an object": crafted('{"object": ["Kind", {}]}'),
    "state of another class": crafted('{"object": ["SparseCholesky", {"size": 1}]}'),
    "no factor": crafted('{"object": ["SparseCholesky", {"matrix": 1, "name": "X", "order": null, "dense": 0}]}'),
    "an unknown array": crafted('{"array": "7"}'), "an array that is the structure": crafted('{"array": "structure"}'),
    "no key": crafted('{"dict": [[{"list": []}, 1]]}'), "no pairs": crafted('{"dict": [1]}'),
    "no float": crafted('{"float": "1e3"}'), "a deep structure": crafted('{"list":[' * 100_000 + "]}" * 100_000),
    "a structure that nobody closes": crafted('{"list":[' * 100_000), "a number of many digits": crafted("9" * 100_000),
    "indices out of range": csr(np.ones(2), np.array([0, 10**6]), np.array([0, 1, 2]), [2, 2]),
    "negative indices": csr(np.ones(2), np.array([0, -5]), np.array([0, 1, 2]), [2, 2]),
    "pointers out of range": csr(np.ones(2), np.array([0, 1]), np.array([0, 10**9, 2]), [2, 2]),
    "indices that are no integers": csr(np.ones(2), np.array([0.0, 1.0]), np.array([0, 1, 2]), [2, 2]),
    "a huge matrix": csr(np.ones(1), np.array([0]), np.array([0, 1]), [10**15, 10**15]),
    "no shape": csr(np.ones(2), np.array([0, 1]), np.array([0, 1, 2]), ["2", 2]),
    "no sparse format": crafted('{"sparse": ["x", "os", true, [1, 1], []]}'),
}  # fmt: skip


@pytest.mark.parametrize("content", DAMAGED.values(), ids=DAMAGED)
def test_what_a_stranger_writes_is_damaged_and_no_more(content: bytes) -> None:
    with pytest.raises(DamagedArtefactError):
        loads(content)


@given(st.data())
def test_no_bit_makes_another_error(data: st.DataObject) -> None:
    """Without the digest, which finds every one: the reader itself says that it is damaged, or finds other numbers."""
    matrix = sp.csc_array(np.diag(np.arange(1.0, 9.0)))
    value = {"sample": Sample(1, (0.5,)), "time": Seconds(1.0, 2.0), "arrays": [np.arange(5), matrix]}
    content = bytearray(dumps(value))
    content[data.draw(st.integers(0, len(content) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    with contextlib.suppress(DamagedArtefactError):
        loads(bytes(content))
