"""Five hundred study files, each broken somewhere: a line and exit code 2, or a matrix; never a traceback."""

import copy
import random
from pathlib import Path
from typing import Any

import pytest
from running import Main, refused
from samples import STUDY, toml

FILES = 500
PARTS = 10

ODD: list[Any] = [
    "", " ", "nan", "quick", "piqp", "mcpg", "\x7f", "µ" * 50, "../..", 0, 1, -1, 2**70, -0.0, 1e-400, 1e300, 0.5,
    True, False, float("nan"), float("inf"), float("-inf"), [], {}, [[]],
    [{}], [None], [0.5, "x"], {"name": "cpg"}, {"": 1},
    {"name": "obstacle", "options": {"resolution": -5}}, {"name": "hertz", "options": {"colour": 3}}, ["osqp", "osqp"],
    [{"name": "cpg", "label": ""}], {"offline-pga": []}, {"offline-pga": [2.0]},
]  # fmt: skip


def places(content: Any, here: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    found = [here] if here else []
    steps = content.items() if isinstance(content, dict) else enumerate(content) if isinstance(content, list) else ()
    for step, value in steps:
        found += places(value, (*here, step))
    return found


def without_none(value: Any) -> Any:
    return "None" if value is None else [without_none(v) for v in value] if isinstance(value, list) else value


def broken_content(rng: random.Random) -> str:
    content = copy.deepcopy(dict(STUDY))
    for _ in range(rng.randint(1, 3)):
        *path, last = rng.choice(places(content))
        parent: Any = content
        for step in path:
            parent = parent[step]
        how = rng.choice(["replace", "replace", "replace", "remove", "double", "rename"])
        if how == "replace":
            parent[last] = without_none(copy.deepcopy(rng.choice(ODD)))
        elif how == "remove":
            del parent[last]
        elif isinstance(parent, list):
            parent.insert(last, copy.deepcopy(parent[last]))
        else:
            parent[rng.choice(["", "names", f"{last}s", str(last).upper(), "µ"])] = parent.pop(last)
    return toml(content)


def broken_text(rng: random.Random) -> bytes:
    text = bytearray(toml(STUDY).encode())
    for _ in range(rng.randint(1, 4)):
        place = rng.randrange(len(text))
        how = rng.choice(["flip", "cut", "insert", "truncate", "move"])
        if how == "flip":
            text[place] = rng.randrange(256)
        elif how == "cut":
            del text[place : place + rng.randint(1, 20)]
        elif how == "insert":
            text[place:place] = rng.choice(
                [b"\n", b'"', b"]", b"[[", b"=", b"#", b"\x00", b"\xff", b"1e999", b"1979-05-27"]
            )
        elif how == "truncate":
            del text[max(place, 1) :]
        else:
            text += text[place : place + 40]
    return bytes(text)


@pytest.mark.parametrize("part", range(PARTS))
def test_a_broken_study_file_is_refused_in_a_line_or_its_matrix_listed(part: int, main: Main, tmp_path: Path) -> None:
    statuses = {0: 0, 2: 0}
    for number in range(part, FILES, PARTS):
        rng = random.Random(number)
        content = broken_content(rng).encode() if rng.random() < 0.6 else broken_text(rng)
        path = tmp_path / "study.toml"
        path.write_bytes(content)
        outcome = main("run", str(path), "--dry-run")
        statuses[outcome[0]] += 1
        if outcome[0] == 0:
            assert outcome[2] == ""
            assert outcome[1].splitlines()[-1].endswith(" cells")
        else:
            refused(outcome)
    assert statuses[2] > FILES / PARTS / 2
    assert not (tmp_path / "here" / "runs").exists()
