"""Commands and worker processes, forked from a process with the libraries loaded: imports are most of a short run.

A template process imports the libraries and vibench, and hashes its sources, once for all processes of the tests. What
is forked from it has the arguments, folder, environment and path that a new interpreter would get, and imports plugins
itself. Tests of how processes start and what belongs to them take new interpreters: the fixtures `command` and
`new_workers`.
"""

import atexit
import contextlib
import gc
import itertools
import os
import pickle
import resource
import runpy
import selectors
import shutil
import signal
import socket
import struct
import subprocess
import sys
import threading
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from importlib import import_module
from pathlib import Path
from pkgutil import walk_packages
from typing import Any

from template import paths, template

from vibench.execution import forking, supervisor

LOADED = [
    "annotated_types", "cachetools", "jinja2", "lazy_loader", "multiprocessing.connection", "numpy", "osqp", "pandas",
    "piqp", "platformdirs", "proxsuite", "pydantic", "rich.console", "rich.live", "rich.progress", "rich.table",
    "safetensors", "scipy.optimize", "scipy.sparse.linalg", "skfem", "statistics", "typer",
]  # fmt: skip

PACKAGES = ("cli", "execution", "plugins", "results", "stages", "study", "testing")
"""Packages of vibench that the template imports with all their modules, and so most others; plugins it does not."""

FILE_KIB = "VIBENCH_TESTS_FILE_KIB"
"""Variable of the environment: the largest file that a forked process and its workers may write, in KiB."""

SUPERVISOR = "VIBENCH_TESTS_SUPERVISOR"
"""Variable of the environment of a forked worker process: the process that watches it, which is not its parent."""

start_new_worker = supervisor.start_worker


class Forked(forking.Forked):
    """A process that the template has forked; what `subprocess.Popen` is to a supervisor."""

    def __init__(self, address: str, request: Mapping[str, Any], *files: int) -> None:
        status = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        status.connect(address)
        socket.send_fds(status, [pickle.dumps(request)], files)
        super().__init__(status)


class ForkedCommand(Forked):
    """A program that the template has forked; what `subprocess.Popen` is to a test that reads what it prints."""

    def __init__(self, program: Mapping[str, Any], folder: Path, file_kib: int | None = None) -> None:
        limit = {} if file_kib is None else {FILE_KIB: str(file_kib)}
        request = {"folder": str(folder), "template": template(), "environment": os.environ | limit, **program}
        (out, out_end), (err, err_end) = os.pipe(), os.pipe()
        super().__init__(template(), request, out_end, err_end)
        for end in (out_end, err_end):
            os.close(end)
        self.stdout, self.stderr = (os.fdopen(end, encoding="utf-8") for end in (out, err))

    def kill(self) -> None:
        if self.poll() is None:
            os.kill(self.pid, signal.SIGKILL)

    def communicate(self, timeout: float) -> tuple[str, str]:
        """What is left of what it prints, once it has ended; its group is killed if that takes longer."""
        with ThreadPoolExecutor(2) as pool:
            texts = [pool.submit(stream.read) for stream in (self.stdout, self.stderr)]
            try:
                self.wait(timeout)
            except subprocess.TimeoutExpired:
                os.killpg(self.pid, signal.SIGKILL)
                raise
            out, err = (text.result() for text in texts)
        return out, err


@contextlib.contextmanager
def _ended(process: ForkedCommand) -> Iterator[ForkedCommand]:
    try:
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        process.stdout.close()
        process.stderr.close()


def forked(
    arguments: Sequence[str], folder: Path, plugins: Path, file_kib: int | None = None
) -> contextlib.AbstractContextManager[ForkedCommand]:
    """`vibench ARGUMENTS` as `running.started` starts it, but forked."""
    program = {"main": "command", "arguments": ["vibench", *arguments], "path": [str(plugins), *paths()]}
    return _ended(ForkedCommand(program, folder, file_kib))


def run_command(
    arguments: Sequence[str], folder: Path, plugins: Path, timeout: float, file_kib: int | None = None
) -> subprocess.CompletedProcess[str]:
    """Run `vibench ARGUMENTS` in a folder, third-party plugins first on its path; as `subprocess.run` does.

    With `file_kib` no file may be longer than so many KiB, which is how a full disk looks to every process of it.
    """
    with forked(arguments, folder, plugins, file_kib) as process:
        out, err = process.communicate(timeout)
    return subprocess.CompletedProcess(list(arguments), process.wait(), out, err)


