"""Makes all pages of results anew: runs the command that every page names, in the order of the overview.

python results/scripts/everything.py FOLDER

Runs are kept in FOLDER/runs, pages are written into FOLDER/results, FOLDER/docs and FOLDER/README.md. A study that
several pages need runs once. FOLDER/done.txt lists what has ended: after an interruption, the same command goes on.
`--list` as FOLDER prints the commands.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

from page import start

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "results"
LINK = re.compile(r"^\| \[[^\]]+\]\(([^)]+\.md)\)", re.MULTILINE)
MADE_BY = re.compile(r"^(?:Generated|Drawn) by `([^`]+)`", re.MULTILINE)
REPRODUCTION = re.compile(r"made by\n\n```\n(.+?)\n```", re.DOTALL)

SMALLER = {
    "python -m vibench_problems.paper paper-obstacle paper-hertz hertz-direct": (
        "python results/scripts/paper_figures.py runs/paper-obstacle runs/paper-hertz runs/hertz-direct "
        "results/paper-figures"
    )
}
"""What writes a page with files that are smaller than those of the command that it names."""


CONCLUSIONS = (
    "python tests/benchmarks/certified.py runs/certified --table results/certified/unseen.csv",
    "python results/scripts/one_picture.py results docs/one-picture.png",
    "python docs/sentences.py",
)
"""What is made from tables of several pages, in the end."""


def main(folder: str) -> None:
    if folder == "--list":
        print("\n".join(commands()))
        return
    target, done = Path(folder), Path(folder) / "done.txt"
    if not done.exists():
        for part in ("results", "docs", "tests", "examples"):
            shutil.copytree(ROOT / part, target / part, dirs_exist_ok=True)
        shutil.copy(ROOT / "README.md", target)
        # Its script keeps the rows that its table has.
        (target / "results" / "calibration" / "chains.csv").unlink()
        done.touch()
    ended = done.read_text(encoding="utf-8").splitlines()
    for command in commands():
        if command not in ended:
            print(command, flush=True)
            subprocess.run(command, shell=True, check=True, cwd=target, env=os.environ)
            with done.open("a", encoding="utf-8") as file:
                file.write(f"{command}\n")


def commands() -> Iterator[str]:
    """The commands of all pages, each once."""
    pages = [RESULTS / name for name in LINK.findall((RESULTS / "README.md").read_text(encoding="utf-8"))]
    lines = [MADE_BY.findall(page.read_text(encoding="utf-8"))[0] for page in pages]
    lines += REPRODUCTION.findall((ROOT / "docs" / "reproduction.md").read_text(encoding="utf-8"))[0].splitlines()
    parts = [SMALLER.get(part.strip(), part.strip()) for line in lines for part in line.split("&&")]
    # what reads runs comes after all of them, since a page may need those of several studies
    runs = [part for part in parts if part.startswith("vibench run ")]
    studies: dict[str, str] = {}
    for run in runs:  # pages that need the same study may ask for less of it; no page needs its figures
        study = run.split()[2]
        studies[study] = max(studies.get(study, ""), run, key=len)
    yield from studies.values()
    yield from dict.fromkeys(part for part in parts if not part.startswith("vibench run "))
    yield from CONCLUSIONS


if __name__ == "__main__":
    start(main)
