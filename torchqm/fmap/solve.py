"""The initial functional map: descriptor preservation and Laplacian commutativity, closed form (paper, section 4.3)."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchqm.fmap.commutativity import commutativity_mask
from torchqm.fmap.rows import UndeterminedRowsError, solve_rows

__all__ = ["solve_fmap"]


def solve_fmap(
    coeffs_x: Float[Tensor, "Kx C"],
    coeffs_y: Float[Tensor, "Ky C"],
    evals_x: Float[Tensor, " Kx"],
    evals_y: Float[Tensor, " Ky"],
    weight: float = 1.0,
    normalize: bool = True,
    ridge: float = 0.0,
) -> Float[Tensor, "Ky Kx"]:
    """Minimise ``sum_s || C f_s - g_s ||^2 + w sum_ij C_ij^2 (lambda_j - mu_i)^2`` over all matrices C.

    The energy separates over the rows of C. Row i solves ``(F F^T + w diag((lambda_j - mu_i)^2)) c_i = F g_i``; all
    rows go through one batched Cholesky factorisation.

    Args:
        coeffs_x: ``(Kx, C)`` descriptors of the source in its basis (the f_s as columns).
        coeffs_y: ``(Ky, C)`` the same descriptors of the target (g_s).
        evals_x: ``(Kx,)`` eigenvalues of the source basis; Kx and Ky may differ (semi-quotient).
        evals_y: ``(Ky,)`` eigenvalues of the target basis.
        weight: w, with eigenvalues scaled to ``[0, 1]`` if ``normalize``.
        ridge: multiple of the mean descriptor energy added to every diagonal: entries of C that neither descriptors nor
            commutativity determine become 0 instead of an error.
        normalize: divide both spectra by the larger of their maxima, so that ``weight`` has no unit.

    Returns:
        ``fmap_xy`` ``(Ky, Kx)``: takes functions on x to functions on y.

    Raises:
        ValueError: the descriptors do not fit each other or the eigenvalues, ``weight`` is negative, or the problem has
            no unique solution (too few independent descriptors and no commutativity weight).

    Example:
        >>> f = torch.eye(2, dtype=torch.float64)
        >>> spectrum = torch.tensor([0.0, 1.0], dtype=torch.float64)
        >>> solve_fmap(f, -f, spectrum, spectrum).round().tolist()
        [[-1.0, 0.0], [0.0, -1.0]]

    References:
        Paper, section 4.3, E_0 = E_sig + E_com; Ovsjanikov et al. 2012, section 6.
    """
    if coeffs_x.shape[1] != coeffs_y.shape[1]:
        raise ValueError(
            f"coeffs_x has {coeffs_x.shape[1]} descriptors, coeffs_y has {coeffs_y.shape[1]}: they must agree"
        )
    if coeffs_x.shape[0] != evals_x.shape[0] or coeffs_y.shape[0] != evals_y.shape[0]:
        raise ValueError(
            f"coefficients of {coeffs_x.shape[0]} and {coeffs_y.shape[0]} basis functions do not fit "
            f"{evals_x.shape[0]} and {evals_y.shape[0]} eigenvalues"
        )
    if weight < 0 or ridge < 0:
        raise ValueError(f"weight={weight}, ridge={ridge}: neither may be negative")
    gram = coeffs_x @ coeffs_x.T
    diagonal = weight * commutativity_mask(evals_x, evals_y, "normalized" if normalize else "squared")
    diagonal = diagonal + ridge * gram.diagonal().mean()
    try:
        return solve_rows(gram, diagonal, coeffs_y @ coeffs_x.T)
    except UndeterminedRowsError as error:
        rows = error.undetermined.nonzero().flatten().tolist()
        raise ValueError(
            f"the descriptors (rank {int(torch.linalg.matrix_rank(gram))} of {gram.shape[0]}) and weight={weight} "
            f"leave row(s) {rows[:5]} of the map undetermined; give a positive weight or more descriptors"
        ) from error
