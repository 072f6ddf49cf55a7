from __future__ import annotations

import hashlib

from vibench.results.schema import STORED, VERSION

WRITTEN = {19: "4d97"}
"""By version, the first four digits of the digest of tables and columns."""


def test_other_columns_are_another_version() -> None:
    """A file with other columns under the same version would be refused as damaged."""
    declared = [
        (table, *((name, column.kind) for name, column in columns.items())) for table, columns in STORED.items()
    ]
    assert {VERSION: hashlib.sha256(repr(declared).encode()).hexdigest()[:4]} == WRITTEN
