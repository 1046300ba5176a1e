"""Synthetic matches as a matcher gives them: varied scenes, noise, scores, and outliers of several kinds."""

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import torch
from kornia.geometry.conversions import axis_angle_to_rotation_matrix, convert_points_to_homogeneous
from torch import Generator, Tensor
from torch.nn.functional import normalize

from kornia_learnnorm.data.synthetic import draws, scenes
from kornia_learnnorm.geometry.distances import symmetric_epipolar_distance, transfer_distance

ORBIT_CANDIDATES = 6  # motions per scene
PLANE_CANDIDATES = 6  # planes and motions per scene
Errors = Callable[[Tensor, Tensor], Tensor]  # distances (B, N) of points (B, N, 2) x 2 under the true model
MIN_DEPTH = 0.15  # of a point of a plane, over its depth in the other view


class SyntheticMatches(NamedTuple):
    """Matches of synthetic scenes."""

    points1: Tensor  # pixels in the first image, (B, N, 2)
    points2: Tensor  # pixels in the second image, (B, N, 2)
    scores: Tensor  # a score for each match, as 1 minus Lowe's ratio, (B, N)
    inliers: Tensor  # one for inliers, zero for outliers, (B, N)
    exact1: Tensor  # pixels in the first image of further correspondences, without noise, (B, M, 2)
    exact2: Tensor  # pixels in the second image of the further correspondences, (B, M, 2)
    K1: Tensor  # cameras, (B, 3, 3)
    K2: Tensor
    E_mat: Tensor  # true essential matrices of unit Frobenius norm, (B, 3, 3)


def random_matches(
    batch_size: int, num_points: int, num_exact: int, generator: Generator, coarse: float = 0.0
) -> SyntheticMatches:
    """Draw ``num_points`` matches of varied scenes, and ``num_exact`` further correspondences without noise.

    All scenes of a call are of one kind: random (:func:`~kornia_learnnorm.data.synthetic.scenes.random_scenes`),
    driving, hand-held, orbit or :func:`wide_baseline`. The noise is Gaussian or, in half of the scenes, Student-t with
    three degrees of freedom; its scale is log-uniform in 0.05-1 px and varies between the points of a scene by a
    log-normal factor. A quarter of the scenes has some radial distortion. Half of the scenes have up to 20 % outliers,
    the others 20 to 90 %: two fifths anywhere in the other image, the rest at the partner of another point, often of
    one of a few, or shifted by 4-150 px. In a quarter of the scenes, with 10 to 50 % outliers, the shifts are one, as
    of an object that moves. Outliers are neighbours in a third of the scenes.

    A share ``coarse`` of the scenes has matches as learned detectors give them: noise of 0.2-1.5 px, smaller where the
    score is high; half of these scenes as LightGlue leaves them, with up to 20 % outliers and most scores near one, the
    others as mutual nearest neighbours with 10 to 70 %.
    """
    named = (partial(draw, noise=0.0) for draw in (scenes.forward_driving, scenes.handheld, scenes.orbit))
    kinds: list[Callable[..., scenes.TwoViewScene]] = [scenes.random_views, *named, wide_baseline]
    kind = int(torch.randint(len(kinds), (), generator=generator, device=generator.device))
    scene = _distort(kinds[kind](batch_size, num_points + num_exact, generator), generator)
    points1, exact1 = torch.split(scene.points1, [num_points, num_exact], 1)
    points2, exact2 = torch.split(scene.points2, [num_points, num_exact], 1)
    distance = partial(symmetric_epipolar_distance, F_mat=scene.F_mat)
    matches = _corrupt(points1, points2, scene.inliers[:, :num_points], scene.image_size, distance, coarse, generator)
    E_mat = scene.K2.mT @ scene.F_mat @ scene.K1
    E_mat = E_mat / torch.linalg.matrix_norm(E_mat, keepdim=True)
    return SyntheticMatches(*matches, exact1, exact2, scene.K1, scene.K2, E_mat)


