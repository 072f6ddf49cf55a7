"""Figures 3 to 15 of Niakh et al. (2022), drawn again from runs of paper-obstacle, paper-hertz or hertz-direct."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from vibench import RequestError, open_run
from vibench_problems.paper.figures import PAGE, draw_again


def main(arguments: Sequence[str] | None = None) -> int:
    """Draw the figures and say where their page is; the exit code is 2 if there is nothing to draw."""
    parser = argparse.ArgumentParser("python -m vibench_problems.paper", description=__doc__)
    parser.add_argument("runs", metavar="RUN", nargs="+", help="a run folder, or its name in runs/")
    parser.add_argument("--out", metavar="DIR", type=Path, default=Path("paper-figures"), help="default: paper-figures")
    parser.add_argument("--format", dest="formats", action="append", choices=("png", "svg", "pdf"), help="repeatable")
    given = parser.parse_args(arguments)
    try:
        runs = list({run.path.resolve(): run for run in map(open_run, given.runs)}.values())
        files = draw_again(runs, given.out, given.formats or ("png", "svg"), print)
    except RequestError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(f"{len(files)} figures: {given.out}", f"page: {given.out / PAGE}", sep="\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
