"""Half-space pressed by a rigid paraboloid: writes the arrays of a pack. python3 paraboloid.py FOLDER N.

One quarter, by symmetry, of a block of hexahedra that are graded towards the contact.
"""

import sys
from pathlib import Path

import getfem as gf
import numpy as np

folder, n = Path(sys.argv[1]), int(sys.argv[2])
zone, edge, growth = 0.06, 1.2, 1.7  # potential contact zone of n×n cells, far faces, sizes of successive layers [m]

along = np.linspace(0.0, zone, n + 1)
size = along[1]
while along[-1] < edge:
    size *= growth
    along = np.append(along, along[-1] + size)
mesh = gf.Mesh("cartesian", along, along, np.flip(-along))
top = mesh.outer_faces_with_direction([0.0, 0.0, 1.0], 0.1)
corners = [mesh.pts()[:, mesh.pid_from_cvid(int(cell))[0]].max(axis=1) for cell in top[0]]
mesh.set_region(1, top[:, [max(corner[0], corner[1]) < zone * 1.001 for corner in corners]])

displacement, nodal = gf.MeshFem(mesh, 3), gf.MeshFem(mesh, 1)
for field in (displacement, nodal):
    field.set_classical_fem(1)
integration = gf.MeshIm(mesh, gf.Integ("IM_HEXAHEDRON(5)"))
model = gf.Model("real")
model.add_fem_variable("u", displacement)
model.add_fem_variable("p", nodal)
iu, ip = (start + np.arange(size) for start, size in map(model.interval_of_variable, "up"))
contact = ip[nodal.basic_dof_on_region(1)]
nodes, component = displacement.basic_dof_nodes(), np.arange(len(iu)) % 3
far = (nodes[:2] > along[-1] - 1e-9).any(axis=0) | (nodes[2] < 1e-9 - along[-1])
clamped = far | (nodes[0] < 1e-9) & (component == 0) | (nodes[1] < 1e-9) & (component == 1)


def save(name, form, rows, columns, region=-1):
    """Write the matrix of a bilinear form."""
    whole = gf.asm_generic(integration, 2, form, region, model)
    gf.Spmat("copy", whole, rows, columns).save("mm", str(folder / f"{name}.mtx"))


save("A_lame", "Div_u*Div_Test_u", iu, iu)
save("A_shear", "2*Sym(Grad_u):Grad_Test_u", iu, iu)
save("X_V", "Grad_u:Grad_Test_u", iu, iu)
save("X_W", "p*Test_p", contact, contact, 1)
save("B", "u(3)*Test_p", contact, iu, 1)  # B u <= g: no point moves upwards beyond the paraboloid
gaps = {"along_x": "X(1)*X(1)/2", "along_y": "X(2)*X(2)/2", "approach": "-1"}
vectors = {name: gf.asm_generic(integration, 1, f"({gap})*Test_p", 1, model)[contact] for name, gap in gaps.items()}
np.savez(folder / "vectors.npz", free=np.flatnonzero(~clamped), f=np.zeros(len(iu)), **vectors)
