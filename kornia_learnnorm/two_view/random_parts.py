"""Random parts of the matches, which are solved again: their matrices tell how far that of all matches may be off."""

import torch
from torch import Tensor

from kornia_learnnorm.data.images import Size
from kornia_learnnorm.two_view.pair_warnings import MAX_LOG_FALSE_ALARMS, log_false_alarms, log_false_samples

NUM_PARTS = 12  # random parts of the matches that are solved again
PART_INLIERS = 48  # expected in a part, where these are more than half and less than four fifths of all inliers
MIN_SUPPORT = 0.75  # of the inliers; the matrix of a part with fewer is that of a search that failed
MIN_SOLVED_PARTS = 4  # with fewer matrices of as much support, those of all parts count
FEW_MATCHES = 400  # so few determine a matrix only with more inliers than RANSAC misses again and again
MAX_FAILED_PARTS = 6  # parts of few matches that are no better than chance, as all matches, before the search ends
MAX_EMPTY_PARTS = 2  # parts with no more inliers than a search among random matches finds, before the search ends


def draw_parts(number: int, inliers: int, seed: int) -> Tensor:
    """Return the rows (P, M) of random subsets: half of the matches, or so many that 48 inliers are expected."""
    share = min(max(0.5, PART_INLIERS / max(1, inliers)), 0.8)
    size = min(max(8, round(share * number)), number - 1)
    generator = torch.Generator().manual_seed(seed)
    return torch.stack([torch.randperm(number, generator=generator)[:size] for _ in range(NUM_PARTS)])


def are_in_vain(tried: int, matches: int, inliers: int, threshold: float, size2: Size) -> bool:
    """Return whether so many parts of few matches found no more inliers than chance, and the others needn't be solved.

    Of more matches a late part can find what all others missed.
    """
    if matches > FEW_MATCHES:
        return False
    if tried == MAX_EMPTY_PARTS and log_false_samples(matches, inliers, threshold, size2) > 0:
        return True
    return tried == MAX_FAILED_PARTS and log_false_alarms(matches, inliers, threshold, size2) > MAX_LOG_FALSE_ALARMS


def drop_failed_parts(F_parts: Tensor, support: Tensor, inliers: int) -> Tensor:
    """Return the matrices of parts (P, 3, 3) whose support (P,) is most inliers; all of them where these are few."""
    solved = support >= MIN_SUPPORT * inliers
    return F_parts[solved] if int(solved.sum()) >= MIN_SOLVED_PARTS else F_parts
