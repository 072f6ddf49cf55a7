import contextlib
import os
import socket
import ssl
import struct
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import Future
from multiprocessing import forkserver
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.parse import urlsplit

import dask
import pytest
from distributed import LocalCluster
from distributed.security import Security
from distributed.utils import get_mp_context
from fake_stages import KillsItsSupervisor, Whole
from running import PATIENCE, Main, Vibench, assert_same_numbers, refused
from samples import wire_study, write_study
from template import TEMPLATE, template

from vibench import Study
from vibench.errors import ExecutorError, RequestError
from vibench.execution import executors
from vibench.execution.executors import Dask, Local
from vibench.execution.run import Observer, Options, run_study
from vibench.execution.supervisor import Job
from vibench.stages.artefacts import Store
from vibench.stages.base import Done, Stage


def elsewhere(_: str) -> tuple[bool, str, str]:
    """What a worker says that does not see the folder of the artefacts."""
    return executors._describe("/on/another/machine")


def job(stage: Stage, store: Path) -> Job:
    return Job(str(store), stage, 1.0, 60.0, 8.0)


@pytest.fixture(scope="module", autouse=True)
def forked_dask_workers() -> Iterator[None]:
    """Dask forks its workers from a process that has imported dask, here and in the processes that tests start.

    Here it has imported vibench as well, and worker processes of dask's workers are forked from that of the tests.
    """
    with (
        pytest.MonkeyPatch.context() as patch,
        dask.config.set({"distributed.worker.multiprocessing-method": "forkserver"}),
    ):
        patch.setenv("DASK_DISTRIBUTED__WORKER__MULTIPROCESSING_METHOD", "forkserver")
        get_mp_context().set_forkserver_preload(["distributed", "dask_preload"])
        with pytest.MonkeyPatch.context() as beginning:
            beginning.setenv("PYTHONPATH", os.pathsep.join(filter(None, sys.path)))
            beginning.setenv(TEMPLATE, template())
            forkserver.ensure_running()
        yield


@pytest.fixture(scope="module")
def cluster() -> Iterator[LocalCluster]:
    """A cluster as somebody might have it, with TCP between its processes."""
    options = {"protocol": "tcp", "dashboard_address": "127.0.0.1:0", "silence_logs": "CRITICAL"}
    with LocalCluster(n_workers=2, threads_per_worker=1, **options) as made:
        yield made


def test_local_workers_run_side_by_side(tmp_path: Path) -> None:
    """Each of two stages ends when the other one has begun, however late that is."""
    workers = Local(2, tmp_path / "log")
    try:
        stages = [Whole(f"meet {k}", str(tmp_path / "diary")) for k in range(2)]
        outcomes = [future.result() for future in [workers.submit(job(stage, tmp_path)) for stage in stages]]
        assert [type(outcome) for outcome in outcomes] == [Done, Done]
    finally:
        workers.close()
    processes = {line.split()[0] for line in (tmp_path / "diary").read_text().splitlines()}
    assert len(processes) == 2
    for process in processes:
        with pytest.raises(ProcessLookupError):
            os.kill(int(process), 0)
    assert not (tmp_path / "log").exists()  # nothing was printed


@pytest.mark.long
def test_a_cluster_somebody_has_is_used_and_left_alone(cluster: LocalCluster, tmp_path: Path) -> None:
    for k in range(2):
        workers = Dask(cluster.scheduler_address, 1, tmp_path)
        try:
            assert workers.slots == 2
            stage = Whole(f"fine {k}")
            assert isinstance(workers.submit(job(stage, tmp_path)).result(timeout=PATIENCE), Done)
            assert Store(tmp_path).get(stage.key) is not None
            diary = tmp_path / f"diary {k}"
            endless = workers.submit(job(Whole("sleep", str(diary)), tmp_path))
            while not diary.exists() or not diary.read_text():  # it is there before it is written
                time.sleep(0.05)
        finally:
            workers.close()
        worker = int(diary.read_text().split()[0])
        with pytest.raises(ProcessLookupError):  # nothing of ours goes on there
            os.kill(worker, 0)
        with pytest.raises(ExecutorError):
            endless.result(timeout=PATIENCE)
    assert list(tmp_path.glob("*.part")) == []


