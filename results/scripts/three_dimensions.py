"""Contact in three dimensions: the problem against its closed form on four meshes, and the study `three-dimensions`.

vibench run three-dimensions --no-figures
python results/scripts/three_dimensions.py runs/three-dimensions results/three-dimensions

PARDISO factorises where the extra `fast` is installed.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise, product

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.tri import Triangulation
from page import CERTIFIED, SECONDS, Page, made_by, origin, read, start

from vibench import HighFidelitySolver, create
from vibench.highfidelity.active_set import solve_high_fidelity
from vibench.report.figures.style import CaptionedFigure, styled
from vibench.results import formats
from vibench.study.matrix import read_study
from vibench.timing import timed

RESOLUTIONS = ("coarse", "medium", "paper", "fine")

MUS = np.array([[1.0, 1.0, 0.00125, 0.3], [1.3, 0.8, 0.0014, 0.25], [0.7, 0.8, 0.001, 0.35]])
"""Where the closed form is compared: a round contact, a large elliptic one, a small one."""

FLAT = 50.0
"""Factor on radii, and divisor of approaches, that leaves the closed form's axes and takes away the slopes."""

MODEL = ["problem", "dual", "primal", "pod_tol", "dual_tol", "assembly"]

SHOWN = {
    "N": "N", "R": "R", "enrichment": "added", "beta_span_min": "min β span", "beta_cone_lower_min": "min β cone",
    "error_u_mean": "error u", "error_lambda_mean": "error λ", "queries_ok": "queries ok",
}  # fmt: skip

BUSY = 1.25
"""Wall seconds over CPU seconds beyond which a machine had other work."""

OFFLINE = ["snapshots", "pod", "cone", "enrichment", "assembly", "certificate"]


def against_theory(resolutions: tuple[str, ...] = RESOLUTIONS) -> pd.DataFrame:
    """Relative differences from Hertz's elliptic contact on every mesh, and the CPU seconds of the solutions.

    "force, flat" is that of paraboloids of the same contact without slopes, where the closed form has no error.
    """
    return pd.DataFrame([row for resolution in resolutions for row in _on_mesh(resolution)])


def _on_mesh(resolution: str) -> Iterator[dict[str, object]]:
    problem = create("problem", "hertz3d", {"resolution": resolution, "factorisation": "available"})
    solver, start = HighFidelitySolver(problem), None
    for mu in MUS:
        flat = mu * np.array([FLAT, FLAT, 1.0 / FLAT, 1.0])  # with the same A
        vi, vertical = problem.assemble(mu).copy(), problem.assemble(flat).copy()
        stiffness, eliminating = timed(lambda vi=vi: solver.condensed(vi))
        solution, solving = timed(
            lambda vi=vi, stiffness=stiffness, start=start: solve_high_fidelity(vi, stiffness, start)
        )
        start = solution.lam > 0.0
        theory, found = problem.theory(mu), problem.measured(solution.lam)
        force = problem.force(solve_high_fidelity(vertical, stiffness, start).lam)
        yield {
            "mesh": resolution, "unknowns": problem.V.dim, "multipliers": problem.W.dim,
            "mu": ", ".join(f"{each:g}" for each in mu),
            "force": problem.force(solution.lam) / theory.force - 1.0,
            "force, flat": force / problem.theory(flat).force - 1.0,
            "peak": found.peak / theory.peak - 1.0,
            "a": found.a / theory.a - 1.0, "b": found.b / theory.b - 1.0,
            "in contact": int(np.sum(solution.lam > 0.0)), "active sets": solution.iterations,
            "seconds": eliminating.cpu + solving.cpu,
        }  # fmt: skip


def far_faces(resolution: str = "coarse") -> pd.DataFrame:
    """The same differences at one parameter with the far face at other distances, by what is outside the block."""
    rows = []
    for far, distance in product(("boussinesq", "clamped"), (10.0, 20.0, 40.0, 80.0)):
        options = {"resolution": resolution, "factorisation": "available", "far": far, "distance": distance}
        problem, mu = create("problem", "hertz3d", options), MUS[0]
        solution, theory = HighFidelitySolver(problem).solve(mu), problem.theory(mu)
        found = problem.measured(solution.lam)
        rows.append({
            "outside": far, "distance": distance, "unknowns": problem.V.dim,
            "force": problem.force(solution.lam) / theory.force - 1.0, "peak": found.peak / theory.peak - 1.0,
            "a": found.a / theory.a - 1.0,
        })  # fmt: skip
    return pd.DataFrame(rows)


def rates(compared: pd.DataFrame) -> pd.DataFrame:
    """Orders of the force without slopes in the size of the cells, from every mesh to the next; two by theory."""
    force = compared.pivot_table(index="mu", columns="multipliers", values="force, flat")
    sizes = np.sqrt(force.columns.to_numpy(float))  # cells along the zone
    orders = np.log(force.to_numpy()[:, :-1] / force.to_numpy()[:, 1:]) / np.log(sizes[1:] / sizes[:-1])
    names = [f"{first:g} → {second:g} cells" for first, second in pairwise(sizes)]
    return pd.DataFrame(orders, columns=names).assign(mu=list(force.index))[["mu", *names]]


