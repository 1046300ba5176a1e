"""Samples of stores and synthetic scenes, and the sources that draw them block by block."""

from itertools import pairwise

import numpy as np
import pytest
import torch
from references import eight_point, epipolar_distances
from scenes import raises, seeded

from kornia_learnnorm.data import match_sets
from kornia_learnnorm.data.match_sets import draw_samples, plain_residual
from kornia_learnnorm.data.store import read_store
from kornia_learnnorm.data.store_writer import write_store
from kornia_learnnorm.data.synthetic import handheld
from kornia_learnnorm.data.synthetic.scenes import synthetic_store
from kornia_learnnorm.data.training_samples import Block, StoreSamples, SyntheticSamples, block_generator
from kornia_learnnorm.data.training_sets import StoreSets


@pytest.mark.parametrize("kind", [StoreSamples, StoreSets])
def test_paths(store, tmp_path, monkeypatch, kind):
    write_store(tmp_path / "a.h5", store)
    monkeypatch.setenv("SOME_DATA", str(tmp_path))
    assert len(kind(["$SOME_DATA/a.h5", "${SOME_DATA}/a.h5@0:2"]).paths) == 2
    for unset in ("$UNSET_DATA", "${EMPTY_DATA}"):
        monkeypatch.setenv("EMPTY_DATA", "")
        with pytest.raises(ValueError, match=rf"environment variable {unset.strip('${}')}.* is not set; data\.train, "):
            kind([f"{unset}/a.h5"])
    raises(FileNotFoundError, r"c\.h5", kind, ["$SOME_DATA/c.h5@0:1"])
    raises(ValueError, "at least one store", kind, [])


def test_synthetic_source():
    source = SyntheticSamples(number=9000, num_heldout=3, max_residual=None)
    assert source.blocks(0) == [Block(8192, 8192), Block(808, 808)]
    samples, rest = (source.draw(0, block) for block in range(2))
    assert samples.points1.shape == (8192, 8, 2)
    assert samples.heldout2.shape == (8192, 3, 2)
    assert [*samples.pair, *rest.pair] == list(range(9000))
    assert not torch.equal(samples.points1[:808], rest.points1)
    assert torch.equal(samples.points2, source.draw(0, 0).points2)
    raises(ValueError, "number must be positive", SyntheticSamples, number=0)


def test_some_pairs_of_a_store(store, rows_of, tmp_path):
    """Parts are stores of their own: their pairs count on, whatever they were in the file."""
    write_store(tmp_path / "a.h5", store)
    path = str(tmp_path / "a.h5")
    got = StoreSamples([f"{path}@4:7", f"{path}@0:2"], num_heldout=2, max_residual=None).draw(3, 0)
    generator = block_generator(3, 0)
    parts = [read_store(f"{path}@{part}") for part in ("4:7", "0:2")]
    first, second = (draw_samples(part, generator, num_heldout=2) for part in parts)
    assert got.pair.tolist() == first.pair.tolist() + (second.pair + 3).tolist()
    for field, a, b in zip(got[:4], first[:4], second[:4], strict=True):
        assert torch.equal(field, torch.cat([a, b]))
    assert {*rows_of(got.points1, got.points2)[1].ravel()} == {0, 1, 4, 5, 6}


def test_synthetic_source_of_one_kind():
    samples = SyntheticSamples(number=60, num_heldout=3, max_residual=None, scenes=handheld).draw(5, 0)
    scene = handheld(60, 11, block_generator(5, 0))
    for own, heldout, points in zip(samples[:2], samples[2:4], (scene.points1, scene.points2), strict=True):
        assert torch.equal(own, points[:, :8].float())
        assert torch.equal(heldout, points[:, 8:].float())
    filtered = SyntheticSamples(number=60, size=9, max_residual=0.5, scenes=handheld).draw(6, 0)
    scene = handheld(60, 9, block_generator(6, 0))
    kept = plain_residual(scene.points1.float(), scene.points2.float()) < 0.5
    assert 0 < kept.sum() < 60
    assert torch.equal(filtered.points2, scene.points2[kept].float())
    assert filtered.pair.tolist() == torch.nonzero(kept)[:, 0].tolist()


@pytest.fixture
def sources(store, tmp_path):
    """A source of two stores of nine pairs each, in blocks of at most five pairs."""
    paths = [str(tmp_path / f"{name}.h5") for name in ("a", "b")]
    for path in paths:
        write_store(path, store)
    return lambda **options: StoreSamples(paths, **{"max_residual": None, "block_pairs": 5, **options})