def random_planes(
    batch_size: int, num_points: int, num_exact: int, generator: Generator, coarse: float = 0.0
) -> SyntheticMatches:
    """Draw matches of planes, and in a quarter of the scenes of a camera that only rotates.

    The plane is slanted by up to about 60 degrees. The camera turns by 0.005-0.7 rad, also about its axis, and moves by
    0.01-1 times the distance of the plane. The second image shows an eighth of the first or more. Noise, outliers and
    scores are those of :func:`random_matches`. Half of the exact correspondences are in the part that both images show,
    the others anywhere in the first image. Essential matrices, of which a plane has two, are NaN.
    """
    size, K = draws.random_cameras(batch_size, generator)
    shape = (batch_size, PLANE_CANDIDATES)
    shared, total = num_exact // 2, num_points + num_exact // 2
    points1 = draws.spread_points(size, 8 * total, generator, clustered=0.3)
    anywhere = draws.spread_points(size, num_exact - shared, generator)
    angle = draws.log_uniform(shape, 0.005, 0.7, generator)
    direction, axes = (draws.normal((*shape, 3), generator) for _ in range(2))
    turning = draws.uniform((batch_size, 1), 0.0, 1.0, generator) < 0.25
    baseline = torch.where(turning, 0.0, draws.log_uniform(shape, 0.01, 1.0, generator))
    R, t = draws.motions(axes, angle, direction, baseline)
    slope = 0.6 * draws.normal((*shape, 2), generator)
    normal = normalize(torch.cat([slope, torch.ones_like(slope[..., :1])], -1), dim=-1)
    K_inverse = torch.linalg.inv(K)
    H = K[:, None] @ (R + t[..., None] * normal[..., None, :]) @ K_inverse[:, None]

    rays = convert_points_to_homogeneous(torch.cat([points1, anywhere], 1))
    x2 = H @ rays.mT[:, None]  # (B, C, 3, M)
    in_front = (x2[:, :, 2] > MIN_DEPTH) & ((normal @ K_inverse) @ rays.mT > MIN_DEPTH)
    pixels = x2[:, :, :2] / x2[:, :, 2:].clamp(min=MIN_DEPTH)
    inside = in_front & ((pixels >= 0) & (pixels < size[:, None, :, None])).all(2)
    number = points1.shape[1]
    shown = inside[..., :number]
    count = shown.sum(-1).clamp(max=total) * in_front[..., number:].all(-1)
    row, chosen = torch.arange(batch_size, device=size.device), count.argmax(1)
    H, shown, pixels = H[row, chosen], shown[row, chosen], pixels[row, chosen].mT
    order = shown.to(torch.uint8).argsort(dim=1, descending=True, stable=True)[:, :total]
    pick = order[..., None].expand(-1, -1, 2)
    points1, shared1 = torch.split(points1.gather(1, pick), [num_points, shared], 1)
    points2, shared2 = torch.split(pixels.gather(1, pick), [num_points, shared], 1)
    distance, shown = partial(transfer_distance, H_mat=H), shown.gather(1, order)[:, :num_points]
    matches = _corrupt(points1, points2, shown, size, distance, coarse, generator)
    exact1, exact2 = torch.cat([shared1, anywhere], 1), torch.cat([shared2, pixels[:, number:]], 1)
    return SyntheticMatches(*matches, exact1, exact2, K, K.clone(), torch.full_like(K, torch.nan))


