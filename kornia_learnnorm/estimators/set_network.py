r"""The network of a stage of :class:`~kornia_learnnorm.LearnedEightPoint`: a logit for every correspondence of a set.

All operations are invariant or equivariant under permutations of the correspondences, and ignore absent ones.
"""

import torch
from torch import Tensor, nn
from torch.nn.functional import adaptive_max_pool1d

from kornia_learnnorm.normalizers.networks.crossview import set_maximum

MIN_VARIANCE = 1e-3  # added to the variance of a feature over the set


class SetWeightingNetwork(nn.Module):
    """Predict a logit for every correspondence and ``outputs`` numbers of the whole set.

    Residual blocks in which every correspondence sees the attentive mean, deviation and maximum of the set. The last
    layers start at zero: an untrained network gives all correspondences the same weight and leaves the transforms.

    Reference:
        W. Sun, W. Jiang, E. Trulls, A. Tagliasacchi, K. M. Yi, ACNe: Attentive context normalization for robust
        permutation-equivariant learning, CVPR 2020.
    """

    def __init__(self, features: int, width: int, depth: int, outputs: int) -> None:
        super().__init__()
        self.stem = nn.Linear(features, width)
        self.blocks = nn.ModuleList(AttentiveContextBlock(width) for _ in range(depth))
        self.norm = nn.LayerNorm(width)
        self.logit = nn.Linear(width, 1)
        self.attention = nn.Linear(width, 1)
        last = nn.Linear(width, outputs)
        self.head = nn.Sequential(nn.Linear(3 * width, width), nn.ReLU(), last)
        for layer in (self.logit, last):
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)

    def forward(self, features: Tensor, absent: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return logits :math:`(B, N)` and the set's outputs :math:`(B, P)` of features :math:`(B, N, C)`.

        ``absent`` marks the rows that are no correspondences, :math:`(B, N)` bool.
        """
        hidden = self.stem(features)
        for block in self.blocks:
            hidden = block(hidden, absent)
        hidden = self.norm(hidden)
        pooled = torch.cat(set_statistics(hidden, self.attention(hidden), absent), -1)
        outputs: Tensor = self.head(pooled.squeeze(1))
        return self.logit(hidden).squeeze(-1), outputs


class AttentiveContextBlock(nn.Module):
    """A residual two-layer perceptron on features normalised over the set by attention, with the set's maximum."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.attention = nn.Linear(width, 1)
        self.point = nn.Linear(2 * width, 2 * width)
        self.context = nn.Linear(width, 2 * width, bias=False)
        self.out = nn.Linear(2 * width, width)

    def forward(self, hidden: Tensor, absent: Tensor | None) -> Tensor:
        """Return the features after the block with shape :math:`(B, N, C)`."""
        z = self.norm(hidden)
        mean, deviation, maximum = set_statistics(z, self.attention(z), absent)
        context = self.context(maximum)
        # Only for a plain layer, not for an adapter (such as LoRA) in its place.
        if type(self.point) is nn.Linear and not torch.compiler.is_compiling() and z.shape[1] > z.shape[2]:
            # Fold the statistics into one layer per set, which then reads half as many features.
            own, relative = self.point.weight.chunk(2, 1)
            relative = relative / deviation
            bias = self.point.bias + context - mean @ relative.mT
            update = torch.baddbmm(bias, z, (own + relative).mT)
        else:
            update = self.point(torch.cat([z, (z - mean) / deviation], -1)).add_(context)
        return torch.add(hidden, self.out(update.relu_()))  # not in place: under autocast, it has half the precision


def set_statistics(features: Tensor, logits: Tensor, absent: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """Return attentive mean, attentive deviation and maximum over the set, each :math:`(B, 1, C)`.

    The statistics of empty sets are arbitrary, but finite.
    """
    features = features.to(logits.dtype)
    absent = None if absent is None else absent[..., None]
    if absent is None and not features.requires_grad:
        maximum = adaptive_max_pool1d(features.mT, 1).mT  # much faster than `amax` over the middle dimension
    else:
        maximum = set_maximum(features, absent, 1, keepdim=True)
    if absent is not None:
        logits = logits.masked_fill(absent, torch.finfo(logits.dtype).min)
    attention = torch.softmax(logits, 1).mT
    mean = attention @ features
    deviation = (attention @ (features - mean).square() + MIN_VARIANCE).sqrt()
    return mean, deviation, maximum
