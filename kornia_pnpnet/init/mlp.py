"""The paper's fully connected network: n ordered pairs in, a coarse pose out."""

from __future__ import annotations

from itertools import pairwise

import torch
from kornia.core.check import KORNIA_CHECK
from kornia.core.exceptions import ShapeError
from torch import Tensor, nn

from kornia_pnpnet.core.checks import check_devices, check_positive
from kornia_pnpnet.types import Correspondences, Guess, Pose

__all__ = ["MLPInit"]


def _relu_layers(sizes: list[int]) -> list[nn.Module]:
    """Fully connected ReLU layers with He initialisation: ten narrow layers die out under PyTorch's default."""
    layers: list[nn.Module] = []
    for size_in, size_out in pairwise(sizes):
        linear = nn.Linear(size_in, size_out)
        nn.init.kaiming_normal_(linear.weight, nonlinearity="relu")
        nn.init.zeros_(linear.bias)
        layers += [linear, nn.ReLU()]
    return layers


def _run(layers: nn.Sequential, hidden: Tensor) -> Tensor:
    """The layers on columns, (units, B), in the wider of the dtypes of their input and their weights."""
    for layer in layers:
        if isinstance(layer, nn.Linear):
            weight: Tensor = layer.weight
            bias: Tensor = layer.bias
            if weight.dtype != hidden.dtype:
                wider = torch.promote_types(weight.dtype, hidden.dtype)
                weight, bias, hidden = weight.to(wider), bias.to(wider), hidden.to(wider)
            hidden = torch.addmm(bias[:, None], weight, hidden)
        else:
            hidden = hidden.relu_()  # of a sum that nothing else needs
    return hidden


def _rotation(axis: Tensor, angle: Tensor) -> Tensor:
    r"""Rotations by some angles about unnormalised axes.

    Args:
        axis: :math:`s` as columns, shape :math:`(3, B)`.
        angle: :math:`\theta` in radians, shape :math:`(B)`.

    Returns:
        :math:`\exp(\theta [s / \|s\|]_\times)`, shape :math:`(B, 3, 3)`.
    """
    limits = torch.finfo(axis.dtype)
    # |s| with a floor under the root: the gradient stays finite where the branch returns zeros.
    vector = axis * (angle * ((axis * axis).sum(0) + limits.eps).rsqrt())
    length = (vector * vector).sum(0).clamp(min=limits.tiny).sqrt()
    # The unit quaternion, times the root of 2.
    half, root = 0.5 * length, 2.0**0.5
    w, xyz = root * half.cos(), vector * (root * half.sin() / length)
    (x, y, z), (wx, wy, wz) = xyz.unbind(), (w * xyz).unbind()
    xy, yz, zx, cosine = x * y, y * z, z * x, w * w - 1.0
    first = torch.addcmul(cosine, x, x), xy - wz, zx + wy
    second = xy + wz, torch.addcmul(cosine, y, y), yz - wx
    third = zx - wy, yz + wx, torch.addcmul(cosine, z, z)
    return torch.stack((*first, *second, *third)).unflatten(0, (3, 3)).permute(2, 0, 1)


class MLPInit(nn.Module):
    r"""Stage 1 of PnP-Net: a small multilayer perceptron for exactly ``n`` ordered pairs.

    The 5n coordinates pass through shared ReLU layers of 20n, 5n and 3n units; then a rotation branch and a
    translation branch, five ReLU layers of 2n units each and a linear last layer. The rotation branch gives an
    unnormalised axis and an angle, :math:`R = \exp(\theta [s / \|s\|]_\times)`; the translation branch gives three
    numbers. All pairs weigh the same.

    Source: Sheffer and Wiesel 2020, figure 2. The scales of the input are ours: they bring both kinds of coordinates
    to the order of 1. The network computes in the wider of its own dtype and that of the correspondences.

    Args:
        n: number of pairs.
        world_scale: length by which world coordinates are divided; 1 suits a centred and scaled world.
        img_scale: pixels by which image coordinates are divided.

    Raises:
        BaseError: when ``n`` is less than 3, or a scale is not a positive number.

    Example:
        >>> corr = Correspondences(torch.randn(2, 9, 3), torch.randn(2, 9, 2), torch.ones(2, 9), torch.tensor(3400.0))
        >>> guess = MLPInit(n=9)(corr)
        >>> guess.pose.rotation.shape, guess.pose.translation.shape
        (torch.Size([2, 3, 3]), torch.Size([2, 3]))
    """

    def __init__(self, n: int, *, world_scale: float = 1.0, img_scale: float = 1000.0) -> None:
        super().__init__()
        KORNIA_CHECK(isinstance(n, int) and n >= 3, f"n must be an integer of at least 3, got {n!r}.")
        check_positive(world_scale=world_scale, img_scale=img_scale)
        self.config = {"n": n, "world_scale": world_scale, "img_scale": img_scale}
        self.n = n
        self.world_scale = world_scale
        self.img_scale = img_scale
        self.shared = nn.Sequential(*_relu_layers([5 * n, 20 * n, 5 * n, 3 * n]))
        branch = [3 * n] + 5 * [2 * n]
        self.rotation = nn.Sequential(*_relu_layers(branch), nn.Linear(2 * n, 4))
        self.translation = nn.Sequential(*_relu_layers(branch), nn.Linear(2 * n, 3))

    def extra_repr(self) -> str:
        """Show the constructor's arguments."""
        return ", ".join(f"{key}={value!r}" for key, value in self.config.items())

    def forward(self, corr: Correspondences) -> Guess:
        r"""Guess the pose.

        Args:
            corr: normalised correspondences with :math:`N` = ``n``, ordered by their pixels. A pair without weight
                enters as zeros, which the network has not been trained on.

        Returns:
            The coarse pose and weights of one.

        Raises:
            ShapeError: when :math:`N` is not ``n``.
            DeviceError: when the correspondences are not where the network is.
        """
        count = corr.world_points.shape[1]
        if count != self.n:
            raise ShapeError(
                f"This network was built for n = {self.n} pairs, got N = {count}. Use a model for {count} pairs.",
                actual_shape=tuple(corr.world_points.shape),
                expected_shape=["B", str(self.n), "3"],
            )
        check_devices({"world_points": corr.world_points}, next(self.parameters()), "the network")
        # The pairs one after the other, x, y, z, u, v of each, as columns: that is how they lie in memory.
        world_points, img_points = corr.world_points / self.world_scale, corr.img_points / self.img_scale
        features = torch.cat((world_points.permute(1, 2, 0), img_points.permute(1, 2, 0)), 1).flatten(0, 1)  # (5n, B)
        hidden = _run(self.shared, features)  # (3n, B)
        axis, angle = _run(self.rotation, hidden).split((3, 1))
        rotation = _rotation(axis, angle[0])
        translation = _run(self.translation, hidden).mT
        pose = Pose(rotation.to(features.dtype), translation.to(features.dtype))
        return Guess(pose, torch.ones_like(corr.weights))
