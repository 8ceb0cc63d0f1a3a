"""torchqm.fmap.operator: an operator that torch takes as one piece, and that loads no compiler."""

import subprocess
import sys

import pytest
import torch
from torch import Tensor

from torchqm.fmap.operator import operator


@operator("twice_for_a_test")
def twice(values: Tensor, times: int) -> Tensor:
    """Twice."""
    return values * (2 * times)


@torch.library.register_fake("torchqm::twice_for_a_test")
def _(values: Tensor, times: int) -> Tensor:
    return values.new_empty(values.shape)


def test_the_function_is_an_operator():
    assert torch.equal(torch.ops.torchqm.twice_for_a_test(torch.ones(2), 3), torch.full((2,), 6.0))
    assert twice(torch.ones(1), 1).item() == 2
    schema = torch.ops.torchqm.twice_for_a_test.default._schema
    assert str(schema) == "torchqm::twice_for_a_test(Tensor values, SymInt times) -> Tensor"


def test_torch_finds_no_fault_with_it():
    outcomes = torch.library.opcheck(torch.ops.torchqm.twice_for_a_test.default, (torch.ones(2), 3))
    assert set(outcomes.values()) == {"SUCCESS"}


def test_a_backward_pass_through_it_is_an_error():
    result = torch.ops.torchqm.twice_for_a_test(torch.ones(2, requires_grad=True), 3)
    with pytest.raises(RuntimeError, match="twice_for_a_test has no derivative"):
        result.sum().backward()


@pytest.mark.filterwarnings("ignore:Dynamo does not know")
def test_the_compiler_does_not_look_into_it():
    """Called outside of a graph, too, where the compiler takes up every function that it meets."""
    graphs = []

    def note(graph, _):
        graphs.append([str(node.target) for node in graph.graph.nodes if node.op == "call_function"])
        return graph

    @operator("looked_into_for_a_test")
    def looked_into(values: Tensor) -> Tensor:
        return values.cos()

    call = torch._dynamo.disallow_in_graph(torch.ops.torchqm.looked_into_for_a_test.default)
    compiled = torch.compile(lambda values: call(values.sin()).exp(), backend=note)
    torch.testing.assert_close(compiled(torch.ones(2)), torch.ones(2).sin().cos().exp())
    assert len(graphs) == 2
    assert not any("cos" in target for graph in graphs for target in graph)


def test_solving_loads_no_compiler():
    """torch._dynamo and sympy are more than a second of every process that finds a map."""
    code = """
import sys, torch
from torchqm.fmap import solve_fmap
a = torch.arange(12.0, dtype=torch.float64).reshape(3, 4).sin()
a.requires_grad_()
solve_fmap(a, a.detach(), torch.arange(3.0).double(), torch.arange(3.0).double(), 1.0, ridge=1e-3).sum().backward()
print(sorted({"torch._dynamo", "sympy"} & set(sys.modules)))
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.split() == ["[]"]
