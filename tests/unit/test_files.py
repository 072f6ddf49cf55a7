"""Lock files: one holder, or several that share, and a refusal that names the holder."""

import os
from pathlib import Path

import pytest

from vibench.errors import RequestError
from vibench.files import locked


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
