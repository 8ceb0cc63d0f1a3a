"""Algorithm 1 of the paper step by step, from the functions that the matcher is made of.

python examples/quotient_by_hand.py
"""

import torchqm
from torchqm.fmap import fmap_to_p2p, quotient_icp, solve_fmap
from torchqm.geometry import area_samples
from torchqm.spectral import split_descriptors, unit_columns, wave_energies, wave_kernel_signature

# Two poses of one creature, and the symmetry of each: here they are known exactly.
x = torchqm.creature("quadruped", 1000, pose=1)
y = torchqm.creature("quadruped", 1000)
group_x, group_y = torchqm.SymmetryGroup(x.base_group), torchqm.SymmetryGroup(y.base_group)
mesh_x, mesh_y = x.mesh.normalized(), y.mesh.normalized()

# 1. Bases of the symmetric functions L2+, with their own eigenvalues.
basis_x, basis_y = torchqm.mesh_basis(mesh_x, 30), torchqm.mesh_basis(mesh_y, 30)
even_x = torchqm.symmetrized_basis(basis_x, group_x).even
even_y = torchqm.symmetrized_basis(basis_y, group_y).even
print(f"{even_x.k} of 30 functions are symmetric")

# 2. Descriptors at the same energies on both shapes, split into where they take which value, as coefficients.
energies = wave_energies([basis_x, basis_y], n=100)
values = split_descriptors([wave_kernel_signature(b, energies) for b in (basis_x, basis_y)], s=5)
f, g = unit_columns([even_x.coefficients(values[0]), even_y.coefficients(values[1])])

# 3. and 4. Descriptor preservation and Laplacian commutativity in least squares.
fmap = solve_fmap(f, g, even_x.evals, even_y.evals, weight=100 * f.shape[1] / even_x.k)

# 5. Quotient-ICP, then the point-to-orbit map.
fmap = quotient_icp(fmap, even_x, even_y, area_samples(mesh_x, 1000), steps=20)
orbit_map = fmap_to_p2p(fmap, even_x, even_y)

# The two share their triangulation, so vertex i belongs to the orbit of vertex i.
positions = mesh_y.verts[group_y.orbits[orbit_map]]
error = (positions - mesh_y.verts[:, None]).norm(dim=2).min(1).values.mean()
print(f"mean distance from the true orbit: {error:.4f} sqrt(area)")
