"""Kornia code from correspondences to the camera's motion, in which one line changes.

The function below is Kornia alone. What solves for the fundamental matrix is the line that changes: Kornia's function,
this package's of the same call, or a layer.
"""

from __future__ import annotations

from argparse import ArgumentParser
from collections.abc import Callable, Sequence

import torch
from kornia.geometry import epipolar
from torch import Generator, Tensor

import kornia_learnnorm as kln
from kornia_learnnorm.data.synthetic import forward_driving


def relative_pose(
    points1: Tensor, points2: Tensor, K1: Tensor, K2: Tensor, find_fundamental: Callable[[Tensor, Tensor], Tensor]
) -> tuple[Tensor, Tensor]:
    """Return rotations (B, 3, 3) and directions of the translations (B, 3, 1)."""
    F_mat = find_fundamental(points1, points2)  # epipolar.find_fundamental(points1, points2) in Kornia
    E_mat = epipolar.essential_from_fundamental(F_mat, K1, K2)
    R, t = epipolar.motion_from_essential_choose_solution(E_mat, K1, K2, points1, points2)[:2]
    return R, t


def main(args: Sequence[str] | None = None) -> dict[str, float]:
    """Return the median error of the rotation in degrees by solver."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=2000)
    parser.add_argument("--points", type=int, default=8, help="correspondences per scene")
    options = parser.parse_args(args)
    scene = forward_driving(options.scenes, options.points, Generator().manual_seed(0), noise=0.5)
    solvers: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
        "kornia.geometry.epipolar.find_fundamental": epipolar.find_fundamental,
        "kornia_learnnorm.find_fundamental": kln.find_fundamental,
        "EightPoint(Whitening())": kln.EightPoint(kln.Whitening()),
        "EightPoint(LearnedNormalizer.from_pretrained())": kln.EightPoint(kln.LearnedNormalizer.from_pretrained()),
    }
    errors = {}
    for name, solver in solvers.items():
        with torch.no_grad():
            R, _ = relative_pose(scene.points1, scene.points2, scene.K1, scene.K2, solver)
        cosine = ((R.mT @ scene.R).diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2
        errors[name] = cosine.clamp(-1, 1).arccos().rad2deg().median().item()
        print(f"{name:48} median error of the rotation {errors[name]:.4f} degrees")
    return errors


if __name__ == "__main__":
    main()