def test_a_dask_worker_that_dies_is_survived(cluster: LocalCluster, tmp_path: Path) -> None:
    workers = Dask(cluster.scheduler_address, 1, tmp_path)
    try:
        stages = [KillsItsSupervisor(str(tmp_path / f"diary {k}")) for k in range(2)]
        futures = [workers.submit(job(stage, tmp_path)) for stage in stages]
        for k, future in enumerate(futures):
            assert isinstance(future.result(timeout=PATIENCE), Done)
            assert len((tmp_path / f"diary {k}").read_text().splitlines()) >= 2  # it was begun again
    finally:
        workers.close()


@pytest.mark.long
def test_dask_workers_get_the_classes_of_a_notebook(cluster: LocalCluster, tmp_path: Path) -> None:
    names: dict[str, Any] = {"__name__": "__main__"}
    exec("import fake_plugins\nclass Mine(fake_plugins.Wire):\n    pass\n", names)
    problems = [names["Mine"], {"name": names["Mine"](9), "label": "short"}]
    tolerances = [{"pod": [1e-2], "dual": [1e-2]}]
    study = Study(
        name="mine", validation=3, solvers=["piqp"], problem=problems, dual=["cpg"], primal=["decorrelated"],
        tolerances=tolerances, timing_rounds=1,
    )  # fmt: skip
    options = Options(0, False, False, "dask", cluster.scheduler_address, 0)
    outcome = run_study(study, tmp_path, Observer(), options)
    assert sorted((row["problem"], row["status"]) for row in outcome.rows) == [("Mine", "ok"), ("short", "ok")]


@pytest.mark.parametrize(
    ("client", "job_status"), [("closed", "finished"), ("running", "finished"), ("running", "error")]
)
def test_a_client_that_closes_while_it_is_asked_holds_up_nobody(client: str, job_status: str) -> None:
    """The callbacks of all clients share one thread: a result that never comes would be the end of all later runs."""
    asked: list[float] = []

    def result(timeout: float) -> str:
        asked.append(timeout)
        if len(asked) < 3:
            raise TimeoutError
        return "outcome"

    ours: Future[Any] = Future()
    executors._hand_over(SimpleNamespace(client=SimpleNamespace(status=client), status=job_status, result=result), ours)
    if (client, job_status) != ("running", "finished"):
        with pytest.raises(ExecutorError, match="the dask cluster was lost"):
            ours.result(timeout=0)
    else:
        assert (ours.result(timeout=0), len(asked)) == ("outcome", 3)


def test_a_cluster_that_cannot_start_is_refused_in_a_line(tmp_path: Path) -> None:
    refused = pytest.raises(RequestError, match="dask cannot start its workers: ModuleNotFoundError: No module named")
    with dask.config.set({"distributed.nanny.preload": ["no_such_module"]}), refused:
        Dask(None, 1, tmp_path)


