"""The paper's network: its layers, and the rotation that it returns."""

from __future__ import annotations

import pytest
import torch
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from torch import nn

from kornia_pnpnet import MLPInit
from kornia_pnpnet.propose.mlp import rotation_about


def sizes(module):
    return [(layer.in_features, layer.out_features) for layer in module if isinstance(layer, nn.Linear)]


@pytest.mark.parametrize("n", [6, 12])
def test_layers_are_the_papers(n):
    net = MLPInit(n)
    assert sizes(net.shared) == [(5 * n, 20 * n), (20 * n, 5 * n), (5 * n, 3 * n)]
    branch = [(3 * n, 2 * n)] + 4 * [(2 * n, 2 * n)]
    assert sizes(net.rotation) == [*branch, (2 * n, 4)]
    assert sizes(net.translation) == [*branch, (2 * n, 3)]
    # A ReLU after each layer, except the last layer of a branch.
    for module, is_branch in ((net.shared, False), (net.rotation, True), (net.translation, True)):
        assert [type(layer) for layer in module] == (len(sizes(module)) * [nn.Linear, nn.ReLU])[: len(module)]
        assert isinstance(module[-1], nn.Linear) == is_branch


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_axis_and_angle_turn_as_kornias_rotation_vectors(dtype):
    """Large and tiny angles, long and short axes; values and gradients."""
    generator = torch.Generator().manual_seed(0)
    axis = torch.randn(3, 400, generator=generator, dtype=torch.float64)
    axis *= 10.0 ** torch.linspace(-1, 3, 20, dtype=torch.float64).repeat(20)
    angle = 10.0 * torch.randn(400, generator=generator, dtype=torch.float64)
    angle[:200] *= 10.0 ** torch.linspace(-12, 0, 200, dtype=torch.float64)
    upstream = torch.randn(400, 3, 3, generator=generator, dtype=torch.float64).to(dtype)
    outcomes = []
    for at in (dtype, torch.float64):
        leaves = [x.to(dtype).to(at).requires_grad_() for x in (axis, angle)]
        if at == dtype:
            rotation = rotation_about(*leaves)
        else:
            floor = torch.finfo(dtype).eps
            length = (leaves[0].square().sum(0) + floor).sqrt()
            rotation = axis_angle_to_rotation_matrix((leaves[0] / length * leaves[1]).mT)
        by_axis, by_angle = torch.autograd.grad(rotation, leaves, upstream.to(at))
        size = leaves[0].detach().norm(dim=0)  # the gradient by the axis is inverse to it
        outcomes.append([x.to(torch.float64) for x in (rotation, by_axis * size, by_angle)])
    tolerance = 2e-5 if dtype == torch.float32 else 1e-12
    for mine, kornias in zip(*outcomes, strict=True):
        torch.testing.assert_close(mine, kornias, rtol=tolerance, atol=20 * tolerance)
