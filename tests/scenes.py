"""Scenes, points, layers and a check of errors that the tests share."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor

import kornia_learnnorm as kln
from kornia_learnnorm import LearnedEightPoint, LearnedNormalizer
from kornia_learnnorm.data.store import CorrespondenceStore
from kornia_learnnorm.data.synthetic import TwoViewScene, forward_driving, handheld, orbit, random_scenes
from kornia_learnnorm.geometry.transforms import paper_transform

SCENES = {"random": random_scenes, "driving": forward_driving, "handheld": handheld, "orbit": orbit}
DTYPES = [torch.float32, torch.float64]
ROWS = torch.tensor([[0.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # x2^T F x1 = y1 - y2; symmetric distance: twice |y1 - y2|
ORIGIN = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 0]])  # both epipoles are at the origin
SMALL = {"width": 16, "depth": 2, "stages": 2, "samples": 8}  # of learned layers


def plane(batch_size: int = 3, number: int = 40, noise: float = 0.0, outliers: float = 0.0):
    """Points of a plane in two views, and its homographies of unit norm with a positive first entry."""
    H = torch.eye(3, dtype=torch.float64) + 0.1 * uniform(batch_size, 3, 3, low=-1, seed=1)
    H[:, :2, 2], H[:, 2, :2] = 30 * H[:, :2, 2], 1e-4 * H[:, 2, :2]
    points1 = uniform(batch_size, number, 2, high=600)
    moved = torch.cat([points1, torch.ones_like(points1[..., :1])], -1) @ H.mT
    points2 = moved[..., :2] / moved[..., 2:] + noise * uniform(batch_size, number, 2, low=-1, seed=2)
    wrong = int(outliers * number)
    points2[:, :wrong] = uniform(batch_size, wrong, 2, high=600, seed=3)
    return points1, points2, H / torch.linalg.matrix_norm(H, keepdim=True)


def raises(error: type[Exception], message: str, function: Callable, *args, **options) -> None:
    """Ask for the error of a call, whose message a pattern matches."""
    with pytest.raises(error, match=message):
        function(*args, **options)


def distorted(points: Tensor, K: Tensor, share: float) -> Tensor:
    """Points (*, N, 2) moved away from the principal point, the farthest by a share of its distance."""
    offsets = points - K[..., None, :2, 2]
    squares = offsets.square().sum(-1, keepdim=True)
    return points + share * squares / squares.amax(-2, keepdim=True) * offsets


def store_of(points1, points2, offsets, names, size=(640, 480), ratio=0.5, **known) -> CorrespondenceStore:
    """A store of matches whose cameras, motions and matrices are not known unless they are given."""
    shapes = {"F": (3, 3), "K": (2, 3, 3), "R": (3, 3), "t": (3,)}
    unknown = {name: np.full((len(names), *shape), np.nan) for name, shape in shapes.items()}
    texts = dict.fromkeys(("dataset", "pairs", "detector"), "made by a test")
    points = np.float32(points1), np.float32(points2), np.broadcast_to(np.float32(ratio), len(points1))
    sizes = np.full((len(names), 2, 2), size, np.int32)
    return CorrespondenceStore(*points, np.array(offsets), sizes, names, **unknown | texts | known)


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def scenes(name: str, batch_size: int = 20, num_points: int = 8, seed: int = 0, **options: float) -> TwoViewScene:
    """Scenes of one kind, in float64 on the CPU."""
    return SCENES[name](batch_size, num_points, seeded(seed), **options)


def one_scene(name: str, num_points: int, seed: int = 0, **options: float) -> TwoViewScene:
    """One scene, without the dimension of the batch."""
    return TwoViewScene(*(value[0] for value in scenes(name, 1, num_points, seed, **options)))


def correspondences(name: str = "handheld", *args, **options) -> tuple[Tensor, Tensor]:
    scene = scenes(name, *args, **options)
    return scene.points1, scene.points2


def inputs(kind: str, batch_size: int, num_points: int, seed: int = 0, scene: str = "handheld") -> list[Tensor]:
    """Points of scenes, or of planes with some noise, and the cameras of a pose."""
    if kind == "homography":
        return [*plane(batch_size, num_points, noise=0.2)[:2]]
    found = scenes(scene, batch_size, num_points, seed)
    return [found.points1, found.points2, *((found.K1, found.K2) if kind == "pose" else ())]


def uniform(*shape: int, low: float = 0.0, high: float = 1.0, seed: int = 0, dtype=torch.float64) -> Tensor:
    return torch.empty(shape, dtype=dtype).uniform_(low, high, generator=seeded(seed))


def small(base=None, **options) -> LearnedNormalizer:
    return LearnedNormalizer(base or kln.Whitening(), kln.CrossViewNetwork(width=16, depth=2, **options))


def paper() -> LearnedNormalizer:
    return LearnedNormalizer(kln.Hartley(), kln.PaperNetwork(16, 3), paper_transform)


def last_layer(normalizer: LearnedNormalizer) -> torch.nn.Linear:
    return getattr(normalizer.network, "set_network", normalizer.network).head[-1]


def shaken(normalizer: LearnedNormalizer | None = None, scale: float = 0.3, seed: int = 0) -> LearnedNormalizer:
    """A learned normaliser whose last layer holds random numbers, so that it differs from its base."""
    torch.manual_seed(seed)
    normalizer = small(kln.ReweightedWhitening()) if normalizer is None else normalizer
    with torch.no_grad():
        for value in last_layer(normalizer).parameters():
            value.normal_(0, scale)
    return normalizer.eval()


def shaken_estimator(seed: int = 0, **options) -> LearnedEightPoint:
    """A small estimator whose last layers hold random numbers, so that weights and transforms differ."""
    torch.manual_seed(seed)
    layer = LearnedEightPoint(**{"width": 16, "depth": 2, "stages": 2} | options)
    with torch.no_grad():
        for network in layer.networks:
            for last in (network.logit, network.head[-1]):
                for value in last.parameters():
                    value.normal_(0, 0.3)
    return layer.eval()


def roughened(cls: type, **options) -> torch.nn.Module:
    """A small learned layer in float64 whose weights all differ from one another, as after training."""
    torch.manual_seed(0)
    small = {"patch_size": 9, "width": 8} if cls is kln.MatchRefiner else SMALL
    layer, generator = cls(**small | options).double().eval(), seeded(1)
    with torch.no_grad():
        for parameter in layer.parameters():
            parameter.add_(0.1 * torch.randn(parameter.shape, generator=generator, dtype=parameter.dtype))
    return layer


def refined(points1, points2, weights=None, steps: int = 5, **options) -> Tensor:
    """Some steps of Levenberg-Marquardt from the linear solution."""
    start = kln.find_fundamental(points1, points2, weights).detach()
    return kln.refine_fundamental(points1, points2, start, weights, max_iterations=steps, **options).F_mat


LAYERS = {
    "hartley": lambda: kln.EightPoint(),
    "optimal": lambda: kln.EightPoint(rank2="optimal"),
    "whitening": lambda: kln.EightPoint(kln.Whitening()),
    "reweighted": lambda: kln.EightPoint(kln.ReweightedWhitening()),
    "learned": lambda: kln.EightPoint(shaken()),
    "shipped": lambda: kln.EightPoint(kln.LearnedNormalizer.from_pretrained()),
    "estimator": shaken_estimator,
}


def rewrite_weights(file, change) -> None:
    """Change the tensors and metadata of a file of weights in place, by a function of both."""
    with safe_open(file, "pt") as opened:
        metadata = opened.metadata()
    state = load_file(file)
    change(state, metadata)
    save_file(state, file, metadata=metadata)


def prepared(transform, name: str = "handheld", batch_size: int = 6, num_points: int = 12, seed: int = 0):
    """Correspondences in the coordinates of ``numpy_hartley`` or ``numpy_whitening``, as a network gets them."""
    points = correspondences(name, batch_size, num_points, seed)
    T = [torch.from_numpy(transform(p)) for p in points]
    return tuple(p @ t[:, :2, :2].mT + t[:, None, :2, 2] for p, t in zip(points, T, strict=True))


def repeated_wall(copies: int = 90, seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    """Points of a wall (0), of a board before it (1), and of windows that match the next one (2), 640 x 480 px."""
    cell, epipole = np.array([60.0, 0.0]), np.array([0.8, 0.6])  # from a window to the next, pixels; a direction
    rng = np.random.default_rng(seed)
    wall, board = rng.uniform(0, (640, 480), (600, 2)), rng.uniform(200, 300, (120, 2))
    false = rng.uniform(0, (640, 480), (copies, 2))
    wall = wall[((wall < 195) | (wall > 305)).any(-1)]
    points1 = np.concatenate([wall, board, false])
    label = np.repeat([0, 1, 2], [len(wall), len(board), len(false)])
    points2 = points1 + np.array([4.0, 3.0]) + rng.normal(0, 0.1, points1.shape)
    points2[label == 1] += rng.uniform(8, 14, (len(board), 1)) * epipole
    points2[label == 2] += rng.integers(1, 4, (len(false), 1)) * cell
    return torch.from_numpy(points1), torch.from_numpy(points2), torch.from_numpy(label)
