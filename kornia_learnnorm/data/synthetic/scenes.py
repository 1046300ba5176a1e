r"""Synthetic two-view scenes with exact ground truth: varied ones for training, named ones for tests and examples.

Candidate points of the first image get depths, and the second camera gets a few candidate motions. The scene keeps a
motion and points that lie in both images and before both cameras. Noise and gross outliers come last. All is in float64
on the generator's device and depends only on the arguments and the generator's state.
"""

import math
from collections.abc import Collection
from typing import NamedTuple

import numpy as np
import torch
from kornia.geometry.conversions import axis_angle_to_rotation_matrix, convert_points_from_homogeneous
from torch import Generator, Tensor
from torch.nn.functional import normalize

from kornia_learnnorm.data.datasets.frames import fundamental_from_motion
from kornia_learnnorm.data.store import CorrespondenceStore
from kornia_learnnorm.data.synthetic import draws

__all__ = ["TwoViewScene", "forward_driving", "handheld", "orbit", "random_scenes", "random_views", "two_views"]

MAX_SCALE_CHANGE = 4.0  # ratio of a point's depths in view 1 and view 2; no descriptor matches beyond


class TwoViewScene(NamedTuple):
    """Correspondences of a batch of image pairs and their ground truth: X2 = R X1 + t, x2^T F x1 = 0."""

    points1: Tensor  # pixels in the first image, (B, N, 2)
    points2: Tensor  # pixels in the second image, (B, N, 2)
    F_mat: Tensor  # unit Frobenius norm, (B, 3, 3)
    inliers: Tensor  # boolean, (B, N); false for gross outliers
    K1: Tensor  # intrinsics of the first camera, (B, 3, 3)
    K2: Tensor  # intrinsics of the second camera, (B, 3, 3)
    R: Tensor  # rotations, (B, 3, 3)
    t: Tensor  # translations in the unit of depth, (B, 3)
    image_size: Tensor  # width and height, pixels, (B, 2)


def random_scenes(batch_size: int, num_points: int, generator: Generator) -> TwoViewScene:
    """Draw varied scenes for training.

    Images are 400-1,400 px wide and 0.3-0.8 as high, focal lengths 0.5-1.3 widths. Points are uniform, or in half of
    the scenes clustered; depths log-uniform in 3-75, with about 40 % of the points on a ground plane. A third of the
    motions drives forward and turns by up to 0.06 rad, the rest go anywhere and turn by up to 0.24 rad, doubled in a
    third of these; the baseline is log-uniform in 1-40 % of the median depth. Noise in both views is Student-t with
    three degrees of freedom, its scale per scene log-uniform in 0.1-1.5 px. Half of the scenes have up to 30 % gross
    outliers, uniform in the second image. Arguments and errors are those of :func:`forward_driving`.
    """
    scene = random_views(batch_size, num_points, generator)
    scale = draws.log_uniform((batch_size, 1, 1), 0.1, 1.5, generator)
    noise1, noise2 = (scale * draws.student_t(scene.points1.shape, generator) for _ in range(2))
    contaminated = draws.uniform((batch_size, 1), 0.0, 1.0, generator) < 0.5
    share = torch.where(contaminated, draws.uniform((batch_size, 1), 0.0, 0.3, generator), 0.0)
    return _corrupt(scene, noise1, noise2, share, generator)


def random_views(batch_size: int, num_points: int, generator: Generator) -> TwoViewScene:
    """Draw the scenes of :func:`random_scenes` without noise and outliers; the arguments and errors are the same."""
    _check_arguments(batch_size, num_points, generator, 0.0, 0.0)
    size, K = draws.random_cameras(batch_size, generator)
    points1 = draws.spread_points(size, 2 * num_points + 16, generator, clustered=0.5)
    height = draws.log_uniform((batch_size, 1), 1.2, 4.0, generator)
    depths = draws.draw_depths(points1, K, 3.0, 75.0, height, generator, tilt=0.1)
    R, t = draws.random_motions(depths.median(dim=1, keepdim=True).values, generator)
    return two_views(points1, depths, K, R, t, size, num_points)


