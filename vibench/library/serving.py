"""A reduced model as a server of UM-Bridge 1.0, JSON over HTTP: its outputs, and bounds of their errors."""

from __future__ import annotations

import json
import os
import sys
import warnings
from http.server import BaseHTTPRequestHandler
from socketserver import ThreadingTCPServer
from threading import Lock
from typing import Any

import numpy as np

from vibench.errors import NumericalError, RequestError, VibenchError, at_parameter, message_of
from vibench.interfaces.parameters import outside
from vibench.offline.models import Model, parameter_in
from vibench.qp.status import Status
from vibench.text import shown


class ModelServer(ThreadingTCPServer):
    """A server of a model by the name of its problem; a `RequestError` without outputs, or at a wrong address."""

    allow_reuse_address = daemon_threads = True

    def __init__(self, model: Model, host: str, port: int) -> None:
        self.model, self.lock, self.outputs = model, Lock(), [output.name for output in model.problem.outputs]
        self.name = str(model.row.get("problem") or type(model.problem).__name__)
        if not self.outputs:
            raise RequestError("the problem has no outputs, with which a server would answer")
        # Taken before anybody is told of the server, who may end.
        self.timeout, self._parent = 0.5, os.getppid()
        sizes = [len(self.outputs)] * (1 if model.certificate is None else 2)
        able = {"Evaluate": True, "Gradient": False, "ApplyJacobian": False, "ApplyHessian": False}
        self.fixed: dict[str, dict[str, Any]] = {
            "GET /Info": {"protocolVersion": 1.0, "models": [self.name]}, "POST /ModelInfo": {"support": able},
            "POST /InputSizes": {"inputSizes": [model.parameters.dim]}, "POST /OutputSizes": {"outputSizes": sizes},
        }  # fmt: skip
        try:
            super().__init__((host, port), _Request)
        except (OSError, UnicodeError) as error:
            raise RequestError(f"no server can listen at '{host}', port {port}: {message_of(error)}") from None

    def serve(self) -> None:
        """Answer requests while the parent of this process lives, for which it looks twice a second."""
        while os.getppid() == self._parent:
            self.handle_request()

    def evaluate(self, given: Any) -> list[list[float]]:
        """Outputs at the input of a request, and their bounds; a `VibenchError` says why there are none."""
        box, vector = self.model.parameters, given[0] if isinstance(given, list) and len(given) == 1 else None
        if not isinstance(vector, list) or [type(one) in {int, float} for one in vector] != [True] * box.dim:
            raise RequestError(f"input is {shown(given)}, expected one vector of numbers [[{', '.join(box.names)}]]")
        # One after the other: neither warnings nor plugins know of threads.
        with self.lock, warnings.catch_warnings(action="ignore"):
            mu = parameter_in(box, vector)
            for k in np.flatnonzero(outside(box, mu))[:1]:
                raise RequestError(f"{box.names[k]} is {mu[k]}, expected {box.lower[k]} to {box.upper[k]}")
            with at_parameter(mu):
                solution = self.model.solve(mu)
                if solution.status is not Status.OK:
                    raise NumericalError(f"{solution.status.value}: {solution.reason}")
                found = [solution.outputs] + [solution.output_bounds] * (self.model.certificate is not None)
        # JSON has no infinity; the largest number is a bound of all others.
        return [[min(values[name], sys.float_info.max) for name in self.outputs] for values in found]


class _Request(BaseHTTPRequestHandler):
    """A request in a thread, which is answered by what it asks for or by an error of the protocol."""

    server: ModelServer

    def setup(self) -> None:
        # A client that says nothing for a minute has no thread any longer.
        self.request.settimeout(60.0)
        super().setup()

    def do_GET(self) -> None:
        server, call = self.server, f"{self.command} {self.path}"
        try:
            asked = self._asked() if self.command == "POST" else {"name": server.name}
            if asked.get("name") != server.name:
                self.send_error(400, f"no model is called {shown(asked.get('name'))}", "ModelNotFound")
            elif call == "POST /Evaluate":
                self._reply(200, {"output": server.evaluate(asked.get("input"))})
            elif call in server.fixed:
                self._reply(200, server.fixed[call])
            else:
                known = ", ".join([*server.fixed, "POST /Evaluate"])
                self.send_error(404, f"{shown(call)} is not supported: {known}", "UnsupportedFeature")
        except RequestError as error:
            self.send_error(400, str(error))
        except VibenchError as error:
            self.send_error(500, str(error), "InvalidOutput")

    do_POST = do_GET  # noqa: N815  the name that the base class looks for

    def _asked(self) -> dict[str, Any]:
        """The object in the body."""
        text = self.headers.get("Content-Length", "")
        left = int(text) if text.isdecimal() and len(text) < 20 else -1
        if not 0 <= left <= 2**20:
            # A client looks for an answer when all that it sends has been read.
            while left > 0 and (piece := self.rfile.read(min(left, 2**16))):
                left -= len(piece)
            raise RequestError("the Content-Length of the body is not a number of at most 1048576")
        try:
            asked = json.loads(self.rfile.read(left))
        except (ValueError, RecursionError) as error:
            raise RequestError(f"the body is no JSON: {message_of(error)}") from None
        if not isinstance(asked, dict) or asked.get("config"):
            raise RequestError(f"the body is {shown(asked)}, expected an object whose config, if any, is empty")
        return asked

    def _reply(self, status: int, answer: dict[str, Any]) -> None:
        content = json.dumps(answer, allow_nan=False).encode()
        self.send_response(status)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Refuse a request with an error of the protocol, also where the base class sends a page."""
        self._reply(code, {"error": {"type": explain or "InvalidInput", "message": message or "no request"}})

    def log_message(self, *_: Any) -> None:
        """Print nothing: a chain makes thousands of requests."""
