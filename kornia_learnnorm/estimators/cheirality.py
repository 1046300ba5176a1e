"""Cheirality: which correspondences are in front of both cameras under the poses of essential matrices."""

import torch
from torch import Tensor

from kornia_learnnorm.estimators.moments import Evidence
from kornia_learnnorm.models.essential import Calibrated


def in_front_of_best_pose(evidence: Evidence, state: Calibrated, weights: Tensor, number: int) -> Tensor:
    """Return which correspondences are in front of both cameras under the best of the four poses, (B, S, N) bool.

    States are ``number`` of each set; the pose with the largest sum of weights (B, S or 1, N) in front is the best.
    """
    R, t, C1, C2 = state.rotations(), state.axes[:, 0, :, 2:], state.C1, state.C2

    def times(forms: Tensor, points: Tensor) -> Tensor:
        """Return the products of K forms of each state, (B S, K, P), with all points, (B, S, K, N)."""
        values = torch.unflatten(forms, 0, (-1, number)).flatten(1, 2) @ points
        return torch.unflatten(values, 1, (number, forms.shape[1]))

    between = times((C2.mT[:, None] @ R @ C1[:, None]).mT.flatten(2), evidence.rows)  # x2^T R x1 of directions
    along1, along2 = times(((R[:, 0] @ C1).mT @ t).mT, evidence.x1), times((C2.mT @ t).mT, evidence.x2)  # of either R
    views = (C1, evidence.x1), (C2, evidence.x2)  # the states of a set have the same cameras
    square1, square2 = ((C[::number] @ x).square().sum(1)[:, None, None] for C, x in views)
    depth1, depth2 = along2 * between - along1 * square2, along2 * square1 - along1 * between
    front = torch.cat([(depth1 > 0) & (depth2 > 0), (depth1 < 0) & (depth2 < 0)], 2)
    best = (front.to(weights) @ weights[..., None]).argmax(2, keepdim=True)
    return front.gather(2, best.expand(-1, -1, 1, front.shape[-1]))[:, :, 0]
