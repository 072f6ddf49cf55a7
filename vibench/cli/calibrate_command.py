"""`vibench calibrate`: a posterior from measured data, whose every decision is that of the high-fidelity model."""

from __future__ import annotations

import io
import json
import signal
import zipfile
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Annotated, Any

from typer import Argument, Exit, Option

from vibench.cli.completion import problems
from vibench.cli.console import echo, print_frame
from vibench.cli.plugin_commands import key_value
from vibench.errors import RequestError, UnsupportedError, message_of, placed

if TYPE_CHECKING:
    from vibench.calibration.decisions import Predict
    from vibench.calibration.metropolis import Metropolis
    from vibench.interfaces.problem import Problem
    from vibench.offline.models import Model
    from vibench.study.cells import Cell


def calibrate(
    problem: Annotated[
        str,
        Argument(
            help="NAME, FILE.py:CLASS or a pack, which is trained; or a run with --cell.", autocompletion=problems
        ),
    ],
    data: Annotated[Path, Argument(metavar="DATA.toml", help="Measured values of outputs, with their noise.")],
    cell: Annotated[str, Option(metavar="KEY", help="Take the model of this certified cell of a run.")] = "",
    option: Annotated[list[str] | None, Option(metavar="KEY=VALUE", help="Option of the problem (repeatable).")] = None,
    synthetic: Annotated[str, Option(metavar="MU", help="Write DATA.toml, from the solution at MU: 1.05,0.01.")] = "",
    noise: Annotated[str, Option(metavar="SHARE", help="Noise of synthetic data.")] = "1%",
    steps: Annotated[int, Option(min=10, help="Steps of the chain; a fifth of them is the burn-in.")] = 5000,
    audit: Annotated[str, Option(metavar="SHARE", help="Decided steps that are asked all the same.")] = "1%",
    seed: Annotated[int, Option(min=0, help="Of all random numbers.")] = 0,
    out: Annotated[Path | None, Option(metavar="DIR", help="Folder; calibrations/DATA by default.")] = None,
    fresh: Annotated[bool, Option("--fresh", help="Replace the chain in the folder.")] = False,
) -> None:
    """Calibrate parameters: a posterior from measured data.

    Error bounds take the decisions of a Metropolis chain where they suffice. Elsewhere the high-fidelity model is
    asked. Ctrl-C keeps the chain, and the same command continues it.
    """
    from vibench.calibration.data import read_data, refuse_unreachable, share
    from vibench.calibration.decisions import Decisions, Sensors
    from vibench.calibration.metropolis import Metropolis
    from vibench.execution.recorded_cell import cell_model, recorded_cell
    from vibench.stages.base import build_problem
    from vibench.text import new_console
    from vibench.timing import timed

    recorded = recorded_cell(problem, cell) if cell else None
    chosen = _trained_cell(problem, option) if recorded is None else recorded.cell
    target = build_problem(chosen.problem)
    if synthetic:
        _write_synthetic(target, synthetic, share(noise), data, seed)
    measured, prior = read_data(data, target)
    # Shown on a terminal alone: training may take a minute.
    with new_console().status(f"model: {chosen}"):
        model, training = timed(lambda: cell_model(chosen) if recorded is None else recorded.model)
    with placed(str(data)):
        predict, how = _predictor(model, measured.sensors)
        snapshots, sensors = model.offline.snapshots, Sensors(target, measured.sensors).outputs
        reached = {one.name: one.values(snapshots.mu, snapshots.u, snapshots.lam) for one in sensors}
        refuse_unreachable(measured, target, reached)
    decisions = Decisions(target, measured, predict, share(audit), seed)
    chain, folder = Metropolis(decisions, prior, steps // 5, seed), out or Path("calibrations") / data.stem
    about = {"data": data.read_text(), "cell": chosen.key, "steps": steps, "audit": audit, "seed": seed, "queries": how}
    seconds = _walk(chain, steps, folder / "chain.npz", json.dumps(about, sort_keys=True), fresh=fresh)
    echo(f"model: {chosen}")
    _conclude(
        chain, folder, f"seconds: {seconds:.3g} for the chain (queries by the {how}), {training.cpu:.3g} for training"
    )


def _trained_cell(problem: str, option: list[str] | None) -> Cell:
    """The cell of the study `calibration` for a problem of the command line."""
    from vibench.cli.run_command import problem_entry
    from vibench.study.matrix import expand, read_study

    entry = problem_entry(problem)
    if option:
        if not isinstance(entry, str):
            raise RequestError("--option is for a problem by its name; a class or a pack has its own")
        entry = {"name": entry, "options": dict(map(key_value, option))}
    return expand(read_study("calibration", {"problem": [entry]}))[0]


def _write_synthetic(problem: Problem, mu: str, noise: float, file: Path, seed: int) -> None:
    """Write data of all linear outputs at a parameter, unless the file has the same ones."""
    from vibench.calibration.data import synthetic
    from vibench.calibration.decisions import Sensors
    from vibench.files import write_atomically, writing
    from vibench.offline.models import parameter_in

    try:
        at = parameter_in(problem.parameters, [float(each) for each in mu.split(",")])
    except ValueError:
        raise RequestError(f"--synthetic is {mu!r}, expected numbers separated by commas, such as 1.2,0.05") from None
    names = tuple(output.name for output in problem.outputs if output.linear)
    if not names:
        raise RequestError("the problem has no linear outputs, which sensors have to be")
    sensors = Sensors(problem, names)
    text = synthetic(sensors.outputs, sensors.high_fidelity()(at), noise, seed)
    if file.exists() and file.read_text(encoding="utf-8") != text:
        raise RequestError(f"'{file}' exists with other data; leave out --synthetic, or choose another name")
    with writing(file):
        write_atomically(file, text.encode())


def _predictor(model: Model, names: tuple[str, ...]) -> tuple[Predict, str]:
    """What answers queries: the C program of the model where that has bounds, else the model."""
    from vibench.calibration.decisions import BoundedSensors
    from vibench.library.certified_program import CertifiedProgram

    bounded = BoundedSensors(model, names)
    try:
        return CertifiedProgram(model, names), "C program"
    except (UnsupportedError, RequestError):
        return bounded, "model"


def _walk(chain: Metropolis, steps: int, file: Path, about: str, *, fresh: bool) -> float:
    """Walk to the last step, continuing what the file has; CPU seconds of all. Ctrl-C ends it after a step."""
    from rich.progress import Progress

    from vibench.text import new_console
    from vibench.timing import Stopwatch

    before, stopped = 0.0, list[int]()
    if file.exists() and not fresh:
        with placed(f"'{file}'"):
            before = _continued(chain, file, about)
    watch, console = Stopwatch(), new_console()
    # A step is never left half-way: what follows from the chain in the file is what would have followed here.
    ends = signal.SIGINT, signal.SIGTERM
    handlers = {number: signal.signal(number, lambda got, _: stopped.append(got)) for number in ends}
    try:
        with Progress(console=console, disable=not console.is_terminal, transient=True) as progress:
            bar = progress.add_task("steps", total=steps, completed=chain.steps)
            while chain.steps < steps and not stopped:
                chain.step()
                progress.update(bar, completed=chain.steps)
                if chain.steps % 500 == 0:
                    _save(chain, file, about, before + watch.seconds().cpu)
    # What refutes bounds is raised again: the chain up to there is kept, too.
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        seconds = before + watch.seconds().cpu
        _save(chain, file, about, seconds)
    if stopped:
        echo(f"interrupted after {chain.steps} of {steps} steps; the same command continues")
        raise Exit(130)
    return seconds


def _save(chain: Metropolis, file: Path, about: str, seconds: float) -> None:
    import numpy as np

    from vibench.files import write_atomically, writing

    content = io.BytesIO()
    arrays: dict[str, Any] = chain.saved() | {"settings": np.array(about), "seconds": np.array(seconds)}
    np.savez_compressed(content, **arrays)
    with writing(file):
        file.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(file, content.getvalue())


def _continued(chain: Metropolis, file: Path, about: str) -> float:
    """Continue the chain of a file with the same settings, and return its seconds."""
    import numpy as np

    try:
        with np.load(file) as saved:
            if str(saved["settings"]) != about:
                raise RequestError("a chain with other data or settings; --fresh replaces it, --out keeps it")
            chain.restore(saved)
            return float(saved["seconds"])
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise RequestError(f"no chain that can be continued: {message_of(error)}; --fresh replaces it") from None


def _conclude(chain: Metropolis, folder: Path, ours: str) -> None:
    """Print and write what the chain says."""
    from vibench.calibration.posterior import draw, summary, write_for_arviz
    from vibench.files import write_atomically, writing

    table, decisions, counts = summary(chain), chain.decisions, chain.decisions.counts
    with writing(folder):
        write_atomically(folder / "posterior.csv", table.to_csv(index=False).encode())
        write_for_arviz(chain, folder / "posterior.json")
        draw(chain, folder / "posterior.png")
    print_frame(table, f"posterior, {100.0 * chain.accepted[chain.burn_in :].mean():.0f} % of the steps accepted")
    asked = f"{counts.undecided} undecided by bounds, {counts.questions} questions to the high-fidelity model"
    echo(f"{counts.decisions} decisions: {asked}; without bounds {counts.wrong} would be wrong")
    if decisions.is_exact:
        echo("exact: every decision is that of the high-fidelity model, by certified bounds")
    else:
        echo(f"{decisions.claim}: bounds are verified, not proved")
    if counts.question_seconds:
        # Every proposal in the box takes one solution, and so does the start.
        solution = median(counts.question_seconds)
        ours += f"; the high-fidelity chain takes about {solution * (counts.decisions + 1):.3g}"
    echo(ours, f"{folder}: chain.npz, posterior.csv, posterior.json for arviz.from_json, posterior.png")