def forward_driving(
    batch_size: int, num_points: int, generator: Generator, noise: float = 0.5, outliers: float = 0.0
) -> TwoViewScene:
    """Draw scenes of a car that drives forward: KITTI's camera (A. Geiger et al., CVPR 2012), a road, steps of a metre.

    Args:
        batch_size: number of scenes :math:`B`.
        num_points: correspondences per scene :math:`N`.
        generator: source of all randomness; a TypeError for anything but a ``torch.Generator``.
        noise: standard deviation of the Gaussian noise, pixels, of each coordinate in both views.
        outliers: share of gross outliers, whose second point is uniform in the image.

    Example:
        >>> scene = forward_driving(2, 100, torch.Generator().manual_seed(0))
        >>> scene.image_size[0]
        tensor([1241., 376.], dtype=torch.float64)
    """
    _check_arguments(batch_size, num_points, generator, noise, outliers)
    size, K = draws.fixed_camera(batch_size, (1241.0, 376.0), 718.856, (607.1928, 185.2157), generator)
    points1 = draws.spread_points(size, 2 * num_points + 16, generator)
    depths = draws.draw_depths(points1, K, 4.0, 75.0, torch.full_like(size[:, :1], 1.65), generator)
    ahead = size.new_tensor([0.0, 0.0, 1.0])
    forward = ahead + draws.normal((batch_size, 1, 3), generator) * size.new_tensor([0.03, 0.01, 0.0])
    axes = draws.normal((batch_size, 1, 3), generator) * size.new_tensor([0.2, 1.0, 0.2])
    baseline = draws.uniform((batch_size, 1), 0.6, 1.4, generator)
    R, t = draws.motions(axes, draws.log_uniform((batch_size, 1), 0.002, 0.05, generator), forward, baseline)
    return _corrupt_evenly(two_views(points1, depths, K, R, t, size, num_points), noise, outliers, generator)


def handheld(
    batch_size: int, num_points: int, generator: Generator, noise: float = 0.5, outliers: float = 0.0
) -> TwoViewScene:
    """Draw scenes of a camera in a hand: VGA, a room of 1-6 m with a floor, a step in any direction.

    Arguments, units and errors are those of :func:`forward_driving`.
    """
    _check_arguments(batch_size, num_points, generator, noise, outliers)
    size, K = draws.fixed_camera(batch_size, (640.0, 480.0), 535.0, (319.5, 239.5), generator)
    points1 = draws.spread_points(size, 2 * num_points + 16, generator)
    depths = draws.draw_depths(points1, K, 1.0, 6.0, torch.full_like(size[:, :1], 1.3), generator, tilt=0.2)
    angle = draws.log_uniform((batch_size, 1), 0.01, 0.12, generator)
    baseline = draws.log_uniform((batch_size, 1), 0.03, 0.15, generator) * depths.median(dim=1, keepdim=True).values
    axes, direction = (draws.normal((batch_size, 1, 3), generator) for _ in range(2))
    R, t = draws.motions(axes, angle, direction, baseline)
    return _corrupt_evenly(two_views(points1, depths, K, R, t, size, num_points), noise, outliers, generator)


def orbit(
    batch_size: int, num_points: int, generator: Generator, noise: float = 0.5, outliers: float = 0.0
) -> TwoViewScene:
    """Draw scenes of a camera that circles an object and keeps looking at it: VGA, 4 m away, 4-15 degrees.

    The second camera is the first one, rotated about the object's centre :math:`c`: :math:`t = c - R c`. Arguments,
    units and errors are those of :func:`forward_driving`.
    """
    _check_arguments(batch_size, num_points, generator, noise, outliers)
    size, K = draws.fixed_camera(batch_size, (640.0, 480.0), 535.0, (319.5, 239.5), generator)
    points1 = draws.spread_points(size, 2 * num_points + 16, generator)
    depths = draws.uniform(points1.shape[:2], 3.0, 5.0, generator)
    axes = draws.normal((batch_size, 1, 3), generator) * size.new_tensor([0.2, 1.0, 0.1])
    angle = torch.deg2rad(draws.uniform((batch_size, 1, 1), 4.0, 15.0, generator))
    R = axis_angle_to_rotation_matrix(angle * normalize(axes, dim=-1))
    centre = size.new_tensor([0.0, 0.0, 4.0])
    scene = two_views(points1, depths, K, R, centre - R @ centre, size, num_points)
    return _corrupt_evenly(scene, noise, outliers, generator)


def _check_arguments(batch_size: int, num_points: int, generator: Generator, noise: float, outliers: float) -> None:
    for name, value in (("batch_size", batch_size), ("num_points", num_points)):
        if value < 1:
            raise ValueError(f"{name} must be at least 1, got {value}")
    if not isinstance(generator, Generator):
        raise TypeError(f"generator must be a torch.Generator, got {type(generator)}")
    if not 0 <= noise < math.inf:
        raise ValueError(f"noise must be a finite standard deviation in pixels, zero or more, got {noise}")
    if not 0 <= outliers <= 1:
        raise ValueError(f"outliers must be a share between 0 and 1, got {outliers}")


