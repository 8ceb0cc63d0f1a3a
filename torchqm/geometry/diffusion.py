"""Smoothing of functions on a mesh by one implicit step of heat flow."""

import numpy as np
import scipy
import torch
from jaxtyping import Float
from torch import Tensor

from torchqm.geometry.laplacian import cotan_matrix
from torchqm.geometry.mesh import Mesh

__all__ = ["diffused"]


def diffused(
    mesh: Mesh,
    values: Float[Tensor, "V C"],
    time: float,
    rtol: float = 1e-4,
    stiffness: "scipy.sparse.csr_array | None" = None,
) -> Float[Tensor, "V C"]:
    """``u = (M + t W)^-1 M f``: a function of frequency lambda is damped by ``1 / (1 + t lambda)``.

    Solved by conjugate gradients, which need few steps for short times: no factorisation, and no eigenfunctions, which
    would leave out what is finer than they are.

    Args:
        mesh: the shape.
        values: ``(V, C)`` functions f; at vertices without area they stay as they are.
        time: t, in squared units of the mesh.
        rtol: relative residual at which the iteration stops.
        stiffness: cotangent matrix W of the mesh, if it is there already.

    Raises:
        ValueError: a negative time.

    Example:
        >>> square = Mesh.from_arrays([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]])
        >>> f = torch.tensor([[0.0], [0.0], [3.0], [0.0]], dtype=torch.float64)
        >>> flat = diffused(square, f, 1e3, 1e-10)
        >>> float((flat - 1).abs().max()) < 0.01
        True
    """
    if time < 0:
        raise ValueError(f"time={time}: must not be negative")
    mass = mesh.vertex_areas.numpy()
    there = mass > 0
    if stiffness is None:
        stiffness = cotan_matrix(mesh.verts, mesh.faces)
    matrix = (scipy.sparse.diags_array(np.where(there, mass, 1.0)) + time * stiffness).tocsr()
    inverse = 1 / matrix.diagonal()
    scaling = scipy.sparse.linalg.LinearOperator(matrix.shape, matvec=lambda v: inverse * v, dtype=np.float64)
    columns = []
    for f in values.numpy().T.astype(np.float64):
        right = np.where(there, mass * f, f)
        columns.append(scipy.sparse.linalg.cg(matrix, right, x0=f, rtol=rtol, M=scaling, maxiter=1000)[0])
    return torch.from_numpy(np.stack(columns, 1)) if columns else values
