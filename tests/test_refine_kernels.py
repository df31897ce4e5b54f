"""Laws of the robust kernels: the weight is the derivative of the loss, for any shape."""

from __future__ import annotations

import pytest
import torch

from kornia_pnpnet.refine.kernels import KERNELS

# The power kernel's exponent through its special value 2 and both ends; scales of the others in pixels.
ALPHAS = (0.0, 1e-3, 1.0, 1.999, 2.0 - 1e-9, 2.0, 2.0 + 1e-9, 3.0)
SCALES = (0.1, 5.0, 1e4)
CASES = [(name, shape) for name in KERNELS for shape in (ALPHAS if name == "power" else SCALES)]
SQ_RESIDUALS = torch.cat((torch.zeros(1), torch.logspace(-8, 12, 241))).double()


def tensor(value):
    return torch.tensor(value, dtype=torch.float64)


@pytest.mark.parametrize(("name", "shape"), CASES)
def test_weight_is_the_derivative_of_the_loss(name, shape):
    kernel = KERNELS[name]
    sq_residual = SQ_RESIDUALS.clone().requires_grad_()
    (derivative,) = torch.autograd.grad(kernel.loss(sq_residual, tensor(shape)).sum(), sq_residual)
    weight = kernel.weight(sq_residual.detach(), tensor(shape))
    kink = (sq_residual.detach().sqrt() - shape).abs() < 1e-9 if name == "truncated" else torch.zeros(242, dtype=bool)
    # Weights are at most 1 except for `power`, whose tail autograd keeps to full precision.
    atol = 1e-300 if name == "power" else 1e-15
    torch.testing.assert_close(derivative[~kink], weight[~kink], rtol=1e-9, atol=atol)


@pytest.mark.parametrize(("name", "shape"), CASES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_loss_starts_at_zero_and_rises_and_weight_falls(name, shape, dtype):
    kernel = KERNELS[name]
    loss = kernel.loss(SQ_RESIDUALS.to(dtype), torch.tensor(shape, dtype=dtype))
    weight = kernel.weight(SQ_RESIDUALS.to(dtype), torch.tensor(shape, dtype=dtype))
    assert loss.dtype == weight.dtype == dtype
    assert loss[0] == 0
    assert (loss[1:] > 0).all()
    rounding = 4 * torch.finfo(dtype).eps
    assert (loss[1:] >= loss[:-1] * (1 - rounding)).all()
    assert (weight >= 0).all()
    assert not kernel.bounded or weight[0] <= 1
    assert (weight[1:] <= weight[:-1] * (1 + rounding)).all()


@pytest.mark.parametrize("name", [name for name in KERNELS if name != "truncated"])
def test_gradcheck_in_both_arguments(name):
    kernel = KERNELS[name]
    sq_residual = tensor([0.0, 1e-3, 0.3, 7.0, 90.0, 3e3]).requires_grad_()
    shapes = (0.1, 1.0, 1.99, 2.0, 2.01, 2.9) if name == "power" else (0.5, 4.0, 30.0)
    for shape in shapes:
        value = tensor(shape).requires_grad_()
        # Differences across sq_residual = 0 need the loss a little below zero, which is smooth there.
        assert torch.autograd.gradcheck(kernel.loss, (sq_residual, value), eps=1e-5, atol=1e-4)
        assert torch.autograd.gradcheck(kernel.weight, (sq_residual, value), eps=1e-7, atol=1e-3, rtol=1e-3)


def test_closed_forms():
    assert [name for name, kernel in KERNELS.items() if not kernel.bounded] == ["power"]
    s = tensor([0.0, 1.0, 4.0, 100.0])
    two = tensor(2.0)
    torch.testing.assert_close(KERNELS["huber"].loss(s, two), tensor([0.0, 1.0, 4.0, 36.0]))
    torch.testing.assert_close(KERNELS["huber"].weight(s, two), tensor([1.0, 1.0, 1.0, 0.2]))
    torch.testing.assert_close(KERNELS["truncated"].loss(s, two), tensor([0.0, 1.0, 4.0, 4.0]))
    torch.testing.assert_close(KERNELS["cauchy"].weight(s, two), tensor([1.0, 0.8, 0.5, 1 / 26]))
    torch.testing.assert_close(KERNELS["geman_mcclure"].loss(s, two), tensor([0.0, 0.8, 2.0, 100 / 26]))
    # The paper's weight, 1/‖r‖^α, above the floor; least squares at α = 0.
    torch.testing.assert_close(KERNELS["power"].weight(tensor([1e6]), tensor(1.0)), tensor([1e-3]), rtol=1e-6, atol=0)
    torch.testing.assert_close(KERNELS["power"].loss(s, tensor(0.0)), s)
    torch.testing.assert_close(KERNELS["power"].loss(s, two), torch.log1p(s / 0.01))