def exponents(compared: pd.DataFrame) -> pd.DataFrame:
    """Seconds of a solution on every mesh, the median of the parameters, and their exponent from the mesh before."""
    found = compared.groupby("unknowns")["seconds"].median().reset_index()
    growth = np.diff(np.log(found["seconds"])) / np.diff(np.log(found["unknowns"]))
    return found.assign(exponent=[None, *growth])


def models(cells: pd.DataFrame) -> pd.DataFrame:
    """Dimensions, constants and errors of every model; those of certified queries are the same."""
    plain = cells[cells["assembly"] != CERTIFIED]
    return plain[[*MODEL[:-1], *SHOWN]].rename(columns=SHOWN)


def effectivities(cells: pd.DataFrame) -> pd.DataFrame:
    """Median effectivities of the bounds, at online cost, too, and how often one was below an error."""
    names = {
        "effectivity_u_energy_median": "u, energy", "effectivity_lambda_natural_median": "λ, natural",
        "effectivity_online_u_energy_median": "u, energy, online",
        "effectivity_online_lambda_natural_median": "λ, natural, online", "certificate": "certificate",
        "bound_online_violations": "violations",
    }  # fmt: skip
    return cells.loc[cells["assembly"] == CERTIFIED, [*MODEL[:-1], *names]].rename(columns=names)


def seconds(cells: pd.DataFrame) -> pd.DataFrame:
    """CPU seconds offline by stage, of a query, and of a high-fidelity solution."""
    named = {f"offline_{stage}_s": f"{stage} [s]" for stage in OFFLINE}
    table = cells[[*MODEL, *named]].rename(columns=named)
    return table.assign(**{"query [ms]": 1e3 * cells["online_s"], "high fidelity [ms]": 1e3 * cells["hf_s"]})


def break_even(thresholds: pd.DataFrame) -> pd.DataFrame:
    """Gains of offline over online enrichment and of every model over the high-fidelity one; from where they pay.

    The gain is the ratio of seconds of a query, with its 95 % interval.
    """
    of_enrichments = thresholds["primal_b"].eq("offline-pga") & thresholds["primal_a"].eq("online-supremizers")
    fair = of_enrichments & thresholds["assembly_a"].eq(thresholds["assembly_b"])
    chosen = thresholds[fair | thresholds["cell_a"].isna()]
    gain = [f"{row.gain:.3g} ({row.gain_low:.3g} to {row.gain_high:.3g})" for row in chosen.itertuples()]
    pays = list(map(formats.break_even, chosen["meaning"], chosen["benefit_threshold"]))
    columns = {"dual": "dual", "pod_tol": "pod_tol", "primal_a": "in place of", "primal_b": "primal"}
    table = chosen[["problem", *columns, "assembly_b"]].rename(columns=columns | {"assembly_b": "assembly"})
    return table.assign(gain=gain, **{"pays, in queries": pays})


def stages(cells: pd.DataFrame) -> pd.DataFrame:
    """Median seconds of a solution, of all snapshots, of a certificate with its base, and exponents in the unknowns."""
    certified = cells[cells["assembly"] == CERTIFIED]
    named = {"hf_s": "solution", "offline_snapshots_s": "snapshots", "offline_certificate_s": "certificate"}
    found = certified.groupby("dim_V")[list(named)].median().rename(columns=named)
    orders = np.log(found).diff().div(np.log(found.index.to_series()).diff(), axis=0).add_suffix(", exponent")
    return found.join(orders).rename_axis("unknowns").reset_index()


def growth(cells: pd.DataFrame) -> pd.DataFrame:
    """Queries on the finest mesh over those on the coarsest, where N, R and what was added agree."""
    of_model = cells.set_index([*MODEL[1:], "N", "R", "enrichment"])
    first, last = (of_model[of_model["dim_V"] == edge] for edge in (cells["dim_V"].min(), cells["dim_V"].max()))
    both = first[["online_s"]].join(last[["online_s"]], how="inner", lsuffix=" first", rsuffix=" last")
    return (both["online_s last"] / both["online_s first"]).rename("ratio").reset_index()


def not_run(cells: pd.DataFrame) -> list[str]:
    """Problems of the study without a cell."""
    return [str(one.label) for one in read_study("three-dimensions").problem if one.label not in set(cells["problem"])]


def restricted(cells: pd.DataFrame) -> str:
    """What restricts the study to the problems that were run."""
    return "".join(f' --problem "{label}"' for label in cells["problem"].unique()) if not_run(cells) else ""


