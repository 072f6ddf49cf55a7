"""The membrane obstacle problem: its data, its figures, and the sentences of §5.1."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from claims.both import CONES, GENERATORS, comparison, ordering, orthogonality, projection_errors, stability, vanishing
from claims.computed import Snapshots
from claims.runs import Pair, Run
from claims.verdicts import DIMENSION, MESH, ORDER, Claim, holds, number, same_order, span, text, unknown
from vibench.interfaces.strategies import Stop
from vibench.reduction.cones import orthogonality as distances
from vibench_problems.obstacle import RADIUS, Obstacle

FIGURE_4 = np.array([0.9, 0.025, -0.025])
"""Parameter of Figure 4 in the reading used here: radius 0.18."""

NAME = "Obstacle"


@dataclass(frozen=True)
class Membrane:
    """What is computed for this problem: snapshots on the mesh of the study, and on one without its symmetry."""

    snapshots: Snapshots
    asymmetric: Snapshots

    @classmethod
    def computed(cls) -> Membrane:
        """Solve all."""
        return cls(Snapshots.of(Obstacle()), Snapshots.of(Obstacle(asymmetric=True)))

    @property
    def problem(self) -> Obstacle:
        """The problem of the study."""
        assert isinstance(self.snapshots.problem, Obstacle)
        return self.snapshots.problem


def data(run: Run, membrane: Membrane) -> Iterator[Claim]:
    """Geometry, parameters, mesh."""
    problem, lam = membrane.problem, membrane.snapshots.lam
    box, training, name = problem.parameters, problem.training_set(), f"{NAME}, §5.1"
    yield from geometry(problem)
    centre = (float(box.lower[1]), float(box.upper[1]))
    yield number(f"{NAME}, (35): range of the coordinates of the centre [m]", (-0.05, 0.05), centre)
    yield number(f"{name}: coefficient of ψ [1/m]", -1.25, problem.obstacle)
    yield number(f"{name}: load [1/m]", -1, problem.load)
    radii = np.linalg.norm(problem.mesh.p[:, problem.disc_nodes], axis=0)
    rim, reach = radii > RADIUS * (1.0 - 1e-9), radii[np.any(lam > 0.0, axis=1)].max() / RADIUS
    yield holds(
        f"{name}: constraints at the boundary of ω(µ) are inactive",
        "yes",
        f"{np.count_nonzero(lam[rim])} active at {rim.sum()} nodes",
        not np.any(lam[rim]),
        why=f"At all {len(training)} training parameters; the contact extends to {reach:.2g} of the radius.",
    )
    steps = [float(np.diff(np.unique(training[:, k]))[0]) for k in (0, 1)]
    yield number(f"{name}: training points, steps of the grid", (125, 0.1, 0.025), (len(training), *steps))
    yield number(
        f"{name}: validation points, uniform random",
        64,
        int(run.cells["queries"].max()),
        why="The sample is another one; that of the paper is not published.",
    )
    yield from mesh(run, problem)


def geometry(problem: Obstacle) -> Iterator[Claim]:
    """The square, the disc, the sign of b."""
    radii = [_radius(problem, scale) for scale in (problem.parameters.lower[0], problem.parameters.upper[0])]
    yield number(f"{NAME}, §5.1, Fig. 2: side A of Ω [m]", 1, float(np.ptp(problem.mesh.p[0])))
    yield number(
        f"{NAME}, (35): range of the radius r = µ₁ of ω(µ) [m]",
        (0.8, 1.2),
        radii,
        cause="A disc of radius 0.8 m does not fit into a square of side 1 m. µ₁ is taken as the ratio of the radius "
        f"to that of ω̂, {RADIUS} m.",
    )
    yield number(
        f"{NAME}, §5.1: radius of ω̂ that 467 of 3594 nodes imply [m]",
        float(np.sqrt(467 / 3594 / np.pi)),
        RADIUS,
        within=0.05,
        why="√(467 / 3594 / π) on a uniform mesh, within 5 %.",
    )
    yield number(
        f"{NAME}, Fig. 4: µ₁ = 0.18, which is outside (35)",
        0.18,
        _radius(problem, FIGURE_4[0]),
        why=f"The radius at µ₁ = {FIGURE_4[0]} [m].",
    )
    B = problem.constraint(FIGURE_4)[0]
    yield holds(
        f"{NAME}, (40): sign of b(v, η) for v, η ≥ 0",
        "positive",
        "positive" if B.data.sum() > 0.0 else "negative",
        B.data.sum() > 0.0,
        cause="b(u, η) ≤ g(η) means u ≥ ψ only with a minus sign in b and in g.",
    )


def mesh(run: Run, problem: Obstacle) -> Iterator[Claim]:
    """Sizes of the mesh, and what is not published."""
    name = f"{NAME}, §5.1"
    yield number(f"{name}: nodes", 3594, problem.nodes, within=MESH)
    yield number(f"{name}: nodes in ω̂", 467, len(problem.disc_nodes), within=MESH)
    cause = "The paper counts the nodes on Γ, where u = 0."
    yield number(f"{name}: primal degrees of freedom", 3594, problem.V.dim, within=MESH, cause=cause)
    yield number(f"{name}: dual degrees of freedom", 467, problem.W.dim, within=MESH)
    yield unknown(f"{name}: norm of V", "not given", "(44), ℓ̂ = 1 m", "The constants, σ and N depend on it.")
    yield unknown(f"{name}: h(µ) outside ω̂", "smooth, invertible", "harmonic extension", "The paper gives no formula.")
    yield unknown(
        f"{NAME}, Fig. 3: largest aspect ratio of the mesh, over D_train ∪ D_valid",
        "satisfactory",
        span(run.diagnostics("aspect_ratio")),
        "The text has no number. Here 1 is equilateral; Salome may define the ratio otherwise.",
    )


def _radius(problem: Obstacle, scale: float) -> float:
    points = problem.points(np.array([scale, 0.0, 0.0]))[:, problem.disc_nodes]
    return float(np.linalg.norm(points, axis=0).max())


def results(run: Run, membrane: Membrane) -> Iterator[Claim]:
    """Figures 4 to 8 and the sentences about them."""
    pairs, lam = run.pairs(), membrane.snapshots.lam
    active = np.count_nonzero(lam, axis=0)
    yield unknown(
        "Fig. 4: u and λ",
        "in the figure only",
        f"{active.min()} to {active.max()} of {len(lam)} multipliers active, λ up to {lam.max():.3g}",
        "Pictures of three solutions are in `results/paper-obstacle`.",
    )
    yield from dimensions(pairs, membrane)
    yield from projection_errors(run, pairs, "Fig. 5")
    yield from orthogonality(run, "Fig. 6")
    yield from without_symmetry(membrane.asymmetric)
    yield from vanishing(run, pairs[:2], "§5.1")
    yield from almost_zero(run, pairs[2])
    yield from greedy(run, pairs)
    yield from stability(run, pairs, "Fig. 7 right")
    yield from ordering(run, pairs, "Fig. 8")


def dimensions(pairs: Sequence[Pair], membrane: Membrane) -> Iterator[Claim]:
    """Sizes of the reduced bases for the tolerances of §5.1."""
    yield number(
        "Fig. 5 left, §5.1: N for δ_POD = 1e-3, 1e-4, 1e-6, of 125",
        [pair.paper.size[0] for pair in pairs],
        [int(pair.plain["N"]) for pair in pairs],
        within=DIMENSION,
        cause="The norm of V and h outside ω̂, on which û depends, are not published.",
    )
    other = [membrane.asymmetric.cone(Stop(tolerance=tolerance)).size for tolerance in (1e-2, 1e-3)]
    yield number(
        "Fig. 5 right, §5.1: R for δ_mCPG = 1e-2, 1e-3, of 125",
        [pair.paper.size[1] for pair in pairs[:2]],
        [int(pair.plain["R"]) for pair in pairs[:2]],
        within=DIMENSION,
        why=f"With the nodes displaced at random, {text(other)}.",
    )


def without_symmetry(snapshots: Snapshots) -> Iterator[Claim]:
    """The comparison of CPG and mCPG on a mesh on which no snapshots are mirror images of others."""
    stop = Stop(tolerance=1e-3)
    plain, modified = snapshots.cone(stop, "cpg"), snapshots.cone(stop)
    errors = [dict(enumerate(map(float, cone.errors))) for cone in (modified, plain)]
    apart = [dict(enumerate(map(float, distances(cone.generators, snapshots.problem.W)))) for cone in (plain, modified)]
    why = "On a mesh whose nodes are displaced at random, where no two snapshots are equally far from a cone."
    yield comparison("Fig. 5 right: e_mCPG(r) ≤ e_CPG(r), without symmetry", *errors, CONES, why)
    yield comparison("Fig. 6: e_orth(r) of CPG ≤ that of mCPG, without symmetry", *apart, GENERATORS, why)


def almost_zero(run: Run, pair: Pair) -> Iterator[Claim]:
    """β_dec of the pair with N ≥ R."""
    found, reference = (run.constants(pair.plain, f"beta_{which}span") for which in ("plain_", "hf_"))
    name = f"§5.1: β_dec over D_valid, {pair.name}"
    cone = run.constants(pair.plain, "beta_plain_cone_lower")
    yield holds(
        f"{name}, almost zero",
        "yes",
        f"at most {text(found.max() / reference.min())} of β_HF",
        found.max() <= 1e-6 * reference.min(),
        why=f"Over the span. Over the cone, as in (14), β_dec is {span(cone)}.",
    )
    yield holds(
        f"{name}, order of magnitude",
        "1e-7",
        span(found),
        same_order(1e-7, found),
        why=f"Within a factor {ORDER:.2g}.",
        cause="The square root of a smallest eigenvalue is accurate to about 1e-8 of the largest one. Here β is a "
        "smallest singular value.",
    )


def greedy(run: Run, pairs: Sequence[Pair]) -> Iterator[Claim]:
    """Convergence of PGA and the dimensions it gives."""
    added, sizes = ([int(pair.offline[key]) for pair in pairs] for key in ("enrichment", "R"))
    yield holds(
        "Fig. 7 left, §5.1: PGA reaches δ_PGA = 1e-3 in at most R iterations",
        f"R = {text([pair.paper.size[1] for pair in pairs])}",
        f"{text(added)} for R = {text(sizes)}",
        all(k <= size for k, size in zip(added, sizes, strict=True)),
        why="All µ share one S_R, of dimension R.",
    )
    courses = [list(run.enrichment(pair.offline, "beta_span_min").values()) for pair in pairs]
    yield holds(
        "Fig. 7 middle: min β over D_train recovers as vectors are added",
        "yes",
        ", ".join(f"{values[0]:.2g} → {values[-1]:.3g}" for values in courses),
        all(values[-1] > 1e6 * values[0] for values in courses),
        why="Over the span, from none to all vectors.",
    )
    off, on = ([pair.dimension(cell) for pair in pairs] for cell in ("offline", "online"))
    yield holds(
        "§5.1: primal dimension smaller off than on",
        "yes",
        f"off {text(off)}; on {text(on)}",
        all(one < other for one, other in zip(off, on, strict=True)),
        why="δ_PGA = 1e-3.",
        cause="PGA saves only those directions of S_R that V_N contains to within 1e-3.",
    )
    assembly = [pair.online["online_assemble_s"] - pair.offline["online_assemble_s"] for pair in pairs]
    shares = [seconds / pair.saving for seconds, pair in zip(assembly, pairs, strict=True)]
    yield holds(
        "§5.1: online time on is larger since the primal basis is reconstructed",
        "yes",
        f"assembly makes {text([f'{100 * share:.0f} %' for share in shares])} of the difference",
        min(shares) > 0.5 and min(pair.saving for pair in pairs) > 0.0,
        why="Assembly includes the supremizers and their orthonormalisation.",
    )
