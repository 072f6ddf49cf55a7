"""What a cell costs the runner: CPU seconds of the process that plans, starts and records, and its memory.

    python tests/benchmarks/cells.py FOLDER [NUMBER OF CELLS …]

Studies of 200, 2,000 and 20,000 cells of a wire of four nodes (the last one takes a quarter of an hour on two cores)
are run below FOLDER where they are missing, each in a process of its own; neither the seconds of workers nor those of
imports count. Then `show`, `report` and `compare` read the run. Exit code 1 if a cell of a larger study costs more than
1.5 times one of the smallest, the runner takes 1 GiB, or one of the commands 30 CPU seconds.
"""

import json
import os
import resource
import subprocess
import sys
import sysconfig
import time
from pathlib import Path

import numpy as np

import vibench
from vibench.execution.run import Options, run_study
from vibench.library.progress import ProgressDisplay
from vibench.results.sqlite import FILE

sys.path.insert(0, str(Path(__file__).parents[1] / "helpers"))
from fake_plugins import Wire

GRIDS = {200: (5, 4), 2_000: (20, 10), 20_000: (50, 40)}
"""Tolerances of the POD and of the cone, by the number of cells; each pair has `ACCURACIES`."""

ACCURACIES = [10.0 ** -(4.0 + k / 4.0) for k in range(10)]

GROWTH, GIB, SECONDS = 1.5, 1.0, 30.0
"""What is asked for: see above."""


def study_of(cells: int) -> vibench.Study:
    pod, dual = (np.geomspace(1e-1, 1e-3, count).tolist() for count in GRIDS[cells])
    return vibench.Study(
        name="cells", validation=1, solvers=["piqp"], problem=[{"name": Wire, "options": {"nodes": 4}}],
        dual=["cpg"], primal=["decorrelated"], accuracy=ACCURACIES, tolerances=[{"pod": pod, "dual": dual}],
        timing_rounds=1,
    )  # fmt: skip


def run(cells: int, folder: Path) -> None:
    start = time.process_time()
    with ProgressDisplay() as progress:
        run_study(study_of(cells), folder, progress, Options(2, False, False, "local", None, 0))
    spent = time.process_time() - start
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20  # KiB on Linux
    (folder / "cost.json").write_text(json.dumps([spent, peak]))


def cost(cells: int, folder: Path) -> tuple[float, float]:
    """CPU seconds of the runner, and its memory in GiB."""
    noted = folder / "cost.json"
    if not noted.exists():
        folder.mkdir(parents=True, exist_ok=True)
        environment = os.environ | {"VIBENCH_CACHE": str(folder.with_name(f"{folder.name}-cache"))}
        with folder.with_suffix(".printed").open("w") as printed:
            command = [sys.executable, __file__, "--run", str(cells), str(folder)]
            subprocess.run(command, env=environment, stdout=printed, check=True)
    seconds, peak = json.loads(noted.read_text())
    return seconds, peak


def seconds_of(*arguments: str) -> float:
    """CPU seconds of a command of vibench and of its processes."""
    before = os.times()
    subprocess.run([str(Path(sysconfig.get_path("scripts")) / "vibench"), *arguments], check=True, capture_output=True)
    after = os.times()
    return after.children_user + after.children_system - before.children_user - before.children_system


def main(folder: Path, sizes: list[int]) -> int:
    missed, least = False, 0.0
    for cells in sizes:
        results = folder / str(cells)
        seconds, peak = cost(cells, results)
        path, page = str(results / FILE), str(results / "report.html")
        asked = {"show": ("show", path), "report": ("report", path, "--out", page), "compare": ("compare", path, path)}
        read = {name: seconds_of(*arguments) for name, arguments in asked.items()}
        least = least or seconds / cells
        missed |= seconds / cells > GROWTH * least or peak > GIB or max(read.values()) > SECONDS
        taken = ", ".join(f"{name} {value:.1f} s" for name, value in read.items())
        print(f"{cells:6d} cells: {1e3 * seconds / cells:.1f} ms a cell, {peak:.2f} GiB; {taken}", flush=True)
    return int(missed)


if __name__ == "__main__":
    if sys.argv[1] == "--run":
        run(int(sys.argv[2]), Path(sys.argv[3]))
    else:
        sys.exit(main(Path(sys.argv[1]), [int(size) for size in sys.argv[2:]] or list(GRIDS)))
