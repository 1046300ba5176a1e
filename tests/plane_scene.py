"""Matches of a scene that is mostly the plane Z = 5, its homography, and the matrix of it and of parallax."""

import numpy as np
import torch

from kornia_learnnorm.geometry.matrices import unit_matrix
from kornia_learnnorm.models.fundamental import Fundamental
from kornia_learnnorm.ransac import dominant_plane
from kornia_learnnorm.ransac.scoring import PairScorer

K, t = np.array([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]]), np.array([0.4, 0.05, 0.1])
R = np.array([[0.9998, 0, 0.02], [0, 1, 0], [-0.02, 0, 0.9998]])
H = torch.from_numpy(K @ (R + np.outer(t, [0, 0, 1]) / 5) @ np.linalg.inv(K))


def make_scene(plane: int, off: int, outliers: int, noise: float, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Matches of points on the plane, off it, and random ones."""
    rng = np.random.default_rng(seed)
    depth = np.concatenate([np.full(plane, 5.0), rng.uniform(3, 4.7, off)])
    x1 = rng.uniform([0, 0], [640, 480], (plane + off, 2))
    x2 = (np.c_[x1, np.ones(len(x1))] @ np.linalg.inv(K).T * depth[:, None] @ R.T + t) @ K.T
    x1, x2 = (x + rng.normal(0, noise, x.shape) for x in (x1, x2[:, :2] / x2[:, 2:]))
    wrong = rng.uniform([0, 0, 0, 0], [640, 480, 640, 480], (outliers, 4))
    return torch.from_numpy(np.r_[x1, wrong[:, :2]]), torch.from_numpy(np.r_[x2, wrong[:, 2:]])


def in_scorer(points: tuple[torch.Tensor, torch.Tensor]) -> tuple[PairScorer, torch.Tensor]:
    """The scorer of matches, and the homography in its coordinates."""
    scorer = PairScorer(*points, 1.0, Fundamental("optimal"))
    return scorer, scorer.T2 @ H @ torch.linalg.inv(scorer.T1)


def fit_parallax(points: tuple[torch.Tensor, torch.Tensor]) -> torch.Tensor:
    """The matrices (K, 3, 3) of the homography and of parallax, in pixels."""
    scorer, plane = in_scorer(points)
    found = dominant_plane.fit_parallax(scorer, plane, torch.Generator().manual_seed(0))
    return unit_matrix(scorer.to_pixels(found.F_mat))
