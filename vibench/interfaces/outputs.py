"""Quantities of interest, pictures in the plane and fields on a mesh, which a problem derives from its solutions."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np

from vibench.arrays import Array, Indices
from vibench.errors import NumericalError, RequestError, in_a_line
from vibench.signatures import bordered, bordered_constructor

OutputFunction = Callable[[Array, Array, Array], float]
"""From a parameter mu (d,) and a solution u (n,), λ (m,) to a number."""


@bordered
@dataclass(frozen=True)
class Output:
    """A quantity of interest s: linear, s = uᵀ`u` + λᵀ`lam`, or else any function of (mu, u, λ).

    Attributes
    ----------
    name, unit
        Its name and its unit, "1" if it has none.
    u, lam
        Coefficients (n,) and (m,) of a linear output; one of the two may be missing.
    function
        The function of any other output.
    """

    name: str
    unit: str
    u: Annotated[Array, "n"] | None = None
    lam: Annotated[Array, "m"] | None = None
    function: OutputFunction | None = None

    def __post_init__(self) -> None:
        if self.linear == (self.function is not None):
            raise RequestError(f"the output '{self.name}' has either coefficients of u and λ, or a function")

    @property
    def linear(self) -> bool:
        """Whether it is linear in u and λ, with coefficients that do not depend on the parameter."""
        return self.u is not None or self.lam is not None

    def values(
        self, mus: Annotated[Array, "P", "d"], u: Annotated[Array, "n", "P"], lam: Annotated[Array, "m", "P"]
    ) -> Array:
        """Values (P,) of the output at parameters (P×d) and solutions, columns of u (n×P) and λ (m×P).

        Raises a `NumericalError` if coefficients have the wrong shape, the function fails, or a value is not finite.
        """
        if self.function is None:
            outputs = np.zeros(len(mus))
            for name, weights, columns in (("u", self.u, u), ("λ", self.lam, lam)):
                if weights is not None and np.shape(weights) != (len(columns),):
                    found = f"shape {np.shape(weights)}; expected ({len(columns)},)"
                    raise NumericalError(f"the output '{self.name}' has coefficients of {name} of {found}")
                outputs += 0.0 if weights is None else weights @ columns
        else:
            outputs = np.array([self._value(mus[k], u[:, k], lam[:, k]) for k in range(len(mus))])
        # The first one is enough for a message.
        for k in np.flatnonzero(~np.isfinite(outputs))[:1]:
            raise NumericalError(f"the output '{self.name}' is {outputs[k]} at mu = {mus[k].tolist()}")
        return outputs

    def _value(self, mu: Array, u: Array, lam: Array) -> float:
        assert self.function is not None  # `values` asks for no other
        try:
            # Copies: a function may write into its arguments, which others use after it.
            return float(self.function(mu.copy(), u.copy(), lam.copy()))
        except Exception as error:
            raise NumericalError(f"the output '{self.name}' fails at mu = {mu.tolist()}: {in_a_line(error)}") from error


@bordered_constructor
@dataclass(frozen=True)
class Picture:
    """A solution to be drawn.

    Attributes
    ----------
    points, triangles
        Mesh in the configuration to be drawn (2×p), (3×t); on a line points (1×p) and no triangles.
    values, name
        Nodal values of the colour map (p,), and their name with its unit.
    positions, multiplier
        Points of the multiplier (1×m on a line, 2×m in the plane) and its values (m,).
    multiplier_name
        Name of the multiplier, with its unit.
    length_unit
        Unit of the coordinates; "" where it is not said.
    """

    points: Annotated[Array, "dimension", "p"]
    triangles: Annotated[Indices, "corners", "t"]
    values: Annotated[Array, "p"]
    name: str
    positions: Annotated[Array, "k", "m"]
    multiplier: Annotated[Array, "m"]
    multiplier_name: str
    length_unit: str = ""

    def __post_init__(self) -> None:
        for name, right in (("points", (1, 2)), ("positions", (1, 2)), ("triangles", (3,))):
            if (rows := len(getattr(self, name))) not in right:
                raise RequestError(f"{name} of Picture has {rows} rows, expected {' or '.join(map(str, right))}")
        corners, count = self.triangles, self.points.shape[1]
        if corners.size and (corners.min() < 0 or corners.max() >= count):
            refers = f"refers to points {corners.min()} to {corners.max()}"
            raise RequestError(f"triangles of Picture {refers}; there are {count}")


@dataclass(frozen=True)
class MeshFields:
    """A solution on a mesh.

    Attributes
    ----------
    points
        Nodes (p×3), in the configuration to be shown.
    cells
        Corners (k×v) of the cells of every type, by meshio's names of the types, such as "triangle" or "hexahedron".
    at_points
        Fields at the nodes (p,) or (p×3), by name with unit; NaN where there is none.
    in_cells
        Fields in the cells of one type (k,), by type and by name with unit.
    """

    points: Array
    cells: Mapping[str, Indices]
    at_points: Mapping[str, Array]
    in_cells: Mapping[str, Mapping[str, Array]]

    def faults(self) -> Iterator[str]:
        """Faults of the fields: shapes, types, nodes that do not exist, cells inside out."""
        count = len(self.points)
        if faults := list(_real_faults("points", self.points, (count, 3), missing=False)):
            yield from faults
            return
        for name, corners in self.cells.items():
            yield from self._cell_faults(name, np.asarray(corners))
        for name, values in self.at_points.items():
            yield from _real_faults(f"at_points[{name!r}]", values, (count,), (count, 3))
        for owner, named in self.in_cells.items():
            if owner not in self.cells:
                yield f"in_cells has {owner!r}, of which there are no cells; expected one of {sorted(self.cells)}"
                continue
            for name, values in named.items():
                yield from _real_faults(f"in_cells[{owner!r}][{name!r}]", values, (len(self.cells[owner]),))

    def _cell_faults(self, name: str, corners: Indices) -> Iterator[str]:
        where, nodes = f"cells[{name!r}]", _node_counts()
        if name not in nodes:
            yield f"{where}: no type of cells; expected one of {', '.join(nodes)}"
        elif not np.issubdtype(corners.dtype, np.integer) or corners.ndim != 2 or corners.shape[1] != nodes[name]:
            yield f"{where} has dtype {corners.dtype} and shape {corners.shape}; expected indices (k, {nodes[name]})"
        elif corners.size and (corners.min() < 0 or corners.max() >= len(self.points)):
            yield f"{where} refers to nodes {corners.min()} to {corners.max()}; there are {len(self.points)}"
        elif count := np.count_nonzero(self._inverted(name, corners)):
            right = "expected nodes in the order of VTK, at every corner with edges that are right-handed"
            yield f"{where}: {count} of {len(corners)} cells are inside out or flat; {right}"

    def _inverted(self, name: str, corners: Indices) -> Any:
        """Mask of the cells (k,) of a type with a corner whose edges are not right-handed."""
        inverted = np.zeros(len(corners), dtype=bool)
        # Corners of cells in space, each followed by its neighbours: three edges with a positive determinant.
        right_handed = {
            "tetra": "0123", "hexahedron": "0134 1205 2316 3027 4750 5461 6572 7643",
        }.get(name.rstrip("0123456789"), "").split()  # fmt: skip
        for corner, *beside in (map(int, numbers) for numbers in right_handed):
            edges = self.points[corners[:, beside]] - self.points[corners[:, [corner]]]
            inverted |= np.linalg.det(edges) <= 0.0
        return inverted

    @classmethod
    def of_picture(cls, picture: Picture) -> MeshFields:
        """The triangles of a picture, or its line, with the colour map; the multiplier at vertices at its positions."""
        count, values = picture.points.shape[1], picture.values
        # Multipliers have vertices of their own, since they may lie between the nodes of the mesh.
        vertices = np.arange(count, count + picture.positions.shape[1])[:, None]
        points = np.zeros((count + len(vertices), 3))
        points[:count, : len(picture.points)] = picture.points.T
        points[count:, : len(picture.positions)] = picture.positions.T
        # Points on a line come in any order; its segments join neighbours.
        order = np.argsort(picture.points[0], kind="stable")
        line = {"line": np.column_stack([order[:-1], order[1:]])}
        cells = {"triangle": picture.triangles.T} if picture.triangles.size else line
        at_points = {picture.name: np.concatenate([values, np.full(len(vertices), np.nan)])}
        in_cells = {"vertex": {picture.multiplier_name: picture.multiplier}}
        return cls(points, cells | {"vertex": vertices}, at_points, in_cells)


def _node_counts() -> dict[str, int]:
    """Numbers of nodes of the types of cells, by meshio's names; the corners come first, as in VTK."""
    linear = ("vertex", "line", "triangle", "quad", "tetra", "pyramid", "wedge", "hexahedron")
    counts = dict(zip(linear, (1, 2, 3, 4, 4, 5, 6, 8), strict=True))
    # Types of higher order have their number of nodes at the end of their names.
    higher = (
        "line3", "triangle6", "quad8", "quad9", "tetra10", "pyramid13", "wedge15", "hexahedron20", "hexahedron27",
    )  # fmt: skip
    return counts | {name: int(name.lstrip("abcdefghijklmnopqrstuvwxyz")) for name in higher}


def _real_faults(name: str, values: Any, *shapes: tuple[int, ...], missing: bool = True) -> Iterator[str]:
    """Reasons why values are not floats in one of the shapes, finite or, where some may be missing, NaN."""
    given = np.asarray(values)
    if given.shape not in shapes or given.dtype != np.float64:
        expected = " or ".join(map(str, shapes))
        yield f"{name} has dtype {given.dtype} and shape {given.shape}; expected float64 of shape {expected}"
    elif np.isinf(given).any() or (not missing and np.isnan(given).any()):
        yield f"{name} is not finite"
