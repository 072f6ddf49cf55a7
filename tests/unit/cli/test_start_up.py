"""Help imports none of the libraries that take most of the time to start, and completion of names none but pydantic."""

import os
import subprocess
import sys

HEAVY = {"numpy", "scipy", "pandas", "matplotlib", "pydantic", "qpsolvers", "rich", "skfem", "vibench_problems"}


def imported(command: str, *arguments: str, **environment: str) -> tuple[set[str], str]:
    """Top-level packages that a process of the installed command imports, and what it prints."""
    line = [sys.executable, "-X", "importtime", command, *arguments]
    done = subprocess.run(line, env=os.environ | environment, capture_output=True, text=True, check=True)
    lines = [line for line in done.stderr.splitlines() if line.startswith("import time:")]
    return {line.rsplit("|", 1)[1].strip().split(".")[0] for line in lines}, done.stdout


def test_help_lists_and_completion_import_no_library_they_do_not_need(command: str) -> None:
    """All commands are defined before any prints its help: one stands for the others."""
    for name in ("", "export"):
        packages, printed = imported(command, *name.split(), "--help")
        assert printed.startswith(f"Usage: vibench {name}".rstrip())
        assert "vibench" in packages
        assert packages & HEAVY == set()
    packages, printed = imported(command, "list")
    assert "obstacle" in printed
    assert packages & {"scipy", "pandas", "skfem", "qpsolvers", "matplotlib"} == set()
    packages, printed = imported(command, "list", "problems")
    assert "resolution: " in printed
    assert "skfem" in packages
    assert packages & {"pandas", "matplotlib", "qpsolvers"} == set()
    for line, word in (
        ("r", "replay"), ("run --dual ", "mcpg"), ("show quick --table ", "histories"),
        ("check obstacle --option ", "resolution="),
    ):  # fmt: skip
        words = {"COMP_WORDS": f"vibench {line}", "COMP_CWORD": str(line.count(" ") + 1)}
        packages, printed = imported(command, _VIBENCH_COMPLETE="complete_bash", **words)
        assert word in printed.split()
        assert "vibench" in packages
        package = {"vibench_problems"} if "--option" in line else set()  # the package that holds the module
        assert packages & (HEAVY - {"pydantic"}) == package  # typer itself checks the words before with pydantic
