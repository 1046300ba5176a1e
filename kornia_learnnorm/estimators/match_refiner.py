r"""The learned sub-pixel refinement of matches: both points move so that the patches around them agree."""

from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import grid_sample

from kornia_learnnorm.geometry import checks
from kornia_learnnorm.pretrained import check_architecture, load_module, save_module

FORMAT = "kornia_learnnorm.match_refiner.v1"
WINDOWS = (1.0, 1.7, 3.0)  # pixels, initial standard deviations of the Lucas-Kanade windows, which are trained
RANGE_ROUNDING = 1e-5  # amount by which interpolated grey values may exceed one
NEIGHBOURHOOD = 60.0  # pixels, standard deviation of the Gaussian weights of neighbouring matches
MAX_NEIGHBOURS = 256
ORDER = 1.0, 0.6, 1.0, 0.6  # direction along which matches are sorted to pick neighbours evenly, equal in both views
NEGLIGIBLE = -60.0  # smallest logarithm of a neighbour's weight relative to the nearest one's
ABSENT = -1e9  # logarithm of the weight of masked neighbours; finite, for sets where all are masked
FRAME_PRIOR = 6.0  # pixels, standard deviation added to the spread of neighbours; it pulls affinities to the identity
FRAME_FLOOR = 1e-12  # added under a root
MAX_AREA = 3.0  # largest factor by which an affinity may enlarge or reduce areas
MIN_TRACE = 0.5  # of an affinity over the root of its determinant; less is a rotation by more than about 75 degrees
LARGEST_STEP = 3.0  # pixels, bound on the Lucas-Kanade step of one window
MAX_OUTSIDE = 0.2  # of the points of a view; more suggest pixels of a resized image
# Of patches with a variance of one:
NOISE = 1e-2  # added to the squared gradients, so that patches without texture give no step
FLOOR = 1e-3  # of the differences under their logarithm
VARIANCE_FLOOR = 1e-4  # of the grey values of a patch, from 0 to 1


class RefinedMatches(NamedTuple):
    """Refined matches and their predicted noise."""

    points1: Tensor  # pixels, (B, N, 2)
    points2: Tensor
    scale: Tensor  # predicted standard deviation of a match, pixels, (B, N); infinite where the mask is false


