"""An exported model as one C99 source: its arrays, and a template that evaluates them and solves the program."""

from __future__ import annotations

import ast
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from importlib.resources import files
from string import Template
from types import MappingProxyType
from typing import Any

import numpy as np

from vibench.arrays import Array, Indices, Mask
from vibench.errors import RequestError
from vibench.interfaces.affine import CONSTANTS, AffineSum, Expression, Thetas
from vibench.interfaces.contact_source import ContactSource
from vibench.interfaces.problem import MEMBERS
from vibench.model.chebyshev import AffinePolynomial
from vibench.model.hyperreduced import AnyReducedModel, ContactTerms, HyperReducedModel


@dataclass(frozen=True)
class ExactMember:
    """A member Σ_q θ_q(mu) · terms_q whose θ_q are C expressions, with its flat terms (Q×size)."""

    thetas: tuple[str, ...]
    terms: Array

    @classmethod
    def from_sum(cls, declared: AffineSum, terms: Array) -> ExactMember | None:
        """The member of a declared sum with other terms; `None` if a θ_q is code."""
        texts = list[str]()
        for theta in declared.thetas.functions if isinstance(declared.thetas, Thetas) else (declared.thetas,):
            if isinstance(theta, Expression):
                texts.append(_in_c(ast.parse(theta.text.strip(), mode="eval").body, theta.names))
            elif callable(theta):
                return None
            else:
                texts.append(repr(float(theta)))
        return cls(tuple(texts), terms)


@dataclass(frozen=True)
class ContactCode:
    """The code of a problem that evaluates B and g in C, and what makes the reduced ones of its answers."""

    source: ContactSource
    terms: ContactTerms

    @classmethod
    def of(cls, queried: AnyReducedModel) -> ContactCode | None:
        """That of a model whose B and g are evaluated on the contact unknowns; `None` where there is none."""
        source, terms = queried.problem.contact_source(), None
        if source is not None and isinstance(queried, HyperReducedModel):
            terms = queried.contact_terms()
        return None if source is None or terms is None else cls(source, terms)

    def values(self, plain: int) -> dict[str, Any]:
        """Values of the template `reduced_model_contact`, where V_N has so many coordinates that no load touches."""
        terms, acting = self.terms, np.flatnonzero(self.terms.tested.any(axis=1))
        first, last = (int(acting[0]), int(acting[-1]) + 1) if len(acting) else (0, 1)
        columns = np.arange(1, terms.fixed.shape[1] + 1)
        lengths = [np.max((part != 0.0) * columns, axis=1, initial=0) for part in (terms.fixed, terms.reached)]
        arrays = {
            "reduced_eta": terms.tested[first:last], "reduced_fixed": terms.fixed, "reduced_reached": terms.reached,
            "reduced_lengths": lengths[1],
        }  # fmt: skip
        return {
            "contact_rows": len(terms.tested), "contact_entries": self.source.entries, "first_row": first,
            "acting": last - first, "first_unknown": terms.first, "reach": len(terms.reached),
            "least_columns": max(plain, *lengths[0]), "contact_text": contact_text(self.source),
            "contact_tables": "\n".join(map(_array, arrays, arrays.values())),
        }  # fmt: skip


def contact_text(source: ContactSource) -> str:
    """The code of a constraint, after the tables that it needs."""
    return "\n".join([*(_table(f"contact_{name}", table) for name, table in source.tables.items()), source.text])


