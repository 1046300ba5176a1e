r"""Correspondences from the output of matching networks: matches by index, one padded batch."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, NoReturn

import torch
from kornia.core.check import KORNIA_CHECK_SHAPE
from torch import Tensor, nn
from torch.nn.functional import pad
from torch.nn.utils.rnn import pad_sequence

__all__ = ["Correspondences", "MatchLayer", "correspondences_from_matches", "refuse_jit"]


class Correspondences(NamedTuple):
    """Padded correspondences of a batch of image pairs."""

    points1: Tensor  # pixels, (B, N, 2)
    points2: Tensor
    weights: Tensor | None  # scores of the matches, zero in padded rows, (B, N)
    mask: Tensor  # false in padded rows, (B, N)


def correspondences_from_matches(
    keypoints1: Tensor,
    keypoints2: Tensor,
    matches: Tensor | Sequence[Tensor],
    scores: Tensor | Sequence[Tensor] | None = None,
) -> Correspondences:
    """Return the matched keypoints of a batch, padded to one length of at least eight.

    Arguments and errors are those of :meth:`~kornia_learnnorm.EightPoint.from_matches`. Gradients reach keypoints and
    scores.
    """
    for name, keypoints in (("keypoints1", keypoints1), ("keypoints2", keypoints2)):
        if not isinstance(keypoints, Tensor):
            raise TypeError(f"{name} must be a tensor, got {type(keypoints)}")
        KORNIA_CHECK_SHAPE(keypoints, ["B", "M", "2"])
    if isinstance(matches, Tensor):
        matches, scores = _pairs_of_matches(keypoints1, matches, scores)
    if not len(matches) == len(keypoints1) == len(keypoints2):
        raise ValueError(
            f"matches of every pair are needed, got {len(matches)} for {len(keypoints1)} and {len(keypoints2)} pairs"
        )
    if scores is not None and len(scores) != len(matches):
        raise ValueError(f"scores of every pair are needed, got {len(scores)} for {len(matches)} pairs")
    for k, pairs in enumerate(matches):
        _check_pairs(k, pairs, keypoints1.shape[1], keypoints2.shape[1])
        if scores is not None:
            _check_scores(k, scores[k], len(pairs))
    length = max(8, *(len(pairs) for pairs in matches)) if len(matches) else 8
    index = pad_sequence([*matches, keypoints1.new_zeros(length, 2, dtype=torch.int64)], batch_first=True)[:-1].long()
    present = torch.tensor([len(pairs) for pairs in matches], device=index.device)
    mask = torch.arange(length, device=index.device) < present[:, None]
    points1, points2 = (
        # A view without any keypoint gets one at the origin: padded rows take the first.
        pad(keypoints, (0, 0, 0, int(keypoints.shape[1] == 0))).gather(1, index[..., k : k + 1].expand(-1, -1, 2))
        for k, keypoints in enumerate((keypoints1, keypoints2))
    )
    if scores is None:
        return Correspondences(points1, points2, None, mask)
    padding = (
        torch.zeros(length, dtype=scores[0].dtype, device=index.device) if len(scores) else keypoints1.new_zeros(8)
    )
    weights = pad_sequence([*scores, padding], batch_first=True)[:-1]
    return Correspondences(points1, points2, weights, mask)


class MatchLayer(nn.Module):
    """What all layers have in common: they take the output of matching networks, and refuse ``torch.jit``."""

    scores_are = "weights"  # what the scores of matches are to `estimate`, "weights" or "scores"
    estimate: Callable[..., Any]

    def from_matches(
        self,
        keypoints1: Tensor,
        keypoints2: Tensor,
        matches: Tensor | Sequence[Tensor],
        scores: Tensor | Sequence[Tensor] | None = None,
        K1: Tensor | None = None,
        K2: Tensor | None = None,
    ) -> Any:
        """Return the estimate of the matches of a matching network, whose scores get gradients.

        Args:
            keypoints1: pixels in the first view with shape :math:`(B, M_1, 2)`.
            keypoints2: pixels in the second view with shape :math:`(B, M_2, 2)`.
            matches: a list of B tensors :math:`(S_i, 2)` of index pairs, as Kornia's LightGlue returns; or one tensor
                :math:`(B, M_1)` with the index of the match of each keypoint of view 1, negative for no match, as
                SuperGlue and Transformers (``matches[:, 0]``) return.
            scores: optional, non-negative, of a learned layer from 0 to 1: a list of B tensors :math:`(S_i,)`, or one
                tensor :math:`(B, M_1)`.
            K1: optional cameras of the first view, as for :meth:`estimate`.
            K2: optional cameras of the second view.

        Returns:
            the estimate; pairs with fewer than eight matches are not determined.

        Raises:
            TypeError: if keypoints, matches or scores are no tensors, matches no integers or scores not floating-point.
            ShapeError: if the keypoints do not have the shape above.
            ValueError: if the matches do not fit the keypoints, or the scores not the matches, or as :meth:`estimate`.

        """
        points1, points2, weights, mask = correspondences_from_matches(keypoints1, keypoints2, matches, scores)
        return self.estimate(points1, points2, mask=mask, K1=K1, K2=K2, **{self.scores_are: weights})

    def __prepare_scriptable__(self) -> NoReturn:
        """Raise a TypeError: ``torch.jit`` is not supported."""
        refuse_jit()


def refuse_jit() -> NoReturn:
    """Raise a TypeError that says what to use instead of ``torch.jit``."""
    raise TypeError("this layer cannot be compiled by torch.jit, use torch.compile or torch.export")


def _pairs_of_matches(
    keypoints1: Tensor, matches: Tensor, scores: Tensor | Sequence[Tensor] | None
) -> tuple[list[Tensor], list[Tensor] | None]:
    """Return matches by keypoint, (B, M1), as pairs of indices."""
    if matches.shape != keypoints1.shape[:2]:
        raise ValueError(f"matches must have shape {[*keypoints1.shape[:2]]} or be a list, got {[*matches.shape]}")
    if scores is not None and (not isinstance(scores, Tensor) or scores.shape != matches.shape):
        raise ValueError(f"scores must have the shape of the matches, {[*matches.shape]}, got {_shape(scores)}")
    if matches.is_floating_point() or matches.dtype == torch.bool:
        raise TypeError(f"matches must be tensors of integers, got {matches.dtype}")
    rows = [torch.nonzero(row >= 0)[:, 0] for row in matches]
    pairs = [torch.stack([own, row[own]], -1) for own, row in zip(rows, matches, strict=True)]
    return pairs, None if scores is None else [row[own] for own, row in zip(rows, scores, strict=True)]


def _check_pairs(k: int, pairs: Tensor, number1: int, number2: int) -> None:
    if not isinstance(pairs, Tensor) or pairs.is_floating_point() or pairs.dtype == torch.bool:
        got = pairs.dtype if isinstance(pairs, Tensor) else type(pairs)
        raise TypeError(f"matches must be tensors of integers, got {got}")
    if pairs.ndim != 2 or pairs.shape[1] != 2:
        raise ValueError(f"matches of pair {k} must have shape [S, 2], got {[*pairs.shape]}")
    limit = torch.tensor([number1, number2], device=pairs.device)
    if bool(((pairs < 0) | (pairs >= limit)).any()):
        raise ValueError(f"matches of pair {k} must be indices of {number1} and {number2} keypoints, got others")


def _check_scores(k: int, scores: Tensor, number: int) -> None:
    if not isinstance(scores, Tensor) or not scores.is_floating_point():
        got = scores.dtype if isinstance(scores, Tensor) else type(scores)
        raise TypeError(f"scores must be floating-point tensors, got {got}")
    if scores.shape != (number,):
        raise ValueError(f"scores of pair {k} must have shape {[number]}, got {[*scores.shape]}")
    if not bool((scores.detach() >= 0).all()) or not bool(scores.detach().isfinite().all()):
        raise ValueError(f"scores of pair {k} must be finite and not negative")


def _shape(value: object) -> object:
    return [*value.shape] if isinstance(value, Tensor) else type(value)
