"""Floor 1: meshes, their files and faults, Laplacians, geodesic distances and samples of vertices."""

from torchqm.geometry.check import (
    MeshError,
    MeshReport,
    check_mesh,
    clean_faces,
    inspect_mesh,
    orient_faces,
    weld,
)
from torchqm.geometry.curvature import mean_curvature, vertex_normals
from torchqm.geometry.diffusion import diffused
from torchqm.geometry.geodesic import EdgePoints, distance_to_curve, distances, edge_graph, nodal_crossings
from torchqm.geometry.geodesic_solver import GeodesicSolver
from torchqm.geometry.gradient import VertexGradient, tangent_frames, vertex_gradient
from torchqm.geometry.io import load_mesh, save_mesh
from torchqm.geometry.laplacian import (
    Laplacian,
    cotan_matrix,
    cotan_stiffness,
    laplacian,
    lumped_mass,
    robust_stiffness,
    to_scipy,
)
from torchqm.geometry.mesh import Mesh
from torchqm.geometry.sampling import area_samples, farthest_points

__all__ = [
    "EdgePoints",
    "GeodesicSolver",
    "Laplacian",
    "Mesh",
    "MeshError",
    "MeshReport",
    "VertexGradient",
    "area_samples",
    "check_mesh",
    "clean_faces",
    "cotan_matrix",
    "cotan_stiffness",
    "diffused",
    "distance_to_curve",
    "distances",
    "edge_graph",
    "farthest_points",
    "inspect_mesh",
    "laplacian",
    "load_mesh",
    "lumped_mass",
    "mean_curvature",
    "nodal_crossings",
    "orient_faces",
    "robust_stiffness",
    "save_mesh",
    "tangent_frames",
    "to_scipy",
    "vertex_gradient",
    "vertex_normals",
    "weld",
]
