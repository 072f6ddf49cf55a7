"""Models and solutions as notebooks and tables show them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from vibench.offline.models import Model, Solution


def about_model(model: Model) -> dict[str, Any]:
    """What a model is, by what it is called."""
    problem = model.row.get("problem") or type(model.problem).__name__
    return {
        "problem": str(problem), "R": model.reduced.generators.shape[1],
        "parameters": ", ".join(model.parameters.names), "solver": model.solver, "accuracy": model.accuracy,
        "bounds": "none" if model.certificate is None else model.certificate.base.guarantee.value,
    }  # fmt: skip


def about_solution(solution: Solution, names: Sequence[str]) -> dict[str, Any]:
    """What a solution is: a row of the table of many."""
    found: dict[str, Any] = dict(zip(names, solution.mu.tolist(), strict=True))
    found |= {"status": solution.status.value, "reason": solution.reason}
    found["residual"] = None if solution.residuals is None else solution.residuals.worst
    if solution.bound is not None:
        bound = solution.bound
        found |= {"bound_u_energy": bound.u_energy, "bound_lambda_natural": bound.lambda_natural}
        found |= {"bound_u_relative": bound.relative, "guarantee": bound.guarantee.value, "verdict": solution.verdict}
    if solution.x is not None:
        found |= {f"output:{name}": value for name, value in solution.outputs.items()}
        bounds = solution.output_bounds if solution.bound is not None else {}
        found |= {f"bound:{name}": value for name, value in bounds.items()}
    return found | {"assembly": solution.assembly, "solution": solution.solution}


def html(title: str, given: Mapping[str, Any]) -> str:
    """A table of two columns, for notebooks."""
    texts = ((name, f"{value:.3g}" if isinstance(value, float) else str(value)) for name, value in given.items())
    body = "".join(f"<tr><th>{escape(name)}</th><td>{escape(text)}</td></tr>" for name, text in texts if text)
    return f"<table><caption>{escape(title)}</caption><tbody>{body}</tbody></table>"