def test_blocks_hold_every_sample_once(store, rows_of, sources):
    source = sources(max_ratios=[0.8, None], num_heldout=2)
    for seed in range(3):
        blocks = source.blocks(seed)
        drawn = [source.draw(seed, block) for block in range(len(blocks))]
        assert len(blocks) == 4
        assert [block.samples for block in blocks] == [len(samples.pair) for samples in drawn]
        assert [block.pairs for block in blocks] == [len(samples.pair.unique()) for samples in drawn]
        assert sorted(torch.cat([samples.pair.unique() for samples in drawn]).tolist()) == list(range(18))
        passing = [int((store.ratio[a:b] < 0.8).sum()) // 8 for a, b in pairwise(store.offsets)]
        expected = [number + 101 // 8 for number in passing] * 2
        assert torch.bincount(torch.cat([samples.pair for samples in drawn])).tolist() == expected
        for samples in drawn:  # of the right pair
            _, own = rows_of(samples.points1, samples.points2)
            assert (own == samples.pair.numpy()[:, None] % 9).all()


def test_draws_distribute_the_pairs_anew(sources):
    source = sources()
    first, again, other = (source.draw(seed, 0).pair.unique().tolist() for seed in (0, 0, 1))
    assert first == again != other


def test_a_range_of_sizes(sources):
    source = sources(size=(8, 20), block_pairs=2)
    sizes = [source.draw(0, block).points1.shape[1] for block in range(9)]
    assert len(set(sizes)) > 3
    assert 8 <= min(sizes) <= max(sizes) <= 20
    assert [block.samples for block in source.blocks(0)] == [len(source.draw(0, block).pair) for block in range(9)]


def test_blocks_without_samples(store, tmp_path):
    """Pairs of fewer than eight correspondences fill no sample; a block of them is empty."""
    few = synthetic_store(pairs=1, points=8, seed=0, scenes=["orbit"])
    write_store(tmp_path / "few.h5", few)
    write_store(tmp_path / "a.h5", store)
    paths = [str(tmp_path / "few.h5"), f"{tmp_path}/a.h5@0:1"]
    source = StoreSamples(paths, size=9, max_residual=None, block_pairs=1)
    blocks = source.blocks(0)
    assert sorted(block.pairs for block in blocks) == [0, 1]
    for number, block in enumerate(blocks):
        assert source.draw(0, number).points1.shape == (block.samples, 9, 2)
    weak = StoreSamples([str(tmp_path / "few.h5"), paths[1]], num_heldout=2, max_ratios=[None], max_residual=None)
    assert weak.draw(0, 0).pair.unique().tolist() == [1]  # of eight, none is held out
    raises(ValueError, r"no pair of .*few\.h5 has 9 correspondences", StoreSamples, [str(tmp_path / "few.h5")], size=9)


@pytest.mark.parametrize("kind", [StoreSamples, StoreSets])
def test_draws_that_cannot_be(sources, kind):
    for arguments, message in [
        ({"num_heldout": -1}, "num_heldout must be 0 or more, got -1"),
        ({"max_ratios": [0.8, 2.0]}, "max_ratios must be above 0 and at most 1, or null for no limit, got 2"),
        ({"max_ratios": [0.0]}, "max_ratios must be above 0 and at most 1, or null for no limit, got 0"),
    ]:
        raises(ValueError, message, kind, sources().paths, **arguments)


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
    """The un-normalised eight-point algorithm and Eq. 8 in NumPy."""
    samples = draw_samples(store, seeded())
    points = samples.points1.double(), samples.points2.double()
    expected = epipolar_distances(*points, eight_point(*points, np.eye(3), np.eye(3))).mean(-1)
    assert len(samples.with_residual_below(60.0).pair) == (expected < 60).sum()
    monkeypatch.setattr(match_sets, "RESIDUAL_BATCH", 7)
    near = expected < 1e3
    np.testing.assert_allclose(plain_residual(*samples[:2]).numpy()[near], expected[near], rtol=1e-3)


def test_bad_arguments(store, sources):
    for arguments in ({"size": (7, 8)}, {"size": (9, 8)}, {"block_pairs": 0}):
        raises(ValueError, "at least 8 correspondences, a block at least one pair, got", sources, **arguments)
    for arguments, message in [({"size": 7}, "size=7"), ({"max_ratio": 0.1}, "no pair of the store")]:
        raises(ValueError, message, draw_samples, store, seeded(), **arguments)


def test_too_few_to_hold_out(store):
    samples = draw_samples(store, seeded(), size=96, max_ratio=None, num_heldout=4)
    assert samples.heldout1.isnan().any()
    assert torch.equal(samples.points1, draw_samples(store, seeded(), size=96, max_ratio=None).points1)
