import numpy as np
import pytest
import torch

from kornia_learnnorm.data.samples import draw_samples, plain_residual
from kornia_learnnorm.data.sources import StoreSamples, SyntheticSamples
from kornia_learnnorm.data.store import write_store
from kornia_learnnorm.data.synthesize import synthetic_store
from kornia_learnnorm.data.synthetic import forward_driving, handheld


@pytest.fixture(scope="module")
def store():
    return synthetic_store(pairs=3, points=101, seed=2)


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def rows_of(store, points1, points2):
    """Row of each correspondence in the store, found by its coordinates."""
    index = {tuple(row): i for i, row in enumerate(np.c_[store.points1, store.points2].tolist())}
    return [index[tuple(row)] for row in torch.cat([points1, points2], -1).reshape(-1, 4).tolist()]


def test_every_correspondence_is_used_at_most_once(store):
    samples = draw_samples(store, seeded(), max_ratio=None)
    rows = rows_of(store, samples.points1, samples.points2)
    assert len(rows) == len(set(rows)) == 9 * (101 // 8) * 8
    pair = np.searchsorted(store.offsets, np.array(rows), side="right") - 1
    assert (pair.reshape(-1, 8) == samples.pair.numpy()[:, None]).all()


def test_ratio_test(store):
    samples = draw_samples(store, seeded(), max_ratio=0.8)
    assert store.ratio[rows_of(store, samples.points1, samples.points2)].max() < 0.8


def test_heldout_are_others_of_the_pair_that_pass_the_ratio_test(store):
    samples = draw_samples(store, seeded(), max_ratio=None, num_heldout=16)
    own = np.array(rows_of(store, samples.points1, samples.points2)).reshape(-1, 8)
    rest = np.array(rows_of(store, samples.heldout1, samples.heldout2)).reshape(-1, 16)
    assert not (own[:, :, None] == rest[:, None, :]).any()
    assert (np.searchsorted(store.offsets, rest, side="right") - 1 == samples.pair.numpy()[:, None]).all()
    assert store.ratio[rest].max() < 0.8


def test_seed_decides(store):
    first, again = (draw_samples(store, seeded(5), num_heldout=4) for _ in range(2))
    other = draw_samples(store, seeded(6), num_heldout=4)
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))
    assert not torch.equal(first.points1, other.points1)


def test_filter_agrees_with_numpy(store):
    """The un-normalised eight-point algorithm and Eq. 7 in NumPy."""
    samples = draw_samples(store, seeded())
    x1, x2 = (np.concatenate([p.numpy(), np.ones_like(p[..., :1])], -1).astype(float) for p in samples[:2])
    A = (x2[..., :, None] * x1[..., None, :]).reshape(-1, 8, 9)
    F = np.linalg.svd(A)[2][:, -1].reshape(-1, 3, 3)
    U, s, V = np.linalg.svd(F)
    F = (U[:, :, :2] * s[:, None, :2]) @ V[:, :2]
    l2, l1 = x1 @ F.swapaxes(1, 2), x2 @ F
    expected = np.abs((x2 * l2).sum(-1)) * (1 / np.hypot(*l2[..., :2].T).T + 1 / np.hypot(*l1[..., :2].T).T)
    got = plain_residual(samples.points1, samples.points2, batch_size=7)
    near = expected.mean(-1) < 1e3
    np.testing.assert_allclose(got.numpy()[near], expected.mean(-1)[near], rtol=1e-3)
    kept = draw_samples(store, seeded(), max_residual=60.0)
    assert len(kept.pair) == (expected.mean(-1) < 60).sum()


@pytest.mark.parametrize(
    ("arguments", "message"), [({"size": 7}, "size=7"), ({"max_ratio": 0.1}, "no pair of the store")]
)
def test_bad_arguments(store, arguments, message):
    with pytest.raises(ValueError, match=message):
        draw_samples(store, seeded(), **arguments)


