"""The seeded faults still fit the sources; that the tests catch them is what `python tests/mutations.py` shows."""

from mutations import FAULTS, ROOT, changed


def test_every_fault_can_be_put_in_its_place() -> None:
    for fault in FAULTS:
        text = changed(ROOT, fault)
        if fault.file.endswith(".py"):
            compile(text, fault.file, "exec")
        assert all((ROOT / tests).exists() for tests in fault.tests), fault.name
    assert len(FAULTS) >= 130
