"""Elastic disc on a rigid parabola, pressed by its flat top: writes the arrays of a pack. python3 hertz.py FOLDER N."""

import sys
from pathlib import Path

import getfem as gf
import numpy as np

folder, n = Path(sys.argv[1]), int(sys.argv[2])
young, poisson, zone = 15.0, 0.35, 0.4  # plane strain; angle of the potential contact zone

# A quarter of the unit disc, its apex in the origin: the unit square, graded towards the apex, mapped on it.
mesh = gf.Mesh("triangles grid", np.linspace(0.0, 1.0, n + 1) ** 1.5, 1.0 - np.linspace(1.0, 0.0, n + 1) ** 2)
a, b = mesh.pts()
mesh.set_pts(np.array([a * np.sqrt(1.0 - b**2 / 2.0), 1.0 - b * np.sqrt(1.0 - a**2 / 2.0)]))
mesh.set_region(1, mesh.outer_faces_with_direction([0.0, -1.0], zone))

displacement, nodal = gf.MeshFem(mesh, 2), gf.MeshFem(mesh, 1)
for field in (displacement, nodal):
    field.set_classical_fem(1)
integration = gf.MeshIm(mesh, gf.Integ("IM_TRIANGLE(6)"))
model = gf.Model("real")
model.add_fem_variable("u", displacement)
model.add_fem_variable("p", nodal)
iu, ip = (start + np.arange(size) for start, size in map(model.interval_of_variable, "up"))
contact = ip[nodal.basic_dof_on_region(1)]
x, y = displacement.basic_dof_nodes()
components = np.arange(len(iu)) % 2
clamped = (x < 1e-9) & (components == 0) | (y > 1.0 - 1e-9) & (components == 1)  # axis of symmetry, flat top


def save(name, form, rows, columns, region=-1):
    """Write the matrix of a bilinear form."""
    whole = gf.asm_generic(integration, 2, form, region, model)
    gf.Spmat("copy", whole, rows, columns).save("mm", str(folder / f"{name}.mtx"))


lame, shear = young * poisson / ((1.0 + poisson) * (1.0 - 2.0 * poisson)), young / (2.0 * (1.0 + poisson))
save("A", f"{lame}*Div_u*Div_Test_u + 2*{shear}*Sym(Grad_u):Grad_Test_u", iu, iu)
save("X_V", "u.Test_u + Grad_u:Grad_Test_u", iu, iu)
save("X_W", "p*Test_p", contact, contact, 1)
save("B", "-u(2)*Test_p", contact, iu, 1)  # B u <= g: the displacement downwards is at most the gap
gaps = {"disc": "1 - sqrt(1 - X(1)*X(1))", "parabola": "X(1)*X(1)/2", "depth": "-1"}
vectors = {name: gf.asm_generic(integration, 1, f"({gap})*Test_p", 1, model)[contact] for name, gap in gaps.items()}
x_contact = nodal.basic_dof_nodes()[0, contact - ip[0]]
np.savez(folder / "vectors.npz", free=np.flatnonzero(~clamped), f=np.zeros(len(iu)), x=x_contact, **vectors)
