"""Augmentation of sets of matches that keeps their epipolar geometry."""

from __future__ import annotations

import math

import torch
from torch import Generator, Tensor

from kornia_learnnorm.data.sets import MatchSets
from kornia_learnnorm.data.synthetic.draws import log_uniform, normal, uniform
from kornia_learnnorm.geometry.transforms import affine_transform, transform_points

__all__ = ["augment"]


def augment(sets: MatchSets, generator: Generator) -> MatchSets:
    """Return sets with image planes rotated, scaled and flipped, views swapped, and outliers added.

    Rotations: up to about 15 degrees for each view alone, in half of the sets; a quarter turn or none for both; any
    angle for each view in a tenth. Scales: log-uniform 0.6-1.6 for both, 0.8-1.25 for one, and as much for the aspect
    of both. Half of the sets are mirrored, in half the views are swapped. In half of the sets up to 40 % of the matches
    get a wrong partner: another match's, or their own shifted by 5-150 px in any direction. Directions in the cameras
    don't change: their matrices take the maps.
    """
    batch_size, centre = len(sets.points1), sets.points1.mean(1)
    A1, A2 = (A.to(centre) for A in _maps(batch_size, generator))
    points1, heldout1 = (transform_points(p - centre[:, None], A1) for p in (sets.points1, sets.heldout1))
    points2, heldout2 = (transform_points(p - centre[:, None], A2) for p in (sets.points2, sets.heldout2))
    swap = uniform((batch_size, 1, 1), 0.0, 1.0, generator) < 0.5
    points1, points2 = torch.where(swap, points2, points1), torch.where(swap, points1, points2)
    heldout1, heldout2 = torch.where(swap, heldout2, heldout1), torch.where(swap, heldout1, heldout2)
    share = uniform((batch_size, 1), -0.4, 0.4, generator).clamp(min=0.0)
    replaced = uniform(tuple(points1.shape[:2]), 0.0, 1.0, generator) < share
    points2 = torch.where(replaced[..., None], _wrong_partners(points2, generator), points2)
    inliers = None if sets.inliers is None else torch.where(replaced, 0.0, sets.inliers)
    scores = None if sets.scores is None else torch.where(replaced, 0.2 * sets.scores, sets.scores)
    cameras: list[Tensor | None] = [sets.K1, sets.K2, sets.E_mat]
    if sets.K1 is not None and sets.K2 is not None and sets.E_mat is not None:
        shift = affine_transform(torch.eye(2).to(centre).expand(batch_size, 2, 2), -centre)
        K1, K2 = (A.to(K) @ shift.to(K) @ K for A, K in ((A1, sets.K1), (A2, sets.K2)))
        cameras = [torch.where(swap, a, b) for a, b in ((K2, K1), (K1, K2), (sets.E_mat.mT, sets.E_mat))]
    return MatchSets(points1, points2, heldout1, heldout2, sets.pair, scores, inliers, sets.labelled, *cameras)


def _maps(batch_size: int, generator: Generator) -> tuple[Tensor, Tensor]:
    """Return linear maps of both image planes as transforms (B, 3, 3)."""
    shape = (batch_size, 1)
    some, any_angle = (uniform(shape, 0.0, 1.0, generator) < p for p in (0.5, 0.1))
    quarter = (uniform(shape, 0.0, 4.0, generator).floor() * (uniform(shape, 0.0, 1.0, generator) < 0.4)) * math.pi / 2
    scale = log_uniform(shape, 0.6, 1.6, generator)
    aspect = log_uniform(shape, 0.8, 1.25, generator)
    mirror = torch.where(uniform(shape, 0.0, 1.0, generator) < 0.5, -1.0, 1.0)
    maps = []
    for view in range(2):
        angle = quarter + torch.where(some, 0.13 * normal(shape, generator), 0.0)
        angle = torch.where(any_angle, uniform(shape, 0.0, 2 * math.pi, generator), angle)
        own = scale * (log_uniform(shape, 0.8, 1.25, generator) if view else 1.0)
        linear = torch.cat([angle.cos(), -angle.sin(), angle.sin(), angle.cos()], -1).view(-1, 2, 2)
        linear = torch.cat([mirror * aspect, torch.ones_like(aspect)], -1)[..., None] * linear
        maps.append(affine_transform(own[..., None] * linear, torch.zeros_like(linear[:, 0])))
    return maps[0], maps[1]


def _wrong_partners(points2: Tensor, generator: Generator) -> Tensor:
    """Return other points in the second view: another point's partner, or the own one shifted by 5-150 px."""
    shape = (*points2.shape[:2], 1)
    index = (uniform(shape, 0.0, 1.0, generator) * shape[1]).long().clamp(max=shape[1] - 1).expand_as(points2)
    angle = uniform(shape, 0.0, 2 * math.pi, generator)
    length = log_uniform(shape, 5.0, 150.0, generator)
    shifted = points2 + (length * torch.cat([angle.cos(), angle.sin()], -1)).to(points2)
    return torch.where(uniform(shape, 0.0, 1.0, generator) < 0.5, points2.gather(1, index), shifted)
