r"""Two views of a synthetic scene: projection, choice of the motion and the points, noise and outliers."""

from __future__ import annotations

from typing import NamedTuple

import torch
from kornia.geometry.conversions import convert_points_from_homogeneous
from torch import Generator, Tensor

from kornia_learnnorm.data.motion import fundamental_from_motion
from kornia_learnnorm.data.synthetic.draws import normal, uniform, viewing_rays

__all__ = ["TwoViewScene", "corrupt", "corrupt_evenly", "two_views"]

MAX_SCALE_CHANGE = 4.0  # ratio of a point's depths in view 1 and view 2; no descriptor matches beyond


class TwoViewScene(NamedTuple):
    r"""Correspondences of a batch of image pairs and their ground truth; :math:`X_2 = R X_1 + t` for points in space.

    Args:
        points1: pixels in the first image with shape :math:`(B, N, 2)`.
        points2: pixels in the second image with shape :math:`(B, N, 2)`.
        F_mat: fundamental matrices with shape :math:`(B, 3, 3)`, unit Frobenius norm, :math:`x_2^\top F x_1 = 0`.
        inliers: boolean, :math:`(B, N)`; false for gross outliers.
        K1: intrinsics of the first camera with shape :math:`(B, 3, 3)`.
        K2: intrinsics of the second camera with shape :math:`(B, 3, 3)`.
        R: rotations with shape :math:`(B, 3, 3)`.
        t: translations with shape :math:`(B, 3)`, in the unit of depth.
        image_size: width and height in pixels with shape :math:`(B, 2)`.

    """

    points1: Tensor
    points2: Tensor
    F_mat: Tensor
    inliers: Tensor
    K1: Tensor
    K2: Tensor
    R: Tensor
    t: Tensor
    image_size: Tensor


def two_views(
    points1: Tensor, depths: Tensor, K: Tensor, R: Tensor, t: Tensor, size: Tensor, num_points: int
) -> TwoViewScene:
    """Return scenes without noise, of candidate points ``(B, M)`` and candidate motions ``(B, C)``.

    The motion is the first that shows half of the candidate points, or else the one that shows most. If it shows fewer
    than ``num_points``, the missing points are outliers; fewer than one point in a thousand is.
    """
    X = (viewing_rays(points1, K) * depths[..., None]).mT.contiguous()
    probe = _project(X[..., : X.shape[-1] // 2], K, R, t, size)[1]  # half of the points, to save time
    motion = probe.sum(-1).clamp(max=(probe.shape[-1] + 1) // 2).argmax(1)
    row = torch.arange(len(K), device=K.device)
    R, t = R[row, motion], t[row, motion]
    x2, shown = (values[:, 0] for values in _project(X, K, R[:, None], t[:, None], size))
    order = shown.to(torch.uint8).argsort(dim=1, descending=True, stable=True)[:, :num_points]
    pick = order[..., None].expand(-1, -1, 2)
    points2 = convert_points_from_homogeneous(x2.mT).gather(1, pick)
    F_mat = fundamental_from_motion(K, K, R, t)
    return TwoViewScene(points1.gather(1, pick), points2, F_mat, shown.gather(1, order), K, K.clone(), R, t, size)


def corrupt(scene: TwoViewScene, noise1: Tensor, noise2: Tensor, share: Tensor, generator: Generator) -> TwoViewScene:
    """Return the scenes with noise ``(B, N, 2)`` added and a share ``(B, 1)`` of points2 at random pixels."""
    shape = scene.inliers.shape
    rank = uniform(shape, 0.0, 1.0, generator).argsort(1)
    inliers = scene.inliers & (rank >= (share * shape[1]).round())
    anywhere = (scene.image_size[:, None] - 1) * uniform((*shape, 2), 0.0, 1.0, generator)
    points2 = torch.where(inliers[..., None], scene.points2 + noise2, anywhere)
    return scene._replace(points1=scene.points1 + noise1, points2=points2, inliers=inliers)


def corrupt_evenly(scene: TwoViewScene, noise: float, outliers: float, generator: Generator) -> TwoViewScene:
    """Return the scenes with Gaussian noise (standard deviation in pixels) and the same share of gross outliers."""
    noise1, noise2 = (noise * normal(scene.points1.shape, generator) for _ in range(2))
    return corrupt(scene, noise1, noise2, torch.full_like(scene.t[:, :1], outliers), generator)


def _project(X: Tensor, K: Tensor, R: Tensor, t: Tensor, size: Tensor) -> tuple[Tensor, Tensor]:
    """Return homogeneous pixels ``(B, C, 3, M)`` of points ``(B, 3, M)`` in ``C`` views, and a mask of those shown."""
    KR, Kt = K[:, None] @ R, K[:, None] @ t[..., None]
    x2 = torch.baddbmm(Kt.flatten(1, 2), KR.flatten(1, 2), X).reshape(*R.shape[:3], -1)
    (x, y, z), last = x2.unbind(2), size[:, None] - 1
    inside = (x >= 0) & (y >= 0) & (x <= last[..., :1] * z) & (y <= last[..., 1:] * z)
    return x2, inside & (MAX_SCALE_CHANGE * z > X[:, 2:])
