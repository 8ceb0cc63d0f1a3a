"""torchqm.fmap.spare: memory is used again only when nobody holds it, and no more is kept than the limit."""

from concurrent.futures import ThreadPoolExecutor

import torch

from torchqm.fmap.spare import SpareMemory

SHAPE, SIZE = (10, 25), 1000


def test_any_view_holds_it():
    spare = SpareMemory(10 * SIZE)
    first = spare.empty(SHAPE, torch.float32)
    address, view = first.data_ptr(), first[3:, ::2]
    del first
    second = spare.empty(SHAPE, torch.float32)
    second.fill_(1.0)
    view.fill_(2.0)
    assert bool((second == 1).all())
    del view
    assert spare.empty(SHAPE, torch.float32).data_ptr() == address


def test_what_autograd_keeps_is_held_as_long_as_its_graph():
    spare = SpareMemory(10 * SIZE)
    x = torch.ones(SHAPE, requires_grad=True)
    factor = spare.empty(SHAPE, torch.float32).fill_(3.0)
    address, y = factor.data_ptr(), x * factor
    del factor
    spare.empty(SHAPE, torch.float32).fill_(5.0)
    (grad,) = torch.autograd.grad(y.sum(), x)
    assert bool((grad == 3).all())
    del y
    found = {spare.empty(SHAPE, torch.float32).data_ptr() for _ in range(2)}
    assert address in found


def test_another_type_or_shape_of_the_same_size_will_do():
    spare = SpareMemory(10 * SIZE)
    address = spare.empty(SHAPE, torch.float32).data_ptr()
    found = spare.empty((5, 25), torch.float64)
    assert (found.data_ptr(), found.shape, found.dtype) == (address, (5, 25), torch.float64)


def test_no_more_is_kept_than_the_limit():
    spare = SpareMemory(3 * SIZE)
    held = [spare.empty(SHAPE, torch.float32) for _ in range(5)]
    assert sum(array.nbytes for array in spare._arrays) == 3 * SIZE
    large = spare.empty((4, 250), torch.float32)
    assert large.shape == (4, 250)
    assert all(array.nbytes == SIZE for array in spare._arrays)  # too large to be kept
    del held
    spare.clear()
    assert spare._arrays == []


def test_threads_get_memory_of_their_own():
    spare = SpareMemory(100 * SIZE)

    def work(number):
        for _ in range(200):
            mine = spare.empty(SHAPE, torch.float32).fill_(float(number))
            if not bool((mine == number).all()):
                return False
        return True

    with ThreadPoolExecutor(4) as pool:
        assert all(pool.map(work, range(4)))
