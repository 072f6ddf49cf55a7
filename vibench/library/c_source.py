"""An exported model as one C99 source: its arrays, and a template that evaluates them and solves the program."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from importlib.resources import files
from string import Template
from typing import Any

import numpy as np

from vibench.arrays import Array, Indices
from vibench.interfaces.problem import MEMBERS
from vibench.model.chebyshev import AffinePolynomial

TEMPLATE = "reduced_model.c.template"
PER_LINE = 4


def source(
    members: Mapping[str, AffinePolynomial], arrays: Mapping[str, Array], about: Mapping[str, Any], stem: str
) -> str:
    """The C source of a model whose basis does not depend on the parameter; its function is called after `stem`."""
    name = re.sub(r"\W", "_", f"model_{stem}" if not stem[:1].isalpha() else stem, flags=re.ASCII)
    box, cell = about["parameters"], about["cell"]
    return Template((files("vibench.library") / TEMPLATE).read_text(encoding="utf-8")).substitute(
        name=name,
        macro=name.upper(),
        origin=_comment(f"{cell['problem']}, {cell['dual']}, {cell['primal']}; cell {cell['cell']}"),
        licence=_comment(f"{about['source']['distribution']}, {about['source']['licence']}"),
        exporter=_comment(about["exported_by"]),
        parameters=_comment(", ".join(f"{n} [{u}]" for n, u in zip(box["names"], box["units"], strict=True))),
        dimension=len(arrays["lower"]),
        unknowns=members["f"].terms.shape[1],
        constraints=members["g"].terms.shape[1],
        degree=max(max(member.degrees) for member in members.values()),
        terms=max(len(member.terms) for member in members.values()),
        accuracy=repr(float(about["accuracy"])),
        lower=_numbers(arrays["lower"]),
        upper=_numbers(arrays["upper"]),
        members="\n".join(_member(key, members[key]) for key in MEMBERS),
    )


def _member(name: str, member: AffinePolynomial) -> str:
    """Arrays of one member: degrees, coefficients that are not zero, product by product, and terms."""
    products, terms = member.coefficients.shape
    rows, columns = np.nonzero(member.coefficients)
    starts = np.searchsorted(rows, np.arange(products + 1))
    # C has no arrays without elements.
    columns, values = (columns, member.coefficients[rows, columns]) if len(rows) else (np.zeros(1, int), np.zeros(1))
    return (
        f"enum {{ {name}_PRODUCTS = {products}, {name}_TERMS = {terms} }};\n"
        f"static const int {name}_degrees[] = {{\n{_numbers(member.indices)}\n}};\n"
        f"static const int {name}_starts[] = {{\n{_numbers(starts)}\n}};\n"
        f"static const int {name}_columns[] = {{\n{_numbers(columns)}\n}};\n"
        f"static const double {name}_coefficients[] = {{\n{_numbers(values)}\n}};\n"
        f"static const double {name}_terms[] = {{\n{_numbers(member.terms)}\n}};\n"
    )


def _numbers(values: Array | Indices) -> str:
    """Numbers that a compiler reads back to the last bit."""
    texts = [repr(value) for value in np.ravel(values).tolist()]
    return ",\n".join(", ".join(texts[k : k + PER_LINE]) for k in range(0, len(texts), PER_LINE))


def _comment(text: str) -> str:
    """A text that cannot end a comment, in ASCII."""
    kept: Iterable[str] = (char if re.fullmatch(r"[\w .,;:()\[\]=+-]", char, re.ASCII) else "_" for char in text)
    return "".join(kept)