def _in_c(node: ast.expr, names: Sequence[str]) -> str:
    """A checked expression in the parameters, as C."""
    match node:
        case ast.Constant(value=int() | float() as value):
            text = repr(float(value))
        case ast.Name(id=name):
            text = f"mu[{names.index(name)}]" if name in names else repr(float(CONSTANTS[name]))
        case ast.BinOp(left=left, op=op, right=right):
            one, other = _in_c(left, names), _in_c(right, names)
            signs: dict[type[ast.operator], str] = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/"}
            text = f"pow({one}, {other})" if isinstance(op, ast.Pow) else f"({one} {signs[type(op)]} {other})"
        case ast.UnaryOp(op=op, operand=operand):
            text = f"({'-' if isinstance(op, ast.USub) else '+'}{_in_c(operand, names)})"
        case ast.Call(func=ast.Name(id=name), args=arguments):
            values = [_in_c(each, names) for each in arguments]
            # Functions have the same names in both languages but for these, and two arguments at most in C.
            c_name = {"abs": "fabs", "min": "fmin", "max": "fmax"}.get(name, name)
            text = reduce(lambda a, b: f"{c_name}({a}, {b})", values) if len(values) > 1 else f"{c_name}({values[0]})"
        case _:
            raise RequestError(f"{ast.unparse(node)} is no checked expression")
    return text