def two_views(
    points1: Tensor, depths: Tensor, K: Tensor, R: Tensor, t: Tensor, size: Tensor, num_points: int
) -> TwoViewScene:
    """Return scenes without noise, of candidate points ``(B, M)`` and candidate motions ``(B, C)``.

    The motion is the first that shows half of the candidate points, or else the one that shows most. If it shows fewer
    than ``num_points``, the missing points are outliers; fewer than one point in a thousand is.
    """
    X = (draws.viewing_rays(points1, K) * depths[..., None]).mT.contiguous()
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


def _corrupt(scene: TwoViewScene, noise1: Tensor, noise2: Tensor, share: Tensor, generator: Generator) -> TwoViewScene:
    """Return the scenes with noise ``(B, N, 2)`` added and a share ``(B, 1)`` of points2 at random pixels."""
    shape = scene.inliers.shape
    rank = draws.uniform(shape, 0.0, 1.0, generator).argsort(1)
    inliers = scene.inliers & (rank >= (share * shape[1]).round())
    anywhere = (scene.image_size[:, None] - 1) * draws.uniform((*shape, 2), 0.0, 1.0, generator)
    points2 = torch.where(inliers[..., None], scene.points2 + noise2, anywhere)
    return scene._replace(points1=scene.points1 + noise1, points2=points2, inliers=inliers)


def _corrupt_evenly(scene: TwoViewScene, noise: float, outliers: float, generator: Generator) -> TwoViewScene:
    """Return the scenes with Gaussian noise (standard deviation in pixels) and the same share of gross outliers."""
    noise1, noise2 = (noise * draws.normal(scene.points1.shape, generator) for _ in range(2))
    return _corrupt(scene, noise1, noise2, torch.full_like(scene.t[:, :1], outliers), generator)


def _project(X: Tensor, K: Tensor, R: Tensor, t: Tensor, size: Tensor) -> tuple[Tensor, Tensor]:
    """Return homogeneous pixels ``(B, C, 3, M)`` of points ``(B, 3, M)`` in ``C`` views, and a mask of those shown."""
    KR, Kt = K[:, None] @ R, K[:, None] @ t[..., None]
    x2 = torch.baddbmm(Kt.flatten(1, 2), KR.flatten(1, 2), X).reshape(*R.shape[:3], -1)
    (x, y, z), last = x2.unbind(2), size[:, None] - 1
    inside = (x >= 0) & (y >= 0) & (x <= last[..., :1] * z) & (y <= last[..., 1:] * z)
    return x2, inside & (MAX_SCALE_CHANGE * z > X[:, 2:])


SCENES = {"forward driving": forward_driving, "hand-held": handheld, "orbit": orbit}


def synthetic_store(
    pairs: int, points: int, seed: int = 0, noise: float = 0.5, outliers: float = 0.2, scenes: Collection[str] = SCENES
) -> CorrespondenceStore:
    """Return a store of synthetic scenes, ``pairs`` of each kind; the ratio test of 0.8 keeps half of the outliers."""
    if pairs < 1 or points < 8:
        raise ValueError(f"at least 1 pair of each scene and 8 points are needed, got {pairs} and {points}")
    if set(scenes) - set(SCENES) or not scenes:
        raise ValueError(f"scenes must be among {', '.join(SCENES)}, got {', '.join(scenes) or 'none'}")
    generator = torch.Generator().manual_seed(seed)
    made = [SCENES[kind](pairs, points, generator, noise, outliers) for kind in scenes]
    scene = TwoViewScene(*map(torch.cat, zip(*made, strict=True)))
    low, high = torch.where(scene.inliers, 0.3, 0.6), torch.where(scene.inliers, 0.8, 1.0)
    ratio = low + (high - low) * torch.rand(low.shape, generator=generator)
    names = [(f"{kind}/{i:04d}-1", f"{kind}/{i:04d}-2") for kind in scenes for i in range(pairs)]
    return CorrespondenceStore(
        points1=scene.points1.flatten(0, 1).numpy().astype(np.float32),
        points2=scene.points2.flatten(0, 1).numpy().astype(np.float32),
        ratio=ratio.flatten().numpy().astype(np.float32),
        offsets=np.arange(len(names) + 1, dtype=np.int64) * points,
        image_size=scene.image_size[:, None].expand(-1, 2, -1).int().numpy(),
        names=names,
        F=scene.F_mat.numpy(),
        K=torch.stack([scene.K1, scene.K2], 1).numpy(),
        R=scene.R.numpy(),
        t=scene.t.numpy(),
        dataset=f"synthetic scenes ({', '.join(scenes)}), noise {noise:g} px, {outliers:.0%} outliers",
        pairs="independent",
        detector="none",
    )
