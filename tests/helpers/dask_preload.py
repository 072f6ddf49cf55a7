"""What the process has done from which dask forks its workers in tests: each of them would take a second for it.

It has imported vibench and read its sources, and the worker processes of dask's workers are forked as well.
"""

import fake_stages  # noqa: F401  what these worker processes run
import forking

from vibench.execution import executors

executors.code_here()
FORKED = forking.fork_workers()
FORKED.__enter__()
