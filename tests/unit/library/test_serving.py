import json
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from http.client import HTTPConnection
from pathlib import Path

import numpy as np
import pytest
from running import Main, read_until, refused, started
from samples import with_ways

import vibench
from vibench import interrupts
from vibench.library.serving import ModelServer
from vibench_problems.obstacle import Obstacle

umbridge = pytest.importorskip("umbridge")


def cell_of(run: vibench.Run, assembly: str, problem: str = "obstacle") -> str:
    cells = with_ways(run.cells).set_index(["primal", "problem", "assembly"])
    return str(cells.loc[("decorrelated", problem, assembly), "cell"])


@pytest.fixture
def server(small_run: vibench.Run, monkeypatch: pytest.MonkeyPatch) -> Iterator[ModelServer]:
    """A server in a thread, which ends with what it takes for the parent of this process."""
    monkeypatch.setenv("no_proxy", "*")
    parents, model = [1], small_run.model(cell_of(small_run, "certified"))
    with monkeypatch.context() as patch:
        patch.setattr(os, "getppid", lambda: parents[-1])
        with ModelServer(model, "127.0.0.1", 0) as server:
            # A daemon: whatever ends the tests early is not kept waiting by a server whose parent lives.
            thread = threading.Thread(target=server.serve, daemon=True)
            thread.start()
            try:
                yield server
            finally:
                parents.append(2)
                thread.join(10.0)
            assert not thread.is_alive()


def client_of(server: ModelServer) -> umbridge.HTTPModel:
    return umbridge.HTTPModel(f"http://127.0.0.1:{server.server_address[1]}", "obstacle")


def test_a_client_finds_answers_and_bounds_of_the_model(server: ModelServer, monkeypatch: pytest.MonkeyPatch) -> None:
    model, client = server.model, client_of(server)
    assert (client.get_input_sizes(), client.get_output_sizes()) == ([3], [len(server.outputs)] * 2)
    assert client.supports_evaluate()
    assert not client.supports_gradient()
    assert not client.supports_apply_hessian()
    for mu in [*model.parameters.sample(5, seed=2), model.parameters.upper]:
        own, found = model.solve(mu), client([mu.tolist()])
        bounds = [min(bound, sys.float_info.max) for bound in own.output_bounds.values()]
        assert found == [pytest.approx(list(own.outputs.values()), 1e-9), pytest.approx(bounds, 1e-9)]
        assert found[1][2] < 1.0
    with pytest.raises(Exception, match=r"InvalidInput: scale is 9.0, expected .* to "):
        client([[9.0, 0.0, 0.0]])

    def solve(mu: np.ndarray) -> None:
        raise ZeroDivisionError("by a plugin")

    monkeypatch.setattr(type(model), "solve", lambda self, mu: solve(mu))
    with pytest.raises(Exception, match=r"InvalidOutput: at mu = .*ZeroDivisionError: by a plugin"):
        client([mu.tolist()])


