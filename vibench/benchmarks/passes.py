"""The passes of a benchmark, which processes tell one by one, as one entry of a file of pytest-benchmark."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

PASS = re.compile(r"-@\d+(?=[-\]])")
"""The pass in the name of a benchmark."""

Entry = Mapping[str, Any]
"""What pytest-benchmark keeps of a benchmark."""


def plain_name(fullname: str) -> str:
    """Name of a benchmark without the file, what every function begins with, and the pass."""
    return PASS.sub("", fullname.rsplit("::", 1)[-1].removeprefix("test_"))


def is_slow(entry: Entry) -> bool:
    """Whether one pass is all that a benchmark takes."""
    return bool(entry["extra_info"].get("slow"))


def together(entries: Sequence[Entry]) -> list[Entry]:
    """An entry for every benchmark: its statistics are over the rounds of all passes."""
    passes: dict[str, list[Entry]] = {}
    for entry in entries:
        passes.setdefault(plain_name(entry["fullname"]), []).append(entry)
    return [_merged(name, some) for name, some in passes.items()]


def _merged(name: str, passes: Sequence[Entry]) -> Entry:
    from pytest_benchmark.stats import Stats  # noqa: PLC0415  it is not installed wherever this module is read

    first, all_rounds = passes[0], Stats()  # type: ignore[no-untyped-call]
    for one in passes:
        for seconds in one["stats"]["data"]:
            all_rounds.update(seconds)  # type: ignore[no-untyped-call]
    statistics = {field: getattr(all_rounds, field) for field in Stats.fields}
    kept = ("q1", "median", "q3", "rounds")
    several = [
        {key: one["stats"][key] for key in kept} | {"calibration_s": one["extra_info"]["calibration_s"]}
        for one in passes
    ]
    extra = {key: value for key, value in first["extra_info"].items() if key not in ("pass", "slow", "calibration_s")}
    return {
        **first,
        "name": f"test_{name}",
        "fullname": PASS.sub("", first["fullname"]),
        "stats": {**first["stats"], **statistics, "data": all_rounds.data},
        "extra_info": {**extra, "passes": several},
    }