def conditions(cells: pd.DataFrame) -> str:
    """On which meshes of the study it was run, and what wall seconds say of other work that the machine had."""
    labels = dict(zip(cells["problem"], cells["dim_V"], strict=True))
    meshes = " and ".join(f"{label} ({int(n):,} unknowns)" for label, n in labels.items())
    left = not_run(cells)
    missing = f" Not run: {' and '.join(left)}." if left else ""
    shares = {name: cells[f"{kind}_wall_s"].sum() / cells[f"{kind}_s"].sum()
              for kind, name in (("offline", "offline phases"), ("online", "queries"))}  # fmt: skip
    load = " and ".join(f"{name} took {share:.2g} times their CPU seconds" for name, share in shares.items()
                        if share > BUSY)  # fmt: skip
    busy = f" The machine had other work, too: in wall seconds {load}." if load else ""
    return f"The study was run on: {meshes}.{missing}{busy}"


def pressed(resolution: str = "medium") -> Figure:
    """The surface pressed by an elliptic paraboloid, and the contact pressure beside that of Hertz."""
    problem, mu = create("problem", "hertz3d", {"resolution": resolution, "factorisation": "available"}), MUS[1]
    solution = HighFidelitySolver(problem).solve(mu)
    picture = problem.picture(mu, solution.u, solution.lam)
    with styled():
        figure = CaptionedFigure(figsize=(9.0, 3.6), layout="constrained")
        figure.caption = (
            f"A quarter of the surface pressed by a rigid paraboloid of the radii {mu[0]:g} m and {mu[1]:g} m, its "
            "vertical displacement exaggerated, and the pressure along both axes of the contact beside Hertz's."
        )
        surface = figure.add_subplot(1, 2, 1, projection="3d")
        mesh = Triangulation(*picture.points, picture.triangles.T)
        surface.plot_trisurf(mesh, 1e3 * picture.values, cmap="viridis", linewidth=0.1)
        surface.set(xlabel="x [m]", ylabel="y [m]", zlabel="displacement [mm]")
        surface.locator_params(nbins=4)
        axes = figure.add_subplot(1, 2, 2)
        theory, along = problem.theory(mu), np.linspace(0.0, 0.06, 200)
        for axis, name in enumerate("xy"):
            near = np.isclose(picture.positions[1 - axis], picture.positions[1 - axis].min())
            offset = np.full_like(along, picture.positions[1 - axis].min())
            exact = theory.pressure(*((along, offset) if axis == 0 else (offset, along)))
            (line,) = axes.plot(along, exact, label=f"along {name}, Hertz")
            axes.plot(picture.positions[axis][near], picture.multiplier[near], "o", color=line.get_color(),
                      label=f"along {name}, computed")  # fmt: skip
        axes.set(xlabel="distance from the apex [m]", ylabel="contact pressure [Pa]")
        axes.legend()
    return figure


def main(run: str, target: str) -> None:
    cells = read(run, "cells")
    page = Page(
        target, "Does contact in space reduce as in the plane?",
        made_by("three_dimensions", *["three-dimensions"] * 2, options=f"{restricted(cells)} --no-figures"),
        f"A half-space pressed by a rigid elliptic paraboloid (`hertz3d`). {SECONDS} {conditions(cells)}",
        machine=origin(cells),
    )  # fmt: skip
    compared, pays = against_theory(), break_even(read(run, "thresholds"))
    finest = compared[compared["unknowns"] == compared["unknowns"].max()]
    reduced = cells[(cells["assembly"] == "reduced") & (cells["dim_V"] == cells["dim_V"].max())]
    bounded = effectivities(cells)
    page.answer(
        f"On the finest mesh force and peak differ from Hertz's closed form by at most "
        f"{100 * finest[['force', 'peak']].abs().max(axis=None):.2g} %. On {int(reduced['dim_V'].iloc[0]):,} unknowns "
        f"a reduced query takes about {1e3 * reduced['online_s'].median():.2g} ms and a full solution "
        f"{reduced['hf_s'].median():.2g} s. None of the bounds is violated.",
        models(reduced[reduced["dual"] == "mcpg"]).drop(columns=["problem", "dual", "queries ok"]),
    )
    assert not bounded["violations"].any()
    page.draw("pressed", pressed())
    page.file(
        "theory",
        "relative differences from the closed form at parameters (R_x, R_y, δ, ν), and seconds; `flat` is the force of "
        "paraboloids of fifty times the radii, without slopes; axes are √5 times the radii of inertia of the pressure",
        compared,
    )
    page.file("rates", "orders of convergence of the force without slopes, two by theory", rates(compared))
    page.file(
        "growth", "seconds of a solution with its factorisation, and exponents in the unknowns", exponents(compared)
    )
    page.file("far-face", "the far face at other distances, in largest semi-axes, on `coarse`", far_faces())
    page.file("models", "dimensions, constants and errors of every model", models(cells))
    page.file("bounds", "median effectivities; those of u include the error of λ", bounded)
    page.file("seconds", "seconds offline by stage, of a query, and of a full solution", seconds(cells))
    page.file("break-even", "gains with 95 % intervals, and from how many queries a model is cheaper in total", pays)
    if cells["dim_V"].nunique() > 1:
        page.file("stages", "offline seconds, and exponents in the unknowns", stages(cells))
        page.file("queries", "queries of equal dimensions, the finer mesh over the coarser one", growth(cells))
    page.file("cells", "every cell, with all columns", cells)
    page.write()


if __name__ == "__main__":
    start(main)
