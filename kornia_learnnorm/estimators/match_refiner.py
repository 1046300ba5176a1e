r"""The learned refinement of matches: both points move so that the patches around them agree."""

from __future__ import annotations

import json
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import grid_sample, pad

from kornia_learnnorm.geometry.checks import (
    check_correspondences,
    check_mask,
    check_tensor,
    check_whole_number,
    read_condition,
)
from kornia_learnnorm.pretrained import check_architecture, load_module, save_module

__all__ = ["MatchRefiner", "RefinedMatches", "local_frames"]

FORMAT = "kornia_learnnorm.match_refiner.v1"
WINDOWS = (1.0, 1.7, 3.0)  # pixels, standard deviations of the windows of Lucas-Kanade before training
RANGE_ROUNDING = 1e-5  # by which interpolated grey values may exceed one
NEIGHBOURHOOD = 60.0  # pixels, standard deviation of the distance of neighbours in both views
MAX_NEIGHBOURS = 256
ORDER = 1.0, 0.6, 1.0, 0.6  # direction along which neighbours are spread, alike in both views
ABSENT = -1e9  # logarithm of the weight of neighbours that are masked; finite, also where all are
FRAME_PRIOR = 6.0  # pixels, standard deviation of the spread that is added to neighbours, where the affinity is one
FRAME_FLOOR = 1e-12  # added under a root
MAX_AREA = 3.0  # by which an affinity may enlarge or reduce
MIN_TRACE = 0.5  # of an affinity; less is a turn by more than some 75 degrees
LARGEST_STEP = 3.0  # pixels, the bound of what Lucas-Kanade gives in one window
# Of patches with a variance of one:
NOISE = 1e-2  # added to the moments of the gradients, so that patches without texture give no step
FLOOR = 1e-3  # of the differences under their logarithm
VARIANCE_FLOOR = 1e-4  # of the grey values of a patch, from 0 to 1


class RefinedMatches(NamedTuple):
    """Moved matches and how exact they are."""

    points1: Tensor  # pixels, (B, N, 2)
    points2: Tensor
    scale: Tensor  # predicted standard deviation of a match, pixels, (B, N); infinite where the mask is false