def test_other_code_or_store_is_refused(cluster: LocalCluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(executors, "code_here", lambda: "mine")
        with pytest.raises(RequestError, match=r"the dask worker tcp://.* has other code: .* instead of mine"):
            Dask(cluster.scheduler_address, 1, tmp_path)
    monkeypatch.setattr(executors, "_describe", elsewhere)
    with pytest.raises(RequestError, match="does not see the artefacts"):
        Dask(cluster.scheduler_address, 1, tmp_path)


def test_wrong_requests_for_dask_are_one_line(main: Main, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, there = write_study(tmp_path, wire_study(problem=["obstacle"])), "tcp://127.0.0.1:9"
    for options, expected in (
        (("--executor", "dask", "--scheduler", there), f"no dask scheduler answers at '{there}'"),
        (("--executor", "dask", "--scheduler", "tls://a:9"),
         "the scheduler 'tls://a:9' asks for credentials: set distributed.comm.tls of dask"),
        (("--scheduler", there), f"--scheduler {there} is for --executor dask"),
    ):  # fmt: skip
        code, _, err = main("run", path, *options)
        assert code == 2
        *warnings, line = err.splitlines()
        assert line.startswith(f"vibench: {expected}")
        unsafe = f"vibench: {there}: the connection is not authenticated"
        assert [warning.startswith(unsafe) for warning in warnings] == [True] * ("answers" in expected)
        assert "answers" in expected or line == f"vibench: {expected}"
    monkeypatch.setitem(sys.modules, "distributed", None)
    refused(main("run", path, "--executor", "dask"), "of vibench's extra 'cluster'")


@pytest.mark.parametrize(
    ("said", "words"),
    [
        (b"", "nothing within 0.5 s"),
        (struct.pack("<Q", 2**50) + bytes(99), "Error: "),
        (b"HTTP/1.1 400 Bad\r\n\r\n", "Error: "),
    ],
)
def test_a_port_that_is_no_scheduler_is_refused_in_a_line(said: bytes, words: str) -> None:
    """One accepts and says nothing, the others say how much they are about to say."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def answer() -> None:
            with contextlib.suppress(OSError):  # the server is closed
                while True:
                    taken.append(server.accept()[0])
                    taken[-1].sendall(said)

        taken: list[socket.socket] = []
        threading.Thread(target=answer, daemon=True).start()
        address = f"tcp://127.0.0.1:{server.getsockname()[1]}"
        with pytest.raises(RequestError, match=f"no dask scheduler answers at '{address}': .*{words}") as error:
            executors._greet(address, 60.0 if said else 0.5)
        assert "\n" not in str(error.value)
        for one in taken:
            one.close()


def test_a_cluster_of_this_machine_answers_nobody_else(tmp_path: Path) -> None:
    workers = Dask(None, 1, tmp_path)
    try:
        address = urlsplit(workers._cluster.scheduler_address)
        assert (address.scheme, address.hostname) == ("tls", "127.0.0.1")
        with socket.create_connection((address.hostname, address.port), timeout=PATIENCE) as plain:
            plain.sendall(bytes(64))
            assert answer(plain) == b""
        other = Security.temporary().get_connection_args("client")["ssl_context"]
        nobody = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        for context in (nobody, other):
            context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
            with socket.create_connection((address.hostname, address.port), timeout=PATIENCE) as plain:
                assert refusal(context, plain)
        stage = Whole("fine")
        assert isinstance(workers.submit(job(stage, tmp_path)).result(timeout=PATIENCE), Done)
    finally:
        workers.close()


def answer(connection: socket.socket) -> bytes:
    """What the scheduler says, "" if it hangs up."""
    try:
        return connection.recv(1)
    except ConnectionError:
        return b""


def refusal(context: ssl.SSLContext, plain: socket.socket) -> bool:
    """Whether the scheduler refuses the credentials of a client: with TLS 1.3 it says so after the handshake."""
    try:
        with context.wrap_socket(plain) as connection:
            return answer(connection) == b""
    except (ssl.SSLError, ConnectionError):
        return True


@pytest.mark.long
def test_dask_changes_no_number(vibench: Vibench, tmp_path: Path) -> None:
    study = wire_study(
        problem=[{"name": "wire", "options": {"nodes": 40}}], solvers=["piqp", "osqp", "gives-up"],
        primal=["online-supremizers", "offline-pga"],
        tolerances=[{"pod": [1e-3], "dual": [1e-2], "primal": {"offline-pga": [0.5]}}],
    )  # fmt: skip
    path = write_study(tmp_path, study)
    for executor, jobs in (("local", "1"), ("dask", "2")):
        done = vibench(tmp_path, "run", path, "--jobs", jobs, "--executor", executor, "--out", executor, "--fresh")
        assert (done.returncode, done.stderr) == (0, "")
    assert_same_numbers(tmp_path / "local", tmp_path / "dask")
