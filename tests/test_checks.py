import pytest
import torch

from torchqm import checks


def test_letters_are_learned_and_compared():
    sizes = checks.Sizes()
    sizes.bind("evecs", torch.zeros(4, 2, 50, 10), "... V K")
    assert (sizes["V"], sizes["K"], sizes.leading) == (50, 10, (4, 2))
    sizes.bind("mass", torch.zeros(4, 2, 50), "... V")
    with pytest.raises(
        ValueError, match=r"evals: shape \(4, 2, 9\) given, expected \(4, 2, K\) with K = 10 as in evecs"
    ):
        sizes.bind("evals", torch.zeros(4, 2, 9), "... K")
    with pytest.raises(ValueError, match=r"mass: shape \(3, 50\) given, expected \(4, 2, V\) with V = 50 as in evecs"):
        sizes.bind("mass", torch.zeros(3, 50), "... V")
    with pytest.raises(ValueError, match=r"verts: shape \(50, 2\) given, expected \(V, 3\) with V = 50 as in evecs"):
        sizes.bind("verts", torch.zeros(50, 2), "V 3")
    with pytest.raises(ValueError, match=r"evals: shape \(\) given, expected \(..., K\)"):
        sizes.bind("evals", torch.zeros(()), "... K")
    with pytest.raises(ValueError, match=r"gram: shape \(3, 4\) given, expected \(N, N\)"):
        sizes.bind("gram", torch.zeros(3, 4), "N N")
    with pytest.raises(TypeError, match="faces: expected a tensor, got list"):
        sizes.bind("faces", [1, 2], "F 3")


def test_one_dtype_for_all_real_numbers():
    sizes = checks.Sizes()
    sizes.bind("feat", torch.zeros(5, 2), "V C")
    sizes.bind("ids", torch.zeros(5, dtype=torch.int64), "V")
    sizes.bind("weights", torch.zeros(2, dtype=torch.float64), "C", any_dtype=True)
    with pytest.raises(ValueError, match=r"mass: dtype torch\.float64 given, expected torch\.float32 as in feat"):
        sizes.bind("mass", torch.zeros(5, dtype=torch.float64), "V")


def test_a_wrong_argument_teaches_nothing():
    sizes = checks.Sizes()
    with pytest.raises(ValueError, match="verts"):
        sizes.bind("verts", torch.zeros(50, 2), "V 3")
    sizes.bind("verts", torch.zeros(40, 3), "V 3")
    assert sizes["V"] == 40


def test_values():
    with pytest.raises(ValueError, match=r"feat: 2 of 6 entries are NaN or infinite, the first at \(0, 1\)"):
        checks.require_finite("feat", torch.tensor([[0.0, torch.nan, 1.0], [torch.inf, 0.0, 0.0]]))
    with pytest.raises(ValueError, match=r"mass: 1 of 2 entries are negative, the first at \(1,\) is -0.5"):
        checks.require_nonnegative("mass", torch.tensor([1.0, -0.5]))
    with pytest.raises(ValueError, match="mass: 1 of 1 entries are NaN"):
        checks.require_nonnegative("mass", torch.tensor([torch.nan]))
    with pytest.raises(ValueError, match=r"verts_mask: no true element in row\(s\) \[1\]"):
        checks.require_mask("verts_mask", torch.tensor([[True, False], [False, False]]))
    with pytest.raises(ValueError, match=r"verts_mask: dtype torch\.int64 given"):
        checks.require_mask("verts_mask", torch.ones(2, 2, dtype=torch.int64))


def test_values_are_not_looked_at_where_they_are_unknown_or_not_wanted():
    bad = torch.tensor([torch.nan])
    with checks.disabled():
        checks.require_finite("feat", bad)
        checks.require_mask("mask", torch.zeros(1, dtype=torch.bool))
    with pytest.raises(ValueError, match="feat"):
        checks.require_finite("feat", bad)
    checks.set_enabled(False)
    try:
        checks.require_nonnegative("mass", -torch.ones(1))
    finally:
        checks.set_enabled(True)

    def looked_at(row):
        checks.require_finite("row", row)
        return row * 2

    assert torch.func.vmap(looked_at)(bad.expand(3, 1)).shape == (3, 1)


@pytest.mark.parametrize("dtype", [torch.int64, torch.bool, torch.complex64])
def test_what_is_no_real_number(dtype):
    """Like shapes, dtypes are always checked; an empty tensor has one, too."""
    for require in (checks.require_real, checks.require_finite, checks.require_nonnegative):
        for tensor in (torch.ones(2, dtype=dtype), torch.ones(0, dtype=dtype)):
            with (
                checks.disabled(),
                pytest.raises(ValueError, match=rf"^mass: dtype {dtype} given, expected real numbers"),
            ):
                require("mass", tensor)
    checks.require_real("mass", torch.ones(2, dtype=torch.float16))
