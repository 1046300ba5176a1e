"""Random parts of the matches, which are solved again: their spread shows how far the estimate may be off."""

import torch
from torch import Tensor

from kornia_learnnorm.data.images import Size
from kornia_learnnorm.two_view.pair_warnings import MAX_LOG_FALSE_ALARMS, log_false_alarms, log_false_samples

NUM_PARTS = 12  # random parts of the matches that are solved again
PART_INLIERS = 48  # inliers expected in a part, unless it had less than half or more than four fifths of the matches
MIN_SUPPORT = 0.75  # of the inliers; with fewer, the search in a part has failed
MIN_SOLVED_PARTS = 4  # with fewer parts that have not failed, all parts count
FEW_MATCHES = 400  # matches; if so few determine a matrix, RANSAC cannot miss its many inliers in every part
MAX_FAILED_PARTS = 6  # parts of few matches without a result better than chance, before the search ends
MAX_EMPTY_PARTS = 2  # parts without a result better than a search among random matches, before the search ends


def draw_parts(number: int, inliers: int, seed: int) -> Tensor:
    """Return the rows (P, M) of random subsets: half of the matches, or so many that 48 inliers are expected."""
    share = min(max(0.5, PART_INLIERS / max(1, inliers)), 0.8)
    size = min(max(8, round(share * number)), number - 1)
    generator = torch.Generator().manual_seed(seed)
    return torch.stack([torch.randperm(number, generator=generator)[:size] for _ in range(NUM_PARTS)])


def are_in_vain(tried: int, matches: int, inliers: int, threshold: float, size2: Size) -> bool:
    """Return whether to stop after ``tried`` parts, as they found no more inliers than chance; only for few matches.

    Among more matches, a late part can find what all others missed.
    """
    if matches > FEW_MATCHES:
        return False
    if tried == MAX_EMPTY_PARTS and log_false_samples(matches, inliers, threshold, size2) > 0:
        return True
    return tried == MAX_FAILED_PARTS and log_false_alarms(matches, inliers, threshold, size2) > MAX_LOG_FALSE_ALARMS


def drop_failed_parts(F_parts: Tensor, support: Tensor, inliers: int) -> Tensor:
    """Return the matrices (P, 3, 3) with a support (P,) of 3/4 of the inliers; all if there are fewer than four."""
    solved = support >= MIN_SUPPORT * inliers
    return F_parts[solved] if int(solved.sum()) >= MIN_SOLVED_PARTS else F_parts
