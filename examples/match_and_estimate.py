"""Kornia's LightGlue with a layer behind it: the error of the matrix reaches the scores of the matches.

The layer is the eight-point algorithm, which takes the scores as weights, or the learned one, which reads them. Without
images, a small LightGlue of random weights learns from synthetic features which matches to trust. With two image files,
DISK and LightGlue with Kornia's weights match them, and the gradient of one step is shown.
"""

from __future__ import annotations

from argparse import ArgumentParser
from collections.abc import Sequence
from pathlib import Path

import torch
from kornia.feature import DISK, LightGlue
from torch import Generator, Tensor, nn

import kornia_learnnorm as kln
from kornia_learnnorm.data.images import read_image
from kornia_learnnorm.data.synthetic import orbit

Features = dict[str, Tensor]
LAYERS = {
    "eight-point": lambda: kln.EightPoint(kln.Whitening()),
    "learned": lambda: kln.LearnedEightPoint.from_pretrained("robust-synthetic").requires_grad_(False),
}
# No early stop and no pruning; with a threshold of zero every mutual neighbour is a match, whose score decides.
EVERY_MATCH = {"depth_confidence": -1, "width_confidence": -1, "filter_threshold": 0.0}


def small_lightglue() -> LightGlue:
    """Return a LightGlue of random weights for descriptors of 32 numbers; ``None`` downloads nothing."""
    return LightGlue(None, input_dim=32, descriptor_dim=32, n_layers=2, num_heads=2, flash=False, **EVERY_MATCH)


def estimate(lightglue: nn.Module, layer: nn.Module, sides: Sequence[Features]) -> Tensor:
    """Match the features of both images and return the matrices (B, 3, 3) of the matches and their scores."""
    found = lightglue({"image0": sides[0], "image1": sides[1]})
    return layer.from_matches(sides[0]["keypoints"], sides[1]["keypoints"], found["matches"], found["scores"]).F_mat


def synthetic_sides(num_pairs: int, generator: Generator) -> tuple[list[Features], Tensor]:
    """Return features of both views of random scenes, a tenth of them misplaced and less alike, and true matrices."""
    scene = orbit(num_pairs, 96, generator, noise=0.3, outliers=0.1)
    descriptors = torch.randn(num_pairs, 96, 32, generator=generator)
    spread = torch.where(scene.inliers, 0.1, 0.8)[..., None]
    changed = descriptors + spread * torch.randn(descriptors.shape, generator=generator)
    size = torch.tensor([640.0, 480.0])
    views = (scene.points1, descriptors), (scene.points2, changed)
    sides = [
        # LightGlue takes no point outside of the image, where noise may have moved it.
        {"keypoints": points.float().clamp(torch.zeros(2), size), "descriptors": rows, "image_size": size[None]}
        for points, rows in views
    ]
    return sides, scene.F_mat.float()


def error(found: Tensor, sides: Sequence[Features], F_mat: Tensor) -> Tensor:
    """Return the mean bounded distance (B,) of the true inliers under the found matrices, in pixels."""
    points = sides[0]["keypoints"], sides[1]["keypoints"]
    inliers = (kln.symmetric_epipolar_distance(*points, F_mat) < 2).float()
    distance = kln.symmetric_epipolar_distance(*points, found).clamp(max=50)
    return (inliers * distance).sum(-1) / inliers.sum(-1)


def train(layer: nn.Module, steps: int) -> tuple[float, float]:
    """Train on synthetic features; return the held-out error in pixels before and after."""
    torch.manual_seed(0)
    lightglue, generator = small_lightglue(), Generator().manual_seed(0)
    optimizer = torch.optim.Adam(lightglue.parameters(), 1e-3)
    held_out, F_held_out = synthetic_sides(32, Generator().manual_seed(1))
    errors = []
    for step in range(steps + 1):
        if step in (0, steps):
            with torch.no_grad():
                errors.append(error(estimate(lightglue, layer, held_out), held_out, F_held_out).median().item())
        sides, F_mat = synthetic_sides(8, generator)
        optimizer.zero_grad()
        error(estimate(lightglue, layer, sides), sides, F_mat).log().mean().backward()
        optimizer.step()
    print(f"held-out pairs, median error: {errors[0]:.3f} px before, {errors[-1]:.3f} px after {steps} steps")
    return errors[0], errors[-1]


def read_sides(disk: nn.Module, images: Sequence[Path], num_features: int = 1024) -> list[Features]:
    """Return the DISK features of image files."""
    sides = []
    for path in images:
        grey = torch.from_numpy(read_image(path)).float()[None, None] / 255
        found = disk(grey.expand(-1, 3, -1, -1), num_features, pad_if_not_divisible=True)[0]
        size = torch.tensor([[grey.shape[-1], grey.shape[-2]]], dtype=torch.float32)
        sides.append({"keypoints": found.keypoints[None], "descriptors": found.descriptors[None], "image_size": size})
    return sides


def match_images(
    disk: nn.Module, lightglue: nn.Module, layer: nn.Module, images: Sequence[Path]
) -> tuple[float, float]:
    """Return the median distance of the matches in pixels and the norm of LightGlue's gradient."""
    with torch.no_grad():
        sides = read_sides(disk, images)
    found = lightglue({"image0": sides[0], "image1": sides[1]})
    matches, scores = found["matches"], found["scores"]
    points = [side["keypoints"][0, matches[0][:, k]][None] for k, side in enumerate(sides)]
    F_mat = layer.from_matches(sides[0]["keypoints"], sides[1]["keypoints"], matches, scores).F_mat
    distance = kln.symmetric_epipolar_distance(*points, F_mat)
    distance.clamp(max=5).mean().backward()
    gradients = [p.grad.norm() for p in lightglue.parameters() if p.grad is not None]
    norm = torch.stack(gradients).norm().item()
    print(
        f"{len(matches[0])} matches, median distance {distance.median().item():.3f} px; gradient of LightGlue: "
        f"{len(gradients)} tensors, norm {norm:.2e}"
    )
    return distance.median().item(), norm


def main(args: Sequence[str] | None = None) -> tuple[float, float]:
    """Train on synthetic features, or match two images."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("--layer", choices=LAYERS, default="eight-point")
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--images", nargs=2, type=Path, help="two image files; loads Kornia's weights")
    options = parser.parse_args(args)
    layer = LAYERS[options.layer]()
    if options.images:
        return match_images(DISK.from_pretrained("depth").eval(), LightGlue("disk").eval(), layer, options.images)
    return train(layer, options.steps)


if __name__ == "__main__":
    main()
