"""The fundamental matrix or homography of two images: features, one-to-one matches, and the estimate that they give."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kornia_learnnorm.data import images
from kornia_learnnorm.data.matching.features import DETECTORS, READS_COLOUR, Features, check_mask, keep_features
from kornia_learnnorm.data.matching.matchers import check_methods, match_both_ways, match_lightglue
from kornia_learnnorm.estimators.learned_eight_point import LearnedEightPoint
from kornia_learnnorm.estimators.match_refiner import MatchRefiner
from kornia_learnnorm.geometry.matrices import unit_matrix
from kornia_learnnorm.geometry.transforms import transform_fundamental, transform_points
from kornia_learnnorm.models.homography import Homography
from kornia_learnnorm.protocol import INLIER_THRESHOLD, RATIO
from kornia_learnnorm.two_view.estimate_matches import estimate_matches
from kornia_learnnorm.two_view.input_checks import Points, check_number, check_settings, read_cameras
from kornia_learnnorm.two_view.repeated_texture import mutual_share, resolve_ambiguity
from kornia_learnnorm.two_view.result import NoReliableMatrixError, PairEstimate

MAX_SIZE = 2000  # pixels of the longer side at which images are matched: SIFT then takes up to 0.5 GB and seconds
MIN_SIZE = 64  # pixels of the longer side; smaller ones have too few features
NUM_FEATURES = 4000  # of an image
MIN_MUTUAL_SHARE = 0.85  # of the matches off the plane that fit; below, false matches may agree with each other

Image = str | Path | NDArray[np.uint8] | Tensor
Mask = NDArray[np.bool_] | Tensor


def estimate_pair(
    image1: Image,
    image2: Image,
    layer: LearnedEightPoint | None = None,
    ratio: float = RATIO,
    threshold: float = INLIER_THRESHOLD,
    seed: int = 0,
    K1: Points | None = None,
    K2: Points | None = None,
    mask1: Mask | None = None,
    mask2: Mask | None = None,
    max_size: int = MAX_SIZE,
    detector: str = "sift",
    matcher: str = "nearest",
    model: str = "auto",
    refiner: MatchRefiner | None = None,
) -> PairEstimate:
    """Return the fundamental matrix or homography of two images, with cameras the pose, a predicted error and warnings.

    Matches are mutual nearest neighbours that pass the ratio test in both directions, with 1 minus the larger ratio as
    score, or LightGlue's with its scores; :func:`~kornia_learnnorm.estimate_matches` estimates the matrix. Features on
    a constant black frame around an image are dropped. Where texture repeats, matches that do not move like their
    neighbours are left out; the predicted error is then too small.

    Args:
        image1: file of image 1, or its values: grey with shape (H, W) or RGB with shape (H, W, 3), uint8.
        image2: file of image 2, or its values.
        layer: estimates the fundamental matrix instead of RANSAC.
        ratio: largest ratio of the nearest to the second-nearest descriptor distance, of the matcher ``nearest``.
        threshold: RANSAC's threshold and the largest distance of an inlier, pixels of the images as they are matched.
        seed: seed of RANSAC and of the random subsets of the matches; equal images and seeds give equal estimates.
        K1: camera of image 1, (3, 3), pixels of the full image; with both, the result has an essential matrix and pose.
        K2: camera of image 2; both or none.
        mask1: true for the pixels of image 1 whose features are used, (H, W) bool.
        mask2: mask of image 2.
        max_size: longest side at which images are matched, pixels; larger images are reduced, but points and matrices
            are those of the full images.
        detector: a key of ``kornia_learnnorm.data.matching.features.DETECTORS``.
        matcher: one of ``kornia_learnnorm.data.matching.matchers.MATCHERS``.
        model: ``"auto"``, ``"fundamental"`` or ``"homography"``.
        refiner: moves the matches to sub-pixel accuracy before the matrix is estimated.

    Raises:
        NoReliableMatrixError, TypeError, ValueError: as :func:`~kornia_learnnorm.estimate_matches`, and a
            NoReliableMatrixError for a blank image, a ValueError for a file that is not an image.
        FileNotFoundError: if a file does not exist.
        ImportError: if OpenCV is not installed.
    """
    check_settings(threshold, seed, layer, model)
    read_cameras(K1, K2)  # before the work begins
    pair = match_two_images(image1, image2, ratio, mask1, mask2, max_size, detector, matcher, refiner)
    return pair.estimate(layer, threshold, seed, K1, K2, model)


@dataclass(frozen=True, eq=False)
class MatchedPair:
    """The matches of two images, for any estimator; nearest neighbours pass the ratio test at least from image 1."""

    points1: Tensor  # pixels of image 1 as it was matched, (N, 2), float64
    points2: Tensor  # pixels of image 2 as it was matched, (N, 2), float64
    scores: Tensor  # 1 minus the larger ratio of the two directions, or LightGlue's score, (N,), float64
    mutual: Tensor  # mask of the matches that pass the ratio test also from image 2 to image 1, (N,), bool
    size1: images.Size  # of image 1 as it was matched
    size2: images.Size  # of image 2 as it was matched
    full_size1: images.Size  # of image 1
    full_size2: images.Size  # of image 2
    ratio: float | None  # largest ratio of the nearest to the second-nearest descriptor distance
    path1: Path | None = None
    path2: Path | None = None

    def estimate(
        self,
        layer: LearnedEightPoint | None = None,
        threshold: float = INLIER_THRESHOLD,
        seed: int = 0,
        K1: Points | None = None,
        K2: Points | None = None,
        model: str = "auto",
    ) -> PairEstimate:
        """Return the estimate of the matches; arguments and errors are those of :func:`estimate_pair`."""
        S1, S2 = images.scaling(self.full_size1, self.size1), images.scaling(self.full_size2, self.size2)
        cameras = read_cameras(K1, K2)
        K1, K2 = (None, None) if cameras is None else (S1 @ cameras[0], S2 @ cameras[1])

        def solve(model: str, points1: Tensor, points2: Tensor, scores: Tensor) -> PairEstimate:
            sizes = self.size1, self.size2
            return estimate_matches(points1, points2, scores, *sizes, layer, threshold, seed, K1, K2, model)

        try:
            first = solve(model, *(x[self.mutual] for x in (self.points1, self.points2, self.scores)))
        except NoReliableMatrixError as error:
            raise _named(error, (self.path1, self.path2)) from error
        found, given = first, (self.points1, self.points2, self.mutual)
        if first.model == "fundamental" and mutual_share(*given, first.matrix, threshold) < MIN_MUTUAL_SHARE:
            false = self.points1[~self.mutual], self.points2[~self.mutual]
            matches = first.points1, first.points2, first.scores
            found = resolve_ambiguity(first, *false, lambda kept: solve("fundamental", *(x[kept] for x in matches)))
            choice = first.choice._replace(fundamental_inliers=found.num_inliers)
            found = replace(found, choice=choice, H_mat=first.H_mat)
        # A homography's distances are those in image 2, a fundamental matrix's those in both images.
        scales = [S2] if found.model == "homography" else [S1, S2]
        scale = float(torch.stack([S.diagonal()[:2] for S in scales]).mean())
        return replace(
            found,
            F_mat=None if found.F_mat is None else unit_matrix(transform_fundamental(found.F_mat, S1, S2)),
            H_mat=None if found.H_mat is None else unit_matrix(Homography().carry(found.H_mat, S1, S2)),
            points1=transform_points(found.points1[None], torch.linalg.inv(S1)[None])[0],
            points2=transform_points(found.points2[None], torch.linalg.inv(S2)[None])[0],
            predicted_error=found.predicted_error / scale,
            threshold=threshold / scale,
            size1=self.full_size1,
            size2=self.full_size2,
            ratio=self.ratio,
            path1=self.path1,
            path2=self.path2,
            rows=None,
        )


def match_two_images(
    image1: Image,
    image2: Image,
    ratio: float = RATIO,
    mask1: Mask | None = None,
    mask2: Mask | None = None,
    max_size: int = MAX_SIZE,
    detector: str = "sift",
    matcher: str = "nearest",
    refiner: MatchRefiner | None = None,
) -> MatchedPair:
    """Return the matches of two images; arguments and errors are those of :func:`estimate_pair`."""
    check_matching(ratio, max_size, detector, matcher)
    if not isinstance(refiner, MatchRefiner | None):
        raise TypeError(f"refiner must be a MatchRefiner or None, got {type(refiner).__name__}")
    path1, path2 = (Path(image) if isinstance(image, str | Path) else None for image in (image1, image2))
    colour = detector in READS_COLOUR
    (pixels1, full_size1), (pixels2, full_size2) = (_pixels(image, max_size, colour) for image in (image1, image2))
    features1 = _features(pixels1, full_size1, mask1, detector)
    features2 = _features(pixels2, full_size2, mask2, detector)
    for number, features in enumerate((features1, features2), 1):
        if len(features.points) < 2:
            text = f"image {number} is blank, nearly so, masked or too small: {len(features.points)} features in "
            text += "{} x {} pixels, expected 2 or more".format(*features.size)
            raise _named(NoReliableMatrixError("blank", text), (path1, path2))
    limit: float | None = None
    if matcher == "nearest":
        matches, back = match_both_ways(features1, features2)
        limit, kept = float(ratio), matches.ratio.double() < ratio
        points1, points2, ratios = (x[kept].double() for x in (*matches[:2], torch.maximum(matches.ratio, back)))
        scores, mutual = 1 - ratios, ratios < ratio
    else:
        points1, points2, scores = (part.double() for part in match_lightglue(features1, features2, detector))
        mutual = torch.ones_like(scores, dtype=torch.bool)
    if refiner is not None:
        views = (torch.from_numpy(np.atleast_3d(values)).permute(2, 0, 1)[None] for values in (pixels1, pixels2))
        with torch.no_grad():
            moved = refiner(*views, points1[None], points2[None])
        points1, points2 = moved.points1[0], moved.points2[0]
    sizes = features1.size, features2.size, full_size1, full_size2
    return MatchedPair(points1, points2, scores, mutual, *sizes, limit, path1, path2)


def check_matching(ratio: float, max_size: int, detector: str, matcher: str) -> None:
    """Raise a clear error for matching options that are of a wrong type, out of range or incompatible."""
    check_number("ratio", ratio)
    if not 0 < ratio <= 1:
        raise ValueError(f"ratio must be above 0 and at most 1, got {ratio:g}")
    check_number("max_size", max_size, whole=True)
    if max_size < MIN_SIZE:
        raise ValueError(f"max_size must be at least {MIN_SIZE} pixels, got {max_size}")
    check_methods(detector, matcher)
    if matcher != "nearest" and ratio != RATIO:
        raise ValueError(f"ratio {ratio:g} is for matcher nearest alone: {matcher} has scores and no ratios")


def _named(error: NoReliableMatrixError, paths: tuple[Path | None, Path | None]) -> NoReliableMatrixError:
    """Return the error with the names of both images before its text."""
    names = " and ".join(str(path or f"image {number}") for number, path in enumerate(paths, 1))
    return NoReliableMatrixError(error.code, f"{names}: {error}")


def _features(pixels: NDArray[np.uint8], size: images.Size, mask: Mask | None, detector: str) -> Features:
    """Return the features of an image as it is matched; the mask has the full size."""
    frame = images.content_mask(_grey(pixels))
    if mask is not None:
        mask = mask.cpu().numpy() if isinstance(mask, Tensor) else mask
        check_mask(mask, size)
        small = images.import_cv2().resize(mask.astype(np.uint8), pixels.shape[1::-1], interpolation=0) > 0
        frame = small if frame is None else small & frame
    features = DETECTORS[detector](pixels, NUM_FEATURES)
    return features if frame is None else keep_features(features, frame)


def _pixels(image: Image, max_size: int, colour: bool) -> tuple[NDArray[np.uint8], images.Size]:
    """Return the grey values, or colours where there are some, of an image of at most a size, and its full size."""
    if isinstance(image, str | Path):
        return (images.read_colour if colour else images.read_image)(image, max_size), images.image_size(image)
    values = image.cpu().numpy() if isinstance(image, Tensor) else image
    if not isinstance(values, np.ndarray) or values.dtype != np.uint8:
        hint = "values from 0 to 255 in uint8" if hasattr(values, "dtype") else "numpy.asarray(image)"
        got = f"got {getattr(values, 'dtype', type(values))}: try {hint}"
        raise TypeError(f"an image must be a path or an array of uint8, {got}")
    images.check_grey(values, colour=True)
    values = np.array(values if colour else _grey(values), order="C")
    return images.resize_image(values, max_size), (values.shape[1], values.shape[0])


def _grey(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    if pixels.ndim == 2:
        return pixels
    cv2 = images.import_cv2()
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(pixels), cv2.COLOR_RGB2GRAY), np.uint8)
