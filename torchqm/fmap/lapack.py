"""LAPACK's Cholesky of many small systems in place, called where scipy has it.

Torch factors a batch one matrix after the other, slowly at a hundred rows (47 ms for 800 of them in float32), numpy
copies each in and out, and scipy's Python function holds the lock of the interpreter. The same function is public for
Cython (``scipy.linalg.cython_lapack``); called by its address it takes 17 ms and leaves the lock alone, so that threads
share the work.
"""

import ctypes
from collections.abc import Callable
from functools import cache

import torch
from jaxtyping import Float, Int
from torch import Tensor

__all__ = ["has_lapack", "potrf"]

_LETTERS = {torch.float32: "s", torch.float64: "d"}
# As Cython writes it; where integers have 64 bits it differs, and the function is left alone.
_SIGNATURE = "void (char *, int *, {real} *, int *, int *)"


def has_lapack(tensor: Tensor) -> bool:
    """Whether :func:`potrf` can be used for tensors like this one.

    Example:
        >>> has_lapack(torch.ones(1)), has_lapack(torch.ones(1, dtype=torch.half))
        (True, False)
    """
    return tensor.device.type == "cpu" and tensor.dtype in _LETTERS and _potrf(tensor.dtype) is not None


def potrf(systems: Float[Tensor, "N K K"]) -> Int[Tensor, " N"]:
    """``S = U^T U`` in place: the upper triangles become U, those below the diagonal stay what they were.

    Args:
        systems: ``(N, K, K)`` symmetric, contiguous, on the CPU, float32 or float64.

    Returns:
        ``(N,)`` LAPACK's ``info``: 0, or the number of the first leading minor that is not positive. (What is not a
        number it may miss.)

    Example:
        >>> systems = torch.tensor([[[4.0, 2.0], [2.0, 5.0]]])
        >>> potrf(systems).tolist(), systems.triu().tolist()
        ([0], [[[2.0, 1.0], [0.0, 2.0]]])
    """
    n, k = map(int, systems.shape[:2])
    if systems.shape != (n, k, k) or not systems.is_contiguous() or systems.is_neg():
        raise ValueError(f"systems: contiguous (N, K, K) is allowed, got {tuple(systems.shape)}, {systems.stride()}")
    call = _potrf(systems.dtype) if systems.device.type == "cpu" else None
    if call is None:
        raise ValueError(f"systems: {systems.dtype} on {systems.device} has no LAPACK here")
    info, size = torch.zeros(n, dtype=torch.int32, device="cpu"), ctypes.c_int(k)
    k_at, stride = ctypes.addressof(size), k * k * systems.element_size()
    at, info_at = systems.data_ptr(), info.data_ptr()
    # Row by row in memory is column by column in LAPACK: its lower triangle is our upper one.
    for i in range(n if k else 0):
        call(b"L", k_at, at + i * stride, k_at, info_at + 4 * i)
    if not systems.is_inference():
        torch.autograd.graph.increment_version(systems)  # else autograd would not see that they changed
    return info


@cache
def _potrf(dtype: torch.dtype) -> Callable[..., None] | None:
    """The function behind ``scipy.linalg.cython_lapack``; None where it is not what is expected."""
    try:
        from scipy.linalg import cython_lapack

        capsule = dict(cython_lapack.__pyx_capi__)[_LETTERS[dtype] + "potrf"]
    except (ImportError, AttributeError, KeyError):
        return None
    name_of, pointer_of = ctypes.pythonapi.PyCapsule_GetName, ctypes.pythonapi.PyCapsule_GetPointer
    name_of.restype, name_of.argtypes = ctypes.c_char_p, [ctypes.py_object]
    pointer_of.restype, pointer_of.argtypes = ctypes.c_void_p, [ctypes.py_object, ctypes.c_char_p]
    signature = name_of(capsule)
    real = f"__pyx_t_5scipy_6linalg_13cython_lapack_{_LETTERS[dtype]}"
    if signature.decode() not in {_SIGNATURE.format(real=text) for text in (real, "float", "double")}:
        return None
    arguments = [ctypes.c_char_p, *[ctypes.c_void_p] * 4]
    return ctypes.CFUNCTYPE(None, *arguments)(pointer_of(capsule, signature))
