"""Correspondences from matches by index, in the formats of matching networks."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from kornia.core.exceptions import ShapeError
from kornia.feature import LightGlue
from scenes import raises, uniform
from torch.nn.utils.rnn import pad_sequence
from torch.testing import assert_close

import kornia_learnnorm as kln
from kornia_learnnorm.estimators.matches import correspondences_from_matches

KEYPOINTS = uniform(2, 30, 2, high=600), uniform(2, 25, 2, high=600, seed=1)


def test_lists_of_pairs():
    matches = [torch.tensor([[3, 4], [29, 0], [3, 24]]), torch.stack([torch.arange(12), torch.arange(12) + 10], -1)]
    scores = [torch.rand(3), torch.rand(12)]
    points1, points2, weights, mask = correspondences_from_matches(*KEYPOINTS, matches, scores)
    assert points1.shape == points2.shape == (2, 12, 2)
    assert mask.sum(-1).tolist() == [3, 12]
    for k in range(2):
        assert torch.equal(points1[k][mask[k]], KEYPOINTS[0][k][matches[k][:, 0]])
        assert torch.equal(points2[k][mask[k]], KEYPOINTS[1][k][matches[k][:, 1]])
        assert torch.equal(weights[k][mask[k]], scores[k])
    assert not weights[~mask].any()


@given(st.lists(st.integers(-1, 24), min_size=60, max_size=60))
def test_by_keypoint_is_the_same_as_pairs(index):
    matches = torch.tensor(index).view(2, 30)
    scores = uniform(2, 30)
    pairs = [torch.stack([torch.nonzero(row >= 0)[:, 0], row[row >= 0]], -1) for row in matches]
    picked = [score[row >= 0] for score, row in zip(scores, matches, strict=True)]
    expected = correspondences_from_matches(*KEYPOINTS, pairs, picked)
    assert_close(correspondences_from_matches(*KEYPOINTS, matches, scores), expected, rtol=0, atol=0)


def lightglue_output() -> tuple[list[dict], dict]:
    """The features of two pairs and the output of a small LightGlue of random weights that matches every neighbour."""
    torch.manual_seed(0)
    every = {"depth_confidence": -1, "width_confidence": -1, "filter_threshold": 0.0, "flash": False}
    network = LightGlue(None, input_dim=32, descriptor_dim=32, n_layers=1, num_heads=1, **every).eval()
    size = torch.full((2, 2), 600.0)
    sides = [
        {"keypoints": k.float(), "descriptors": torch.randn(2, k.shape[1], 32), "image_size": size} for k in KEYPOINTS
    ]
    return sides, network(dict(zip(("image0", "image1"), sides, strict=True)))


def test_every_form_of_lightglues_output_is_the_same():
    sides, found = lightglue_output()
    keypoints = [side["keypoints"] for side in sides]
    expected = correspondences_from_matches(*keypoints, found["matches"], found["scores"])
    assert expected.mask.any(1).all()
    by_keypoint = {name: found[name] for name in ("matches0", "matching_scores0")}
    padded = pad_sequence(found["matches"], batch_first=True, padding_value=-1), pad_sequence(found["scores"], True)
    for form in ((*sides, found), (*sides, by_keypoint), (*keypoints, found), (*keypoints, *padded)):
        assert_close(correspondences_from_matches(*form), expected)
    filtered = {name: [value[:5] for value in found[name]] for name in ("matches", "scores")}
    assert (correspondences_from_matches(*sides, found | filtered).mask.sum(1) == 5).all()
    for k in range(2):  # as the reference's rbd removes the batch
        views = [{"keypoints": points[k]} for points in keypoints]
        one = {name: found[name][k] for name in ("matches", "scores", "matches0", "matching_scores0")}
        alone = [points[k : k + 1] for points in keypoints]
        want = correspondences_from_matches(*alone, [one["matches"]], [one["scores"]])
        for form in (one, {name: one[name] for name in by_keypoint}):
            assert_close(correspondences_from_matches(*views, form), want)


@pytest.mark.parametrize("empty", [(), (0,), (1,), (0, 1)])
def test_at_least_eight_rows_of_views_without_keypoints_or_matches(empty):
    keypoints = [torch.rand(2, 0 if k in empty else 30, 2) for k in range(2)]
    nothing = torch.zeros(0, 2, dtype=torch.int64)
    for matches in ([nothing, nothing], torch.full(keypoints[0].shape[:2], -1)):
        points1, _, weights, mask = correspondences_from_matches(*keypoints, matches)
        assert points1.shape == (2, 8, 2)
        assert weights is None
        assert not mask.any()


def test_gradients_reach_keypoints_and_scores():
    keypoints1, keypoints2 = (keypoints.clone().requires_grad_() for keypoints in KEYPOINTS)
    scores = [torch.rand(2, requires_grad=True), torch.rand(1, requires_grad=True)]
    matches = [torch.tensor([[3, 4], [29, 0]]), torch.tensor([[7, 7]])]
    points1, points2, weights, _ = correspondences_from_matches(keypoints1, keypoints2, matches, scores)
    (points1.sum() + points2.sum() + weights.sum()).backward()
    assert {(0, 3), (0, 29), (1, 7)} <= {tuple(row) for row in torch.nonzero(keypoints1.grad[..., 0]).tolist()}
    assert keypoints2.grad[0, 4].tolist()[0] > 0
    assert all(score.grad.eq(1).all() for score in scores)


FIRST = [torch.tensor([[0, 0]])] * 2  # the first keypoints of both views, in both pairs


def test_wrong_matches_and_scores():
    for matches, scores, error, message in [
        (FIRST[:1], None, ValueError, "got 1 for 2 and 2 pairs"),
        ([torch.zeros(1, 2)] * 2, None, TypeError, r"integers, got torch\.float32"),
        ([[[0, 0]]] * 2, None, TypeError, "integers, got <class 'list'>"),
        (None, None, TypeError, "tensor, a list of tensors or a mapping, got <class 'NoneType'>"),
        ([torch.zeros(2, dtype=torch.int64)] * 2, None, ValueError, r"pair 0 .* \[S, 2\], got \[2\]"),
        ([torch.tensor([[0, 0], [0, 25]])] * 2, None, ValueError, r"30 and 25 keypoints, got \[0, 25\] in row 1"),
        ([torch.tensor([[-1, 2]])] * 2, None, ValueError, r"30 and 25 keypoints, got \[-1, 2\] in row 0"),
        (torch.zeros(2, 25, dtype=torch.int64), None, ValueError, r"\[2, 30\] .*, got \[2, 25\]"),
        (FIRST, [torch.rand(2)] * 2, ValueError, r"scores of pair 0 .* \[1\], got \[2\]"),
        (torch.zeros(2, 30).long(), torch.rand(2, 3), ValueError, r"\[2, 30\], got \[2, 3\]"),
        (torch.zeros(2, 9, 3).long(), None, ValueError, r"\[2, 'S', 2\] .*, got \[2, 9, 3\]"),
        (torch.zeros(2, 9, 2).long(), torch.rand(2, 8), ValueError, r"\[2, 9\], got \[2, 8\]"),
        ({"scores": torch.rand(1)}, None, ValueError, "'matches' expected, got one with 'scores'"),
        ({"matches": FIRST}, FIRST, ValueError, "scores must be those of the mapping"),
        (FIRST, [torch.rand(1), None], TypeError, "scores must be floating-point"),
        (FIRST, [torch.rand(1)], ValueError, "scores .* got 1 for 2 pairs"),
        (FIRST, [torch.rand(1), -torch.rand(1)], ValueError, "scores of pair 1 must be finite and not negative"),
    ]:
        raises(error, message, correspondences_from_matches, *KEYPOINTS, matches, scores)


def test_wrong_keypoints():
    with pytest.raises(TypeError, match="keypoints1 must be a float32 or float64 tensor"):
        correspondences_from_matches([[0.0, 0.0]], KEYPOINTS[1], FIRST)
    with pytest.raises(ValueError, match="'keypoints' expected, got one with 'lafs'"):
        correspondences_from_matches({"lafs": KEYPOINTS[0]}, KEYPOINTS[1], FIRST)
    with pytest.raises(ShapeError, match=r"(?s)\[30, 2\].*keypoints1\[None\]"):
        correspondences_from_matches(KEYPOINTS[0][0], KEYPOINTS[1][0], FIRST[:1])
    with pytest.raises(ValueError, match="LearnedHomography takes no cameras, got K1"):
        kln.LearnedHomography().from_matches(*KEYPOINTS, FIRST, K1=torch.eye(3))
