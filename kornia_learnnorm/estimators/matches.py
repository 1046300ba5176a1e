r"""Padded batches of correspondences from the output of matching networks."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import pad
from torch.nn.utils.rnn import pad_sequence

from kornia_learnnorm.geometry.checks import check_tensor, refuse_jit


class Correspondences(NamedTuple):
    """Padded correspondences of a batch of image pairs."""

    points1: Tensor  # pixels, (B, N, 2)
    points2: Tensor
    weights: Tensor | None  # scores of the matches, zero in padded rows, (B, N)
    mask: Tensor  # false in padded rows, (B, N)


Keypoints = Tensor | Mapping[str, Any]  # or the features of a detector
Matches = Tensor | Sequence[Tensor] | Mapping[str, Any]  # or the output of LightGlue
Scores = Tensor | Sequence[Tensor] | None


def correspondences_from_matches(
    keypoints1: Keypoints, keypoints2: Keypoints, matches: Matches, scores: Scores = None
) -> Correspondences:
    """Return the matched keypoints of a batch, padded to one length of at least eight.

    Arguments and errors are those of :meth:`~kornia_learnnorm.EightPoint.from_matches`. Gradients reach keypoints and
    scores.
    """
    keypoints1, keypoints2 = _keypoints("keypoints1", keypoints1), _keypoints("keypoints2", keypoints2)
    if isinstance(matches, Mapping):
        if scores is not None:
            raise ValueError("scores must be those of the mapping of matches: leave out the argument scores")
        matches, scores = _from_mapping(matches)
    if isinstance(matches, Tensor):
        matches, scores = _pairs_of_matches(keypoints1, matches, scores)
    if not isinstance(matches, Sequence):
        raise TypeError(f"matches must be a tensor, a list of tensors or a mapping, got {type(matches)}")
    if len(set(numbers := [len(values) for values in (matches, keypoints1, keypoints2)])) > 1:
        raise ValueError("matches of every pair are needed, got {} for {} and {} pairs".format(*numbers))
    if scores is not None and len(scores) != len(matches):
        raise ValueError(f"scores of every pair are needed, got {len(scores)} for {len(matches)} pairs")
    for k, pairs in enumerate(matches):
        _check_pairs(k, pairs, keypoints1.shape[1], keypoints2.shape[1])
        if scores is not None:
            _check_scores(k, scores[k], len(pairs))
    length = max([8, *map(len, matches)])
    index = pad_sequence([*matches, keypoints1.new_zeros(length, 2, dtype=torch.int64)], batch_first=True)[:-1].long()
    present = torch.tensor([len(pairs) for pairs in matches], device=index.device)
    mask = torch.arange(length, device=index.device) < present[:, None]
    # A view without keypoints gets one at the origin: padded rows index the first keypoint.
    views = (pad(keypoints, (0, 0, 0, int(keypoints.shape[1] == 0))) for keypoints in (keypoints1, keypoints2))
    matched = zip(views, index.unbind(-1), strict=True)
    points1, points2 = (view.gather(1, rows[..., None].expand(-1, -1, 2)) for view, rows in matched)
    if scores is None:
        return Correspondences(points1, points2, None, mask)
    padding = (scores[0] if len(scores) else keypoints1).new_zeros(length)
    return Correspondences(points1, points2, pad_sequence([*scores, padding], batch_first=True)[:-1], mask)


class MatchLayer(nn.Module):
    """Base class of all layers: takes the output of matching networks, refuses ``torch.jit``."""

    scores_are = "weights"  # argument of `estimate` that takes the scores of matches, "weights" or "scores"
    takes_cameras = True
    estimate: Callable[..., Any]

    def from_matches(
        self,
        keypoints1: Keypoints,
        keypoints2: Keypoints,
        matches: Matches,
        scores: Scores = None,
        K1: Tensor | None = None,
        K2: Tensor | None = None,
    ) -> Any:
        """Return the estimate from the output of a matching network, whose scores get gradients.

        Args:
            keypoints1: pixels in the first view with shape :math:`(B, M_1, 2)`, or LightGlue's input, a mapping with
                ``"keypoints"``, of a batch or, after ``rbd``, of one pair.
            keypoints2: pixels in the second view with shape :math:`(B, M_2, 2)`, or such a mapping.
            matches: a list of B tensors :math:`(S_i, 2)` of index pairs, as Kornia's LightGlue returns; or one tensor
                :math:`(B, S, 2)` of pairs, negative for no match; or one tensor
                :math:`(B, M_1)` with the index of the match of each keypoint of view 1, negative for no match, as
                SuperGlue and Transformers (``matches[:, 0]``) return; or LightGlue's output, a mapping with
                ``"matches"`` and ``"scores"`` or ``"matches0"`` and ``"matching_scores0"``, of a batch or of one pair.
            scores: optional, non-negative, for learned layers from 0 to 1: a list of B tensors :math:`(S_i,)`, or one
                tensor :math:`(B, S)` or :math:`(B, M_1)`; leave it out if ``matches`` is a mapping, which has them.
            K1: optional cameras of the first view, as for :meth:`estimate`.
            K2: optional cameras of the second view.

        Returns:
            the estimate; ``determined`` is false for pairs with too few matches (fundamental: eight).

        Raises:
            TypeError: if keypoints, matches or scores are not tensors, matches not integers, or scores not floats.
            ShapeError: if the keypoints do not have the shape above.
            ValueError: if the matches do not fit the keypoints, or the scores not the matches, or as :meth:`estimate`.
        """
        points1, points2, weights, mask = correspondences_from_matches(keypoints1, keypoints2, matches, scores)
        cameras = {name: K for name, K in (("K1", K1), ("K2", K2)) if K is not None}
        if cameras and not self.takes_cameras:
            raise ValueError(f"{type(self).__name__} takes no cameras, got {' and '.join(cameras)}")
        return self.estimate(points1, points2, mask=mask, **cameras, **{self.scores_are: weights})

    __prepare_scriptable__ = staticmethod(refuse_jit)


def _keypoints(name: str, keypoints: Keypoints) -> Tensor:
    """Return the keypoints (B, M, 2) of a tensor, or of a mapping, which may lack the batch."""
    values = _entry(keypoints, "keypoints") if isinstance(keypoints, Mapping) else keypoints
    if isinstance(keypoints, Mapping) and isinstance(values, Tensor) and values.ndim == 2:
        values = values[None]
    check_tensor(name, values, ["B", "M", "2"], precise=True)
    return values


def _from_mapping(found: Mapping[str, Any]) -> tuple[Tensor | Sequence[Tensor], Scores]:
    """Return the matches and scores of LightGlue's output, with a batch."""
    pairs = "matches" in found or "matches0" not in found  # pairs may have been filtered
    matches = _entry(found, "matches" if pairs else "matches0")
    scores = found.get("scores" if pairs else "matching_scores0")
    if isinstance(matches, Tensor) and matches.ndim == 1 + pairs:  # of one pair
        return matches[None], None if scores is None else scores[None]
    return matches, scores


