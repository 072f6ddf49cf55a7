"""The seeded faults still fit the sources; that the tests catch them is what `python tests/mutations.py` shows."""

from __future__ import annotations

import pytest

from mutations import FAULTS, ROOT, Fault, changed


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_a_fault_can_be_put_in_its_place(fault: Fault) -> None:
    text = changed(ROOT, fault)
    assert fault.wrong in text
    if fault.file.endswith(".py"):
        compile(text, fault.file, "exec")
    assert all((ROOT / tests).exists() for tests in fault.tests)


def test_faults_have_different_names() -> None:
    assert len({fault.name for fault in FAULTS}) == len(FAULTS) >= 10