def _corrupt(
    points1: Tensor, points2: Tensor, shown: Tensor, size: Tensor, distance: Errors, coarse: float, generator: Generator
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return exact correspondences with noise and outliers, their scores, and which are inliers."""
    batch_size, num_points = points1.shape[:2]
    scale = draws.log_uniform((batch_size, 1, 1), 0.05, 1.0, generator)
    heavy = draws.uniform((batch_size, 1, 1), 0.0, 1.0, generator) < 0.5
    quality = draws.normal((batch_size, num_points, 1), generator)
    uneven = (0.6 * quality).exp()  # features of different sizes
    learned = scale.new_zeros(batch_size, 1, dtype=torch.bool)
    if coarse:
        learned = draws.uniform((batch_size, 1), 0.0, 1.0, generator) < coarse
        scale = torch.where(learned[..., None], draws.log_uniform((batch_size, 1, 1), 0.2, 1.5, generator), scale)
    shape = (batch_size, num_points, 2)
    noise1, noise2 = (
        torch.where(heavy, 0.6 * draws.student_t(shape, generator), draws.normal(shape, generator)) for _ in range(2)
    )
    points1, points2 = points1 + scale * uneven * noise1, points2 + scale * uneven * noise2
    clean, common = (draws.uniform((batch_size, 1), 0.0, 1.0, generator) < share for share in (0.5, 0.25))
    share = draws.uniform((batch_size, 1), 0.0, 1.0, generator)
    dirty = torch.where(learned, 0.1 + 0.6 * share, 0.2 + 0.7 * share)
    share = torch.where(clean, 0.2 * share, torch.where(common, 0.1 + 0.4 * share, dirty))
    outliers = _choose_outliers(points1, share, generator) | ~shown
    points2 = torch.where(outliers[..., None], _wrong_partners(points2, size, common, generator), points2)
    inliers = shown & (distance(points1, points2) < 3 * scale[..., 0] + 0.5)
    scores = _scores(inliers, clean, generator)
    if coarse:
        scores = torch.where(learned, _learned_scores(inliers, quality[..., 0], clean, generator), scores)
    return points1, points2, scores, inliers


def wide_baseline(batch_size: int, num_points: int, generator: Generator) -> scenes.TwoViewScene:
    """Draw scenes that two photographers take of one object or facade, 5-45 degrees apart, without noise.

    Half of the scenes are a slanted plane with a relief of up to 20 % of its distance.
    """
    size, K = draws.random_cameras(batch_size, generator)
    points1 = draws.spread_points(size, 2 * num_points + 16, generator, clustered=0.5)
    rays = draws.viewing_rays(points1, K)
    median = draws.log_uniform((batch_size, 1), 4.0, 40.0, generator)
    slope = 0.4 * draws.normal((batch_size, 2, 1), generator)
    plane = 1 / (1 + (rays[..., :2] @ slope)[..., 0]).clamp(min=0.4)
    relief = draws.log_uniform((batch_size, 1), 0.01, 0.2, generator) * draws.normal(tuple(plane.shape), generator)
    free = draws.log_uniform(tuple(plane.shape), 0.5, 2.0, generator)
    flat = draws.uniform((batch_size, 1), 0.0, 1.0, generator) < 0.5
    depths = median * torch.where(flat, plane * (1 + relief).clamp(min=0.3), free)

    shape = (batch_size, ORBIT_CANDIDATES)
    axes = draws.normal((*shape, 3), generator) * size.new_tensor([0.4, 1.0, 0.3])
    angle = draws.log_uniform((*shape, 1), math.radians(5.0), math.radians(45.0), generator)
    R = axis_angle_to_rotation_matrix(angle * normalize(axes, dim=-1))
    aside = axis_angle_to_rotation_matrix(0.1 * draws.normal((*shape, 3), generator))
    centre = torch.stack([torch.zeros_like(median), torch.zeros_like(median), median], -1)
    distance = draws.log_uniform((*shape, 1), 0.7, 1.4, generator)
    t = distance * centre - (R @ centre[..., None]).squeeze(-1)
    return scenes.two_views(points1, depths, K, aside @ R, (aside @ t[..., None]).squeeze(-1), size, num_points)


def _distort(scene: scenes.TwoViewScene, generator: Generator) -> scenes.TwoViewScene:
    """Return the scenes with some radial distortion in both images, in a quarter of them."""
    batch_size = len(scene.F_mat)
    some = draws.uniform((batch_size, 1, 1), 0.0, 1.0, generator) < 0.25
    strength = torch.where(some, 0.01 * draws.normal((batch_size, 1, 1), generator), 0.0)
    centre = scene.image_size[:, None] / 2
    radius = centre.norm(dim=-1, keepdim=True)
    moved = []
    for points in (scene.points1, scene.points2):
        offset = (points - centre) / radius
        moved.append(points + radius * strength * offset.square().sum(-1, keepdim=True) * offset)
    return scene._replace(points1=moved[0], points2=moved[1])


def _choose_outliers(points1: Tensor, share: Tensor, generator: Generator) -> Tensor:
    """Return a mask (B, N) of a share (B, 1) of the points; neighbours of one point first in a third of the scenes."""
    batch_size, num_points = points1.shape[:2]
    order = draws.uniform((batch_size, num_points), 0.0, 1.0, generator)
    near = (points1 - points1[:, :1]).norm(dim=-1)
    near = near / near.amax(1, keepdim=True)
    together = draws.uniform((batch_size, 1), 0.0, 1.0, generator) < 1 / 3
    rank = torch.where(together, near + 0.3 * order, order).argsort(1).argsort(1)
    return rank < (share * num_points).round()


def _wrong_partners(points2: Tensor, size: Tensor, common: Tensor, generator: Generator) -> Tensor:
    """Return wrong partners (B, N, 2) of all points, of three kinds; scenes marked ``common`` (B, 1) have one shift."""
    shape = tuple(points2.shape[:2])
    anywhere = (size[:, None] - 1) * draws.uniform((*shape, 2), 0.0, 1.0, generator)
    popular = draws.uniform((shape[0], 1), 0.0, 1.0, generator) < 0.5
    index = draws.uniform(shape, 0.0, 1.0, generator)
    index = (torch.where(popular, index**4, index) * shape[1]).long().clamp(max=shape[1] - 1)
    another = points2.gather(1, index[..., None].expand(-1, -1, 2))
    angle = draws.uniform((*shape, 1), 0.0, 2 * math.pi, generator)
    length = draws.log_uniform((*shape, 1), 4.0, 150.0, generator)
    # An object that moves: one shift for all, but for a little.
    angle = torch.where(common[..., None], angle[:, :1] + 0.02 * angle, angle)
    length = torch.where(common[..., None], length[:, :1] * (1 + 0.0002 * length), length)
    shifted = points2 + length * torch.cat([angle.cos(), angle.sin()], -1)
    kind = draws.uniform((*shape, 1), 0.0, 3.0, generator)
    return torch.where(kind < 1.2, anywhere, torch.where(kind < 2, another, shifted))


def _scores(inliers: Tensor, clean: Tensor, generator: Generator) -> Tensor:
    """Return scores (B, N) such as 1 minus Lowe's ratio has; sets marked ``clean`` (B, 1) have passed a ratio test."""
    shape = tuple(inliers.shape)
    exponent = draws.log_uniform((shape[0], 1), 0.4, 1.2, generator)
    good = draws.uniform(shape, 0.02, 0.95, generator) ** exponent
    ratio = torch.where(inliers, good, 1 - 0.3 * draws.uniform(shape, 0.0, 1.0, generator) ** 3)
    return 1 - torch.where(clean, 0.8 * ratio, ratio)


def _learned_scores(inliers: Tensor, quality: Tensor, clean: Tensor, generator: Generator) -> Tensor:
    """Return scores (B, N) as of LightGlue, in sets marked ``clean`` (B, 1), and of ratios, by the log of the noise."""
    chance = draws.normal(tuple(inliers.shape), generator)
    good = torch.where(clean, 3 - 1.7 * quality + 0.7 * chance, -0.7 - 0.6 * quality + 0.5 * chance)
    return torch.where(inliers, good, torch.where(clean, 1.5 * chance, chance - 2.2)).sigmoid()
