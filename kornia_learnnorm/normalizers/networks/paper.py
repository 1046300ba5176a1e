r"""The network of Fan et al.: each view's transform from that view's points alone."""

import torch
from torch import Tensor, nn
from torch.nn.functional import batch_norm, layer_norm

from kornia_learnnorm.normalizers.networks.crossview import set_maximum

__all__ = ["PaperNetwork"]

_EPSILON = 1e-5


class PaperNetwork(nn.Module):
    r"""Predict each view's parameters from its own points, as Fan et al. do (section 4, network architecture).

    A linear layer shared by the points, residual blocks with instance normalisation over the points, the maximum over
    the points before the first block and after each, a convolution over the stack of these maxima, and two fully
    connected layers. Both views share all weights. It takes two or more points, in any order.

    Where the paper leaves a choice: the first layer has no activation; a block is twice a linear layer, instance
    normalisation and ReLU, plus the skip; no normalisation has parameters of its own; each maximum is normalised over
    its channels; the convolution is not padded; the last layer starts at zero, so an untrained network gives the
    transforms of the base.

    Args:
        width: channels of a point, 128 in the paper.
        depth: residual blocks, 12 in the paper. ValueError if the stack of maxima is smaller than the kernel, 3x3.
        num_parameters: parameters per view; in the paper the three of
            :func:`~kornia_learnnorm.geometry.transforms.paper_transform`.

    The points enter in the coordinates of :class:`~kornia_learnnorm.Hartley`.

    Example:
        >>> network = PaperNetwork()
        >>> network(torch.rand(2, 8, 2), torch.rand(2, 8, 2))[0]
        tensor([[0., 0., 0.],
                [0., 0., 0.]], grad_fn=...)
    """

    def __init__(self, width: int = 128, depth: int = 12, num_parameters: int = 3) -> None:
        super().__init__()
        if width < 3 or depth < 2:
            raise ValueError(f"the 3x3 convolution needs width >= 3 and depth >= 2, got {width} and {depth}")
        if num_parameters < 1:
            raise ValueError(f"a transform has at least one parameter, got {num_parameters}")
        self.width, self.depth, self.num_parameters = width, depth, num_parameters
        self.stem = nn.Linear(2, width)
        self.blocks = nn.ModuleList(ResidualBlock(width) for _ in range(depth))
        self.convolution = nn.Conv2d(1, 8, kernel_size=3, stride=(1, 4))
        features = 8 * (depth - 1) * ((width - 3) // 4 + 1)
        last = nn.Linear(256, num_parameters)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        self.head = nn.Sequential(nn.Linear(features, 256), nn.ReLU(), nn.Linear(256, 256), nn.ReLU(), last)

    def forward(self, points1: Tensor, points2: Tensor, weights: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return the parameters :math:`(B, P)` of both views of points :math:`(B, N, 2)` in base coordinates.

        Optional weights :math:`(B, N)` are not negative; zero means absent.
        """
        dtype = self.stem.weight.dtype
        points = torch.cat([points1, points2]).to(dtype)
        maxima = self.global_features(points, None if weights is None else torch.cat([weights, weights]).to(dtype))
        params = self.head(self.convolution(maxima[:, None]).flatten(1)).to(points1.dtype)
        # Not `chunk`, which torch.export cannot trace with a dynamic batch.
        params1, params2 = torch.unflatten(params, 0, (2, -1)).unbind(0)
        return params1, params2

    def global_features(self, points: Tensor, weights: Tensor | None = None) -> Tensor:
        """Return the normalised maxima over the points before the first block and after each, :math:`(B, D + 1, C)`."""
        w = None if weights is None else weights.T[..., None]
        absent = None if w is None else w <= 0
        # Points come first: statistics over them are then sums of whole rows, which are fast on a CPU.
        h = self.stem(points.transpose(0, 1))
        maxima = [set_maximum(h, absent, 0)]
        for block in self.blocks:
            h = block(h, w)
            maxima.append(set_maximum(h, absent, 0))
        return layer_norm(torch.stack(maxima, 1), (self.width,), eps=_EPSILON)


class ResidualBlock(nn.Module):
    """Linear layer, instance normalisation over the points and ReLU, twice, plus the skip."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first, self.second = nn.Linear(width, width), nn.Linear(width, width)

    def forward(self, h: Tensor, weights: Tensor | None) -> Tensor:
        """Return the features after the block, ``(N, B, C)``; weights are ``(N, B, 1)``."""
        z = torch.relu(_instance_norm(self.first(h), weights))
        return h + torch.relu(_instance_norm(self.second(z), weights))


def _instance_norm(h: Tensor, weights: Tensor | None) -> Tensor:
    """Return features with zero mean and unit variance over the points of each channel and sample, ``(N, B, C)``."""
    if weights is None:  # every channel of every sample is a channel of its own, the points are the batch
        return batch_norm(h.flatten(1), None, None, training=True, eps=_EPSILON).view_as(h)
    total = weights.sum(0)
    share = weights / torch.where(total > 0, total, 1.0)
    centred = h - (share * h).sum(0)
    return centred * ((share * centred.square()).sum(0) + _EPSILON).rsqrt()
