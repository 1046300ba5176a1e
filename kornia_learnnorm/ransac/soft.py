"""Differentiable RANSAC for training: random minimal samples, soft inlier counts, and a choice by softmax."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from kornia.core.check import KORNIA_CHECK_SHAPE
from torch import Generator, Tensor

from kornia_learnnorm.estimators.linear import find_fundamental
from kornia_learnnorm.geometry.checks import check_correspondences, check_tensor
from kornia_learnnorm.geometry.distances import sampson_distance
from kornia_learnnorm.normalizers.normalizer import Normalizer


def sample_minimal_sets(logits: Tensor, count: int, generator: Generator | None = None) -> tuple[Tensor, Tensor]:
    r"""Draw minimal samples of eight correspondences, without replacement within a sample.

    One after the other, correspondence :math:`i` is drawn with probability :math:`\propto e^{l_i}` among those that are
    left. So the probability of an ordered sample is, with :math:`p = \mathrm{softmax}(l)`,

    .. math:: P(i_1, \dots, i_8) = \prod_{j=1}^{8} \frac{p_{i_j}}{1 - \sum_{k < j} p_{i_k}} .

    Args:
        logits: :math:`l` with shape :math:`(B, N)`, :math:`N \ge 8`, such as a network's output, or logarithms of
            probabilities up to a constant; zeros draw uniformly.
        count: number :math:`K` of samples.
        generator: source of randomness on the device of the logits; PyTorch's own when not given.

    Returns:
        indices with shape :math:`(B, K, 8)` and :math:`\log P` with shape :math:`(B, K)`, differentiable in the logits.

    Raises:
        TypeError: if the logits are not a floating-point tensor.
        ShapeError: if they are not :math:`(B, N)`.
        ValueError: if there are fewer than eight correspondences, a logit is not finite or the count is not positive.

    Reference:
        E. Brachmann, C. Rother, Neural-guided RANSAC: learning where to sample model hypotheses, ICCV 2019.

    Example:
        >>> samples, log_probs = sample_minimal_sets(torch.zeros(2, 100), 16, torch.Generator().manual_seed(0))
        >>> samples.shape, log_probs.shape
        (torch.Size([2, 16, 8]), torch.Size([2, 16]))
    """
    check_tensor("logits", logits, ["B", "N"])
    if logits.shape[1] < 8:
        raise ValueError(f"at least 8 correspondences are needed, got {logits.shape[1]}")
    if bad := int((~torch.isfinite(logits)).sum()):
        raise ValueError(f"logits must be finite, got {bad} NaN or infinite values")
    if count < 1:
        raise ValueError(f"count must be >= 1, got {count}")
    log_p = logits.double().log_softmax(-1)[:, None].expand(-1, count, -1)
    # The first arrivals of exponential clocks with these rates are draws without replacement.
    arrivals = torch.empty_like(log_p).exponential_(generator=generator).log() - log_p.detach()
    samples = arrivals.topk(8, largest=False).indices
    chosen = log_p.gather(-1, samples)
    never = log_p.scatter(-1, samples, -torch.inf).logsumexp(-1, keepdim=True)
    left = torch.cat([never, chosen.flip(-1)], -1).logcumsumexp(-1)[..., 1:]  # probabilities of those left, last first
    return samples, (chosen - left.flip(-1)).sum(-1).to(logits.dtype)


class SoftChoice(NamedTuple):
    """Expected loss of the chosen hypothesis, with all hypotheses and their probabilities."""

    loss: Tensor  # expected loss, (B,)
    F_mat: Tensor  # of the samples, (B, K, 3, 3)
    probability: Tensor  # of each to be chosen, (B, K)


def expected_loss(
    points1: Tensor,
    points2: Tensor,
    samples: Tensor,
    loss: Callable[[Tensor], Tensor],
    log_probs: Tensor | None = None,
    normalizer: Normalizer | None = None,
    threshold: float = 1.0,
    slope: float = 5.0,
    scale: float = 0.1,
) -> SoftChoice:
    r"""Return the expected loss of a hypothesis drawn with the softmax probabilities of soft inlier counts.

    With :math:`F_k` from the eight correspondences of sample :math:`k` and Sampson distances :math:`d_{ki}`,

    .. math:: s_k = \sum_i \sigma\big(\beta\, (1 - d_{ki} / \tau)\big), \quad p = \mathrm{softmax}(\alpha s), \quad
              L = \sum_k p_k\, \ell(F_k).

    Gradients reach the points and the normaliser through :math:`\ell` and through :math:`s`. With ``log_probs`` they
    reach the sampling as well, by the score function (REINFORCE): the gradient of the loss gets the term
    :math:`\sum_k (L - L_{-k}) \nabla \log P_k`, in which the baseline :math:`L_{-k}`, the expected loss without sample
    :math:`k`, reduces the variance and adds no bias.

    Args:
        points1: pixels in the first image with shape :math:`(B, N, 2)`, :math:`N \ge 8`, float32 or float64.
        points2: pixels in the second image with shape :math:`(B, N, 2)`.
        samples: indices of minimal samples with shape :math:`(B, K, 8)`, such as those of :func:`sample_minimal_sets`.
        loss: :math:`\ell`, from matrices :math:`(B, K, 3, 3)` to losses :math:`(B, K)`. Bad hypotheses have huge
            distances: bound it.
        log_probs: optional :math:`\log P_k` of the samples with shape :math:`(B, K)`, :math:`K \ge 2`.
        normalizer: maps ``(points1, points2, weights)`` of the samples to the transforms of both views;
            :class:`~kornia_learnnorm.Hartley` when not given.
        threshold: :math:`\tau`, distance in pixels at which a correspondence counts half.
        slope: :math:`\beta`, how sharply inliers end at the threshold.
        scale: :math:`\alpha`, log-odds that one more inlier is worth; 0 chooses uniformly.

    Returns:
        the expected loss with the hypotheses and their probabilities.

    Raises:
        TypeError: if points are not floating-point tensors of one dtype or the samples not of int64.
        ShapeError: if a shape is wrong.
        ValueError: if there are fewer than eight correspondences, shapes do not pair up, a value is not finite, the
            loss returns another shape, or ``threshold`` or ``slope`` is not positive.

    Reference:
        E. Brachmann et al., DSAC: differentiable RANSAC for camera localization, CVPR 2017; E. Brachmann, C. Rother,
        Neural-guided RANSAC: learning where to sample model hypotheses, ICCV 2019.

    Example:
        >>> _ = torch.manual_seed(0)
        >>> points1, points2 = torch.rand(2, 50, 2) * 600, torch.rand(2, 50, 2) * 600
        >>> logits = torch.zeros(2, 50, requires_grad=True)
        >>> samples, log_probs = sample_minimal_sets(logits, 16)
        >>> choice = expected_loss(points1, points2, samples, lambda F: F[..., 0, 0].abs(), log_probs)
        >>> choice.loss.sum().backward()
        >>> logits.grad.shape
        torch.Size([2, 50])
    """
    check_correspondences(points1, points2)
    if not isinstance(samples, Tensor) or samples.dtype != torch.int64:
        got = samples.dtype if isinstance(samples, Tensor) else type(samples)
        raise TypeError(f"samples must be an int64 tensor, got {got}")
    KORNIA_CHECK_SHAPE(samples, ["B", "K", "8"])
    batch, count = samples.shape[:2]
    if batch != len(points1):
        raise ValueError(f"samples of {len(points1)} sets of points are needed, got {batch}")
    if log_probs is not None and (log_probs.shape != (batch, count) or count < 2):
        wanted = f"{[batch, count]} with two samples or more"
        raise ValueError(f"log_probs must have shape {wanted}, got {[*log_probs.shape]}")
    if not (threshold > 0 and slope > 0):
        raise ValueError(f"threshold and slope must be positive, got {threshold} and {slope}")
    x1, x2 = (p.gather(1, samples.flatten(1)[..., None].expand(-1, -1, 2)) for p in (points1, points2))
    F = find_fundamental(x1.view(-1, 8, 2), x2.view(-1, 8, 2), normalizer=normalizer).view(batch, count, 3, 3)
    every1, every2 = (p[:, None].expand(-1, count, -1, -1) for p in (points1, points2))
    distances = sampson_distance(every1, every2, F)
    scores = scale * torch.sigmoid(slope * (1 - distances / threshold)).sum(-1)
    losses = loss(F)
    if losses.shape != (batch, count):
        raise ValueError(f"the loss must return one value per matrix, {[batch, count]}, got {[*losses.shape]}")
    expected = (scores.softmax(-1) * losses).sum(-1)
    if log_probs is not None:
        left_out = torch.eye(count, dtype=torch.bool, device=scores.device)
        without_each = (scores[:, None].masked_fill(left_out, -torch.inf).softmax(-1) * losses[:, None]).sum(-1)
        advantage = (expected[:, None] - without_each).detach()
        expected = expected + (advantage * (log_probs - log_probs.detach())).sum(-1)
    return SoftChoice(expected, F, scores.softmax(-1))
