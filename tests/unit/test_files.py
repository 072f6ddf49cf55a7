import os
from pathlib import Path

import pytest

from vibench import RequestError
from vibench.files import locked, scratch


def test_a_lock_has_one_holder_or_several_that_share(tmp_path: Path) -> None:
    path = tmp_path / ".lock"
    for first, second in ((False, False), (False, True), (True, False)):
        holder = "" if first else rf" \(process {os.getpid()} on .+\)"
        refused = pytest.raises(RequestError, match=rf"^busy{holder}$")
        with locked(path, busy="busy", shared=first), refused, locked(path, busy="busy", shared=second):
            pass
    with locked(path, busy="busy", shared=True), locked(path, busy="busy", shared=True):
        pass
    assert path.read_text() == ""


def test_scratch_folders_of_killed_processes_are_removed_and_those_of_others_kept(tmp_path: Path) -> None:
    (tmp_path / "vibench-killed.part").mkdir()
    (tmp_path / "vibench-killed.part" / "site").touch()
    (tmp_path / "vibench-mine").mkdir()
    (tmp_path / "vibench-linked.part").symlink_to("vibench-mine")
    with scratch(tmp_path) as first, scratch(tmp_path) as second:
        kept = {"vibench-mine", "vibench-linked.part"}
        assert {path.name for path in tmp_path.iterdir()} == {first.name, second.name, *kept}
    assert {path.name for path in tmp_path.iterdir()} == kept
