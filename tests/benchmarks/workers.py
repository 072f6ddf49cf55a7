"""Wall time of a study on one worker, on two, and on a dask cluster of two over TCP; do their numbers agree?

    python tests/benchmarks/workers.py FOLDER [STUDY] [ARGUMENT OF vibench run …]

Every run begins from nothing, in a folder of its own below FOLDER. Exit code 1 if a number besides times differs, or
two workers take more than 65 % of the wall time of one.
"""

import os
import subprocess
import sys
import sysconfig
import time
from collections.abc import Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "helpers"))

from running import assert_same_numbers

TWO = ("--jobs", "2")
WAYS = {"one worker": ("--jobs", "1"), "two workers": TWO, "dask, two workers": (*TWO, "--executor", "dask")}


def wall(folder: Path, study: str, arguments: Sequence[str]) -> float:
    """Seconds of one run; one that ended before is not done again."""
    noted = folder / "seconds"
    if not noted.exists():
        command = [str(Path(sysconfig.get_path("scripts")) / "vibench"), "run", study, "--out", str(folder / "run")]
        environment = os.environ | {"VIBENCH_CACHE": str(folder / "cache")}
        folder.mkdir(parents=True, exist_ok=True)
        start = time.perf_counter()
        with (folder / "printed").open("w") as printed:
            subprocess.run([*command, *arguments], env=environment, stdout=printed, check=True)
        noted.write_text(f"{time.perf_counter() - start:.1f}")
    return float(noted.read_text())


def main(folder: Path, study: str, more: Sequence[str]) -> int:

    slow, alone = False, 0.0
    for way, arguments in WAYS.items():
        place = folder / way.replace(",", "").replace(" ", "-")
        seconds = wall(place, study, [*arguments, *more])
        alone = alone or seconds
        slow |= way != next(iter(WAYS)) and seconds > 0.65 * alone
        print(f"{way:20s} {seconds:8.1f} s  {seconds / alone:5.0%}", flush=True)
        assert_same_numbers(folder / "one-worker" / "run", place / "run")
    print("numbers besides times are the same; those of solvers that do not repeat themselves, to round-off")
    return int(slow)


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), sys.argv[2] if len(sys.argv) > 2 else "quick", sys.argv[3:]))