class MatchRefiner(nn.Module):
    r"""Move both points of a match by fractions of a pixel so that their patches agree, and predict its noise.

    The patches of a match are normalised to zero mean and unit variance. One Lucas-Kanade step with the mean of both
    gradients, in several Gaussian windows, gives displacements :math:`d_k`. A network reads the patches and these
    steps, and predicts a weight :math:`w_k` of each step, a displacement :math:`r` of its own and the noise. The second
    point moves by half of

    .. math:: \frac{b\, s}{\sqrt{b^2 + \|s\|^2}}, \qquad s = r + \sum_k w_k d_k

    with the bound :math:`b`, the first one by as much in the opposite direction. The network is odd in the difference
    of the patches, so swapping the views swaps the result. Each patch is warped by half of the affine map between
    neighbouring matches (:func:`local_frames`), so that patches also agree if the views are rotated, scaled or slanted
    against each other. An untrained refiner moves no points.

    Do not use it for matches that are off by more than two or three pixels: it hardly corrects them.

    Args:
        patch_size: side of the patches, odd, pixels.
        width: channels of the network.
        bound: largest change of the displacement between both points, pixels; each moves by half of it.

    Attributes:
        passes: number of refinement passes, initially 1; 2 help with coarse matches.
        trained_on: names of the data that the weights were trained on, saved with them; empty if unknown.

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
        checks.check_whole_number("patch_size", patch_size, 5)
        checks.check_whole_number("width", width, 1)
        if patch_size % 2 == 0:
            raise ValueError(f"patch_size must be odd, got {patch_size}")
        if not bound > 0:
            raise ValueError(f"bound must be positive, got {bound}")
        self.patch_size, self.width, self.bound = patch_size, width, bound
        pixels, windows = patch_size**2, len(WINDOWS)
        self.log_windows = nn.Parameter(torch.tensor(WINDOWS).log())
        self.even = nn.Linear(pixels + 3 * windows + 1, width)  # features that swapping the views leaves unchanged
        self.odd = nn.Linear(pixels + 2 * windows, width, bias=False)  # features that swapping the views negates
        self.hidden = nn.Linear(width, width)
        self.shift = nn.Linear(width, 2, bias=False)
        self.gates = nn.Linear(width, windows + 1)  # weights of the steps, and the logarithm of the noise
        for last in (self.shift.weight, self.gates.weight, self.gates.bias):
            nn.init.zeros_(last)
        self.passes = 1
        self.trained_on: tuple[str, ...] = ()

    def extra_repr(self) -> str:
        """Return the parameters."""
        return f"patch_size={self.patch_size}, bound={self.bound:g}, trained_on={self.trained_on}"

    def forward(
        self, image1: Tensor, image2: Tensor, points1: Tensor, points2: Tensor, mask: Tensor | None = None
    ) -> RefinedMatches:
        r"""Return the refined matches and the predicted standard deviation of each.

        Gradients reach points and images. Pass ``1 / scale`` to layers as weights.

        Args:
            image1: first views with shape :math:`(B, C, H, W)`, grey or colour, values from 0 to 1, or bytes.
            image2: second views, of any height and width.
            points1: pixels in the first view with shape :math:`(B, N, 2)`; the centre of the top left pixel is (0, 0).
            points2: pixels in the second view.
            mask: optional, true for the rows that are matches, (B, N); other rows come back as they are.

        Returns:
            the matches in the dtype of the points.

        Raises:
            TypeError: if an argument is not a tensor of the right kind, or the weights are of half precision.
            ShapeError: if an argument does not have its shape.
            ValueError: if numbers of images and points differ, over a fifth of the points of a view lies outside of the
                images, or a value is not finite or out of its range.
        """
        checks.check_whole_number("passes", self.passes, 1)
        views = [points1, points2]
        if mask is not None:
            checks.check_mask(mask, points1, points2)
            views = [torch.where(mask[..., None], points, 0.0) for points in views]
        checks.check_correspondences(views[0], views[1], min_points=0)
        for number, (image, points) in enumerate(zip((image1, image2), views, strict=True), 1):
            _check_image(f"image{number}", image, len(points1))
            _check_inside(number, image, points)
        dtype = self.shift.weight.dtype
        if dtype not in (torch.float32, torch.float64):
            raise TypeError(f"the refiner's weights must be float32 or float64, which hold pixels, got {dtype}")
        start = [points.to(dtype) for points in views]
        with checks.inference_mode(), checks.without_autocast(points1):
            frames = local_frames(start[0], start[1], mask)
            half, log_scale = self._move(image1, image2, start, frames)
            for _ in range(self.passes - 1):
                moved = [start[0] - (frames[0] * half).sum(-1), start[1] + (frames[1] * half).sum(-1)]
                further, log_scale = self._move(image1, image2, moved, frames)
                half = half + further
        scale = log_scale.exp().to(points1.dtype)
        if mask is not None:
            half, scale = torch.where(mask[..., None, None], half, 0.0), torch.where(mask, scale, torch.inf)
        half1, half2 = ((frame * half).sum(-1).to(points1.dtype) for frame in frames)
        return RefinedMatches(points1 - half1, points2 + half2, scale)

    def _move(
        self, image1: Tensor, image2: Tensor, views: list[Tensor], frames: tuple[Tensor, Tensor]
    ) -> tuple[Tensor, Tensor]:
        """Return half of the displacements in the frames, (B, N, 1, 2), and the logarithm of the noise, (B, N)."""
        displacement, log_scale = self._displacements(*map(self._normalized_patches, (image1, image2), views, frames))
        return 0.5 * displacement.mT[..., None, :], log_scale

    def _normalized_patches(self, image: Tensor, points: Tensor, frame: Tensor) -> tuple[Tensor, Tensor]:
        """Return the grey patches around points of images (B, C, H, W), (B, S S, N), and their variance, (B, 1, N)."""
        white = 255 if image.dtype == torch.uint8 else 1
        middle = 0.5 * points.new_tensor([image.shape[-1], image.shape[-2]])
        terms = torch.stack([points + 0.5 - middle, frame[..., 1], frame[..., 0]], 1) / middle  # of grid_sample
        line = torch.arange(self.patch_size, dtype=points.dtype, device=points.device) - self.patch_size // 2
        constants = torch.cartesian_prod(line.new_ones(1), line, line)  # 1, y and x of the pixels of a patch
        grid = (constants @ terms.flatten(2)).view(len(points), len(constants), points.shape[1], 2)
        patches = grid_sample(image.to(points.dtype), grid, padding_mode="border", align_corners=False)
        patches = patches[:, 0] if patches.shape[1] == 1 else patches.mean(1)
        if patches.numel() and white == 1:
            low, high = patches.detach().aminmax()
            if checks.read_condition(~((low >= 0) & (high <= 1 + RANGE_ROUNDING))):
                raise ValueError(f"images must have values from 0 to 1, got {low.item():g} to {high.item():g}")
        patches = patches - patches.mean(1, keepdim=True)
        variance = (patches * patches).mean(1, keepdim=True) / white**2 + VARIANCE_FLOOR
        return patches * (variance.rsqrt() / white), variance

    def _displacements(self, first: tuple[Tensor, Tensor], second: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
        """Return the displacements of the second points against the first, (B, 2, N), and the log noise, (B, N)."""
        (patch1, variance1), (patch2, variance2) = first, second
        mean, difference = 0.5 * (patch1 + patch2), patch1 - patch2
        steps, statistics = self._lucas_kanade(mean, difference)
        even = _linear(self.even, torch.cat([mean, statistics, (variance1 * variance2).log()], 1))
        odd = _linear(self.odd, torch.cat([difference, steps.flatten(1, 2)], 1))
        forward, backward = (_linear(self.hidden, both.relu()).relu() for both in (even + odd, even - odd))
        gates = _linear(self.gates, forward + backward)
        shift = _linear(self.shift, forward - backward) + (gates[:, :-1, None] * steps).sum(1)
        return _bounded(shift, self.bound), gates[:, -1]

    def _lucas_kanade(self, mean: Tensor, difference: Tensor) -> tuple[Tensor, Tensor]:
        """Return a step in each window, (B, K, 2, N), and statistics of its reliability, (B, 3 K, N)."""
        size = self.patch_size
        line = (torch.arange(1, size - 1, dtype=mean.dtype, device=mean.device) - size // 2).square()
        squared = (line[:, None] + line).flatten()
        windows = (-0.5 * squared / (2 * self.log_windows[:, None]).exp()).softmax(-1)
        shape = len(mean), size, size, mean.shape[-1]
        mean, difference = mean.view(shape), difference.view(shape)
        dx = 0.5 * (mean[:, 1:-1, 2:] - mean[:, 1:-1, :-2]).flatten(1, 2)
        dy = 0.5 * (mean[:, 2:, 1:-1] - mean[:, :-2, 1:-1]).flatten(1, 2)
        rest = difference[:, 1:-1, 1:-1].flatten(1, 2)
        pairs = (dx, dx), (dx, dy), (dy, dy), (dx, rest), (dy, rest), (rest, rest)
        xx, xy, yy, xr, yr, rr = (windows @ (first * second) for first, second in pairs)
        xx, yy = xx + NOISE, yy + NOISE
        determinant = xx * yy - xy * xy
        step = torch.stack([yy * xr - xy * yr, xx * yr - xy * xr], 2) / determinant[:, :, None]
        return _bounded(step, LARGEST_STEP), torch.cat([(xx + yy).log(), determinant.log(), (rr + FLOOR).log()], 1)

    def save_pretrained(self, path: str | Path) -> None:
        """Write weights and architecture to one ``.safetensors`` file, whole or not at all.

        ValueError for another suffix, OSError if it cannot be written.
        """
        save_module(path, self, FORMAT, {key: getattr(self, key) for key in ("patch_size", "width", "bound")})

    @classmethod
    def from_pretrained(cls, name: str | Path = "refiner") -> "MatchRefiner":
        """Load a trained refiner in evaluation mode: ``"refiner"``, or the path of a ``.safetensors`` file.

        Errors are those of :meth:`~kornia_learnnorm.LearnedEightPoint.from_pretrained`.
        """

        def build(architecture: dict[str, Any]) -> MatchRefiner:
            check_architecture(architecture)
            return cls(**architecture)

        return load_module(name, FORMAT, "refiner", build)


def _check_image(name: str, image: Tensor, number: int) -> None:
    """Raise a clear error for anything but images (B, 1 or 3, H, W) of floating-point numbers or bytes."""
    if isinstance(image, Tensor) and image.dtype != torch.uint8 and not image.is_floating_point():
        raise TypeError(f"{name} must hold floating-point numbers from 0 to 1, or uint8, got {image.dtype}")
    if not isinstance(image, Tensor) or image.dtype != torch.uint8:
        checks.check_tensor(name, image, ["B", "C", "H", "W"])
    if image.ndim != 4 or len(image) != number or image.shape[1] not in (1, 3) or 0 in image.shape[2:]:
        raise ValueError(f"{name} must have shape [{number}, 1 or 3, H, W], got {[*image.shape]}")


def _check_inside(number: int, image: Tensor, points: Tensor) -> None:
    """Raise a ValueError if more than a fifth of the points (B, N, 2) lie outside of the images of a view."""
    width, height = image.shape[-1], image.shape[-2]
    outside = ((points < -1) | (points > points.new_tensor([width, height]))).any(-1)
    if checks.read_condition(outside.sum() > MAX_OUTSIDE * outside.numel()):
        text = f"{int(outside.sum())} of {outside.numel()} points{number} lie outside of image{number}"
        raise ValueError(f"{text}, {width} x {height} pixels: are they pixels of another size of it?")


def _linear(layer: nn.Linear, values: Tensor) -> Tensor:
    """Return a layer's output for values (B, C, N): with the matches last, inner loops are long."""
    weight = layer.weight.expand(len(values), -1, -1)
    return weight @ values if layer.bias is None else torch.baddbmm(layer.bias[:, None], weight, values)


