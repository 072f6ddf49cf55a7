"""Figures 3 to 15 of the paper, drawn again, with a page that compares: `vibench figures --paper`, in smaller files.

python results/paper_figures.py runs/paper-obstacle runs/paper-hertz runs/hertz-direct
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

from palette import use_palette

from vibench.report.figures.publication import draw_published
from vibench.results import tables

TARGET = Path(__file__).with_name("paper-figures")


def main() -> None:
    if len(sys.argv) < 2:
        sys.exit("usage: python results/paper_figures.py RUN…")
    paths = [tables.results_file(run) for run in sys.argv[1:]]
    shutil.rmtree(TARGET, ignore_errors=True)
    for file in draw_published(paths, TARGET, ("png",), note=print):
        use_palette(file)


if __name__ == "__main__":
    main()
