"""Random sets of matches together with the images that they were found in."""

import re
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from torch import Generator, Tensor

from kornia_learnnorm.data.images import Pixels, Size, image_size, read_image, reduced_size
from kornia_learnnorm.data.match_sets import MatchSets
from kornia_learnnorm.data.training_samples import expand_path
from kornia_learnnorm.data.training_sets import StoreSets
from kornia_learnnorm.geometry.transforms import transform_points

CACHED_IMAGES = 512  # in memory, in the size of the store
SYMMETRIES = 8  # of a square: flips and transposition

read_cached = lru_cache(CACHED_IMAGES)(read_image)


class ImageSets(StoreSets):
    """Random sets of matches without labels, as many held-out ones of the same pair, and both images, in grey.

    An image is the file of its name in the store below one of the folders, or else the only one whose name without
    folder and suffix is that of the store's. Pairs without images, of another shape than in the store, or with fewer
    than 32 matches are left out. In half of the sets a random displacement is added to the matches.

    Args:
        paths: store files, or some pairs of them as ``file.h5@3:10``; environment variables are filled in.
        images: folders of images.
        max_ratios: limits of Lowe's ratio, of which each draw takes one; None for no limit.
        jitter: largest standard deviation of the displacement that is added, pixels.
        symmetries: flip and transpose images and matches at random, both views alike.

    Where the images were undistorted for matching, the files must be undistorted too. The attribute ``left_out`` counts
    pairs without images of their names and shapes. FileNotFoundError if a store or a folder does not exist; ValueError
    if no pair is left, or an argument is out of its range.
    """

    def __init__(
        self,
        paths: Sequence[str],
        images: Sequence[str],
        max_ratios: Sequence[float | None] = (None,),
        jitter: float = 0.5,
        symmetries: bool = True,
    ) -> None:
        if not jitter >= 0:
            raise ValueError(f"jitter must be zero or more pixels, got {jitter}")
        super().__init__(paths, 1, max_ratios, labels=False)
        self.jitter, self.symmetries = jitter, symmetries
        find = find_images(images)
        files = [[find(name, size) for name, size in zip(pair.names, pair.sizes, strict=True)] for pair in self._pairs]
        if not (kept := [i for i, found in enumerate(files) if None not in found]):
            raise ValueError(f"none of {len(files)} pairs of {', '.join(paths)} has images in {', '.join(images)}")
        self.left_out = len(files) - len(kept)
        self._pairs = [self._pairs[i] for i in kept]
        self._files = [files[i] for i in kept]
        self._sizes = [sizes[kept] for sizes in self._sizes]

    def draw(self, num_sets: int, num_points: int, generator: Generator) -> MatchSets:
        """Return sets of random pairs; fewer matches in each, set and held out, where no pair has twice as many."""
        choice = int(torch.randint(len(self.max_ratios), (), generator=generator))
        ratio, sizes = self.max_ratios[choice], self._sizes[choice]
        num_points = min(num_points, int(sizes.max()) // 2)
        able = (sizes >= 2 * num_points).nonzero()[:, 0]
        chosen = able[torch.randint(len(able), (num_sets,), generator=generator)].tolist()
        points, images, cameras = zip(*(self._draw(i, num_points, ratio, generator) for i in chosen), strict=True)
        first, heldout = torch.stack(points).chunk(2, 1)
        shape = [max(image.shape[side] for pair in images for image in pair) for side in (0, 1)]
        image1, image2 = (torch.stack([_padded(image, shape) for image in view]) for view in zip(*images, strict=True))
        K1, K2, E_mat = (torch.stack(values) for values in zip(*cameras, strict=True))
        sets = MatchSets(first[..., :2], first[..., 2:], heldout[..., :2], heldout[..., 2:], torch.tensor(chosen))
        return sets._replace(K1=K1, K2=K2, E_mat=E_mat, image1=image1, image2=image2)

    def _draw(
        self, index: int, num_points: int, ratio: float | None, generator: Generator
    ) -> tuple[Tensor, list[Pixels], tuple[Tensor, Tensor, Tensor]]:
        """Return points of both views (2 N, 4), both images and cameras of a pair."""
        pair = self._pairs[index]
        rows = pair.passing(ratio)
        rows = rows[torch.randperm(len(rows), generator=generator)[: 2 * num_points]]
        views = [*pair.points[rows].chunk(2, 1)]
        noise = torch.randn(len(rows), 2, generator=generator)
        jitter, coin = torch.rand(2, generator=generator).tolist()
        if coin < 0.5:
            views = [views[0] - 0.5 * self.jitter * jitter * noise, views[1] + 0.5 * self.jitter * jitter * noise]
        symmetry = int(torch.randint(SYMMETRIES, (), generator=generator)) if self.symmetries else 0
        images, cameras = [], [*pair.cameras]
        for view, (path, size) in enumerate(zip(self._files[index], pair.sizes, strict=True)):
            image, A = _mapped(read_cached(path, max(size)), symmetry)
            images.append(image)
            views[view], cameras[view] = transform_points(views[view][None], A[None])[0], A @ cameras[view]
        return torch.cat(views, 1), images, (cameras[0], cameras[1], cameras[2])


def find_images(folders: Sequence[str]) -> Callable[[str, Size], Path | None]:
    """Return a function that finds the file, of its size or larger, of an image by its name and size in a store."""
    roots = [Path(expand_path(folder)) for folder in folders]
    by_stem: dict[str, Path | None] = {}  # None where several files have the name
    for root in roots:
        if not root.is_dir():
            raise FileNotFoundError(f"no folder of images at {root}")
        for path in filter(Path.is_file, root.rglob("*")):
            stem = _stem(path.name)
            by_stem[stem] = path if by_stem.get(stem, path) == path else None

    def find(name: str, size: Size) -> Path | None:
        exact = (path for path in (root / name for root in roots) if path.is_file())
        path = next(exact, by_stem.get(_stem(Path(name).name)))
        return path if path is not None and reduced_size(image_size(path), max(size)) == size else None

    return find


def _stem(name: str) -> str:
    """Return the name of a file without suffixes: 00046 of 00046._c.png, but 1341.59 of 1341.59.png, a time."""
    return re.sub(r"(\.[^\d.][^.]*)+$", "", name)


def _mapped(image: Pixels, symmetry: int) -> tuple[Pixels, Tensor]:
    """Return an image (H, W) under a symmetry of the square, and the transform (3, 3) of its pixels."""
    A, (height, width) = torch.eye(3), image.shape
    if symmetry & 1:
        image, A = image[:, ::-1], torch.tensor([[-1.0, 0, width - 1], [0, 1, 0], [0, 0, 1]])
    if symmetry & 2:
        image, A = image[::-1], torch.tensor([[1.0, 0, 0], [0, -1, height - 1], [0, 0, 1]]) @ A
    if symmetry & 4:
        image, A = image.T, A[[1, 0, 2]]
    return image, A


def _padded(image: Pixels, shape: Sequence[int]) -> Tensor:
    """Return an image with its last row and column repeated up to a height and width, (1, H, W)."""
    missing = [(0, wanted - side) for wanted, side in zip(shape, image.shape, strict=True)]
    return torch.from_numpy(np.pad(image, missing, "edge"))[None]
