"""Matches of a scene that is mostly a plane, and its true geometry."""

import numpy as np
import torch

K = np.array([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]])
R = np.array([[0.9998, 0, 0.02], [0, 1, 0], [-0.02, 0, 0.9998]])
t = np.array([0.4, 0.05, 0.1])
H = torch.from_numpy(K @ (R + np.outer(t, [0, 0, 1]) / 5) @ np.linalg.inv(K))  # of the plane Z = 5


def make_scene(plane: int, off: int, outliers: int, noise: float, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Matches of points on the plane, off it, and random ones."""
    rng = np.random.default_rng(seed)
    depth = np.concatenate([np.full(plane, 5.0), rng.uniform(3, 4.7, off)])
    x1 = rng.uniform([0, 0], [640, 480], (plane + off, 2))
    X = np.c_[x1, np.ones(len(x1))] @ np.linalg.inv(K).T * depth[:, None]
    x2 = (X @ R.T + t) @ K.T
    x2 = x2[:, :2] / x2[:, 2:]
    x1, x2 = (x + rng.normal(0, noise, x.shape) for x in (x1, x2))
    wrong = rng.uniform([0, 0, 0, 0], [640, 480, 640, 480], (outliers, 4))
    return torch.from_numpy(np.r_[x1, wrong[:, :2]]), torch.from_numpy(np.r_[x2, wrong[:, 2:]])
