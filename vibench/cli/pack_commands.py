"""`vibench pack`: model packs are checked, written, and reduced to cones."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Option

from vibench.cli.completion import duals, problems
from vibench.cli.console import echo
from vibench.cli.plugin_commands import key_value
from vibench.errors import NumericalError, RequestError, UnsupportedError
from vibench.files import write_atomically
from vibench.plugins.kinds import PluginKind

if TYPE_CHECKING:
    from vibench.packs.pack import ModelPack


def pack(
    words: Annotated[
        list[str],
        Argument(
            metavar="[PROBLEM] FOLDER",
            help="FOLDER alone is a pack to check; with a registered PROBLEM it is the new pack of that.",
            autocompletion=problems,
        ),
    ],
    option: Annotated[list[str] | None, Option(metavar="KEY=VALUE", help="Option of the problem (repeatable).")] = None,
    validation: Annotated[int, Option(min=1, help="Number of validation parameters of a new pack.")] = 64,
    seed: Annotated[int, Option(min=0, help="Seed of the validation parameters, as in a study.")] = 0,
    solutions: Annotated[bool, Option("--solutions", help="Add the high-fidelity solutions, as references.")] = False,
    cones: Annotated[bool, Option("--cones", help="Build cones from the multipliers of the pack.")] = False,
    dual: Annotated[list[str] | None, Option(help="Dual strategies; default: all.", autocompletion=duals)] = None,
    dual_tol: Annotated[float, Option(min=1e-12, max=1.0, help="Tolerance of --cones.")] = 1e-2,
    out: Annotated[Path, Option(metavar="DIR", help="Folder of the table and the figure of --cones.")] = Path("cones"),
) -> None:
    """Check a model pack, write one of a problem, or build cones.

    A pack is a folder of matrices with a manifest pack.toml. A check says what can be done with it, or what is wrong.
    Cones are the dual half of a reduced model, which needs no operators; their errors are relative to the largest norm.
    """
    *problem, last = words
    folder = Path(last)
    if len(problem) > 1 or (problem and cones):
        raise RequestError("expected FOLDER, a pack to check, or PROBLEM FOLDER, the new pack of a problem")
    if problem:
        from vibench.packs.writer import write_pack
        from vibench.plugins.registry import find

        plugin = find(PluginKind.PROBLEM, problem[0])
        made, source = plugin.create(dict(map(key_value, option or []))), f"{plugin} of {plugin.origin}"
        write_pack(made, folder, name=plugin.name, source=source, validation=validation, seed=seed, solutions=solutions)
        counts = f"{len(made.training_set())} training and {validation} validation parameters (seed {seed})"
        echo(f"{folder}: the problem '{plugin.name}' at {counts}", f"  vibench pack {folder}")
    elif cones:
        _reduce_cones(folder, dual or [], dual_tol, out)
    else:
        from vibench.packs.checks import read_model_pack
        from vibench.packs.reader import naming

        checked = read_model_pack(folder)
        with naming(folder):
            echo(*_contents(checked), *_uses(checked, folder))


def _reduce_cones(folder: Path, dual: list[str], dual_tol: float, out: Path) -> None:
    """Build cones and print their errors over the multipliers at training parameters, and over the others."""
    import pandas as pd

    from vibench.cli.console import print_frame
    from vibench.packs.checks import read_model_pack
    from vibench.packs.pack import pack_multipliers, reduce_multipliers
    from vibench.packs.reader import naming
    from vibench.plugins.registry import find, registered
    from vibench.report.figures.spaces import cone_errors
    from vibench.report.figures.style import save, styled
    from vibench.results.formats import to_csv

    pack = read_model_pack(folder)
    # A pack without multipliers is refused by name before any strategy runs.
    with naming(folder):
        pack_multipliers(pack)
    wanted = dual or [name for name, plugin in registered(PluginKind.DUAL).items() if not plugin.missing]
    rows, steps = [], list[tuple[str, int, float]]()
    for name in wanted:
        try:
            cone, other_error = reduce_multipliers(pack, find(PluginKind.DUAL, name).create({}), dual_tol)
        # One strategy that fails, as some do at small tolerances, leaves the others.
        except (NumericalError, UnsupportedError) as error:
            echo(f"{'failed' if isinstance(error, NumericalError) else 'unavailable'}: {name}: {error}")
            continue
        steps += [(name, r, float(error)) for r, error in enumerate(cone.errors)]
        rows.append((name, cone.size, cone.errors[-1], other_error, len(cone.fallbacks)))
    columns = ("dual", "R", "error, training", "error, other parameters", "fallbacks")
    print_frame(pd.DataFrame(rows, columns=columns), f"cones of tolerance {dual_tol:g}")
    out.mkdir(parents=True, exist_ok=True)
    table, errors = out / "errors.csv", pd.DataFrame(steps, columns=("dual", "step", "value"))
    write_atomically(table, to_csv(errors).encode())
    with styled():
        drawn = save(cone_errors(pack.manifest.name or folder.name, errors), out, "errors")
    echo(f"table: {table}, figures: {', '.join(map(str, drawn))}")


def _contents(pack: ModelPack) -> Iterator[str]:
    """Sizes, members, parameters and reference solutions of a pack."""
    manifest, d = pack.manifest, pack.box.dim
    yield f"{manifest.name or 'model pack'}{': ' * bool(manifest.description)}{manifest.description}"
    sizes = f"{pack.W.dim} multipliers" if pack.V is None else f"{pack.V.dim} unknowns, {pack.W.dim} multipliers"
    yield f"  {sizes}, {d} parameter{'s' * (d > 1)}: {', '.join(pack.box.names)}"
    yield from (f"  {name}: {member}" for name, member in pack.members.items())
    yield from (f"  K: {len(block.rows)} of the multipliers in {block.kind.value}s" for block in pack.K.blocks)
    count = "drawn at random in the box" if pack.validation is None else f"{len(pack.validation)} listed"
    yield f"  training parameters: {len(pack.training)}, validation parameters: {count}"
    if pack.members:
        from vibench.packs.checks import solve_at_training, zero_rows_of

        mu, solution = solve_at_training(pack)
        inside = "between their bounds, or positive without" if pack.K.blocks else "positive"
        found = f"{int(pack.K.free(solution.lam).sum())} of {pack.W.dim} multipliers are {inside}"
        yield f"  solved at mu = {mu.tolist()}: {found}, KKT residuals up to {solution.residuals.worst:.0e}"
        if len(zero := zero_rows_of(pack)):
            yield f"  {len(zero)} rows of B are zero at every listed parameter, the first is {zero[0]}"
    if pack.outputs:
        yield f"  outputs: {', '.join(f'{output.name} [{output.unit}]' for output in pack.outputs)}"
    if pack.reference is not None:
        unchecked = "not checked, since u or the operators are missing"
        checked = unchecked if pack.residual is None else f"KKT residuals up to {pack.residual:.0e}"
        yield f"  reference solutions: {pack.reference.lam.shape[1]}, {checked}"


def _uses(pack: ModelPack, folder: Path) -> Iterator[str]:
    """The table of a study file that names a pack, how it is assembled, and where that is inaccurate."""
    from vibench.model.affine import INTERPOLATION_RTOL, is_missed

    if pack.members:
        count = "" if pack.validation is None else f" --validation {len(pack.validation)}"
        yield f"it can be run: vibench run --problem {folder}{count}"
        yield from ("or as a problem of a study:", "  [[problem]]", '  name = "pack"')
        # JSON quotes a path as TOML does.
        yield f"  options = {{ path = {json.dumps(str(folder), ensure_ascii=False)} }}"
        summed, interpolated = sorted(pack.affine), sorted(pack.entrywise - set(pack.affine))
        ways = [f"interpolates {', '.join(interpolated)}"] * bool(interpolated)
        ways += [f"sums the terms of {', '.join(summed)}"] * bool(summed)
        where = "anywhere in the box" if pack.everywhere else "at its listed parameters only"
        yield f"it is evaluated {where}" + f"; reduced assembly {' and '.join(ways)}" * bool(ways)
        # Members that are interpolated between few listed parameters may be wrong in between.
        for name, error in pack.interpolation_errors(INTERPOLATION_RTOL).items():
            if is_missed(INTERPOLATION_RTOL, error):
                where = f"{name}, interpolated over {len(pack.training)} training parameters to {INTERPOLATION_RTOL:g}"
                wrong = f"has an error of {error:.1e} at the listed validation parameters"
                yield f"warning: {where}, {wrong}: use full assembly, or list more"
    if pack.reference is not None:
        yield f"its multipliers give cones: vibench pack {folder} --cones"
    if not pack.members:
        yield "it has no operators: a study, whose primal half needs them, cannot run it"
