"""The paper's fully connected network, which maps n ordered pairs to a coarse pose."""

from __future__ import annotations

from itertools import pairwise

import torch
from kornia.core.exceptions import ShapeError
from torch import Tensor, nn

from kornia_pnpnet.core.checks import check_devices, check_positive, check_whole
from kornia_pnpnet.problem import Problem, Starts
from kornia_pnpnet.propose.initialiser import Initialiser
from kornia_pnpnet.result import Pose

__all__ = ["MLPInit", "rotation_about"]


def _relu_layers(sizes: list[int]) -> list[nn.Module]:
    """Linear layers with ReLU and He initialisation. PyTorch's default would lose the signal in ten narrow layers."""
    layers: list[nn.Module] = []
    for size_in, size_out in pairwise(sizes):
        linear = nn.Linear(size_in, size_out)
        nn.init.kaiming_normal_(linear.weight, nonlinearity="relu")
        nn.init.zeros_(linear.bias)
        layers += [linear, nn.ReLU()]
    return layers


def _run(layers: nn.Sequential, hidden: Tensor) -> Tensor:
    """Apply the layers to ``hidden`` (units, B), in the dtype of ``hidden``."""
    for layer in layers:
        if isinstance(layer, nn.Linear):
            weight, bias = layer.weight.to(hidden.dtype), layer.bias.to(hidden.dtype)
            hidden = torch.addmm(bias.unsqueeze(1), weight, hidden)
        else:
            hidden = hidden.relu_()
    return hidden


def rotation_about(axis: Tensor, angle: Tensor) -> Tensor:
    """Rotations (B, 3, 3) about axes (3, B) by angles (B,) in radians. The axes need not have length 1."""
    limits = torch.finfo(axis.dtype)
    # The added epsilon keeps the gradient finite if the network returns a zero vector as axis.
    vector = axis * (angle * ((axis * axis).sum(0) + limits.eps).rsqrt())
    length = (vector * vector).sum(0).clamp(min=limits.tiny).sqrt()
    # The quaternion (w, xyz) has the length √2.
    half, root = 0.5 * length, 2.0**0.5
    w, xyz = root * half.cos(), vector * (root * half.sin() / length)
    (x, y, z), (wx, wy, wz) = xyz.unbind(), (w * xyz).unbind()
    xy, yz, zx, cosine = x * y, y * z, z * x, w * w - 1.0
    first = torch.addcmul(cosine, x, x), xy - wz, zx + wy
    second = xy + wz, torch.addcmul(cosine, y, y), yz - wx
    third = zx - wy, yz + wx, torch.addcmul(cosine, z, z)
    return torch.stack((*first, *second, *third)).unflatten(0, (3, 3)).permute(2, 0, 1)


class MLPInit(Initialiser):
    r"""Stage 1 of PnP-Net: a small multilayer perceptron for exactly ``n`` ordered pairs.

    The input is 5n coordinates. Shared ReLU layers have 20n, 5n and 3n units. A rotation branch and a translation
    branch follow. Each branch has five ReLU layers of 2n units and a linear last layer. The rotation branch returns an
    axis :math:`s` and an angle :math:`\theta`. The rotation is :math:`R = \exp(\theta [s / \|s\|]_\times)`.

    Source: Sheffer and Wiesel 2020, figure 2. The scales of the input are our addition. The network computes in its own
    dtype or in the dtype of the problem, whichever is wider.

    Args:
        n: number of pairs.
        world_scale: divisor of the world coordinates. The value 1 suits a centred and scaled world.
        img_scale: divisor of the image coordinates, in pixels.

    Raises:
        BaseError: when ``n`` is less than 3, or a scale is not a positive number.

    Example:
        >>> starts = MLPInit(n=9)(Problem.of(torch.randn(2, 9, 3), torch.randn(2, 9, 2), 3400.0))
        >>> starts.pose.rotation.shape, starts.pose.translation.shape
        (torch.Size([2, 3, 3]), torch.Size([2, 3]))
    """

    fixed_pairs = True
    weighs_unusual = True  # unusual pairs keep the weight 0

    def __init__(self, n: int, *, world_scale: float = 1.0, img_scale: float = 1000.0) -> None:
        super().__init__(locals())
        check_whole(3, n=n)
        check_positive(world_scale=world_scale, img_scale=img_scale)
        self.n = n
        self.world_scale = world_scale
        self.img_scale = img_scale
        self.shared = nn.Sequential(*_relu_layers([5 * n, 20 * n, 5 * n, 3 * n]))
        branch = [3 * n] + 5 * [2 * n]
        self.rotation = nn.Sequential(*_relu_layers(branch), nn.Linear(2 * n, 4))
        self.translation = nn.Sequential(*_relu_layers(branch), nn.Linear(2 * n, 3))

    def forward(self, problem: Problem) -> Starts:
        """Find a coarse pose.

        Args:
            problem: ``n`` pairs, sorted by their pixels. The coordinates of unusual pairs (see ``Problem.usual``) are
                replaced by 0.

        Returns:
            The coarse pose and the weights. The weight of a usual pair is 1, the weight of an unusual pair is 0.

        Raises:
            ShapeError: when the number of pairs is not ``n``.
            DeviceError: when the problem and the network are on different devices.
        """
        count = problem.world_points.shape[1]
        if count != self.n:
            raise ShapeError(
                f"This network was built for n = {self.n} pairs, got N = {count}. Use a model for {count} pairs.",
                actual_shape=tuple(problem.world_points.shape),
                expected_shape=["B", str(self.n), "3"],
            )
        weight = next(self.parameters())
        check_devices({"world_points": problem.world_points}, weight, "the network")
        # A column has x, y, z, u, v of the first pair, then x, y, z, u, v of the second pair, and so on.
        coordinates = problem.world_points / self.world_scale, problem.img_points / self.img_scale
        usual = problem.usual[..., None]
        features = torch.cat([(x * usual).permute(1, 2, 0) for x in coordinates], 1).flatten(0, 1)  # (5n, B)
        hidden = _run(self.shared, features.to(torch.promote_types(features.dtype, weight.dtype)))  # (3n, B)
        axis, angle = _run(self.rotation, hidden).split((3, 1))
        rotation, translation = rotation_about(axis, angle[0]), _run(self.translation, hidden).mT
        return Starts(Pose(rotation.to(features.dtype), translation.to(features.dtype)), problem.usual)