def local_frames(points1: Tensor, points2: Tensor, mask: Tensor | None = None) -> tuple[Tensor, Tensor]:
    r"""Return frames :math:`A^{-1/2}` and :math:`A^{1/2}`, (B, N, 2, 2) x 2, of the affinities of neighbouring matches.

    :math:`A = C_2^{1/2} R\, C_1^{-1/2}` maps the surroundings of a match from the first view to the second. :math:`C_1`
    and :math:`C_2` are the covariances of the neighbouring matches in each view, and :math:`R` is the rotation nearest
    to :math:`C_2^{-1/2} C_{21} C_1^{-1/2}`. Swapping the views inverts :math:`A`. Neighbours are weighted by a Gaussian
    of their distance in both views, so that false matches count little; among more than 256 matches, 256 evenly spread
    ones are the neighbours. An implausible affinity is replaced by the identity.
    """
    joint = torch.cat([points - points.mean(1, keepdim=True) for points in (points1, points2)], -1)
    near, exponent = _neighbours(joint, mask)
    logits = torch.baddbmm(exponent[:, None], joint / NEIGHBOURHOOD**2, near.mT)
    if logits.numel():  # denormal weights would take ten times as long
        logits = torch.maximum(logits, logits.detach().amax(-1, keepdim=True) + NEGLIGIBLE)
    features = torch.cat([near, (near[..., :, None] * near[..., None, :]).flatten(-2)], -1)
    moments = (logits.softmax(-1) @ features).mT.contiguous()  # the matches last
    squares = moments[:, :4, None] * moments[:, None, :4]
    C = moments[:, 4:].view_as(squares) - squares
    eye = torch.eye(2).to(C)[..., None]
    blocks = torch.stack([C[:, :2, :2], C[:, 2:, 2:], C[:, 2:, :2]]) + FRAME_PRIOR**2 * eye
    (_, root2), (inverse1, inverse2) = _roots(blocks[:2])
    turn = _product(_product(inverse2, blocks[2]), inverse1)
    cosine, sine = turn[:, 0, 0] + turn[:, 1, 1], turn[:, 1, 0] - turn[:, 0, 1]
    length = (cosine.square() + sine.square() + FRAME_FLOOR).sqrt()
    rotation = torch.stack([cosine, -sine, sine, cosine], 1).view_as(root2) / length[:, None, None]
    A = _product(_product(root2, rotation), inverse1)
    determinant, trace = A[:, 0, 0] * A[:, 1, 1] - A[:, 0, 1] * A[:, 1, 0], A[:, 0, 0] + A[:, 1, 1]
    plausible = (determinant > 1 / MAX_AREA) & (determinant < MAX_AREA) & (trace > MIN_TRACE * determinant.sqrt())
    root, inverse = _roots(torch.where(plausible[:, None, None], A, eye))
    return inverse.movedim(-1, 1), root.movedim(-1, 1)


