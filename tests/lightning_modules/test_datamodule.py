"""The loader and the datamodule: every sample once, the same batches wherever and however often they are drawn."""

from types import SimpleNamespace

import pytest
import torch
from train_processes import Pairs

from kornia_learnnorm.data.training_samples import Block, SyntheticSamples
from kornia_learnnorm.data.training_sets import RandomSets, SyntheticSets
from lightning_modules.datamodule import BatchLoader, CorrespondenceDataModule


def same(batches, expected):
    return all(torch.equal(a.points1, b.points1) for a, b in zip(batches, expected, strict=True))


def random_sets(**arguments):
    return RandomSets([SyntheticSets(16)], **{"sizes": (16, 64), "correspondences": 512, "batches": 20, **arguments})


@pytest.mark.parametrize(("source", "size"), [(SyntheticSamples(300, max_residual=None), 64), (random_sets(), None)])
def test_batches_depend_on_seed_and_position_alone(source, size):
    loader = BatchLoader(source, size, seed=0, shuffle=True)
    first, second = list(loader), list(loader)
    assert len(first) == len(second) == len(loader) == (5 if size else 20)
    assert not torch.equal(first[0].points1[0, :8], second[0].points1[0, :8])
    again = BatchLoader(source, size, seed=0, shuffle=True)
    again.load_state_dict({"epoch": 1, "batch": 2})
    assert same(again, second[2:])
    ordered = list(BatchLoader(source, size, seed=0, shuffle=False))
    if size is None:
        assert same(ordered, [source.draw(0, block) for block in range(20)])
    else:
        assert [len(batch.pair) for batch in first] == [60] * 5
        assert torch.equal(torch.cat([batch.pair for batch in ordered]), torch.arange(300))


@pytest.mark.parametrize(("size", "shuffle"), [(64, True), (64, False), (None, True), (9, False)])
def test_small_blocks_are_batches_too(size, shuffle):
    parts = SyntheticSamples(113, max_residual=None).draw(0, 0).pair.split([70, 3, 40])
    source = SimpleNamespace(blocks=lambda seed: [Block(len(part), len(part)) for part in parts])
    source.draw = lambda seed, block: SyntheticSamples(113, max_residual=None).draw(0, 0).select(parts[block])
    batches = list(loader := BatchLoader(source, size, seed=0, shuffle=shuffle))
    assert len(batches) == len(loader)
    assert sorted(torch.cat([batch.pair for batch in batches]).tolist()) == list(range(113))


def test_wrong_sizes_of_batches():
    for size, options, message in [
        (64, {}, "a batch takes 64 samples, the source gives 10"),
        (11, {"by_pair": True}, "a batch takes 11 image pairs, the source gives 10"),
        (0, {}, "a batch must hold at least one sample for each process, got 0"),
        (1, {"rank": 0, "world_size": 2}, "at least one sample for each process, got 1"),
    ]:
        with pytest.raises(ValueError, match=message):
            BatchLoader(SyntheticSamples(number=10, max_residual=None), size, seed=0, shuffle=True, **options)


def test_validation_shares_no_sample_with_training_and_can_be_missing(monkeypatch):
    source = SyntheticSamples(number=64, max_residual=None)
    data = CorrespondenceDataModule(source, source, batch_size=64)
    (validated,), (trained,) = data.val_dataloader(), data.train_dataloader()
    assert not (validated.points1[:, None] == trained.points1[None]).flatten(2).all(-1).any()
    assert CorrespondenceDataModule().val_dataloader() == []
    with pytest.raises(ValueError, match=r"data\.train is not set"):
        CorrespondenceDataModule().train_dataloader()
    monkeypatch.setenv("PL_GLOBAL_SEED", "1")  # as seed_everything sets it
    assert (CorrespondenceDataModule().seed, CorrespondenceDataModule(seed=2).seed) == (1, 2)


def test_batch_pairs_are_for_training_alone():
    plain, paired = (CorrespondenceDataModule(*3 * [Pairs()], 32, pairs) for pairs in (None, 3))
    for stage in ("val", "test", "predict"):
        batches, expected = (list(getattr(data, f"{stage}_dataloader")()) for data in (paired, plain))
        assert [len(batch.pair) for batch in batches] == [27, 28]
        assert same(batches, expected)
    assert [len(batch.pair.unique()) for batch in paired.train_dataloader()] == [2, 3, 2, 3]
    assert [len(batch.pair) for batch in plain.train_dataloader()] == [27, 28]


@pytest.mark.parametrize(
    ("source", "size", "by_pair"),
    [(SyntheticSamples(number=5000), 512, False), (Pairs(), 4, True), (random_sets(batches=4), None, False)],
)
@pytest.mark.parametrize("world_size", [2, 3])
def test_processes_share_an_epoch(source, size, by_pair, world_size):
    loaders = [BatchLoader(source, size, 0, True, by_pair, 0, rank, world_size) for rank in range(world_size)]
    whole = BatchLoader(source, size, 0, True, by_pair)
    for epoch in range(2):
        shares = [list(loader) for loader in loaders]
        assert {len(batches) for batches in shares} == {len(whole)}
        held = 0
        for *parts, batch in zip(*shares, whole, strict=True):
            counts = [len(part.pair.unique() if by_pair else part.pair) for part in parts]
            assert max(counts) - min(counts) <= 1
            got = torch.cat([part.points1 for part in parts]).flatten(1).tolist()
            assert sorted(got) == sorted(batch.points1.flatten(1).tolist())
            held += len(got)
        assert held == sum(len(source.draw(epoch, block).pair) for block in range(len(source.blocks(epoch))))


@pytest.mark.parametrize(("source", "size"), [(SyntheticSamples(9000, max_residual=None), 1500), (random_sets(), None)])
def test_workers_change_nothing(source, size):
    plain, helped = (BatchLoader(source, size, 0, shuffle=True, workers=workers) for workers in (0, 2))
    assert same(list(helped), list(plain))
    for loader in (plain, helped):
        loader.load_state_dict({"epoch": 1, "batch": 3})
    assert same(list(helped), list(plain))


def test_no_sample_is_lost_to_more_processes_than_samples():
    source = SyntheticSamples(number=1, max_residual=None)
    loaders = [BatchLoader(source, 4, 0, shuffle=False, rank=rank, world_size=3) for rank in range(3)]
    assert [[len(batch.pair) for batch in loader] for loader in loaders] == [[1], [0], [0]]
    pairs = [BatchLoader(Pairs(), 3, 0, True, by_pair=True, rank=rank, world_size=3) for rank in range(3)]
    assert [len(list(loader)) for loader in pairs] == [4, 4, 4]
