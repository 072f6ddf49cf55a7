"""The command that times plugins."""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Exit, Option

from vibench.cli.completion import plugins, studies
from vibench.cli.console import echo, print_frame
from vibench.cli.result_commands import FormOption
from vibench.errors import RequestError

if TYPE_CHECKING:
    import pandas as pd

    from vibench.benchmarks.files import Timed


REST = "--format csv"
"""Option that prints the columns for which a terminal is too narrow."""

PRIORITY = (
    "verdict", "problem", "dual", "primal", "formulation", "size", "solver", "accuracy", "median [ms]", "before [ms]",
    "after [ms]", "ratio", "quartiles [ms]", "reached", "status", "rounds", "apart",
)  # fmt: skip
"""Columns, those that matter most first."""


def bench_plugins(
    plugin: Annotated[
        list[str] | None,
        Argument(
            metavar="PLUGIN",
            help="Names, or problem|primal|dual|formulation|solver:NAME; all by default.",
            autocompletion=plugins,
        ),
    ] = None,
    out: Annotated[Path | None, Option(metavar="FILE", help="Keep the JSON file of pytest-benchmark.")] = None,
    against: Annotated[Path | None, Option(metavar="FILE", help="Compare with an earlier file.")] = None,
    read: Annotated[Path | None, Option(metavar="FILE", help="Time nothing: read a file that was kept.")] = None,
    resolution: Annotated[
        list[str] | None, Option(metavar="NAME", help="Resolution of the problems (repeatable); coarse by default.")
    ] = None,
    study: Annotated[
        str, Option(help="Study whose strategies complete what is timed.", autocompletion=studies)
    ] = "quick",
    seconds: Annotated[float, Option(min=0.001, help="Seconds for each benchmark, about.")] = 1.0,
    limit: Annotated[float, Option(min=1.0, help="Factor by which a median may grow.")] = 1.25,
    form: FormOption = "terminal",
) -> None:
    """Time plugins in every stage, with what they reach.

    Each benchmark in which one of the plugins takes part is timed. Exit code 1 if one fails, or something is slower or
    less accurate than in the file of --against.
    """
    from vibench.benchmarks import comparison, files
    from vibench.results import formats

    earlier = files.read_benchmarks(against) if against is not None else None
    failed = 0
    if read is not None:
        if plugin or out is not None:
            raise RequestError("--read times nothing: leave out the plugins and --out")
        timed = files.read_benchmarks(read)
    else:
        timed, failed = _timed(plugin or [], out, resolution or ["coarse"], study, seconds)
    frame = comparison.table_of(timed, earlier, limit)
    if form == "terminal":
        print_benchmarks(timed, earlier, limit, failed)
    else:
        sys.stdout.write(formats.FORMS[form](frame))
    if failed or (earlier is not None and comparison.regressions(frame)):
        raise Exit(1)


def _timed(
    plugins: list[str], out: Path | None, resolutions: list[str], study: str, seconds: float
) -> tuple[Timed, int]:
    """What was timed, kept in a file if asked to, and how many benchmarks failed."""
    from vibench.benchmarks import cases, files, running
    from vibench.files import write_atomically

    running.check_installed()
    setting, chosen = cases.setting(study), cases.chosen_plugins(plugins)
    benchmarks = running.planned(chosen, cases.resolutions(resolutions), setting)
    if out is not None and not out.absolute().parent.is_dir():
        raise RequestError(f"'{out}' cannot be written: '{out.absolute().parent}' is not a folder")
    results = running.run_benchmarks(benchmarks, setting, seconds, _tell)
    content = files.written(benchmarks, results.passes)
    if out is not None:
        try:
            write_atomically(out, content)
        except OSError as error:
            raise RequestError(f"'{out}' cannot be written: {error.strerror}") from None
    for reason, count in Counter(results.left_out.values()).items():
        _tell(f"{count} benchmarks left out: {reason}")
    return files.parsed(content), len(results.failed)


def _tell(line: str) -> None:
    """Tell the progress on the standard error, so that the output holds the tables alone."""
    from vibench.text import printable

    sys.stderr.write(f"{printable(line)}\n")
    sys.stderr.flush()


def print_benchmarks(timed: Timed, earlier: Timed | None, limit: float, failed: int = 0) -> None:
    """Print a table for everything that was timed, beside an earlier file if there is one, and how many failed."""
    import pandas as pd

    from vibench.benchmarks.comparison import remarks, table_of
    from vibench.benchmarks.files import AXES

    frame = table_of(timed, earlier, limit)
    if len(frame):
        for group, rows in frame.groupby("group", sort=False):
            shown = _measured(rows) if earlier is None else _compared(rows)
            named = [axis for axis in AXES if (rows[axis] != "").any()]
            print_frame(pd.concat([rows[named], shown], axis=1), str(group), PRIORITY, rest=REST)
            echo("")
    if earlier is None:
        counts = f"{len(frame)} benchmarks" + (f", {failed} failed" if failed else "")
        echo(f"{counts}; times are CPU times of a call on one thread")
    else:
        echo(*remarks(earlier, timed, limit))


def _measured(rows: pd.DataFrame) -> pd.DataFrame:
    import pandas as pd

    from vibench.results.formats import cell_text

    quartiles = zip(1e3 * rows["q1_s"], 1e3 * rows["q3_s"], strict=True)
    reached = [name for name in rows.columns if name.startswith("reached_")]
    return pd.DataFrame(
        {
            "median [ms]": 1e3 * rows["median_s"],
            "quartiles [ms]": [f"{cell_text(low)}–{cell_text(high)}" for low, high in quartiles],
            "rounds": rows["rounds"],
            "reached": [_largest(row) for row in rows[reached].to_dict("records")],
            "status": rows["status"],
        },
        index=rows.index,
    )


def _largest(reached: dict[str, float | None]) -> str:
    """The largest figure of accuracy of a benchmark; those of its table are of the same kind."""
    import pandas as pd

    from vibench.results.formats import cell_text

    figures = {name.removeprefix("reached_"): value for name, value in reached.items() if pd.notna(value)}
    name = max(figures, key=lambda name: figures[name] or 0.0, default="")
    return f"{name} {cell_text(figures[name])}" if name else ""


def _compared(rows: pd.DataFrame) -> pd.DataFrame:
    import pandas as pd

    from vibench.results.formats import cell_text

    changes = rows[["figure", "before", "after"]].itertuples(index=False, name=None)
    return pd.DataFrame(
        {
            "before [ms]": 1e3 * rows["before_s"],
            "after [ms]": 1e3 * rows["after_s"],
            "ratio": rows["ratio"],
            "apart": rows["apart"],
            "reached": [f"{name} {cell_text(was)} → {cell_text(now)}" if name else "" for name, was, now in changes],
            "verdict": rows["verdict"],
        },
        index=rows.index,
    )