def _neighbours(joint: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return at most 256 matches (B, K, 4) of (B, N, 4), and the logarithms of the factors of their weights, (B, K).

    The weights are exp(-d^2 / 2 s^2); a factor that depends on the other match alone cancels and is left out.
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


def _product(first: Tensor, second: Tensor) -> Tensor:
    """Return the products of matrices (B, 2, 2, N); faster than matmul."""
    return (first[:, :, :, None] * second[:, None]).sum(2)


def _roots(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Return roots, and their inverses, of matrices (..., 2, 2, N) without negative or zero eigenvalues."""
    a, b, c, d = matrix.flatten(-3, -2)[..., None, None, :, :].unbind(-2)
    eye = torch.eye(2).to(matrix)[..., None]
    determinant, trace = (a * d - b * c).sqrt(), a + d  # the determinant of the root
    length = (trace + 2 * determinant).sqrt()
    root = (matrix + determinant * eye) / length
    return root, ((trace + determinant) * eye - matrix) / (determinant * length)


def _bounded(vectors: Tensor, bound: float) -> Tensor:
    r"""Return vectors (..., 2, N) shortened to lengths below the bound, :math:`b v / \sqrt{b^2 + \|v\|^2}`."""
    return vectors * (bound / (bound**2 + vectors.square().sum(-2, keepdim=True)).sqrt())
