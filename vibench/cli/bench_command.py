"""The command that times plugins."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Exit, Option

from vibench.cli.completion import plugins, studies
from vibench.cli.console import echo, print_frame
from vibench.cli.result_commands import FormOption
from vibench.errors import RequestError, VibenchError

if TYPE_CHECKING:
    import pandas as pd

    from vibench.benchmarks.comparison import Timed


def bench_plugins(
    plugin: Annotated[
        list[str] | None,
        Argument(help="Names, or problem|primal|dual|formulation|solver:NAME; all by default.", autocompletion=plugins),
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
    seconds: Annotated[float | None, Option(min=0.001, help="Seconds for each benchmark, about; 1 by default.")] = None,
    limit: Annotated[float, Option(min=1.0, help="Factor by which a median may grow.")] = 1.25,
    form: FormOption = "terminal",
) -> None:
    """Time plugins in every stage, with what they reach.

    Each benchmark in which one of the plugins takes part is timed. Exit code 1 if one fails, or something is slower or
    less accurate than in the file of --against.
    """
    from vibench.benchmarks import comparison
    from vibench.results import formats

    earlier = comparison.read_benchmarks(against) if against is not None else None
    if read is None:
        timed = _timed(plugin or [], out, resolution or ["coarse"], study, seconds)
    elif plugin or out is not None:
        raise RequestError("--read times nothing: leave out the plugins and --out")
    else:
        timed = comparison.read_benchmarks(read)
    frame = comparison.table_of(timed, earlier, limit)
    if form == "terminal":
        _print_benchmarks(frame, timed, earlier, limit)
    else:
        sys.stdout.write(formats.to_text(frame, form))
    if (timed.failed and read is None) or (earlier is not None and comparison.regressions(frame)):
        raise Exit(1)


def _timed(plugins: list[str], out: Path | None, resolutions: list[str], study: str, seconds: float | None) -> Timed:
    """Time plugins by pytest-benchmark, and keep its file if asked to."""
    from importlib.util import find_spec
    from tempfile import TemporaryDirectory

    from vibench import benchmarks
    from vibench.benchmarks.comparison import read_benchmarks
    from vibench.files import write_atomically

    if find_spec("pytest_benchmark") is None:
        raise VibenchError("`vibench bench` needs pytest-benchmark: pip install 'vibench[bench]'")
    # Wrong requests are refused here, in a line.
    benchmarks.setting(study), benchmarks.chosen_plugins(plugins), benchmarks.resolutions(resolutions)
    if out is not None and not out.absolute().parent.is_dir():
        raise RequestError(f"'{out}' cannot be written: '{out.absolute().parent}' is not a folder")
    with TemporaryDirectory() as folder:
        file = Path(folder) / "benchmarks.json"
        options = [f"--plugin={name}" for name in plugins] + [f"--resolution={name}" for name in resolutions]
        options += [f"--study={study}", *([] if seconds is None else [f"--seconds={seconds}"])]
        benchmarks.run_pytest([*options, f"--benchmark-json={file}"])
        if not file.exists():  # everything was left out
            file.write_text('{"machine_info": {}, "benchmarks": []}')
        if out is not None:
            try:
                write_atomically(out, file.read_bytes())
            except OSError as error:
                raise RequestError(f"'{out}' cannot be written: {error.strerror}") from None
        return read_benchmarks(file)


def _print_benchmarks(frame: pd.DataFrame, timed: Timed, earlier: Timed | None, limit: float) -> None:
    """Print a table for everything that was timed, beside an earlier file if there is one, and how many failed."""
    import pandas as pd

    from vibench.benchmarks.comparison import AXES, remarks

    # Columns, those that matter most first.
    priority = [
        "verdict", *AXES, "median [ms]", "before [ms]", "after [ms]", "ratio", "quartiles [ms]", "reached", "status",
        "rounds", "apart",
    ]  # fmt: skip
    for group, rows in frame.groupby("group", sort=False) if len(frame) else ():
        shown = _measured(rows) if earlier is None else _compared(rows)
        named = [axis for axis in AXES if (rows[axis] != "").any()]
        print_frame(pd.concat([rows[named], shown], axis=1), str(group), priority, rest="--format csv")
        echo("")
    if earlier is None:
        counts = f"{len(frame)} benchmarks" + (f", {timed.failed} failed" if timed.failed else "")
        echo(f"{counts}; times are CPU times of a call on one thread")
    else:
        echo(*remarks(earlier, timed, frame, limit))


def _measured(rows: pd.DataFrame) -> pd.DataFrame:
    import pandas as pd

    from vibench.results.formats import cell_text

    def largest(reached: dict[str, float | None]) -> str:
        figures = {name.removeprefix("reached_"): value for name, value in reached.items() if pd.notna(value)}
        name = max(figures, key=lambda name: figures[name] or 0.0, default="")
        return f"{name} {cell_text(figures[name])}" if name else ""

    shown = pd.DataFrame({"median [ms]": 1e3 * rows["median_s"]}, index=rows.index)
    quartiles = zip(1e3 * rows["q1_s"], 1e3 * rows["q3_s"], strict=True)
    shown["quartiles [ms]"] = [f"{cell_text(low)}–{cell_text(high)}" for low, high in quartiles]
    shown["rounds"] = rows["rounds"]
    shown["reached"] = [largest(row) for row in rows.filter(like="reached_").to_dict("records")]
    shown["status"] = rows["status"]
    return shown


def _compared(rows: pd.DataFrame) -> pd.DataFrame:
    from vibench.results.formats import cell_text

    changes = rows[["figure", "before", "after"]].itertuples(index=False, name=None)
    reached = [f"{name} {cell_text(was)} → {cell_text(now)}" if name else "" for name, was, now in changes]
    seconds = {"before [ms]": 1e3 * rows["before_s"], "after [ms]": 1e3 * rows["after_s"]}
    return rows[["ratio", "apart", "verdict"]].assign(**seconds, reached=reached)[
        ["before [ms]", "after [ms]", "ratio", "apart", "reached", "verdict"]
    ]
