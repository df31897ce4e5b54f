"""Operations that are written as elementwise operations give the results of the operations."""

import pytest
import torch
from torch import nn

from kornia_pnpnet.core.inlining import INLINE

pytestmark = pytest.mark.filterwarnings("ignore::FutureWarning")  # of the exporter about its own code


def kernels(program):
    return {node.target for node in program.graph.nodes if node.op == "call_function"} & set(INLINE)


def export(function, *inputs):
    module = nn.Module()
    module.forward = lambda *x: function(*x)  # noqa: PLW0108 - built-in functions have no signature
    return torch.export.export(module, inputs)


A, B = torch.linspace(-1.0, 2.0, 24).sin().view(2, 3, 4), torch.linspace(-3.0, 1.0, 40).cos().view(2, 4, 5)
TIES = torch.tensor([[3.0, 1.0, 1.0, -2.0, 3.0, 0.0], [0.0, -0.0, torch.inf, -torch.inf, 5.0, 5.0]])


@pytest.mark.parametrize(
    ("function", "inputs"),
    [
        (torch.matmul, (A, B[0])),
        (torch.mm, (A[0], B[0])),
        (torch.bmm, (A, B)),
        (lambda bias, a, b: torch.addmm(bias, a, b, beta=0.5, alpha=2.0), (B[0, :1], A[0], B[0])),
        (nn.functional.linear, (A, B[0].T, B[0, 0])),
        (nn.functional.linear, (A, B[0].T)),
        (lambda x: (x > 0).cumsum(-1), (A,)),
        (lambda x: x.cumsum(0, dtype=torch.float64), (A,)),
        (lambda x: x.sort(stable=True), (TIES,)),
        (lambda x: x.sort(dim=0, descending=True, stable=True), (TIES,)),
        (lambda x: x.topk(3, 1), (A.mT,)),
        (lambda x: x.topk(2, 1, largest=False), (A,)),
    ],
)
def test_results_stay(function, inputs):
    program = export(function, *inputs)
    inlined = program.run_decompositions(INLINE)
    assert not kernels(inlined)
    expected, found = program.module()(*inputs), inlined.module()(*inputs)
    torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-6)


def test_long_sorts_stay_calls():
    program = export(lambda x: x.sort(stable=True).indices, torch.randn(2, 1000))
    assert kernels(program.run_decompositions(INLINE)) == kernels(program) != set()