def test_too_few_to_hold_out(store):
    with pytest.raises(ValueError, match="held-out correspondences: a pair has only"):
        draw_samples(store, seeded(), size=96, max_ratio=None, num_heldout=4)


def test_store_source(store, tmp_path, monkeypatch):
    for name in ("a", "b"):
        write_store(tmp_path / f"{name}.h5", store)
    monkeypatch.setenv("SOME_DATA", str(tmp_path))
    source = StoreSamples(["$SOME_DATA/a.h5", "$SOME_DATA/b.h5"], [0.8, None], num_heldout=2, max_residual=None)
    samples = source.draw(3)
    assert samples.pair.max() == 17  # pairs of the second store count on
    assert torch.equal(samples.points1, source.draw(3).points1)
    assert not torch.equal(samples.points1, source.draw(4).points1)
    with pytest.raises(ValueError, match="environment variable UNSET_DATA"):
        StoreSamples(["$UNSET_DATA/a.h5"])
    with pytest.raises(FileNotFoundError):
        StoreSamples(["$SOME_DATA/c.h5"])
    with pytest.raises(ValueError, match="at least one store"):
        StoreSamples([])


def test_synthetic_source():
    source = SyntheticSamples(number=9000, num_heldout=3, max_residual=None)
    samples = source.draw(0)
    assert samples.points1.shape == (9000, 8, 2)
    assert samples.heldout2.shape == (9000, 3, 2)
    assert samples.pair.tolist() == list(range(9000))
    assert torch.equal(samples.points2, source.draw(0).points2)
    filtered = SyntheticSamples(number=500).draw(0)
    assert 0 < len(filtered.pair) < 500
    assert plain_residual(filtered.points1, filtered.points2).max() < 60
    with pytest.raises(ValueError, match="number must be positive"):
        SyntheticSamples(number=0)


def test_some_pairs_of_a_store(store, tmp_path, monkeypatch):
    """Parts are stores of their own: their pairs count on, whatever they were in the file."""
    write_store(tmp_path / "a.h5", store)
    monkeypatch.setenv("SOME_DATA", str(tmp_path))
    got = StoreSamples(["$SOME_DATA/a.h5@4:7", "$SOME_DATA/a.h5@0:2"], num_heldout=2, max_residual=None).draw(3)
    generator = seeded(3)
    first, second = (draw_samples(store.select(*part), generator, num_heldout=2) for part in ((4, 7), (0, 2)))
    assert got.pair.tolist() == first.pair.tolist() + (second.pair + 3).tolist()
    for field, a, b in zip(got[:4], first[:4], second[:4], strict=True):
        assert torch.equal(field, torch.cat([a, b]))
    pair = np.searchsorted(store.offsets, rows_of(store, got.points1, got.points2), side="right") - 1
    assert set(pair) == {0, 1, 4, 5, 6}
    with pytest.raises(ValueError, match="pairs 7:12 were asked for, the store has 0:9"):
        StoreSamples(["$SOME_DATA/a.h5@7:12"])
    with pytest.raises(FileNotFoundError, match=r"b\.h5"):
        StoreSamples(["$SOME_DATA/b.h5@0:1"])


@pytest.mark.parametrize("make", [handheld, forward_driving])
def test_synthetic_source_of_one_kind(make):
    samples = SyntheticSamples(number=60, num_heldout=3, max_residual=None, scenes=make).draw(5)
    scene = make(60, 11, seeded(5))
    for own, heldout, points in zip(samples[:2], samples[2:4], (scene.points1, scene.points2), strict=True):
        assert torch.equal(own, points[:, :8].float())
        assert torch.equal(heldout, points[:, 8:].float())
    filtered = SyntheticSamples(number=60, size=9, max_residual=0.5, scenes=make).draw(6)
    scene = make(60, 9, seeded(6))
    kept = plain_residual(scene.points1.float(), scene.points2.float()) < 0.5
    assert 0 < kept.sum() < 60
    assert torch.equal(filtered.points2, scene.points2[kept].float())
    assert filtered.pair.tolist() == list(range(int(kept.sum())))