def _entry(mapping: Mapping[str, Any], name: str) -> Any:
    if name not in mapping:
        raise ValueError(f"a mapping with {name!r} expected, got one with {', '.join(map(repr, mapping))}")
    return mapping[name]


def _pairs_of_matches(keypoints1: Tensor, matches: Tensor, scores: Scores) -> tuple[list[Tensor], list[Tensor] | None]:
    """Return matches by keypoint, (B, M1), or padded pairs of indices, (B, S, 2), as lists of pairs."""
    by_pair = matches.ndim == 3 and matches.shape[2] == 2
    if not by_pair and matches.shape != keypoints1.shape[:2]:
        expected = f"{[*keypoints1.shape[:2]]} or {[len(keypoints1), 'S', 2]}"
        raise ValueError(f"matches must have shape {expected} or be a list, got {[*matches.shape]}")
    if scores is not None and (not isinstance(scores, Tensor) or scores.shape != matches.shape[:2]):
        got = [*scores.shape] if isinstance(scores, Tensor) else type(scores)
        raise ValueError(f"scores must have the shape of the matches, {[*matches.shape[:2]]}, got {got}")
    if matches.is_floating_point() or matches.dtype == torch.bool:
        raise TypeError(f"matches must be tensors of integers, got {matches.dtype}")
    rows = [torch.nonzero((row >= 0).all(-1) if by_pair else row >= 0)[:, 0] for row in matches]
    pairs = [row[own] if by_pair else torch.stack([own, row[own]], -1) for own, row in zip(rows, matches, strict=True)]
    return pairs, None if scores is None else [row[own] for own, row in zip(rows, scores, strict=True)]


def _check_pairs(k: int, pairs: Tensor, number1: int, number2: int) -> None:
    if not isinstance(pairs, Tensor) or pairs.is_floating_point() or pairs.dtype == torch.bool:
        got = pairs.dtype if isinstance(pairs, Tensor) else type(pairs)
        raise TypeError(f"matches must be tensors of integers, got {got}")
    if pairs.ndim != 2 or pairs.shape[1] != 2:
        raise ValueError(f"matches of pair {k} must have shape [S, 2], got {[*pairs.shape]}")
    limit = torch.tensor([number1, number2], device=pairs.device)
    if len(wrong := ((pairs < 0) | (pairs >= limit)).any(1).nonzero()):
        expected, row = f"indices of {number1} and {number2} keypoints", int(wrong[0])
        raise ValueError(f"matches of pair {k} must be {expected}, got {pairs[row].tolist()} in row {row}")


def _check_scores(k: int, scores: Tensor, number: int) -> None:
    if not isinstance(scores, Tensor) or not scores.is_floating_point():
        got = scores.dtype if isinstance(scores, Tensor) else type(scores)
        raise TypeError(f"scores must be floating-point tensors, got {got}")
    if scores.shape != (number,):
        raise ValueError(f"scores of pair {k} must have shape {[number]}, got {[*scores.shape]}")
    if not bool((scores.detach() >= 0).all()) or not bool(scores.detach().isfinite().all()):
        low, high = scores.detach().aminmax()
        raise ValueError(f"scores of pair {k} must be finite and not negative, got {low:g} to {high:g}; no logits")
