"""Stores of synthetic scenes."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch

from kornia_learnnorm.data.store import CorrespondenceStore
from kornia_learnnorm.data.synthetic.scenes import TwoViewScene, forward_driving, handheld, orbit

SCENES: dict[str, Callable[..., TwoViewScene]] = {
    "forward driving": forward_driving,
    "hand-held": handheld,
    "orbit": orbit,
}


def synthetic_store(
    pairs: int,
    points: int,
    seed: int = 0,
    noise: float = 0.5,
    outliers: float = 0.2,
    scenes: Sequence[str] = tuple(SCENES),
) -> CorrespondenceStore:
    """Return a store of synthetic scenes, ``pairs`` of each kind; the kinds are keys of :data:`SCENES`.

    Noise is in pixels, ``outliers`` the share of gross outliers. Lowe's ratio is drawn so that the ratio test of 0.8
    keeps all inliers and half of the outliers.
    """
    if pairs < 1 or points < 8:
        raise ValueError(f"at least 1 pair of each scene and 8 points are needed, got {pairs} and {points}")
    unknown = set(scenes) - set(SCENES)
    if unknown or not scenes:
        raise ValueError(f"scenes must be among {', '.join(SCENES)}, got {', '.join(scenes) or 'none'}")
    generator = torch.Generator().manual_seed(seed)
    made = [SCENES[kind](pairs, points, generator, noise, outliers) for kind in scenes]
    scene = TwoViewScene(*map(torch.cat, zip(*made, strict=True)))
    number = len(scene.points1)
    low = torch.where(scene.inliers, 0.3, 0.6)
    high = torch.where(scene.inliers, 0.8, 1.0)
    ratio = low + (high - low) * torch.rand(low.shape, generator=generator)
    names = [(f"{kind}/{i:04d}-1", f"{kind}/{i:04d}-2") for kind in scenes for i in range(pairs)]
    return CorrespondenceStore(
        points1=scene.points1.flatten(0, 1).numpy().astype(np.float32),
        points2=scene.points2.flatten(0, 1).numpy().astype(np.float32),
        ratio=ratio.flatten().numpy().astype(np.float32),
        offsets=np.arange(number + 1, dtype=np.int64) * points,
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
