"""Make data where there is none: a synthetic store and a rendered image pair: ``learnnorm synthesize``."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from kornia_learnnorm.data.store import CorrespondenceStore, write_store
from kornia_learnnorm.data.synthetic import TwoViewScene, forward_driving, handheld, orbit
from kornia_learnnorm.data.synthetic.render import render_pair, write_pair

__all__ = ["add_arguments", "run", "synthetic_store"]

SCENES = {"forward driving": forward_driving, "hand-held": handheld, "orbit": orbit}


def synthetic_store(
    pairs: int,
    points: int,
    seed: int = 0,
    noise: float = 0.5,
    outliers: float = 0.2,
    scenes: Sequence[str] = tuple(SCENES),
) -> CorrespondenceStore:
    """Make a store of the named scenes, ``pairs`` of each.

    Lowe's ratio is drawn so that the usual test of 0.8 passes all inliers and half of the outliers.

    Args:
        pairs: image pairs of each scene.
        points: correspondences of a pair.
        seed: seed of everything.
        noise: standard deviation of the noise, pixels.
        outliers: share of gross outliers.
        scenes: which scenes, among ``"forward driving"``, ``"hand-held"`` and ``"orbit"``.

    Returns:
        the store.

    Raises:
        ValueError: if a number is out of range.

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


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``learnnorm synthesize`` to a parser."""
    parser.add_argument("folder", metavar="FOLDER", type=Path, help="folder to write to; made if missing")
    parser.add_argument("--pairs", type=int, default=20, help="pairs of each scene (default: %(default)s)")
    parser.add_argument(
        "--scenes", metavar="KIND", nargs="+", default=list(SCENES), help="which scenes (default: %(default)s)"
    )
    parser.add_argument("--points", type=int, default=800, help="correspondences of a pair (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="seed of everything (default: %(default)s)")


def run(args: argparse.Namespace) -> int:
    """Run ``learnnorm synthesize``: write ``synthetic.h5`` and a rendered image pair.

    Raises:
        ValueError: if a number is out of range.
        OSError: if the folder cannot be written.

    """
    store = synthetic_store(args.pairs, args.points, args.seed, scenes=args.scenes)
    args.folder.mkdir(parents=True, exist_ok=True)
    write_store(args.folder / "synthetic.h5", store)
    write_pair(args.folder, render_pair(args.seed))
    print(f"wrote {args.folder / 'synthetic.h5'} ({len(store)} pairs), image1.png, image2.png and ground_truth.json")
    return 0
