"""What the process has done from which dask forks its workers in tests: each of them would take a second for it.

It has imported vibench and read its sources, and the worker processes of dask's workers are forked as well.
"""

import os

import fake_stages  # noqa: F401  what these worker processes run
import forking

from vibench.execution import executors

TEMPLATE = "VIBENCH_TESTS_TEMPLATE"
"""Variable of the environment: the address of the template process of the tests."""

executors.code_here()
FORKED = forking.fork_workers(lambda: os.environ[TEMPLATE])
FORKED.__enter__()
