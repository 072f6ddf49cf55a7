"""Seeded faults: each is put into a copy of the sources, and the tests have to notice it.

    python tests/mutations.py [NAME …]

Tests that mirror the changed file run first, all others if those pass. Prints which test caught which fault; exit code
1 if one survives, or if the tests fail on the copy as it is.
"""

import os
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
IMPORTED = ("", "problems", "strategies", "tests", "tests/helpers")
PATIENCE = 600
"""Seconds after which tests that do not end count as failed."""


@dataclass(frozen=True)
class Fault:
    """A fault: the text `right`, found once in a file, becomes `wrong`; `tests` are those that mirror the file."""

    name: str
    file: str
    right: str
    wrong: str
    tests: tuple[str, ...]


FAULTS = tuple(
    Fault(name, **{**table, "tests": tuple(table["tests"])})
    for name, table in tomllib.loads((ROOT / "tests" / "faults.toml").read_text(encoding="utf-8")).items()
)


def changed(root: Path, fault: Fault) -> str:
    """The text of the faulty file; refuses a fault that no longer fits the sources."""
    text = (root / fault.file).read_text(encoding="utf-8")
    if text.count(fault.right) != 1:
        raise SystemExit(f"{fault.name}: found {text.count(fault.right)} times in {fault.file}, expected once")
    return text.replace(fault.right, fault.wrong)


def first_failure(root: Path, tests: Sequence[str]) -> str | None:
    paths = os.pathsep.join(str(root / folder) for folder in IMPORTED)
    command = [sys.executable, "-m", "pytest", "-x", "-p", "no:cacheprovider", "--tb=no", "-rfE", *tests]
    environment = {**os.environ, "PYTHONPATH": paths, "PYTHONDONTWRITEBYTECODE": "1"}
    try:
        done = subprocess.run(
            command, cwd=root, env=environment, capture_output=True, text=True, check=False, timeout=PATIENCE
        )
    except subprocess.TimeoutExpired:
        return f"no end within {PATIENCE} s"
    if done.returncode == 0:
        return None
    failed = re.search(r"^(?:FAILED|ERROR) (.+?)(?: - .*)?$", done.stdout, re.MULTILINE)
    if done.returncode != 1 or not failed:
        raise SystemExit(f"the tests could not be run:\n{done.stdout[-2000:]}{done.stderr[-2000:]}")
    return failed[1]


def copy_of_sources(folder: str) -> Path:
    ignored = shutil.ignore_patterns(".git", ".venv", "runs", "__pycache__", ".*_cache", ".hypothesis")
    return Path(shutil.copytree(ROOT, Path(folder) / "copy", ignore=ignored))


def caught(fault: Fault) -> str | None:
    with tempfile.TemporaryDirectory() as folder:
        root = copy_of_sources(folder)
        (root / fault.file).write_text(changed(root, fault), encoding="utf-8")
        # That file says whether the faults fit the sources, and so fails on every copy with a fault.
        others = ["tests", "--ignore=tests/faults/test_mutations.py"]
        return first_failure(root, fault.tests) or first_failure(root, others)


def main(names: Sequence[str]) -> int:
    """Try the faults with these names, or all; the number of those that survive."""
    chosen = [fault for fault in FAULTS if not names or fault.name in names]
    if unknown := set(names) - {fault.name for fault in FAULTS}:
        raise SystemExit(f"no fault named {', '.join(sorted(unknown))}")
    mirrored = sorted({test for fault in chosen for test in fault.tests})
    with tempfile.TemporaryDirectory() as folder:
        broken = first_failure(copy_of_sources(folder), mirrored)
    if broken:
        raise SystemExit(f"{broken} fails without any fault")
    survivors = 0
    with ThreadPoolExecutor(2) as pool:
        for fault, test in zip(chosen, pool.map(caught, chosen), strict=True):
            survivors += test is None
            print(f"{fault.name:40s} {test or 'SURVIVED'}", flush=True)
    print(f"{len(chosen)} faults, {survivors} survived")
    return 1 if survivors else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
