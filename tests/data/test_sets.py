import numpy as np
import pytest
import torch
from scenes import eight_point, epipolar_distances, seeded

from kornia_learnnorm.data import sets
from kornia_learnnorm.data.sets import draw_samples, plain_residual


def test_every_correspondence_is_used_at_most_once_and_passes_the_ratio_test(store, rows_of):
    samples, filtered = (draw_samples(store, seeded(), max_ratio=ratio) for ratio in (None, 0.8))
    rows, pairs = rows_of(samples.points1, samples.points2)
    assert rows.size == len(np.unique(rows)) == 9 * (101 // 8) * 8
    assert (pairs == samples.pair.numpy()[:, None]).all()
    assert store.ratio[rows_of(filtered.points1, filtered.points2)[0]].max() < 0.8


def test_heldout_are_others_of_the_pair_that_pass_the_ratio_test(store, rows_of):
    samples = draw_samples(store, seeded(), max_ratio=None, num_heldout=16)
    own, _ = rows_of(samples.points1, samples.points2)
    rest, pairs = rows_of(samples.heldout1, samples.heldout2)
    assert not (own[:, :, None] == rest[:, None, :]).any()
    assert (pairs == samples.pair.numpy()[:, None]).all()
    assert store.ratio[rest].max() < 0.8


def test_seed_decides(store):
    first, again = (draw_samples(store, seeded(5), num_heldout=4) for _ in range(2))
    other = draw_samples(store, seeded(6), num_heldout=4)
    assert all(torch.equal(a, b) for a, b in zip(first[:5], again[:5], strict=True))
    assert not torch.equal(first.points1, other.points1)


def test_filter_agrees_with_numpy(store, monkeypatch):
    """The un-normalised eight-point algorithm and Eq. 7 in NumPy."""
    samples = draw_samples(store, seeded())
    points = samples.points1.double(), samples.points2.double()
    expected = epipolar_distances(*points, eight_point(*points, np.eye(3), np.eye(3))).mean(-1)
    assert len(samples.with_residual_below(60.0).pair) == (expected < 60).sum()
    monkeypatch.setattr(sets, "RESIDUAL_BATCH", 7)
    near = expected < 1e3
    np.testing.assert_allclose(plain_residual(*samples[:2]).numpy()[near], expected[near], rtol=1e-3)


def test_bad_arguments(store):
    for arguments, message in [
        ({"size": 7}, "size=7"),
        ({"max_ratio": 0.1}, "no pair of the store"),
        ({"size": 96, "max_ratio": None, "num_heldout": 4}, "held-out correspondences: a pair has only"),
    ]:
        with pytest.raises(ValueError, match=message):
            draw_samples(store, seeded(), **arguments)


def test_too_few_to_hold_out(store):
    samples = draw_samples(store, seeded(), size=96, max_ratio=None, num_heldout=4, require_heldout=False)
    assert samples.heldout1.isnan().any()
    assert torch.equal(samples.points1, draw_samples(store, seeded(), size=96, max_ratio=None).points1)
