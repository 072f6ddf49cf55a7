"""The page of `python -m vibench_problems.paper`, Figures 3 to 15 of the paper drawn again, with smaller files.

python results/scripts/paper_figures.py runs/paper-obstacle runs/paper-hertz runs/hertz-direct results/paper-figures
"""

from __future__ import annotations

import shutil
from pathlib import Path

from page import limitations, start, use_palette

from vibench import open_run
from vibench_problems.paper.figures import draw_again


def main(obstacle: str, hertz: str, direct: str, target: str) -> None:
    runs = [open_run(run) for run in (obstacle, hertz, direct)]
    shutil.rmtree(target, ignore_errors=True)
    for file in draw_again(runs, Path(target), ("png",), print):
        use_palette(file)
    (written,) = Path(target).glob("*.md")
    with written.open("a", encoding="utf-8") as end:
        end.write(limitations(Path(target)))


if __name__ == "__main__":
    start(main)
