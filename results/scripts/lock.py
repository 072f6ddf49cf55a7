"""Writes requirements.lock: the versions that pip chooses today for everything that makes results, with hashes.

python results/scripts/lock.py

It has to run on Python 3.11 and Linux x86_64, for which the hashes are.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path

from page import start

ROOT = Path(__file__).parents[2]
EXTRAS = "solvers,nmf,hdf5,mesh"
HEAD = """\
# What results/ is made with: Python 3.11 on Linux x86_64, with the extras solvers, nmf, hdf5 and mesh, and what
# builds vibench. Hashes are of the files that pip chooses there. Made by `python results/scripts/lock.py`.
"""


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.json"
        asked = [f"{ROOT}[{EXTRAS}]", "hatchling"]
        pip = [sys.executable, "-m", "pip", "install", "--quiet", "--dry-run", "--ignore-installed"]
        subprocess.run([*pip, "--report", str(report), *asked], check=True)
        installed = json.loads(report.read_text(encoding="utf-8"))["install"]
    lines = sorted(_line(one) for one in installed if one["metadata"]["name"] != "vibench")
    (ROOT / "requirements.lock").write_text(HEAD + "\n".join(lines) + "\n", encoding="utf-8")


def _line(one: dict[str, dict[str, object]]) -> str:
    archive = one["download_info"]["archive_info"]
    assert isinstance(archive, dict)
    return (
        f"{str(one['metadata']['name']).lower()}=={one['metadata']['version']} \\\n"
        f"    --hash=sha256:{archive['hashes']['sha256']}"
    )


if __name__ == "__main__":
    start(main)
