"""The command that writes a reduced model to a file of its own."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Option

from vibench.cli.completion import cells
from vibench.cli.result_commands import RunArgument
from vibench.terminal.output import echo

if TYPE_CHECKING:
    from vibench.model.chebyshev import AffinePolynomial


def export_reduced_model(
    run: RunArgument,
    cell: Annotated[str, Argument(metavar="CELL", help="Key of a cell, or its beginning.", autocompletion=cells)],
    file: Annotated[Path, Argument(metavar="FILE", help="A new file, whose name ends in .npz.")],
    interpolate: Annotated[
        float | None,
        Option(metavar="TOL", help="Allowed error of the polynomials that replace members; 1e-11 by default."),
    ] = None,
    evaluations: Annotated[
        int, Option(min=16, help="Largest number of parameters at which a member is evaluated.")
    ] = 4096,
    bases: Annotated[bool, Option("--bases/--no-bases", help="Include the bases that reconstruct u and λ.")] = True,
    c: Annotated[bool, Option("--c", help="Also write a C99 source, under the same name.")] = False,
) -> None:
    """Export a reduced model for use without vibench."""
    from vibench.library.export import BOUNDS, RUNTIME, TOLERANCE, export_model
    from vibench.library.runs import open_run
    from vibench.model.chebyshev import MEASURED

    model = open_run(run).model(cell)
    tolerance = TOLERANCE if interpolate is None else interpolate
    found = export_model(model, file, tolerance, evaluations=evaluations, bases=bases, c=c)
    echo(*(f"{name}: {_in_words(member)}" for name, member in found.members.items()))
    echo(f"relative errors are those at {MEASURED} random parameters and at the corners of the box")
    if found.about["solver"] != model.solver:
        echo(f"the cell's solver is {model.solver}, the script solves by {found.about['solver']}")
    why = found.about["no_bounds"]
    has_bounds = not why
    echo(f"error bounds: {found.about['certificate']}" if has_bounds else f"no error bounds: {why}")
    if c and has_bounds:
        echo("the C source has no error bounds")
    beside = [file.with_name(BOUNDS)] if has_bounds else []
    written = ", ".join(map(str, [file, file.with_name(RUNTIME), *beside, *([file.with_suffix(".c")] if c else [])]))
    script = Path(BOUNDS if has_bounds else RUNTIME).stem
    echo(f"{written}: `from {script} import Model`, then `Model({str(file)!r}).solve(mu)`")


def _in_words(member: AffinePolynomial) -> str:
    if not any(member.degrees):
        return f"constant, relative error {member.error:.1e}"
    degrees = ", ".join(map(str, member.degrees))
    count = len(member.terms)
    return f"{count} term{'s' * (count > 1)}, polynomials of degree ({degrees}), relative error {member.error:.1e}"