def test_what_is_no_request_gets_an_error_and_leaves_the_server_running(server: ModelServer) -> None:
    def ask(body: bytes | str, call: str = "POST /Evaluate", **headers: str) -> tuple[int, str, str]:
        connection = HTTPConnection(*server.server_address, timeout=60.0)
        connection.request(*call.split(), body, headers)
        answer = connection.getresponse()
        error = json.loads(answer.read())["error"]
        connection.close()
        return answer.status, error["type"], error["message"]

    def given(*inputs: object, **fields: object) -> str:
        return json.dumps({"name": "obstacle", "input": inputs, **fields})

    mu, *rest = server.model.parameters.lower.tolist()
    silent = HTTPConnection(*server.server_address, timeout=60.0)
    silent.connect()  # others are answered in the meantime
    one, bad, unknown = "expected one vector of numbers", (400, "InvalidInput"), (400, "ModelNotFound")
    for body, expected, said in (
        ("{", bad, "no JSON"), (b"\xff\xfe", bad, "no JSON"), ("[" * 100_000, bad, "no JSON"),
        ("[1]", bad, "an object"),
        (given([mu, *rest], config={"level": 1}), bad, "whose config, if any, is empty"), (given(), bad, one),
        (given([mu, *rest], [mu]), bad, one), (given(mu), bad, one), (given(rest), bad, one), (given({}), bad, one),
        (given([[mu, *rest]]), bad, one), (given(["1", *rest]), bad, one), (given([True, *rest]), bad, one),
        (given([np.nan, *rest]), bad, "finite numbers"), (given([10**400, *rest]), bad, "finite numbers"),
        (given([mu - 1.0, *rest]), bad, "scale is "), ("{}", unknown, "no model is called None"),
        (given([mu, *rest], name="cube"), unknown, "'cube'"), (" " * 2**22, bad, "at most 1048576"),
    ):  # fmt: skip
        code, kind, message = ask(body)
        assert (code, kind) == expected, (body[:80], message)
        assert said in message
    assert ask("{}", **{"Content-Length": "two"})[:2] == bad
    for call in ("POST /Gradient", "POST /elsewhere", "POST /Info", "GET /Evaluate"):
        assert ask(given([mu, *rest]), call)[:2] == (404, "UnsupportedFeature")
    assert ask("", "PUT /Evaluate")[:2] == (501, "InvalidInput")
    assert ask("", f"POST /{'x' * 100_000}")[:2] == (414, "InvalidInput")
    assert len(client_of(server)([[mu, *rest]])) == 2
    silent.close()


def test_ctrl_c_ends_the_command(small_run: vibench.Run, main: Main, monkeypatch: pytest.MonkeyPatch) -> None:
    def press(server: ModelServer) -> None:
        signal.raise_signal(signal.SIGINT)
        raise AssertionError("Ctrl-C is ignored")

    # The server itself presses the keys where it waits: a timer would press them in another test if this one failed.
    monkeypatch.setattr(ModelServer, "handle_timeout", press)
    with interrupts.restored():
        signal.signal(signal.SIGINT, signal.default_int_handler)  # tests in the background inherit it ignored
        code, out, err = main("serve", str(small_run.path.parent), cell_of(small_run, "reduced"), "--port", "0")
    assert (code, err) == (130, "vibench: interrupted\n")
    assert "lower deflection), no bounds: `umbridge.HTTPModel('http://127.0.0.1:" in out


def is_running(process: Path) -> bool:
    """Whether a process runs; one that has ended, and that nobody has waited for, has no command line."""
    try:
        return bool((process / "cmdline").read_bytes())
    except OSError:
        return False


@pytest.mark.long
def test_a_server_ends_with_its_parent(command: str, small_run: vibench.Run, tmp_path: Path) -> None:
    serve = f"{command} serve {small_run.path.parent} {cell_of(small_run, 'certified')} --port 0 & echo $!; wait"
    with started(["sh", "-c", serve], tmp_path, tmp_path) as shell:
        server = Path(f"/proc/{int(shell.stdout.readline())}")
        read_until(shell, "verified bounds: `umbridge.HTTPModel(")
        shell.kill()
        shell.wait()
        deadline = time.monotonic() + 30.0
        while is_running(server) and time.monotonic() < deadline:
            time.sleep(0.05)
        assert not is_running(server)


def test_what_cannot_be_served_is_refused(small_run: vibench.Run, main: Main, monkeypatch: pytest.MonkeyPatch) -> None:
    run, obstacle = str(small_run.path.parent), cell_of(small_run, "reduced")
    with monkeypatch.context() as patch:
        patch.setattr(Obstacle, "outputs", ())
        refused(main("serve", run, obstacle), "the problem has no outputs")
    refused(main("serve", run, obstacle, "--host", "256.0.0.1"), "no server can listen at '256.0.0.1', port 4242")
    refused(main("serve", run, obstacle, "--port", "65536"), "--port")
