"""Unrolled robust refinement, against the refinement that runs to convergence."""

import pytest
import torch
from scenes import check_gradients, correspondences, homogeneous, signless, uniform, up_to_sign

import kornia_learnnorm as kln
from kornia_learnnorm.estimators.optimize import UNROLLED_SCALE, refine_unrolled
from kornia_learnnorm.geometry.rank2 import rank2_projection
from kornia_learnnorm.models.fundamental import Fundamental


def refine_weighted(x1, x2, F_mat, weights, steps):
    return refine_unrolled(Fundamental(), x1.mT, x2.mT, F_mat, weights, steps)


def framed(num_points: int = 40, **options):
    """Homogeneous points of about unit size, a matrix to start from and weights."""
    points = [(p - 300) / 200 for p in correspondences("handheld", 6, num_points, **options)]
    x1, x2 = (torch.from_numpy(homogeneous(p.numpy())) for p in points)
    return x1, x2, kln.find_fundamental(*points), uniform(6, num_points, low=0.2)


@pytest.mark.parametrize("num_points", [12, 40])
def test_is_the_optimum_at_its_scale(num_points):
    """Dividing a set's points by its scale gives Geman and McClure's loss at one pixel."""
    x1, x2, F_mat, weights = framed(num_points, noise=0.3)
    found = refine_weighted(x1, x2, F_mat, weights, 60)
    points1, points2 = x1[..., :2], x2[..., :2]
    distance = kln.sampson_distance(points1, points2, F_mat)
    mean = ((weights * (distance**2 + 1e-10).log() / 2).sum(1) / weights.sum(1)).exp()
    effective = (weights.sum(1) ** 2 / (weights**2).sum(1)).clamp(min=8)
    scale = (UNROLLED_SCALE * mean * (effective / (effective - 7)).sqrt())[:, None, None]
    T = torch.diag_embed(torch.cat([scale[:, 0], scale[:, 0], torch.ones_like(scale[:, 0])], -1))
    options = {"loss": kln.GemanMcClure(1.0), "max_iterations": 200}
    expected = kln.refine_fundamental(points1 / scale, points2 / scale, T @ F_mat @ T, weights, **options).F_mat
    T = torch.linalg.inv(T)
    assert up_to_sign(found, T @ expected @ T) < 1e-4


def test_gradients():
    def refined(x1, x2, F_mat, weights):
        return signless(refine_weighted(x1, x2, rank2_projection(F_mat), weights, 2))

    check_gradients(refined, *(value[:2] for value in framed(12, noise=0.5)), atol=1e-4)