def source(
    members: Mapping[str, AffinePolynomial], arrays: Mapping[str, Array], about: Mapping[str, Any], stem: str,
    thetas: Mapping[str, AffinePolynomial] = MappingProxyType({}),
    exact: Mapping[str, ExactMember] = MappingProxyType({}), code: ContactCode | None = None,
    sensors: Mapping[str, Any] = MappingProxyType({}),
) -> tuple[str, str]:  # fmt: skip
    """The C source of a model, and its header."""
    # The names of its functions begin with `stem`. With the `thetas` of a certificate it has error bounds. Members that
    # are `exact` take the place of polynomials with their names; B and g may be those of `code`.
    name = identifier(stem)
    box, cell, polynomials = about["parameters"], about["cell"], {**members, **thetas}
    own = {key: exact.get(key, polynomial) for key, polynomial in polynomials.items()}
    parameters, sets, factor = (arrays.get(f"start_{name}", np.zeros(0)) for name in ("parameters", "sets", "factor"))
    space = members["f"].terms.shape[1]
    tested = members["B"].terms.shape[1] // space if code is None else code.terms.tested.shape[1]
    constraints = members["g"].terms.shape[1] if code is None else code.terms.generators
    combination = None if code is None else code.terms.combination
    # The basis of a model that is enriched at every parameter begins with that of V_N.
    plain = arrays["plain"].shape[1] if "plain" in arrays else space
    supremizers = 0 if plain == space else tested - (constraints if combination is None else 0)
    values = {
        "name": name, "macro": name.upper(),
        "origin": _comment(", ".join(str(cell[key]) for key in ("problem", "dual", "primal", "cell") if key in cell)),
        "licence": _comment(", ".join(filter(None, about["source"].values()))),
        "exporter": _comment(about["exported_by"]),
        "parameters": _comment(", ".join(f"{n} [{u}]" for n, u in zip(box["names"], box["units"], strict=True))),
        "dimension": len(arrays["lower"]), "unknowns": plain + supremizers, "space": space, "plain": plain,
        "tested": tested, "constraints": constraints, "combined": int(combination is not None),
        "combination": _array("reduced_combination", np.zeros(0) if combination is None else combination),
        "degree": max((max(one.degrees) for one in own.values() if isinstance(one, AffinePolynomial)), default=0),
        "terms": max(-(-len(member.terms) // 4) * 4 for member in own.values()),
        "accuracy": repr(float(about["accuracy"])), "factorised": int(factor.size > 0), "factor": numbers(factor),
        "lower": numbers(arrays["lower"]), "upper": numbers(arrays["upper"]),
        "members": "\n".join(_member(key, own[key]) for key in MEMBERS if key in own), "starts": len(parameters),
        "start_parameters": numbers(parameters), "start_sets": numbers(sets, "char"),
    }  # fmt: skip
    # A function that nothing calls would be a warning of the compiler.
    some = any(isinstance(one, AffinePolynomial) for one in own.values())
    values["products"] = filled("reduced_model_products.c", {}) if some else ""
    if code is not None:
        values |= code.values(plain)
    of_constraint, of_space = "members" if code is None else "contact", "enriched" if supremizers else "fixed"
    values["constraint"] = filled(f"reduced_model_{of_constraint}.c", values)
    values["assembly"] = filled(f"reduced_model_{of_space}.c", values)
    parts: list[str] = []
    values["output_count"] = len(arrays.get("outputs_x", ()))
    if "outputs_x" in arrays:
        names = (f"{output['name']} [{output['unit']}]" for output in about["outputs"]["linear"])
        values["output_names"] = _comment(", ".join(names))
        values |= {"output_arrays": "\n".join(_array(key, arrays[key]) for key in ("outputs_x", "outputs_alpha"))}
        parts.append("outputs")
    if thetas:
        values |= _certified({key: own[key] for key in thetas}, arrays) | {"guarantee": about["certificate"]}
        values["contacts"] = len(arrays["certificate_basis"])
        kind, pair = ("scaled", "prepared_pair") if code is None else ("on_contact", "best_pair")
        values["certified_constraint"] = filled(f"reduced_model_{kind}.c", values)
        values["correction"] = filled(f"reduced_model_{pair}.c", values)
        parts += ["certificate", "certified_outputs"] if parts else ["certificate"]
    for kind, name in (("h", "declarations"), ("c", "code")):
        values[name] = "".join(filled(f"reduced_model_{part}.{kind}", values) for part in parts)
    if sensors:
        values["code"] += filled("reduced_model_sensors.c", {**values, **sensors})
    values["evaluated"] = "" if code is None else "; the code\n * of the problem evaluates B and g"
    header = filled("reduced_model.h", values)
    return filled("reduced_model.c", values | {"header": header}), header


def identifier(stem: str) -> str:
    """The name in C of a model whose file has this stem."""
    return re.sub(r"\W", "_", f"model_{stem}" if not stem[:1].isalpha() else stem, flags=re.ASCII)


def filled(template: str, values: Mapping[str, Any]) -> str:
    """A template of this folder with its values."""
    text = (files("vibench.offline") / "templates" / f"{template}.template").read_text(encoding="utf-8")
    return Template(text).substitute(values)


def _certified(thetas: Mapping[str, AffinePolynomial | ExactMember], arrays: Mapping[str, Array]) -> dict[str, Any]:
    """Values for the templates of a certificate: sizes, polynomials and arrays."""
    # These arrays exist only where A depends on the parameter; C needs them always.
    spectral = (
        "axes", "anchors", "lower", "upper", "counts", "places", "turn", "term_norms", "spectral_error", "ranges",
        "range_errors", "term_errors",
    )  # fmt: skip
    own: dict[str, Array] = {f"certificate_{name}": np.zeros(1) for name in spectral}
    own |= {name: array for name, array in arrays.items() if name.startswith("certificate_")}
    own.pop("certificate_lift", None)
    rows, (moved, loads) = len(own["certificate_generators"]), own["certificate_responses"].shape
    directions, kept = own["certificate_factor"].shape
    # Where the best correction is computed at the parameter, its rows are independent.
    near = len(own.get("certificate_near_compliance", ()))
    largest = max(loads, chosen := min(rows, near))
    norms = own["certificate_norms"].size
    # Doubles on the stack of the certificate, for its documentation in the header.
    numbers = largest * (largest + 1) // 2 + chosen**2 + 14 * rows + 20 * (largest + near) + norms + kept
    sizes = dict.fromkeys(("theta_B", "theta_g"), 1)
    sizes |= {name: polynomial.terms.shape[1] for name, polynomial in thetas.items()}
    declared = len(arrays.get("certificate_term_errors", ()))
    return sizes | {
        "rows": rows, "loads": loads, "near": near, "chosen": chosen, "largest": largest, "shifts": near or loads,
        "moved": moved, "directions": directions, "kept": kept, "residual_terms": norms,
        "spectral": int("certificate_anchors" in arrays), "stack": round(8e-3 * numbers) + 1,
        "ranges": len(arrays.get("certificate_ranges", ())), "leading": len(own["certificate_turn"]),
        "declared": declared, "stiffness_terms": sizes["theta_A"] - declared,
        "axes": len(arrays.get("certificate_axes", ())), "places": np.shape(own["certificate_places"])[-1],
        "thetas": "\n".join(_member(key, polynomial) for key, polynomial in thetas.items()),
        "arrays": "\n".join(map(_array, own, own.values())),
    }  # fmt: skip


def _table(name: str, table: Array | Indices | float) -> str:
    """The definition of an array, or of a number, in C."""
    if np.ndim(table):
        return _array(name, np.asarray(table))
    return f"enum {{ {name} = {table} }};" if isinstance(table, int) else f"static const double {name} = {table!r};"


def _array(name: str, array: Array | Indices, kind: str = "") -> str:
    kind = kind or ("int" if array.dtype.kind in "iu" and array.ndim else "double")
    return f"static const {kind} {name}[] = {{\n{numbers(array, kind)}\n}};"


def _member(name: str, member: AffinePolynomial | ExactMember) -> str:
    """Terms of one member, and a function that evaluates its θ."""
    count = len(member.terms)
    single, order = np.zeros(count, bool), np.arange(count)
    if isinstance(member, AffinePolynomial):
        # Terms of double precision come first, and those that most products need.
        single = _is_single(member.terms)
        order = np.lexsort([-np.count_nonzero(member.coefficients, axis=0), single])
    top = (
        f"enum {{ {name}_DOUBLES = {count - single.sum()}, {name}_SINGLES = {single.sum()} }};\n"
        f"{_array(f'{name}_terms', member.terms[order][~single[order]])}\n"
        f"{_array(f'{name}_single_terms', member.terms[order][single[order]], 'float')}\n"
        f"static void {name}_thetas(const double *mu, double polynomials[DIMENSION][DEGREE + 1], double *theta)\n"
        "{\n    (void)mu;\n    (void)polynomials;\n"
    )
    if isinstance(member, ExactMember):
        return top + "".join(f"    theta[{q}] = {text};\n" for q, text in enumerate(member.thetas)) + "}\n"
    # Every product has a prefix of coefficients, in fours.
    coefficients = np.pad(member.coefficients[:, order], ((0, 0), (0, -count % 4)))
    places = np.arange(coefficients.shape[1])
    counts = -(-np.max((coefficients != 0.0) * (places + 1), axis=1) // 4) * 4
    small, arrays, calls = _is_single(coefficients), "", ""
    for kind, number, chosen in (("products", "double", ~small), ("small_products", "float", small)):
        own, kept = f"{name}_{kind}", places < counts[chosen, None]
        arrays += f"{_array(f'{own}_degrees', member.indices[chosen], 'unsigned short')}\n"
        arrays += f"{_array(f'{own}_counts', counts[chosen], 'unsigned short')}\n"
        arrays += f"{_array(f'{own}_coefficients', coefficients[chosen][kept], number)}\n"
        given = f"{own}_degrees, {own}_counts, {own}_coefficients"
        calls += f"    add_{kind}(polynomials, {chosen.sum()}, {given}, theta);\n"
    return f"{arrays}{top}{calls}}}\n"


def _is_single(rows: Array) -> Mask:
    """Which rows single precision holds exactly."""
    with np.errstate(over="ignore"):
        return np.asarray((rows == rows.astype(np.float32)).all(axis=1))


def numbers(values: Array | Indices, kind: str = "double") -> str:
    """Numbers that a compiler reads back to the last bit."""
    # C has no arrays without elements.
    flat: Any = np.ravel(values if values.size else np.zeros(1)).astype({"float": "f", "double": "d"}.get(kind, "q"))
    texts = [str(value).replace("inf", "HUGE_VAL") for value in flat]
    return ",\n".join(", ".join(texts[k : k + 4]) for k in range(0, len(texts), 4))


def _comment(text: str) -> str:
    """A text that cannot end a comment, in ASCII."""
    return "".join(char if re.fullmatch(r"[\w .,;:()\[\]=+-]", char, re.ASCII) else "_" for char in text)
