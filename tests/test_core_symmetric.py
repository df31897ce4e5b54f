"""Symmetric matrices entry by entry: against torch.linalg."""

from __future__ import annotations

import pytest
import torch

from kornia_pnpnet.core.symmetric import Symmetric2, Symmetric3, are_semi_definite, equivalent_sigma

KINDS = {2: Symmetric2, 3: Symmetric3}


def matrices(size, count=200, eigenvalues=None):
    generator = torch.Generator().manual_seed(size)
    turn = torch.linalg.qr(torch.randn(count, size, size, generator=generator, dtype=torch.float64)).Q
    values = 10.0 ** (4.0 * torch.rand(count, size, generator=generator, dtype=torch.float64) - 2.0)
    values = values if eigenvalues is None else torch.tensor(eigenvalues, dtype=torch.float64).expand(count, size)
    return (turn * values[:, None]) @ turn.mT


def full(symmetric):
    size = range(2 if len(symmetric) == 3 else 3)
    upper = dict(zip([(i, j) for i in size for j in size[i:]], symmetric, strict=True))
    return torch.stack([torch.stack([upper[min(i, j), max(i, j)] for j in size], -1) for i in size], -2)


@pytest.mark.parametrize("size", [2, 3])
def test_entries_are_those_of_the_symmetric_part(size):
    matrix = torch.randn(5, size, size)
    torch.testing.assert_close(full(KINDS[size].of(matrix)), 0.5 * (matrix + matrix.mT))


def test_the_calculus_of_two():
    matrix, vector = matrices(2), torch.randn(200, 2, dtype=torch.float64)
    symmetric = Symmetric2.of(matrix)
    torch.testing.assert_close(symmetric.determinant, torch.linalg.det(matrix))
    torch.testing.assert_close(full(symmetric.inverse()), torch.linalg.inv(matrix))
    torch.testing.assert_close(symmetric.form(*vector.mT), torch.einsum("bi,bij,bj->b", vector, matrix, vector))
    a, b, d = torch.randn(3, 200, dtype=torch.float64)
    change = torch.stack((torch.stack((a, b), -1), torch.stack((0.0 * a, d), -1)), -2)
    torch.testing.assert_close(full(symmetric.mapped(a, b, d)), change @ matrix @ change.mT)


def test_the_calculus_of_three():
    matrix, vector = matrices(3), torch.randn(200, 3, dtype=torch.float64)
    symmetric = Symmetric3.of(matrix)
    torch.testing.assert_close(torch.stack(symmetric.times(vector.mT), -1), (matrix @ vector[..., None])[..., 0])
    torch.testing.assert_close(full(symmetric.divided(vector[:, 0])), matrix / vector[:, :1, None].square())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("size", [2, 3])
def test_semi_definite_is_told_up_to_rounding(size, dtype):
    for smallest, expected in ((0.0, True), (1e-3, True), (-1e-3, False), (torch.nan, False), (torch.inf, False)):
        matrix = matrices(size, eigenvalues=[1.0, 1.0, smallest][-size:]).to(dtype)
        assert (are_semi_definite(KINDS[size].of(matrix)) == expected).all(), smallest
        assert not are_semi_definite(KINDS[size].of(-matrix)).any()
    assert are_semi_definite(KINDS[size].of(torch.zeros(1, size, size, dtype=dtype))).all()


@pytest.mark.parametrize("size", [2, 3])
def test_the_equivalent_sigma_has_the_same_trace(size):
    matrix = matrices(size)
    sigma = equivalent_sigma(KINDS[size].of(matrix))
    torch.testing.assert_close(size * sigma.square(), matrix.diagonal(dim1=1, dim2=2).sum(-1))
    zero = torch.zeros(1, size, size, requires_grad=True)
    equivalent_sigma(KINDS[size].of(zero)).sum().backward()
    assert (zero.grad == 0).all()
    assert equivalent_sigma(KINDS[size].of(torch.full((1, size, size), torch.nan))).isnan().all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_eigenvalues_are_raised(dtype):
    matrix = matrices(2, eigenvalues=[4.0, 0.0]).to(dtype)
    raised = Symmetric2.of(matrix).at_least(1.0)
    values = torch.linalg.eigvalsh(full(raised))
    torch.testing.assert_close(values, torch.tensor([1.0, 5.0], dtype=dtype).expand(200, 2), rtol=1e-5, atol=1e-5)
    same = Symmetric2.of(matrices(2, eigenvalues=[4.0, 2.0]).to(dtype))
    torch.testing.assert_close(full(same.at_least(1.0)), full(same), rtol=0, atol=0)
    assert (Symmetric2.of(matrix).at_least(0.0).determinant > 0).all()
