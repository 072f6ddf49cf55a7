"""`vibench calibrate`: a posterior from measured data, whose every decision is that of the high-fidelity model."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Exit, Option

from vibench.cli.completion import problems
from vibench.cli.console import echo, print_frame
from vibench.cli.plugin_commands import key_value
from vibench.cli.result_commands import components
from vibench.errors import RequestError, message_of, placed

if TYPE_CHECKING:
    from vibench.calibration.metropolis import Metropolis
    from vibench.interfaces.problem import Problem
    from vibench.study.cells import Cell


def calibrate(
    problem: Annotated[
        str, Argument(help="NAME, FILE.py:CLASS or a pack, to be trained; a run with --cell.", autocompletion=problems)
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
    asked. Ctrl-C keeps its answers, and the same command continues with them.
    """
    from vibench.calibration.data import read_data, refuse_unreachable, share
    from vibench.calibration.decisions import Decisions, quickest_sensors, refuse_bounded
    from vibench.calibration.metropolis import Metropolis, arviz
    from vibench.execution.recorded_cell import cell_model, recorded_cell
    from vibench.stages.base import build_problem
    from vibench.text import new_console
    from vibench.timing import timed

    # What is not installed is said before the training.
    arviz()
    recorded = recorded_cell(problem, cell) if cell else None
    chosen = _trained_cell(problem, option) if recorded is None else recorded.cell
    target = build_problem(chosen.problem)
    with placed(problem):
        refuse_bounded(target.K)
    if synthetic:
        _write_synthetic(target, synthetic, share(noise), data, seed)
    measured, prior = read_data(data, target)
    # Shown on a terminal alone: training may take a minute.
    with new_console().status(f"model: {chosen}"):
        model, training = timed(lambda: cell_model(chosen) if recorded is None else recorded.model)
    with placed(str(data)):
        refuse_unreachable(measured, target, model.offline.snapshots)
        # Compiling is part of the training.
        (predict, by), compiling = timed(lambda: quickest_sensors(model, measured.sensors))
    decisions = Decisions(target, measured, [predict], share(audit), seed)
    chain, folder = Metropolis(decisions, prior, steps // 5, seed), out or Path("calibrations") / data.stem
    about = {"data": data.read_text(encoding="utf-8"), "cell": chosen.key, "steps": steps, "audit": audit, "seed": seed}
    _walk(chain, steps, folder / "chain.npz", json.dumps(about, sort_keys=True), fresh=fresh)
    echo(f"model: {chosen}", f"answers: {by}")
    _conclude(chain, folder, (training + compiling).cpu)


def _trained_cell(problem: str, option: list[str] | None) -> Cell:
    """The first cell of the study `calibration` for a problem of the command line."""
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
    from vibench.calibration.data import Sensors, as_toml, synthetic
    from vibench.files import write_atomically, writing
    from vibench.offline.models import parameter_in

    at = parameter_in(problem.parameters, components("--synthetic", mu))
    text = as_toml(synthetic(problem, Sensors(problem)(at), noise, seed), problem)
    if file.exists() and file.read_text(encoding="utf-8") != text:
        raise RequestError(f"'{file}' exists with other data; leave out --synthetic, or choose another name")
    with writing(file):
        write_atomically(file, text.encode())


def _walk(chain: Metropolis, steps: int, file: Path, about: str, *, fresh: bool) -> None:
    """Walk to the last step with the answers that the file has; Ctrl-C ends it, and keeps all answers."""
    import numpy as np
    from rich.progress import track
    from threadpoolctl import threadpool_limits

    from vibench.files import write_atomically, writing
    from vibench.text import new_console

    decisions, content, console = chain.decisions, io.BytesIO(), new_console()
    if file.exists() and not fresh:
        with placed(f"'{file}'"):
            decisions.earlier = _answers(file, about, chain.prior.box.dim)
    try:
        # Programs are small: more threads only wait for each other, and would count in the seconds.
        with threadpool_limits(1):
            for _ in track(range(steps), "steps", console=console, disable=not console.is_terminal, transient=True):
                chain.step()
    # A step that is left half-way is walked again: a chain that continues starts anew, and knows the answers.
    except KeyboardInterrupt:
        echo(f"interrupted after {chain.steps} of {steps} steps; the same command continues")
        raise Exit(130) from None
    # What refutes bounds is raised again: the answers up to there are kept, too.
    finally:
        known = decisions.earlier | decisions.answers
        asked = np.array([np.frombuffer(key) for key in known]).reshape(-1, chain.prior.box.dim)
        answers = np.array([*known.values()]).reshape(-1, 2)
        np.savez_compressed(content, states=chain.states, asked=asked, answers=answers, settings=np.array(about))
        with writing(file):
            file.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(file, content.getvalue())


def _answers(file: Path, about: str, dim: int) -> dict[bytes, tuple[float, float]]:
    """Answers of the high-fidelity model in the file of a chain with the same settings."""
    import numpy as np

    try:
        with np.load(file) as saved:
            if str(saved["settings"]) != about:
                raise RequestError("a chain with other data or settings; --fresh replaces it, --out keeps it")
            asked, answers = saved["asked"].reshape(-1, dim), saved["answers"].reshape(-1, 2)
            return {mu.tobytes(): (float(one), float(two)) for mu, (one, two) in zip(asked, answers, strict=True)}
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise RequestError(f"no chain that can be continued: {message_of(error)}; --fresh replaces it") from None


def _conclude(chain: Metropolis, folder: Path, training: float) -> None:
    """Print and write what the chain says."""
    from vibench.calibration.metropolis import draw, summary
    from vibench.files import write_atomically, writing

    decisions, counts = chain.decisions, chain.decisions.counts
    with writing(folder):
        table = summary(chain, folder / "posterior.nc")
        write_atomically(folder / "posterior.csv", table.to_csv(index=False).encode())
        draw(chain, folder / "posterior.png")
    print_frame(table, f"posterior, {100.0 * chain.accepted[chain.burn_in :].mean():.0f} % of the steps accepted")
    asked = f"{counts.undecided} undecided by bounds, {len(decisions.answers)} questions to the high-fidelity model"
    echo(f"{counts.decisions} decisions: {asked}; without bounds {counts.wrong} would be wrong")
    proved = "every decision is that of the high-fidelity model, by certified bounds"
    echo(f"{decisions.claim}: {proved if decisions.claim == 'exact' else 'bounds are verified, not proved'}")
    ours = f"seconds: {decisions.seconds:.3g} for the chain, {training:.3g} for training"
    if decisions.answers:
        ours += f"; the high-fidelity chain takes about {decisions.high_fidelity_seconds:.3g}"
    echo(ours, f"{folder}: chain.npz, posterior.csv, posterior.nc for arviz.from_netcdf, posterior.png")