class MatchRefiner(nn.Module):
    r"""Move both points of matches by fractions of a pixel, by the patches around them, and predict their noise.

    The patches of a match, of zero mean and unit variance, give displacements :math:`d_k` by one step of Lucas and
    Kanade, of the mean of both gradients, in several Gaussian windows. A network of the patches and of the steps
    predicts a weight :math:`w_k` of each step, a displacement of its own :math:`r` and the noise. The second point
    moves by half of

    .. math:: \frac{b\, s}{\sqrt{b^2 + \|s\|^2}}, \qquad s = r + \sum_k w_k d_k

    with the bound :math:`b`, the first one by as much the other way. The network is odd in the difference of the
    patches, so swapping the views swaps the result. Patches are warped by half of the affinity of the neighbouring
    matches each (:func:`local_frames`), so that they also agree where the views are turned, scaled or slanted against
    each other. Before training, points stay where they are.

    Not for matches that are off by more than two or three pixels: those are left nearly where they are.

    Args:
        patch_size: side of the patches, odd, pixels.
        width: channels of the network.
        bound: largest change of the displacement between both points, pixels; each moves by half of it.

    Attributes:
        trained_on: names of the data that the weights were trained on, saved with them; empty where not known.

    Raises:
        ValueError: if a number is not whole or too small, ``patch_size`` is even, or ``bound`` is not positive.

    Reference:
        B. D. Lucas, T. Kanade, An Iterative Image Registration Technique with an Application to Stereo Vision, IJCAI
        1981.

    Example:
        >>> images, points = torch.rand(2, 1, 1, 48, 64), 20 + 20 * torch.rand(2, 1, 100, 2)
        >>> points1, points2, scale = MatchRefiner()(*images, *points)
        >>> points1.shape, scale.shape
        (torch.Size([1, 100, 2]), torch.Size([1, 100]))

    """

    def __init__(self, patch_size: int = 11, width: int = 64, bound: float = 1.5) -> None:
        super().__init__()
        check_whole_number("patch_size", patch_size, 5)
        check_whole_number("width", width, 1)
        if patch_size % 2 == 0:
            raise ValueError(f"patch_size must be odd, got {patch_size}")
        if not bound > 0:
            raise ValueError(f"bound must be positive, got {bound}")
        self.patch_size, self.width, self.bound = patch_size, width, bound
        pixels, windows = patch_size**2, len(WINDOWS)
        self.log_windows = nn.Parameter(torch.tensor(WINDOWS).log())
        self.even = nn.Linear(pixels + 3 * windows + 1, width)  # of what swapping the views keeps
        self.odd = nn.Linear(pixels + 2 * windows, width, bias=False)  # of what swapping the views negates
        self.hidden = nn.Linear(width, width)
        self.shift = nn.Linear(width, 2, bias=False)
        self.gates = nn.Linear(width, windows + 1)  # weights of the steps, and the logarithm of the noise
        for last in (self.shift.weight, self.gates.weight, self.gates.bias):
            nn.init.zeros_(last)
        self.trained_on: tuple[str, ...] = ()

    def extra_repr(self) -> str:
        """Return the parameters."""
        return f"patch_size={self.patch_size}, bound={self.bound:g}, trained_on={self.trained_on}"

    def forward(
        self, image1: Tensor, image2: Tensor, points1: Tensor, points2: Tensor, mask: Tensor | None = None
    ) -> RefinedMatches:
        r"""Return the moved matches and the predicted standard deviation of each.

        Gradients reach points and images. ``1 / scale`` is a weight for layers.

        Args:
            image1: first views with shape :math:`(B, C, H, W)`, grey or colour, values from 0 to 1.
            image2: second views, of any height and width.
            points1: pixels in the first view with shape :math:`(B, N, 2)`; the centre of the top left pixel is (0, 0).
            points2: pixels in the second view.
            mask: optional, true for the rows that are matches, (B, N); other rows come back as they are.

        Returns:
            the matches in the dtype of the points.

        Raises:
            TypeError: if an argument is no tensor of the right kind.
            ShapeError: if an argument does not have its shape.
            ValueError: if numbers of images and points differ, or a value is not finite or out of its range.

        """
        given1, given2 = points1, points2
        if mask is not None:
            check_mask(mask, points1, points2)
            points1, points2 = (torch.where(mask[..., None], points, 0.0) for points in (points1, points2))
        check_correspondences(points1, points2, min_points=0)
        dtype = self.shift.weight.dtype
        views = points1.to(dtype), points2.to(dtype)
        frames = local_frames(*views, mask)
        patches = [
            self._normalized_patches(_grey(name, image, len(points)).to(dtype), points, frame)
            for name, image, points, frame in zip(("image1", "image2"), (image1, image2), views, frames, strict=True)
        ]
        displacement, log_scale = self._displacements(*patches)
        half = 0.5 * displacement.view(points1.shape)
        half1, half2 = ((frame @ half[..., None])[..., 0].to(points1.dtype) for frame in frames)
        scale = log_scale.view(points1.shape[:-1]).exp().to(points1.dtype)
        points1, points2 = points1 - half1, points2 + half2
        if mask is not None:
            points1 = torch.where(mask[..., None], points1, given1)
            points2 = torch.where(mask[..., None], points2, given2)
            scale = torch.where(mask, scale, torch.inf)
        return RefinedMatches(points1, points2, scale)

    def _normalized_patches(self, image: Tensor, points: Tensor, frame: Tensor) -> tuple[Tensor, Tensor]:
        """Return the patches around points of images (B, 1, H, W), (BN, S, S), and their variance, (BN, 1)."""
        size = self.patch_size
        margin = size // 2 + 1
        image = pad(image, [margin] * 4, "replicate")  # faster than grid_sample's own padding
        unit = 2 / points.new_tensor([image.shape[-1], image.shape[-2]])  # a pixel in grid_sample's coordinates
        offsets = torch.arange(size, dtype=points.dtype, device=points.device) - size // 2
        y, x = torch.meshgrid(offsets, offsets, indexing="ij")
        # Points and both columns of their frames times constants: one product is faster than broadcasting.
        constants = torch.stack([torch.ones_like(x), x, y]).view(3, -1, 1, 1) * unit.diag()
        terms = torch.cat([points[..., None, :] + margin + 0.5 - 1 / unit, frame.mT], -2).view(-1, 6)
        grid = terms @ constants.transpose(1, 2).reshape(6, -1)
        grid = grid.view(len(points), points.shape[1] * size, size, 2)
        patches = grid_sample(image, grid, align_corners=False).view(-1, size * size)
        if patches.numel():
            low, high = patches.detach().aminmax()
            if read_condition(~((low >= 0) & (high <= 1 + RANGE_ROUNDING))):
                raise ValueError(f"images must have values from 0 to 1, got {low.item():g} to {high.item():g}")
        patches = patches - patches.mean(-1, keepdim=True)
        variance = (patches * patches).mean(-1, keepdim=True) + VARIANCE_FLOOR
        return (patches * variance.rsqrt()).view(-1, size, size), variance

    def _displacements(self, first: tuple[Tensor, Tensor], second: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
        """Return the displacements of the second points against the first, (BN, 2), and the log noise, (BN,)."""
        (patch1, variance1), (patch2, variance2) = first, second
        mean, difference = 0.5 * (patch1 + patch2), patch1 - patch2
        steps, statistics = self._lucas_kanade(mean, difference)
        even = self.even(torch.cat([mean.flatten(1), statistics, (variance1 * variance2).log()], -1))
        odd = self.odd(torch.cat([difference.flatten(1), steps.flatten(1)], -1))
        forward, backward = (self.hidden((even + sign * odd).relu()).relu() for sign in (1, -1))
        gates = self.gates(forward + backward)
        shift = self.shift(forward - backward) + (gates[:, :-1, None] * steps).sum(1)
        return _bounded(shift, self.bound), gates[:, -1]

    def _lucas_kanade(self, mean: Tensor, difference: Tensor) -> tuple[Tensor, Tensor]:
        """Return a step in each window, (BN, K, 2), and statistics that tell how far to trust it, (BN, 3 K)."""
        size = self.patch_size - 2
        offsets = torch.arange(size, dtype=mean.dtype, device=mean.device) - size // 2
        squared = (offsets[:, None].square() + offsets.square()).flatten()
        windows = (-0.5 * squared[:, None] / (2 * self.log_windows).exp()).softmax(0)
        dx = 0.5 * (mean[:, 1:-1, 2:] - mean[:, 1:-1, :-2]).flatten(1)
        dy = 0.5 * (mean[:, 2:, 1:-1] - mean[:, :-2, 1:-1]).flatten(1)
        rest = difference[:, 1:-1, 1:-1].flatten(1)
        products = (dx * dx, dx * dy, dy * dy, dx * rest, dy * rest, rest * rest)
        xx, xy, yy, xr, yr, rr = (product @ windows for product in products)
        xx, yy = xx + NOISE, yy + NOISE
        determinant = xx * yy - xy * xy
        step = torch.stack([yy * xr - xy * yr, xx * yr - xy * xr], -1) / determinant[..., None]
        statistics = [(xx + yy).log(), determinant.log(), (rr + FLOOR).log()]
        return _bounded(step, LARGEST_STEP), torch.cat(statistics, -1)

    def save_pretrained(self, path: str | Path) -> None:
        """Write weights and architecture to one safetensors file, beside the target and then renamed.

        Args:
            path: the file to write.

        Raises:
            ValueError: if ``path`` does not end in ``.safetensors``.
            OSError: if it cannot be written.

        """
        save_module(path, self, FORMAT, {key: getattr(self, key) for key in ("patch_size", "width", "bound")})

    @classmethod
    def from_pretrained(cls, name: str | Path = "refiner") -> MatchRefiner:
        """Load a trained refiner: one that ships with the package, by name, or a safetensors file.

        Args:
            name: ``"refiner"``, or the path of a ``.safetensors`` file.

        Returns:
            the refiner, in evaluation mode.

        Raises:
            FileNotFoundError: if there are no such weights; the message lists those that ship.
            ValueError: if the file is not a refiner of this package or its tensors do not fit.

        """

        def build(path: Path, text: str) -> MatchRefiner:
            try:
                architecture = json.loads(text)
                check_architecture(architecture)
                return cls(**architecture)
            except (ValueError, TypeError, AttributeError, RuntimeError) as error:
                raise ValueError(f"{path} describes no refiner of this version: {error}") from error

        return load_module(name, FORMAT, build)


def _grey(name: str, image: Tensor, number: int) -> Tensor:
    """Return images (B, 1, H, W), after checking their shape; colours are averaged."""
    check_tensor(name, image, ["B", "C", "H", "W"])
    if len(image) != number or image.shape[1] not in (1, 3) or 0 in image.shape[2:]:
        raise ValueError(f"{name} must have shape [{number}, 1 or 3, H, W], got {[*image.shape]}")
    return image if image.shape[1] == 1 else image.mean(1, keepdim=True)


def local_frames(points1: Tensor, points2: Tensor, mask: Tensor | None = None) -> tuple[Tensor, Tensor]:
    r"""Return frames :math:`A^{-1/2}` and :math:`A^{1/2}`, (B, N, 2, 2) x 2, of the affinities of neighbouring matches.

    :math:`A` maps the surroundings of a match from the first view to the second. It is
    :math:`C_2^{1/2} R\, C_1^{-1/2}` of the covariances :math:`C_1` and :math:`C_2` of neighbouring matches in a view,
    with the rotation :math:`R` nearest to :math:`C_2^{-1/2} C_{21} C_1^{-1/2}`: swapping the views gives the inverse.
    Neighbours have Gaussian weights of their distance in both views, so that false matches count little. Of more than
    256 matches, 256 are neighbours, evenly spread. An affinity that is not plausible is replaced by the identity.
    """
    joint = torch.cat([points - points.mean(1, keepdim=True) for points in (points1, points2)], -1)
    near, exponent = _neighbours(joint, mask)
    weights = torch.baddbmm(exponent[:, None], joint / NEIGHBOURHOOD**2, near.mT).softmax(-1)
    x1, y1, x2, y2 = near.unbind(-1)
    products = [x1 * x1, x1 * y1, y1 * y1, x2 * x2, x2 * y2, y2 * y2, x2 * x1, x2 * y1, y2 * x1, y2 * y1]
    moments = weights @ torch.stack([x1, y1, x2, y2, *products], -1)
    x1, y1, x2, y2, *products = moments.unbind(-1)
    means = [x1 * x1, x1 * y1, y1 * y1, x2 * x2, x2 * y2, y2 * y2, x2 * x1, x2 * y1, y2 * x1, y2 * y1]
    xx1, xy1, yy1, xx2, xy2, yy2, *cross = (product - mean for product, mean in zip(products, means, strict=True))
    prior = FRAME_PRIOR**2 * torch.eye(2).to(moments)
    root1, root2 = (_root(_matrix(xx, xy, xy, yy) + prior) for xx, xy, yy in ((xx1, xy1, yy1), (xx2, xy2, yy2)))
    inverse1 = _inverse(root1)
    turn = _inverse(root2) @ (_matrix(*cross) + prior) @ inverse1
    cosine, sine = turn[..., 0, 0] + turn[..., 1, 1], turn[..., 1, 0] - turn[..., 0, 1]
    length = (cosine.square() + sine.square() + FRAME_FLOOR).sqrt()
    A = root2 @ _matrix(cosine, -sine, sine, cosine) @ inverse1 / length[..., None, None]
    determinant, trace = A[..., 0, 0] * A[..., 1, 1] - A[..., 0, 1] * A[..., 1, 0], A[..., 0, 0] + A[..., 1, 1]
    plausible = (determinant > 1 / MAX_AREA) & (determinant < MAX_AREA) & (trace > MIN_TRACE)
    A = torch.where(plausible[..., None, None], A, torch.eye(2).to(A))
    root = _root(A)
    return _inverse(root), root


def _neighbours(joint: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return at most 256 matches (B, K, 4) of (B, N, 4), and the logarithms of the factors of their weights, (B, K).

    The weights are exp(-d^2 / 2 s^2); the factor of the other match is the same for all neighbours.
    """
    number = min(joint.shape[1], MAX_NEIGHBOURS)
    index = torch.arange(number, device=joint.device)
    present = None
    if joint.shape[1] > MAX_NEIGHBOURS:
        key = joint @ joint.new_tensor(ORDER)
        if mask is None:
            index = index * joint.shape[1] // number
        else:
            count = mask.sum(-1, keepdim=True)
            index = torch.where(count > number, index * count // number, index)
            key, present = key.masked_fill(~mask, torch.inf), index < count
        index = key.argsort(-1).gather(-1, index.expand(len(joint), -1))
        joint = joint.gather(1, index[..., None].expand(-1, -1, 4))
    elif mask is not None:
        present = mask
    exponent = -0.5 / NEIGHBOURHOOD**2 * joint.square().sum(-1)
    return joint, exponent if present is None else exponent.masked_fill(~present, ABSENT)


def _matrix(a: Tensor, b: Tensor, c: Tensor, d: Tensor) -> Tensor:
    """Return the matrices (..., 2, 2) with rows (a, b) and (c, d)."""
    return torch.stack([torch.stack([a, b], -1), torch.stack([c, d], -1)], -2)


def _root(matrix: Tensor) -> Tensor:
    """Return the square root of matrices (..., 2, 2) of positive determinant and no negative eigenvalue."""
    a, b, c, d = matrix.flatten(-2).unbind(-1)
    root = (a * d - b * c).sqrt()
    return (matrix + root[..., None, None] * torch.eye(2).to(matrix)) / (a + d + 2 * root).sqrt()[..., None, None]


def _inverse(matrix: Tensor) -> Tensor:
    a, b, c, d = matrix.flatten(-2).unbind(-1)
    return _matrix(d, -b, -c, a) / (a * d - b * c)[..., None, None]


def _bounded(vectors: Tensor, bound: float) -> Tensor:
    r"""Return vectors shortened to lengths below the bound, :math:`b v / \sqrt{b^2 + \|v\|^2}`."""
    return vectors * (bound / (bound**2 + vectors.square().sum(-1, keepdim=True)).sqrt())
