"""Models as servers of UM-Bridge: the client finds the answers of the model, whatever others send to the server."""

import http.client
import json
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from running import Main, read_until, refused, started
from samples import with_ways

import vibench
from vibench.library.serving import ModelServer

umbridge = pytest.importorskip("umbridge")


def cell_of(run: vibench.Run, problem: str, assembly: str) -> str:
    cells = with_ways(run.cells).set_index(["primal", "problem", "assembly"])
    return str(cells.loc[("decorrelated", problem, assembly), "cell"])


@pytest.fixture(scope="module")
def model(small_run: vibench.Run) -> vibench.Model:
    return small_run.model(cell_of(small_run, "obstacle", "certified"))


@pytest.fixture
def server(model: vibench.Model, monkeypatch: pytest.MonkeyPatch) -> Iterator[ModelServer]:
    monkeypatch.setenv("no_proxy", "*")
    with ModelServer(model, "127.0.0.1", 0) as server:
        parent = [os.getppid()]
        with monkeypatch.context() as patch:
            patch.setattr(os, "getppid", lambda: parent[0])
            thread = threading.Thread(target=server.serve)
            thread.start()
            yield server
            parent[0] = 0
            thread.join(10.0)
            assert not thread.is_alive()


def url(server: ModelServer) -> str:
    return f"http://127.0.0.1:{server.server_address[1]}"


def test_a_client_finds_the_answers_and_bounds_of_the_model(server: ModelServer) -> None:
    model, names = server.model, [output.name for output in server.model.problem.outputs]
    assert umbridge.supported_models(url(server)) == ["obstacle"]
    client = umbridge.HTTPModel(url(server), "obstacle")
    assert (client.get_input_sizes(), client.get_output_sizes()) == ([3], [3, 3])
    assert (client.supports_evaluate(), client.supports_gradient(), client.supports_apply_jacobian()) == (
        True,
        False,
        False,
    )
    for mu in [*model.parameters.sample(5, seed=2), model.parameters.upper]:
        own, found = model.solve(mu), client([mu.tolist()])
        bounds = [min(own.output_bounds[name], sys.float_info.max) for name in names]
        assert found == [pytest.approx([own.outputs[name] for name in names], 1e-9), pytest.approx(bounds, 1e-9)]
        assert found[1][2] < 1.0
    with pytest.raises(Exception, match=r"InvalidInput: scale is 9.0, expected .* to "):
        client([[9.0, 0.0, 0.0]])


def test_what_is_no_request_gets_an_error_and_leaves_the_server_running(server: ModelServer) -> None:
    def ask(body: bytes | str, path: str = "/Evaluate", method: str = "POST", **headers: str) -> tuple[int, str, str]:
        connection = http.client.HTTPConnection(*server.server_address, timeout=60.0)
        connection.request(method, path, body, headers)
        answer = connection.getresponse()
        error = json.loads(answer.read())["error"]
        connection.close()
        return answer.status, error["type"], error["message"]

    def named(**fields: object) -> str:
        return json.dumps({"name": "obstacle", **fields})

    mu = server.model.parameters.lower.tolist()
    silent = http.client.HTTPConnection(*server.server_address, timeout=60.0)
    silent.connect()  # and others are answered in the meantime
    bad, inputs = (
        (400, "InvalidInput"),
        ([mu, mu], mu, [mu[:2]], [[*mu, 1.0]], [[[*mu]]], [["1", *mu[1:]]], [[True, *mu[1:]]]),
    )
    for body, expected, said in (
        ("{", bad, "the body is no JSON"), (b"\xff\xfe", bad, "the body is no JSON"), ("[" * 100_000, bad, "no JSON"),
        ("[1]", bad, "expected an object"), (named(config={"level": 1}), bad, "whose config, if any, is empty"),
        *((named(input=given), bad, "expected") for given in (None, {}, *inputs)),
        (named(input=[[np.nan, *mu[1:]]]), bad, "finite numbers"), (named(input=[[10**400, *mu[1:]]]), bad, "finite"),
        (named(input=[[mu[0] - 1.0, *mu[1:]]]), bad, "scale is "),
        ("{}", (400, "ModelNotFound"), "no model is called None"),
        (named(name="cube"), (400, "ModelNotFound"), "'cube'"), (" " * 2**22, bad, "at most 1048576"),
    ):  # fmt: skip
        code, kind, message = ask(body)
        assert (code, kind) == expected, (body[:80], message)
        assert said in message
    assert ask("{}", **{"Content-Length": "two"})[:2] == bad
    for path, method in (("/Gradient", "POST"), ("/elsewhere", "POST"), ("/Info", "POST"), ("/Evaluate", "GET")):
        assert ask(named(), path, method)[:2] == (404, "UnsupportedFeature")
    assert ask("", "/Evaluate", "PUT")[:2] == (501, "InvalidInput")
    assert ask("", "/" + "x" * 100_000)[:2] == (414, "InvalidInput")
    assert len(umbridge.HTTPModel(url(server), "obstacle")([mu])) == 2
    silent.close()


def test_answers_that_are_not_ok_are_errors(server: ModelServer, monkeypatch: pytest.MonkeyPatch) -> None:
    def assemble(mu: np.ndarray) -> None:
        raise ZeroDivisionError("by a plugin")

    client = umbridge.HTTPModel(url(server), "obstacle")
    monkeypatch.setattr(server.model.reduced, "assemble", assemble)
    with pytest.raises(Exception, match=r"InvalidOutput: at mu = .*ZeroDivisionError: by a plugin"):
        client([server.model.parameters.lower.tolist()])


def test_ctrl_c_ends_the_command(small_run: vibench.Run, main: Main, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(server: ModelServer) -> None:
        monkeypatch.undo()
        threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGINT)).start()
        server.serve()

    monkeypatch.setattr(ModelServer, "serve", interrupt)
    code, out, err = main("serve", str(small_run.path.parent), cell_of(small_run, "obstacle", "reduced"), "--port", "0")
    assert (code, err) == (130, "vibench: interrupted\n")
    assert "(contact force, contact area, deflection), no bounds: `umbridge.HTTPModel('http://127.0.0.1:" in out


def test_a_server_ends_with_its_parent(command: str, small_run: vibench.Run, tmp_path: Path) -> None:
    serve = f"{command} serve {small_run.path.parent} {cell_of(small_run, 'obstacle', 'certified')} --port 0"
    with started(["sh", "-c", f"{serve} & echo $!; wait"], tmp_path, tmp_path) as shell:
        pid = int(shell.stdout.readline())
        read_until(shell, "verified bounds: `umbridge.HTTPModel(")
        shell.kill()
        shell.wait()
        deadline = time.monotonic() + 30.0
        while Path(f"/proc/{pid}").exists() and time.monotonic() < deadline:
            time.sleep(0.05)
        assert not Path(f"/proc/{pid}").exists()


def test_what_cannot_be_served_is_refused(small_run: vibench.Run, main: Main) -> None:
    run = str(small_run.path.parent)
    without = main("serve", run, cell_of(small_run, "radial-obstacle", "reduced"))
    refused(without, "the problem has no outputs")
    obstacle = cell_of(small_run, "obstacle", "reduced")
    refused(main("serve", run, obstacle, "--host", "256.0.0.1"), "no server can listen at '256.0.0.1', port 4242")
    refused(main("serve", run, obstacle, "--port", "65536"), "--port")
    refused(main("serve", run, "nothing"), "nothing")
