"""Libraries and compilers that are broken: what needs them is unavailable with the reason, and everything else runs."""

import ctypes
import errno
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import pytest
from running import PATIENCE

from vibench import UnsupportedError
from vibench.offline import compiled
from vibench.provenance import distribution_version, solver_version

# Modules, and how their import fails.
LIBRARIES = {
    "clarabel": "raise OSError('libgomp.so.1')", "cvxopt": "raise SystemExit(3)", "daqp": "1 / 0",
    "scs": "raise KeyError", "ecos": "this is no Python", "highspy": "raise ImportError('built for another NumPy')",
    "mosek": "[][0]", "osqp": "import no_such_module", "quadprog": "assert not 'supported'",
    "gurobipy": "raise RuntimeError('no licence')", "qpalm": "raise Exception", "copt": "undefined",
    "qpoases": "raise RecursionError", "nppro": "raise TypeError", "pyamg": "raise OSError",
    "pypardiso": "raise SystemExit", "sklearn": "raise ValueError('numpy.dtype size changed')",
    "distributed": "raise AttributeError", "matplotlib": "raise ValueError('Key backend')", "h5py": "raise OSError",
}  # fmt: skip
SCRIPT = """
import json
from pathlib import Path
from types import SimpleNamespace
import vibench
from vibench.cli.doctor import wire
from vibench.execution.executors import Dask
from vibench.execution.run import unavailable
from vibench.library.runs import Run
from vibench.linalg.factorisations import implementation
from vibench.packs.array_files import ArrayFiles
from vibench.qp.solve import solve_qp

def reason(solver, factorisation="superlu"):
    problem = SimpleNamespace(arguments={"factorisation": factorisation})
    return unavailable(SimpleNamespace(plugins=[], problem=problem, solver=solver))

def line(work):
    try:
        work()
    except vibench.errors.VibenchError as error:
        return f"{type(error).__name__}: {error}"

solvers = {"highspy": "highs"}
said = {one: reason(solvers.get(one, one)) for one in "clarabel cvxopt daqp scs ecos highspy osqp quadprog".split()}
assert implementation("available").name == "superlu"
assert not reason("piqp") and not reason("proxqp")
assert solve_qp(wire(), "piqp", 1e-7).x is not None
print(json.dumps(said | {
    "cholmod": reason("piqp", "cholmod"), "pypardiso": reason("piqp", "pardiso"), "pyamg": reason("piqp", "multigrid"),
    "distributed": line(lambda: Dask(None, 1, Path())),
    "matplotlib": line(lambda: object.__new__(Run).figure("errors")),
    "h5py": line(lambda: ArrayFiles(Path(), 0, 1)._hdf5(Path(), "A")),
    "sklearn": line(lambda: vibench.create("dual strategy", "nmf")),
}))
"""


def test_a_broken_library_is_unavailable_with_its_reason_and_stops_nothing_else(tmp_path: Path) -> None:
    for name, text in LIBRARIES.items():
        (tmp_path / f"{name}.py").write_text(f"{text}\n")
    there = os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", str(tmp_path))])}
    line = [sys.executable, "-c", SCRIPT]
    done = subprocess.run(line, env=there, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=PATIENCE)
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout.splitlines()[-1])
    kinds = {"cvxopt": "SystemExit", "daqp": "ZeroDivision", "scs": "Key", "ecos": "Syntax", "osqp": "no_such_module"}
    kinds |= {"quadprog": "Assertion", "highspy": "another NumPy"}
    kinds |= {"pypardiso": "SystemExit", "distributed": "Attribute"}
    for name, why in [("cvxopt", said.pop("cholmod")), *said.items()]:
        installed = solver_version(name) or distribution_version(name) or name in {"sklearn", "distributed"}
        assert (kinds.get(name, LIBRARIES[name][6:11]) if installed else "not installed") in why
        assert "\n" not in why


NO_SPACE, NO_PROCESS = (OSError(number, os.strerror(number)) for number in (errno.ENOSPC, errno.EAGAIN))
NO_MAP = OSError("model.so: failed to map segment from shared object")
# The text of CC, the file that it names, the shell script that this is, or what fails; what is said.
COMPILERS = [
    ("CC", ".", "which is not found"), ("CC", 'gcc "', "No closing quotation"),
    ("CC", "/no/such/cc", "which is not found"), ("CC", "''", "which is not found"),
    ("file", "#!/no/such/shell\n", "FileNotFoundError"), ("file", "\x7fELF", "OSError"),
    ("script", "echo error: bad >&2; exit 1", "failed (1): error: bad"),
    ("script", "exit 7", "failed (7): it says nothing"), ("script", "kill -9 $$", "failed (-9)"),
    ("script", "exit 0", "failed (0)"), ("script", "echo no > model.so", "OSError"),
    ("script", ": > model.so", "OSError"),
    ("script", "mkdir model.so", "failed (0)"),
    ("script", 'cc "$@" && head -c 400 model.so > m && mv m model.so', "OSError"),
    ("script", 'echo "int x;" > model.c; exec cc "$@"', "AttributeError"),
    ("script", "printf 'error \\377' >&2; exit 1", "failed (1)"), (Path, "write_text", NO_SPACE),
    (compiled, "scratch", NO_SPACE), (ctypes, "CDLL", NO_MAP), (subprocess, "run", NO_PROCESS), (os, "mkdir", NO_SPACE),
]  # fmt: skip


@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
def test_a_broken_compiler_is_unavailable_with_its_reason(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for kind, text, reason in COMPILERS:
        (command := tmp_path / "compiler").write_text(text if kind == "file" else f"#!/bin/sh\n{text}\n")
        command.chmod(0o755)
        with monkeypatch.context() as here:
            here.setenv("CC", text if kind == "CC" else str(command) if kind in {"file", "script"} else "cc")
            if isinstance(reason, OSError):
                here.setattr(kind, text, Mock(side_effect=reason))
            with pytest.raises(UnsupportedError) as caught:
                compiled.CompiledProgram("int model_solve(void) { return 0; }\n", 1, 1)
        assert str(reason.args[-1] if isinstance(reason, OSError) else reason) in str(caught.value), text
        assert "\n" not in str(caught.value)