def run_pytest(folder: Path, site: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run `pytest ARGUMENTS` in a folder, with what is installed in another one."""
    script = folder / "run_tests.py"
    found = f"sys.path.insert(0, {str(site)!r})"
    script.write_text(f"import sys\n{found}\nimport pytest\nsys.exit(pytest.main({[*arguments]}))\n")
    program = {"main": "script", "arguments": [str(script)], "path": [str(folder), *paths()]}
    with _ended(ForkedCommand(program, folder)) as process:
        out, err = process.communicate(600.0)
    return subprocess.CompletedProcess([str(script)], process.wait(), out, err)


@contextlib.contextmanager
def fork_workers(address: Callable[[], str] = template) -> Iterator[None]:
    """Block in which the worker processes that this process starts are forked, by the template at an address."""

    def start(descriptor: int, log: str, environment: Mapping[str, str], *, forks: bool) -> Any:
        # Only a new interpreter has another seed than this process was given; dask leaves one in the environment.
        if environment.get("PYTHONHASHSEED") != os.environ.get("PYTHONHASHSEED"):
            return start_new_worker(descriptor, log, environment, forks=forks)
        request = {
            "main": "worker", "arguments": ["worker", str(descriptor), log], "folder": str(Path.cwd()),
            "environment": {**environment, SUPERVISOR: str(os.getpid())},
            "path": environment["PYTHONPATH"].split(os.pathsep),
        }  # fmt: skip
        return Forked(address(), request, descriptor)

    supervisor.start_worker = start
    try:
        yield
    finally:
        supervisor.start_worker = start_new_worker


def main() -> None:
    """Serve requests at an address until the other end of a socket is closed."""
    alive, address = socket.socket(fileno=int(sys.argv[1])), sys.argv[2]
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    listener.bind(address)
    listener.listen(64)
    alive.sendall(b"+")  # who asks now waits until all is loaded
    _load()
    ready = selectors.DefaultSelector()
    for end in (alive, listener):
        ready.register(end, selectors.EVENT_READ)
    while alive not in (keys := {key.fileobj: key for key, _ in ready.select()}):
        for number, key in keys.items():
            if number is listener:
                client = listener.accept()[0]
                told = _forked(client)
                ready.register(os.pidfd_open(told), selectors.EVENT_READ, (told, client))
            else:
                ready.unregister(number)
                os.close(key.fd)
                pid, client = key.data
                told = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
            with contextlib.suppress(OSError):  # the client may have been killed
                client.sendall(struct.pack("q", told))
            if number is not listener:
                client.close()
    shutil.rmtree(Path(address).parent)


def _load() -> None:
    """Import, and do once what every command and every worker process would do again."""
    for name in LOADED:
        import_module(name)
    for package in PACKAGES:
        for module in walk_packages(import_module(f"vibench.{package}").__path__, f"vibench.{package}."):
            import_module(module.name)
    import_module("unsynced").leave_syncing_to_the_system()
    import_module("vibench.execution.supervisor").code_here()
    _hash_stages(import_module("vibench.stages.base").Stage)
    typer = import_module("typer.main")
    typer.get_command = cache(typer.get_command)
    typer.get_command(import_module("vibench.cli.main").app)
    gc.freeze()  # collections in the processes forked leave alone what they share


def _hash_stages(kind: Any) -> None:
    for stage in kind.__subclasses__():
        stage.code()
        _hash_stages(stage)


def _forked(client: socket.socket) -> int:
    """Fork the process that a client asks for, with its files alone; gives its number."""
    content, files, *_ = socket.recv_fds(client, 2**20, 2)
    pid = os.fork()
    if not pid:
        for first, last in itertools.pairwise([2, *sorted(files), os.sysconf("SC_OPEN_MAX")]):
            os.closerange(first + 1, last)
        _be(pickle.loads(content), files)
    with contextlib.suppress(PermissionError, ProcessLookupError):
        os.setpgid(pid, pid)  # it leads a group of its own, whoever is first to say so
    for file in files:
        os.close(file)
    return pid


def _be(request: Mapping[str, Any], files: Sequence[int]) -> None:
    """Be the process that was asked for, and exit as an interpreter does."""
    code = 1
    try:
        os.setpgid(0, 0)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        os.chdir(request["folder"])
        os.environ.clear()
        os.environ.update(request["environment"])
        sys.path[:], sys.argv = request["path"], request["arguments"]
        if FILE_KIB in os.environ:
            resource.setrlimit(resource.RLIMIT_FSIZE, (1024 * int(os.environ[FILE_KIB]),) * 2)
            sys.dont_write_bytecode = True  # it would be cut off
        if request["main"] != "worker":
            for descriptor, file in zip((1, 2), files, strict=True):
                os.dup2(file, descriptor)
                os.close(file)
            # Streams of its own: the template's may be files, and a test waits for a line.
            sys.stdout = open(1, "w", 1, sys.stdout.encoding, sys.stdout.errors)  # noqa: SIM115
            sys.stderr = open(2, "w", 1, sys.stderr.encoding, sys.stderr.errors)  # noqa: SIM115
            with fork_workers(lambda: request["template"]):
                if request["main"] == "command":
                    import_module("vibench.cli").start()
                else:
                    runpy.run_path(sys.argv[0], run_name="__main__")
        else:
            sys.argv[1] = str(files[0])
            signal.alarm(3600)  # it has no guardian
            import_module("vibench.execution.worker").main()
        code = 0
    except SystemExit as error:
        code = error.code if isinstance(error.code, int) else int(error.code is not None)
    except BaseException:  # noqa: BLE001  as an interpreter prints it
        traceback.print_exc()
    finally:
        threading._shutdown()
        atexit._run_exitfuncs()
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError, ValueError):
                stream.flush()
        os._exit(code)
