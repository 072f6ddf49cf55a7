from __future__ import annotations

import hashlib

from vibench.results.schema import STORED, VERSION


def test_other_columns_are_another_version() -> None:
    """A file with other columns under the same version would be refused as damaged."""
    declared = [
        (table, *((name, f"{column.kind} {column.constraint}".strip()) for name, column in columns.items()))
        for table, columns in STORED.items()
    ]
    # the first digits of the digest of tables and columns, by version
    assert {VERSION: hashlib.sha256(repr(declared).encode()).hexdigest()[:4]} == {20: "233a"}
