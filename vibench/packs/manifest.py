"""The manifest of a model pack, `pack.toml`: its schema, and one line for what is wrong with it."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self, TypeAlias

from annotated_types import Ge, Gt, MinLen
from pydantic import AllowInfNan, BaseModel, ConfigDict, Field, ValidationError, model_validator

from vibench.errors import RequestError, fault_line, placed
from vibench.interfaces.affine import normal_names
from vibench.packs.array_files import safe_path

# Name of the manifest in its folder.
FILE = "pack.toml"

Finite: TypeAlias = Annotated[float, AllowInfNan(False)]
Text: TypeAlias = Annotated[str, MinLen(1)]
Points: TypeAlias = Annotated[list[Annotated[list[Finite], MinLen(1)]], MinLen(1)]


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)
    alternatives: ClassVar[tuple[str, ...]] = ()  # keys of which a table has exactly one

    @model_validator(mode="after")
    def _one(self) -> Self:
        given = [key for key in self.alternatives if getattr(self, key) is not None]
        if self.alternatives and len(given) != 1:
            found = " and ".join(given) or "none"
            raise ValueError(f"give exactly one of {', '.join(self.alternatives)} (found {found})")
        return self


class PointSet(_Table):
    """Parameters: an array (P×d), a list of points, or the counts of a regular grid in the box; exactly one."""

    alternatives = ("array", "points", "grid")
    array: Annotated[str | None, Field(description="An array (P×d).")] = None
    points: Annotated[Points | None, Field(description="A list of points.")] = None
    grid: Annotated[list[Annotated[int, Ge(1)]] | None, Field(description="Points of a grid per parameter.")] = None

    @model_validator(mode="before")
    @classmethod
    def _short(cls, value: Any) -> Any:
        if isinstance(value, list):
            return {"points": [point if isinstance(point, list) else [point] for point in value]}
        return {"array": value} if isinstance(value, str) else value


class Parameters(_Table):
    """The parameter domain, and the training and validation sets."""

    names: Annotated[list[Text], MinLen(1), Field(description="One name per parameter, an identifier.")]
    units: Annotated[list[Text] | None, Field(description='Units; "1", the default, for numbers.')] = None
    lower: Annotated[list[Finite] | None, Field(description="Lower bounds; by default those of the sets.")] = None
    upper: Annotated[list[Finite] | None, Field(description="Upper bounds.")] = None
    training: Annotated[PointSet, Field(description="Training set.")]
    validation: Annotated[PointSet | None, Field(description="Validation set; by default random in the box.")] = None


class Term(_Table):
    """One term θ_q(µ)·term_q of an affine sum; θ_q is an expression, or tabulated at the listed parameters."""

    alternatives = ("theta", "table")
    theta: Annotated[str | Finite | None, Field(description="Expression in the names of the parameters.")] = None
    table: Annotated[str | None, Field(description="Or an array of values at the listed parameters.")] = None
    array: Annotated[str, Field(description="The matrix or vector.")]


class Member(_Table):
    """One of A, f, B, g: an array, an affine sum, or one array per listed parameter; exactly one."""

    alternatives = ("constant", "affine", "each")
    constant: Annotated[str | None, Field(description="An array that does not depend on the parameter.")] = None
    affine: Annotated[list[Term] | None, MinLen(1), Field(description="Terms of an affine sum.")] = None
    each: Annotated[str | None, Field(description="Arrays by listed parameter, {} its number; or columns.")] = None

    @model_validator(mode="before")
    @classmethod
    def _short(cls, value: Any) -> Any:
        return {"constant": value} if isinstance(value, str) else value


class Spaces(_Table):
    """The inner products, and what belongs to the unknowns and the multipliers."""

    X_V: Annotated[str | None, Field(description="Gram matrix of the primal space (n×n), required with operators.")] = (
        None
    )
    X_W: Annotated[str, Field(description="Gram matrix of the multiplier space (m×m).")]
    free: Annotated[str | None, Field(description="Indices of the free unknowns, if arrays have others, too.")] = None
    contact: Annotated[str | None, Field(description="Indices of the unknowns B touches; by default found.")] = None
    integrals: Annotated[str | None, Field(description="Integrals (m,) of multiplier functions; else X_W·1.")] = None


class Operators(_Table):
    """The members of the variational inequality."""

    A: Annotated[Member, Field(description="Stiffness (n×n), symmetric positive definite.")]
    f: Annotated[Member, Field(description="Load (n,).")]
    B: Annotated[Member, Field(description="Constraint (m×n).")]
    g: Annotated[Member, Field(description="Bound (m,).")]
    entrywise: Annotated[
        list[Literal["A", "f", "B", "g"]] | None,
        Field(description="Members interpolated in reduced assembly; by default all that depend on the parameter."),
    ] = None


class Block(_Table):
    """Rows whose multipliers are bounded, |λ| ≤ c, as for friction; the others are contact, λ ≥ 0."""

    kind: Annotated[Literal["interval"], Field(description="Kind of the rows.")]
    rows: Annotated[str | None, Field(description="Their indices (k,); by default all rows.")] = None
    radius: Annotated[str | Finite, Field(description="The c > 0: a number, or an array (k,).")]


class Solutions(_Table):
    """Reference solutions, one column per parameter."""

    u: Annotated[str | None, Field(description="Solutions (n×P).")] = None
    lam: Annotated[str, Field(description="Multipliers (m×P).")]
    parameters: Annotated[PointSet | None, Field(description="Their parameters; else the listed, or training.")] = None
    tolerance: Annotated[float, Gt(0.0), AllowInfNan(False), Field(description="Largest relative KKT residual.")] = 1e-6


class Mesh(_Table):
    """A mesh for pictures."""

    file: Annotated[str, Field(description="A file with the whole mesh that meshio reads, such as .vtu or .msh.")]
    points: Annotated[str, Field(description="Indices (k,) of mesh points.")]
    unknowns: Annotated[str | None, Field(description="Indices (k,) of the unknowns there; else all in order.")] = None
    positions: Annotated[str, Field(description="Points of the multipliers (m×1 or m×2).")]
    value: Annotated[str, Field(description="Name of the solution, with its unit.")] = "u"
    multiplier: Annotated[str, Field(description="Name of the multiplier, with its unit.")] = "λ"


class LinearOutput(_Table):
    """A quantity of interest that is linear in u and λ; coefficients of at least one of them."""

    name: Annotated[Text, Field(description="What it is.")]
    unit: Annotated[Text, Field(description="Its unit.")] = "1"
    u: Annotated[str | None, Field(description="Coefficients of the unknowns (n,).")] = None
    lam: Annotated[str | None, Field(description="Coefficients of the multipliers (m,).")] = None

    @model_validator(mode="after")
    def _some(self) -> LinearOutput:
        if self.u is None and self.lam is None:
            raise ValueError("give coefficients of 'u', of 'lam', or of both")
        return self


class Manifest(_Table):
    """`pack.toml`."""

    format: Annotated[int, Field(description="Version of the format: 1.")]
    name: Annotated[str, Field(description="Name of the model.")] = ""
    description: Annotated[str, Field(description="What it is a model of.")] = ""
    source: Annotated[str, Field(description="The code and the script it comes from.")] = ""
    license: Annotated[str, Field(description="Licence of the data.")] = ""
    index_base: Annotated[
        Literal[0, 1], Field(description="The first index of index arrays and triplets; 1 in Matrix Market always.")
    ] = 0
    parameters: Annotated[Parameters, Field(description="The parameters, their box, and sets of them.")]
    spaces: Annotated[Spaces, Field(description="The inner products.")]
    operators: Annotated[Operators | None, Field(description="Without them the pack has its dual half only.")] = None
    K: Annotated[list[Block], Field(description="Rows with bounded multipliers.")] = []
    solutions: Annotated[Solutions | None, Field(description="Reference solutions, which show signs.")] = None
    mesh: Annotated[Mesh | None, Field(description="A mesh, for pictures.")] = None
    outputs: Annotated[list[LinearOutput], Field(description="Quantities of interest.")] = []


def references(value: Any, place: tuple[str, ...] = ()) -> Iterator[tuple[str, str]]:
    """The arrays that a manifest names, "FILE" or "FILE:NAME", and the mesh, each after its place."""
    if isinstance(value, BaseModel):
        for name, part in value:
            yield from references(part, (*place, name))
    elif isinstance(value, list):
        for k, part in enumerate(value):
            yield from references(part, (*place, str(k)))
    # Keys whose texts refer to files.
    elif isinstance(value, str) and place[-1] in {
        "X_V", "X_W", "free", "contact", "integrals", "constant", "each", "table", "array", "u", "lam", "file",
        "points", "unknowns", "positions", "rows", "radius",
    }:  # fmt: skip
        yield ".".join(name for name in place if name not in ("constant", "array")), value


def read_manifest(folder: Path) -> Manifest:
    """Read and check a manifest; a `RequestError` names the key, what is wrong with it, and what is expected."""
    path = safe_path(folder, FILE)
    if (size := path.stat().st_size) > (most := 2**24):
        raise RequestError(f"{FILE} has {size} bytes, at most {most} are read; write points to an array")
    try:
        # Editors may put a byte-order mark in front, which TOML does not know.
        content = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise RequestError(f"{FILE} cannot be read: {error.strerror}") from None
    except (ValueError, RecursionError) as error:
        raise RequestError(f"{FILE}: not valid TOML: {error}") from None
    # Before the schema: keys of another version would be faults of this one.
    if isinstance(version := content.get("format", 1), int) and version != 1:
        raise RequestError(f"{FILE}: format is {version}; this version of vibench reads format 1")
    with placed(FILE):
        try:
            manifest = Manifest.model_validate(content)
        except ValidationError as error:
            raise RequestError(fault_line(error, Manifest)) from None
        _check_parameters(manifest.parameters)
        names = [output.name for output in manifest.outputs]
        if len(set(names)) < len(names):
            raise RequestError(f"outputs: two of them have the same name: {', '.join(names)}")
    return manifest


def _check_parameters(given: Parameters) -> None:
    for name in given.names:
        if not name.isidentifier():
            raise RequestError(f"parameters.names: '{name}' cannot stand in expressions; use letters, digits and _")
    with placed("parameters.names"):
        normal_names(given.names)
    for key in ("units", "lower", "upper"):
        values = getattr(given, key)
        if values is not None and len(values) != len(given.names):
            raise RequestError(f"parameters.{key} has {len(values)} entries for {len(given.names)} parameters")
    if (given.lower is None) != (given.upper is None):
        raise RequestError("parameters: give both 'lower' and 'upper', or neither")
    for name, low, high in zip(given.names, given.lower or (), given.upper or (), strict=False):
        if low > high:
            raise RequestError(f"parameters: the lower bound {low:g} of '{name}' is above its upper bound {high:g}")
    # Neither has points from which a box could be taken.
    if given.lower is None and (given.training.grid is not None or given.validation is None):
        remedy = "'validation', which arrays at listed parameters need, or " * (given.training.grid is None)
        needs = "parameters: a grid, or a random validation set, needs the box"
        raise RequestError(f"{needs}: give {remedy}'lower' and 'upper'")
