r"""Synthetic two-view scenes with exact ground truth: broad random ones for training, named ones to test and to show.

Every scene is made the same way. Candidate points of the first image get a depth, the second camera a few candidate
motions, and of both are kept those that the second image shows: depths are positive in both views, and points lie in
both images, by choice among candidates and not by repair. Noise and gross outliers come last. All of it is vectorised
over the batch, in float64 on the generator's device, and depends only on the arguments and the generator's state.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from kornia.geometry.conversions import (
    axis_angle_to_rotation_matrix,
    convert_points_from_homogeneous,
    convert_points_to_homogeneous,
)
from kornia.geometry.epipolar import cross_product_matrix, fundamental_from_essential
from torch import Generator, Tensor
from torch.nn.functional import normalize

__all__ = ["TwoViewScene", "forward_driving", "handheld", "orbit", "random_scenes"]

MOTION_CANDIDATES = 4
MAX_SCALE_CHANGE = 4.0  # a point that comes closer than a quarter of its depth is not matched by any descriptor


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


def random_scenes(batch_size: int, num_points: int, generator: Generator) -> TwoViewScene:
    r"""Draw scenes as different from each other as training needs.

    Images are 400-1,400 px wide and 0.3-0.8 as high, focal lengths 0.5-1.3 widths. Points are uniform, or in half of
    the scenes clustered; depths log-uniform in 3-75, with about 40 % of the points on a ground plane. A third of the
    motions drives forward and turns by up to 0.06 rad, the others go anywhere and turn by up to 0.24 rad, doubled in a
    third of them; the baseline is log-uniform in 1-40 % of the median depth. Noise in both views is Student-t with
    three degrees of freedom, its scale per scene log-uniform in 0.1-1.5 px. Half of the scenes have up to 30 % gross
    outliers, uniform in the second image.

    Args:
        batch_size: number of scenes :math:`B`.
        num_points: correspondences per scene :math:`N`.
        generator: source of all randomness.

    Returns:
        the scenes.

    Raises:
        TypeError: if ``generator`` is not a ``torch.Generator``.
        ValueError: if ``batch_size`` or ``num_points`` is below one.

    Example:
        >>> scene = random_scenes(4, 24, torch.Generator().manual_seed(0))
        >>> scene.points1.shape, scene.F_mat.shape
        (torch.Size([4, 24, 2]), torch.Size([4, 3, 3]))

    """
    _check_arguments(batch_size, num_points, generator)
    candidates = _num_candidates(num_points)
    size, K = _random_cameras(batch_size, generator)
    points1 = _spread_points(size, candidates, generator, clustered=0.5)
    height = _log_uniform((batch_size, 1), 1.2, 4.0, generator)
    depths = _draw_depths(points1, K, 3.0, 75.0, height, generator, tilt=0.1)
    R, t = _random_motions(depths.median(dim=1, keepdim=True).values, generator)
    scene = _two_views(points1, depths, K, R, t, size, num_points)

    scale = _log_uniform((batch_size, 1, 1), 0.1, 1.5, generator)
    noise1, noise2 = (scale * _student_t(scene.points1.shape, generator) for _ in range(2))
    contaminated = _uniform((batch_size, 1), 0.0, 1.0, generator) < 0.5
    share = torch.where(contaminated, _uniform((batch_size, 1), 0.0, 0.3, generator), 0.0)
    return _corrupt(scene, noise1, noise2, share, generator)


def forward_driving(
    batch_size: int, num_points: int, generator: Generator, noise: float = 0.5, outliers: float = 0.0
) -> TwoViewScene:
    """Draw scenes of a car that drives forward: KITTI's camera, a road, about a metre between the images.

    Args:
        batch_size: number of scenes :math:`B`.
        num_points: correspondences per scene :math:`N`.
        generator: source of all randomness.
        noise: standard deviation of the Gaussian noise, pixels per coordinate, in both views.
        outliers: share of gross outliers, whose second point is uniform in the image.

    Returns:
        the scenes; the unit of depth is the metre.

    Raises:
        TypeError: if ``generator`` is not a ``torch.Generator``.
        ValueError: if ``batch_size`` or ``num_points`` is below one, ``noise`` negative or not finite, or ``outliers``
            outside of 0-1.

    Reference:
        A. Geiger, P. Lenz, R. Urtasun, Are we ready for autonomous driving? The KITTI benchmark suite, CVPR 2012.

    Example:
        >>> scene = forward_driving(2, 100, torch.Generator().manual_seed(0))
        >>> scene.image_size[0]
        tensor([1241., 376.], dtype=torch.float64)

    """
    _check_arguments(batch_size, num_points, generator, noise, outliers)
    size, K = _fixed_camera(batch_size, (1241.0, 376.0), 718.856, (607.1928, 185.2157), generator)
    points1 = _spread_points(size, _num_candidates(num_points), generator)
    depths = _draw_depths(points1, K, 4.0, 75.0, torch.full_like(size[:, :1], 1.65), generator)
    forward = _normal((batch_size, 1, 3), generator) * size.new_tensor([0.03, 0.01, 0.0]) + size.new_tensor([0.0, 0, 1])
    axes = _normal((batch_size, 1, 3), generator) * size.new_tensor([0.2, 1.0, 0.2])
    baseline = _uniform((batch_size, 1), 0.6, 1.4, generator)
    R, t = _motions(axes, _log_uniform((batch_size, 1), 0.002, 0.05, generator), forward, baseline)
    scene = _two_views(points1, depths, K, R, t, size, num_points)
    return _corrupt_evenly(scene, noise, outliers, generator)


def handheld(
    batch_size: int, num_points: int, generator: Generator, noise: float = 0.5, outliers: float = 0.0
) -> TwoViewScene:
    """Draw scenes of a camera in a hand: VGA, a room of 1-6 m with a floor, a step in any direction.

    Args:
        batch_size: number of scenes :math:`B`.
        num_points: correspondences per scene :math:`N`.
        generator: source of all randomness.
        noise: standard deviation of the Gaussian noise, pixels per coordinate, in both views.
        outliers: share of gross outliers, whose second point is uniform in the image.

    Returns:
        the scenes; the unit of depth is the metre.

    Raises:
        TypeError: if ``generator`` is not a ``torch.Generator``.
        ValueError: if ``batch_size`` or ``num_points`` is below one, ``noise`` negative or not finite, or ``outliers``
            outside of 0-1.

    Example:
        >>> scene = handheld(2, 100, torch.Generator().manual_seed(0), outliers=0.2)
        >>> scene.inliers.sum(-1)
        tensor([80, 80])

    """
    _check_arguments(batch_size, num_points, generator, noise, outliers)
    size, K = _fixed_camera(batch_size, (640.0, 480.0), 535.0, (319.5, 239.5), generator)
    points1 = _spread_points(size, _num_candidates(num_points), generator)
    depths = _draw_depths(points1, K, 1.0, 6.0, torch.full_like(size[:, :1], 1.3), generator, tilt=0.2)
    angle = _log_uniform((batch_size, 1), 0.01, 0.12, generator)
    baseline = _log_uniform((batch_size, 1), 0.03, 0.15, generator) * depths.median(dim=1, keepdim=True).values
    axes, direction = (_normal((batch_size, 1, 3), generator) for _ in range(2))
    R, t = _motions(axes, angle, direction, baseline)
    scene = _two_views(points1, depths, K, R, t, size, num_points)
    return _corrupt_evenly(scene, noise, outliers, generator)


def orbit(
    batch_size: int, num_points: int, generator: Generator, noise: float = 0.5, outliers: float = 0.0
) -> TwoViewScene:
    r"""Draw scenes of a camera that circles an object and keeps looking at it: VGA, 4 m away, 4-15 degrees.

    The second camera is the first one, rotated about the object's centre :math:`c`: :math:`t = c - R c`.

    Args:
        batch_size: number of scenes :math:`B`.
        num_points: correspondences per scene :math:`N`.
        generator: source of all randomness.
        noise: standard deviation of the Gaussian noise, pixels per coordinate, in both views.
        outliers: share of gross outliers, whose second point is uniform in the image.

    Returns:
        the scenes; the unit of depth is the metre.

    Raises:
        TypeError: if ``generator`` is not a ``torch.Generator``.
        ValueError: if ``batch_size`` or ``num_points`` is below one, ``noise`` negative or not finite, or ``outliers``
            outside of 0-1.

    Example:
        >>> scene = orbit(2, 100, torch.Generator().manual_seed(0), noise=0.0)
        >>> from kornia_learnnorm.geometry.distances import symmetric_epipolar_distance
        >>> bool(symmetric_epipolar_distance(scene.points1, scene.points2, scene.F_mat).max() < 1e-9)
        True

    """
    _check_arguments(batch_size, num_points, generator, noise, outliers)
    size, K = _fixed_camera(batch_size, (640.0, 480.0), 535.0, (319.5, 239.5), generator)
    points1 = _spread_points(size, _num_candidates(num_points), generator)
    depths = _uniform(points1.shape[:2], 3.0, 5.0, generator)
    axes = _normal((batch_size, 1, 3), generator) * size.new_tensor([0.2, 1.0, 0.1])
    angle = torch.deg2rad(_uniform((batch_size, 1, 1), 4.0, 15.0, generator))
    R = axis_angle_to_rotation_matrix(angle * normalize(axes, dim=-1))
    centre = size.new_tensor([0.0, 0.0, 4.0])
    scene = _two_views(points1, depths, K, R, centre - R @ centre, size, num_points)
    return _corrupt_evenly(scene, noise, outliers, generator)


def _check_arguments(
    batch_size: int, num_points: int, generator: Generator, noise: float = 0.0, outliers: float = 0.0
) -> None:
    for name, value in (("batch_size", batch_size), ("num_points", num_points)):
        if value < 1:
            raise ValueError(f"{name} must be at least 1, got {value}")
    if not isinstance(generator, Generator):
        raise TypeError(f"generator must be a torch.Generator, got {type(generator)}")
    if not 0 <= noise < math.inf:
        raise ValueError(f"noise must be a finite standard deviation in pixels, zero or more, got {noise}")
    if not 0 <= outliers <= 1:
        raise ValueError(f"outliers must be a share between 0 and 1, got {outliers}")


def _uniform(shape: tuple[int, ...], low: float, high: float, generator: Generator) -> Tensor:
    values = torch.rand(shape, generator=generator, dtype=torch.float64, device=generator.device)
    return low + (high - low) * values


def _log_uniform(shape: tuple[int, ...], low: float, high: float | Tensor, generator: Generator) -> Tensor:
    return low * (high / low) ** _uniform(shape, 0.0, 1.0, generator)


def _normal(shape: tuple[int, ...], generator: Generator) -> Tensor:
    return torch.randn(shape, generator=generator, dtype=torch.float64, device=generator.device)


def _student_t(shape: tuple[int, ...], generator: Generator, dof: float = 3.0) -> Tensor:
    """Draw isotropic bivariate Student-t vectors ``(*, 2)`` (R. Bailey's polar method, Math. Comp. 1994)."""
    u = 1 - _uniform(shape[:-1], 0.0, 1.0, generator)  # in (0, 1]
    radius = (dof * (u ** (-2 / dof) - 1)).sqrt()
    angle = _uniform(shape[:-1], 0.0, 2 * math.pi, generator)
    return radius[..., None] * torch.stack([angle.cos(), angle.sin()], -1)


def _camera(focal: Tensor, centre: Tensor) -> Tensor:
    """Build intrinsics ``(B, 3, 3)`` from focal lengths ``(B, 1)`` and principal points ``(B, 2)``."""
    K = torch.eye(3).to(focal).repeat(focal.shape[0], 1, 1)
    K[:, :2, :2] *= focal[..., None]
    K[:, :2, 2] = centre
    return K


def _fixed_camera(
    batch_size: int, size: tuple[float, float], focal: float, centre: tuple[float, float], generator: Generator
) -> tuple[Tensor, Tensor]:
    """Return image sizes ``(B, 2)`` and intrinsics ``(B, 3, 3)`` of one camera, repeated."""
    like = torch.empty(0, dtype=torch.float64, device=generator.device)
    K = _camera(like.new_full((batch_size, 1), focal), like.new_tensor(centre))
    return like.new_tensor(size).repeat(batch_size, 1), K


def _random_cameras(batch_size: int, generator: Generator) -> tuple[Tensor, Tensor]:
    """Draw image sizes ``(B, 2)`` and intrinsics ``(B, 3, 3)``."""
    width = _uniform((batch_size, 1), 400.0, 1400.0, generator)
    size = torch.cat([width, width * _uniform((batch_size, 1), 0.3, 0.8, generator)], -1).round()
    centre = (size - 1) / 2 + size * _uniform((batch_size, 2), -0.03, 0.03, generator)
    return size, _camera(width * _uniform((batch_size, 1), 0.5, 1.3, generator), centre)


def _num_candidates(num_points: int) -> int:
    """Return how many points to draw so that, of those that the second view shows, enough are left."""
    return 2 * num_points + 16


def _spread_points(size: Tensor, num_points: int, generator: Generator, clustered: float = 0.0) -> Tensor:
    """Draw pixels ``(B, N, 2)`` in the image, uniform or, in a share of the scenes, around one to four centres."""
    batch_size, last = size.shape[0], size[:, None] - 1
    uniform = last * _uniform((batch_size, num_points, 2), 0.0, 1.0, generator)
    if clustered == 0:
        return uniform
    chosen = _uniform((batch_size, 1, 1), 0.0, 1.0, generator) < clustered
    # The first points of the uniform draw serve as centres; what falls outside of the image stays uniform.
    count = 1 + torch.floor(_uniform((batch_size, 1), 0.0, 4.0, generator))
    index = torch.floor(count * _uniform((batch_size, num_points), 0.0, 1.0, generator)).long()
    centres = uniform.gather(1, index[..., None].expand(-1, -1, 2))
    spread = last[..., :1] * _log_uniform((batch_size, 1, 1), 0.03, 0.15, generator)
    around = centres + spread * _normal((batch_size, num_points, 2), generator)
    inside = ((around >= 0) & (around <= last)).all(-1, keepdim=True)
    return torch.where(chosen & inside, around, uniform)


def _draw_depths(
    points1: Tensor, K: Tensor, near: float, far: float, height: Tensor, generator: Generator, tilt: float = 0.0
) -> Tensor:
    """Draw depths ``(B, N)``: log-uniform, but nine in ten points whose ray meets the ground lie on the ground.

    The ground plane is ``height`` below the camera; ``tilt`` is the standard deviation of its slopes.
    """
    batch_size, num_points = points1.shape[:2]
    free = _log_uniform((batch_size, num_points), near, far, generator)
    slopes = tilt * _normal((batch_size, 2), generator)
    normal = torch.stack([slopes[:, 0], torch.ones_like(slopes[:, 0]), slopes[:, 1]], -1)
    ground = height / (_rays(points1, K) @ normal[..., None]).squeeze(-1)
    grounded = _uniform((batch_size, num_points), 0.0, 1.0, generator) < 0.9
    return torch.where(grounded & (ground > near) & (ground < far), ground, free)


def _rays(points1: Tensor, K: Tensor) -> Tensor:
    """Return the viewing rays ``(B, N, 3)`` of pixels ``(B, N, 2)``, with depth one."""
    focal, centre = K[:, None].diagonal(dim1=-2, dim2=-1)[..., :2], K[:, None, :2, 2]
    return convert_points_to_homogeneous((points1 - centre) / focal)


def _motions(axes: Tensor, angle: Tensor, direction: Tensor, baseline: Tensor) -> tuple[Tensor, Tensor]:
    """Return ``R (B, C, 3, 3), t (B, C, 3)`` for axes and directions ``(B, C, 3)`` of any length; ``t = -R centre``."""
    R = axis_angle_to_rotation_matrix(angle[..., None] * normalize(axes, dim=-1))
    centre = baseline[..., None] * normalize(direction, dim=-1)
    return R, -(R @ centre[..., None]).squeeze(-1)


def _random_motions(median_depth: Tensor, generator: Generator) -> tuple[Tensor, Tensor]:
    """Draw candidate motions ``R (B, C, 3, 3), t (B, C, 3)``; those of a scene all drive forward or all go anywhere."""
    shape = (median_depth.shape[0], MOTION_CANDIDATES)
    driving = _uniform((shape[0], 1), 0.0, 1.0, generator) < 1 / 3
    doubled = (_uniform((shape[0], 1), 0.0, 1.0, generator) < 1 / 3) & ~driving
    angle = _log_uniform(shape, 0.002, torch.where(driving, 0.06, 0.24).double(), generator)
    baseline = median_depth * _log_uniform(shape, 0.01, 0.4, generator)
    direction, axes = (_normal((*shape, 3), generator) for _ in range(2))
    forward, upright = direction.new_tensor([0.1, 0.05, 0.05]), direction.new_tensor([0.3, 1.0, 0.3])
    ahead = direction * forward + direction.new_tensor([0.0, 0.0, 1.0])
    direction = torch.where(driving[..., None], ahead, direction)
    axes = torch.where(driving[..., None], axes * upright, axes)
    return _motions(axes, torch.where(doubled, 2 * angle, angle), direction, baseline)


def _project(X: Tensor, K: Tensor, R: Tensor, t: Tensor, size: Tensor) -> tuple[Tensor, Tensor]:
    """Project points ``(B, 3, M)`` into views ``(B, C)``: homogeneous pixels ``(B, C, 3, M)``, shown ``(B, C, M)``."""
    KR, Kt = K[:, None] @ R, K[:, None] @ t[..., None]
    x2 = torch.baddbmm(Kt.flatten(1, 2), KR.flatten(1, 2), X).reshape(*R.shape[:3], -1)
    (x, y, z), last = x2.unbind(2), size[:, None] - 1
    inside = (x >= 0) & (y >= 0) & (x <= last[..., :1] * z) & (y <= last[..., 1:] * z)
    return x2, inside & (MAX_SCALE_CHANGE * z > X[:, 2:])


def _two_views(
    points1: Tensor, depths: Tensor, K: Tensor, R: Tensor, t: Tensor, size: Tensor, num_points: int
) -> TwoViewScene:
    """Choose, among candidate points ``(B, M)`` and motions ``(B, C)``, a motion and points that the second view shows.

    The motion is the first that shows half of the candidates, or the one that shows most. Should it show fewer than
    ``num_points``, which befalls fewer than one point in a thousand, the rest are not inliers. No noise yet.
    """
    X = (_rays(points1, K) * depths[..., None]).mT.contiguous()
    probe = _project(X[..., : X.shape[-1] // 2], K, R, t, size)[1]  # every other motion costs: half the points decide
    motion = probe.sum(-1).clamp(max=(probe.shape[-1] + 1) // 2).argmax(1)
    row = torch.arange(len(K), device=K.device)
    R, t = R[row, motion], t[row, motion]
    x2, shown = (values[:, 0] for values in _project(X, K, R[:, None], t[:, None], size))
    order = shown.to(torch.uint8).argsort(dim=1, descending=True, stable=True)[:, :num_points]
    pick = order[..., None].expand(-1, -1, 2)
    points2 = convert_points_from_homogeneous(x2.mT).gather(1, pick)
    F_mat = fundamental_from_essential(cross_product_matrix(t) @ R, K, K)
    F_mat = F_mat / F_mat.norm(dim=(-2, -1), keepdim=True)
    return TwoViewScene(points1.gather(1, pick), points2, F_mat, shown.gather(1, order), K, K.clone(), R, t, size)


def _corrupt(scene: TwoViewScene, noise1: Tensor, noise2: Tensor, share: Tensor, generator: Generator) -> TwoViewScene:
    """Add noise ``(B, N, 2)`` and move a share ``(B, 1)`` of the second points, rounded, anywhere in the image."""
    shape = scene.inliers.shape
    rank = _uniform(shape, 0.0, 1.0, generator).argsort(1)
    inliers = scene.inliers & (rank >= (share * shape[1]).round())
    anywhere = (scene.image_size[:, None] - 1) * _uniform((*shape, 2), 0.0, 1.0, generator)
    points2 = torch.where(inliers[..., None], scene.points2 + noise2, anywhere)
    return scene._replace(points1=scene.points1 + noise1, points2=points2, inliers=inliers)


def _corrupt_evenly(scene: TwoViewScene, noise: float, outliers: float, generator: Generator) -> TwoViewScene:
    """Add Gaussian noise of one standard deviation and the same share of gross outliers to every scene."""
    noise1, noise2 = (noise * _normal(scene.points1.shape, generator) for _ in range(2))
    return _corrupt(scene, noise1, noise2, torch.full_like(scene.t[:, :1], outliers), generator)
