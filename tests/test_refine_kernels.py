"""Laws of the robust kernels: the weight is the derivative of the loss, for any shape."""

from __future__ import annotations

import math

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
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_loss_starts_at_zero_and_rises_and_its_derivative_is_the_weight_which_falls(name, shape, dtype):
    kernel, sq_residual = KERNELS[name], SQ_RESIDUALS.to(dtype).requires_grad_()
    loss, weight = (f(sq_residual, torch.tensor(shape, dtype=dtype)) for f in (kernel.loss, kernel.weight))
    (derivative,) = torch.autograd.grad(loss.sum(), sq_residual)
    assert loss.dtype == weight.dtype == dtype
    assert loss[0] == 0
    assert (loss[1:] > 0).all()
    rounding = 4 * torch.finfo(dtype).eps
    assert (loss[1:] >= loss[:-1] * (1 - rounding)).all()
    assert (weight >= 0).all()
    assert (weight[1:] <= weight[:-1] * (1 + rounding)).all()
    if dtype == torch.float64:
        smooth = (SQ_RESIDUALS.sqrt() - shape).abs() > (1e-9 if name == "truncated" else -1.0)
        # Weights are at most 1 except for `power`, whose tail autograd keeps to full precision.
        atol = 1e-300 if name == "power" else 1e-15
        torch.testing.assert_close(derivative[smooth], weight[smooth], rtol=1e-9, atol=atol)


@pytest.mark.parametrize("name", [name for name in KERNELS if name != "truncated"])
def test_gradcheck_in_both_arguments(name):
    kernel = KERNELS[name]
    sq_residual = tensor([0.0, 1e-3, 0.3, 7.0, 90.0, 3e3]).requires_grad_()
    for shape in (0.1, 1.0, 1.99, 2.0, 2.01, 2.9) if name == "power" else (0.5, 4.0, 30.0):
        inputs = sq_residual, tensor(shape).requires_grad_()
        # Differences across sq_residual = 0 need the loss a little below zero, which is smooth there.
        assert torch.autograd.gradcheck(kernel.loss, inputs, eps=1e-5, atol=1e-4)
        assert torch.autograd.gradcheck(kernel.weight, inputs, eps=1e-7, atol=1e-3, rtol=1e-3)


@pytest.mark.parametrize(
    ("name", "part", "shape", "expected"),
    [
        ("huber", "loss", 2.0, [0.0, 1.0, 4.0, 36.0]),
        ("huber", "weight", 2.0, [1.0, 1.0, 1.0, 0.2]),
        ("truncated", "loss", 2.0, [0.0, 1.0, 4.0, 4.0]),
        ("cauchy", "weight", 2.0, [1.0, 0.8, 0.5, 1 / 26]),
        ("geman_mcclure", "loss", 2.0, [0.0, 0.8, 2.0, 100 / 26]),
        ("power", "loss", 0.0, [0.0, 1.0, 4.0, 100.0]),  # least squares
        ("power", "loss", 2.0, [0.0, *(math.log1p(100.0 * s) for s in (1.0, 4.0, 100.0))]),
    ],
)
def test_closed_forms(name, part, shape, expected):
    found = getattr(KERNELS[name], part)(tensor([0.0, 1.0, 4.0, 100.0]), tensor(shape))
    torch.testing.assert_close(found, tensor(expected))
