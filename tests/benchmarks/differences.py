"""The largest difference of every column between two runs of one study, row by row; seconds are left out.

    python tests/benchmarks/differences.py RUN OTHER

Cells and queries are joined by the key of the cell, which the code is no part of. Of numbers the largest relative and
absolute difference is printed, of texts how many differ, of both how many are there in one run alone. Columns that are
the same to the last bit are not listed.
"""

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd

import vibench
from vibench.results.schema import STORED

OF_THE_RUN = {
    "code", "versions", "machine", "peak_memory_mib", "slowdown", "disturbed", "timed_rounds", "timing_reason",
}  # fmt: skip
"""Columns that differ between two runs of the same numbers, beside those of seconds."""


def differences(one: pd.DataFrame, other: pd.DataFrame, table: str) -> Iterator[str]:
    for name in one.columns.intersection(other.columns):
        column = STORED[table].get(name)
        if name in OF_THE_RUN or (column is not None and column.unit in ("s", "ms")):
            continue
        mine, theirs = one[name], other[name]
        missing = int((mine.isna() != theirs.isna()).sum())
        if pd.api.types.is_numeric_dtype(mine) and pd.api.types.is_numeric_dtype(theirs):
            gaps = (mine - theirs).abs()
            relative = gaps[gaps > 0.0] / np.maximum(mine.abs(), theirs.abs())[gaps > 0.0]
            if len(relative) or missing:
                largest = relative.max() if len(relative) else 0.0
                yield f"{name:40s} {largest:.1e} relative, {gaps.max():.1e} absolute, {missing} missing"
        elif changed := int((mine.fillna("").astype(str) != theirs.fillna("").astype(str)).sum()):
            yield f"{name:40s} {changed} of {len(mine)} texts"


def main(one: Path, other: Path) -> None:
    runs = vibench.open_run(one), vibench.open_run(other)
    for table, keys in (("cells", ["cell"]), ("queries", ["cell", "query"])):
        frames = [run.table(table).set_index(keys).sort_index() for run in runs]
        common = frames[0].index.intersection(frames[1].index)
        only = frames[0].columns.symmetric_difference(frames[1].columns)
        print(f"{table}: {len(common)} common rows of {len(frames[0])} and {len(frames[1])}", *only)
        for line in differences(frames[0].loc[common], frames[1].loc[common], table):
            print(f"  {line}")


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:3]))
