"""The template process from which commands and workers are forked, by `forking`; nothing here imports vibench."""

import atexit
import os
import socket
import subprocess
import sys
import tempfile
import threading
from functools import cache
from pathlib import Path

TESTS = Path(__file__).parents[1]
# A process that multiprocessing starts runs the main file of its parent again, if that has one.
FORKING = f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r}); from forking import main; main()"

TEMPLATE = "VIBENCH_TESTS_TEMPLATE"
"""Variable of the environment: the address of a template process that another process has started."""

_starting = threading.Lock()


def template() -> str:
    """The address of a given template process, or of one that ends with this process: the same one for all threads."""
    with _starting:
        return os.environ.get(TEMPLATE) or _started()


@cache
def _started() -> str:
    folder = tempfile.mkdtemp(prefix="vibench-tests-")
    ours, theirs = socket.socketpair()
    address = f"{folder}/socket"
    with theirs:
        left_out = {"VIBENCH_WORKER", "PYTHONDONTWRITEBYTECODE"}
        environment = {name: value for name, value in os.environ.items() if name not in left_out}
        environment |= {"PYTHONPATH": os.pathsep.join(paths()), "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        process = subprocess.Popen(
            [sys.executable, "-c", FORKING, str(theirs.fileno()), address], env=environment,
            pass_fds=[theirs.fileno()], stdin=subprocess.DEVNULL, start_new_session=True,
        )  # fmt: skip
    assert ours.recv(1) == b"+"
    atexit.register(process.wait)
    atexit.register(ours.close)  # first: the template ends when it is closed
    return address


def paths() -> list[str]:
    """Where this process finds modules, the tests left out."""
    return [entry for entry in sys.path if entry and TESTS not in (Path(entry), *Path(entry).parents)]
