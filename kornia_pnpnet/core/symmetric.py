"""Symmetric 2×2 and 3×3 matrices, one tensor per entry, for the covariances of pixels and world points."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from kornia_pnpnet.core.linalg import factorise

# Rounding error in units in the last place of the trace. Only an eigenvalue below minus this error counts as negative.
_ROUNDING = 16.0
# Least eigenvalue in units in the last place of the trace. Smaller eigenvalues are raised to this bound, because the
# determinant would otherwise be smaller than its rounding error.
_LEAST = 64.0


class Symmetric2(NamedTuple):
    """Symmetric 2×2 matrices, one matrix for each pair. All entries are tensors of the same shape."""

    uu: Tensor
    uv: Tensor
    vv: Tensor

    @property
    def determinant(self) -> Tensor:
        """The determinant of a positive definite matrix, bounded below by its rounding error."""
        product = self.uu * self.vv
        least = _LEAST * torch.finfo(product.dtype).eps * product.detach()
        return torch.addcmul(product, self.uv, self.uv, value=-1).maximum(least)

    def form(self, u: Tensor, v: Tensor) -> Tensor:
        """The quadratic form of the vector (u, v)."""
        cross = torch.addcmul(self.uu * u, self.uv, v, value=2.0)
        return torch.addcmul(cross * u, self.vv * v, v)

    def inverse(self) -> Symmetric2:
        """The inverse of a positive definite matrix, computed with the bounded :attr:`determinant`."""
        scale = self.determinant.reciprocal()
        return Symmetric2(self.vv * scale, -self.uv * scale, self.uu * scale)

    def mapped(self, a: Tensor, b: Tensor, d: Tensor, c: Tensor | float = 0.0) -> Symmetric2:
        """The covariance A S Aᵀ, where S is this covariance and A is [[a, b], [c, d]]."""
        u, v = a * self.uu + b * self.uv, a * self.uv + b * self.vv
        s, t = c * self.uu + d * self.uv, c * self.uv + d * self.vv
        return Symmetric2(a * u + b * v, c * u + d * v, c * s + d * t)

    def at_least(self, least: float) -> Symmetric2:
        """Raise the smallest eigenvalue to at least ``least`` by adding a multiple of the identity."""
        uu, uv, vv = (x.detach() for x in self)
        smallest = 0.5 * (uu + vv) - torch.hypot(0.5 * (uu - vv), uv)
        more = ((_LEAST * torch.finfo(uu.dtype).eps * (uu + vv)).clamp(min=least) - smallest).clamp(min=0.0)
        return Symmetric2(self.uu + more, self.uv, self.vv + more)


class Symmetric3(NamedTuple):
    """Symmetric 3×3 matrices, one matrix for each pair. All entries are tensors of the same shape."""

    xx: Tensor
    xy: Tensor
    xz: Tensor
    yy: Tensor
    yz: Tensor
    zz: Tensor

    def divided(self, length: Tensor) -> Symmetric3:
        """Divide a covariance by a squared length, and add more than the rounding errors to the diagonal."""
        # `length` gets no gradient from zero entries: the gradient would be NaN if the square of `length` underflowed.
        lengths = (torch.where(x == 0, length.detach(), length) for x in self)
        xx, xy, xz, yy, yz, zz = (x / unit / unit for x, unit in zip(self, lengths, strict=True))
        more = 2.0 * _ROUNDING * torch.finfo(xx.dtype).eps * (xx + yy + zz).detach()
        return Symmetric3(xx + more, xy, xz, yy + more, yz, zz + more)

    def times(self, vector: Sequence[Tensor]) -> list[Tensor]:
        """The product of the matrix and a vector of three entries."""
        a, b, c = vector
        rows = (self.xx, self.xy, self.xz), (self.xy, self.yy, self.yz), (self.xz, self.yz, self.zz)
        return [torch.addcmul(torch.addcmul(i * a, j, b), k, c) for i, j, k in rows]


def symmetric(matrix: Tensor) -> Any:
    """The symmetric parts of matrices (..., K, K) with K = 2 or 3, as :class:`Symmetric2` or :class:`Symmetric3`."""
    size, half = range(matrix.shape[-1]), 0.5 * (matrix + matrix.mT)
    return (Symmetric2 if len(size) == 2 else Symmetric3)(*(half[..., i, j] for i in size for j in size[i:]))


def _lower_rows(matrix: Symmetric2 | Symmetric3) -> list[list[Tensor]]:
    if isinstance(matrix, Symmetric2):
        return [[matrix.uu], [matrix.uv, matrix.vv]]
    return [[matrix.xx], [matrix.xy, matrix.yy], [matrix.xz, matrix.yz, matrix.zz]]


def are_semi_definite(matrix: Symmetric2 | Symmetric3) -> Tensor:
    """Tell whether matrices are finite and positive semi-definite up to rounding, bool, with the shape of an entry."""
    rows = [[x.detach() for x in row] for row in _lower_rows(matrix)]
    trace = torch.stack([row[-1] for row in rows]).sum(0)
    limits = torch.finfo(trace.dtype)
    scale = torch.where(trace > 0, trace, 1.0).reciprocal()
    rows = [[x * scale for x in row] for row in rows]
    for row in rows:
        row[-1] = row[-1] + _ROUNDING * limits.eps
    good = (trace >= 0) & (trace < limits.max**0.25)  # products of larger entries could overflow

    def inverse(k: int, pivot: Tensor) -> Tensor:
        nonlocal good
        good = good & (pivot > 0)  # NaN compares false
        return torch.where(pivot > 0, pivot, 1.0).reciprocal()

    factorise(rows, [trace] * len(rows), inverse)
    return good


def equivalent_sigma(matrix: Symmetric2 | Symmetric3) -> Tensor:
    """Sigma of isotropic noise whose covariance has the trace of ``matrix``. NaN for a negative or infinite trace."""
    variance = torch.stack([row[-1] for row in _lower_rows(matrix)]).mean(0)
    positive = (variance > 0) & (variance < torch.inf)  # the square root has an infinite gradient at 0
    sigma = torch.where(positive, variance, 1.0).sqrt()
    return torch.where(positive, sigma, torch.nan).masked_fill(variance == 0, 0.0)
