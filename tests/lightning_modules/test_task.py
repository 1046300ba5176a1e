"""The task, the datamodule, the callbacks: a few steps of training on small data."""

import contextlib
import functools
import re
import signal

import pytest
import pytorch_lightning as pl
import torch
import train_processes
from safetensors.torch import load_file

import kornia_learnnorm as kln
from kornia_learnnorm.data.sources import Block, SyntheticSamples
from lightning_modules.callbacks import Checkpoints, ExportWeights, StepProgress, WritePredictions
from lightning_modules.datamodule import EVALUATION_SEED, CorrespondenceDataModule, SampleLoader
from lightning_modules.task import NormalizerTask


def make_task(**arguments):
    torch.manual_seed(0)
    return NormalizerTask(kln.LearnedNormalizer(kln.Whitening(), kln.CrossViewNetwork(width=8, depth=1)), **arguments)


class Pairs(train_processes.Pairs):
    """Ten image pairs, of pair k the samples of k + 1 scenes, mixed."""

    def draw(self, seed, block):
        samples = super().draw(seed, block)
        return samples._replace(pair=samples.pair[torch.arange(55) * 8 % 55])


def make_data(source=None, **arguments):
    source = source or SyntheticSamples(number=400, num_heldout=4)
    return CorrespondenceDataModule(source, source, source, batch_size=32, **arguments)


def make_trainer(folder, callbacks=(), **arguments):
    quiet = {"logger": False, "enable_progress_bar": False, "enable_model_summary": False, "accelerator": "cpu"}
    return pl.Trainer(default_root_dir=folder, callbacks=list(callbacks), max_epochs=-1, **quiet | arguments)


@pytest.mark.parametrize("precision", ["32-true", "bf16-mixed"])
def test_training_lowers_the_loss(tmp_path, precision):
    """In bfloat16 the network, not the solver: the loss falls as in float32, and matrices are float64."""
    task, data = make_task(optimizer=lambda params: torch.optim.AdamW(params, lr=2e-2)), make_data()
    batch = SyntheticSamples(number=1000).draw(99, 0)
    before, seen = task.compute_loss(batch).item(), []
    network = task.normalizer.network
    network.set_network.head.register_forward_hook(lambda m, a, out: seen.append(out.dtype))
    network.register_forward_hook(lambda m, a, out: seen.append(out[0].dtype))
    make_trainer(tmp_path, max_steps=150, enable_checkpointing=False, precision=precision).fit(task, data)
    assert set(seen[::2]) == {torch.bfloat16 if precision == "bf16-mixed" else torch.float32}
    assert set(seen[1::2]) == {torch.float64}
    assert all(p.dtype == torch.float32 and p.isfinite().all() for p in task.parameters())
    assert task.compute_loss(batch).item() < before - 0.02


class Blocks(SyntheticSamples):
    """Three blocks of 96 samples, so that workers have something to draw."""

    def blocks(self, seed):
        return [Block(96, 96)] * 3

    def draw(self, seed, block):
        return super().draw(3 * seed + block, 0)


@pytest.mark.parametrize(
    ("interrupted_at", "source", "arguments"),
    [
        (5, None, {}),
        (17, None, {}),
        (5, Pairs(), {"batch_pairs": 3}),
        (5, Blocks(number=96, num_heldout=4, max_residual=None), {"workers": 1}),
    ],
)
def test_resumes_to_the_same_curve(tmp_path, interrupted_at, source, arguments):
    """An epoch has about nine batches: the run is cut in the middle of the first and of the second."""
    whole, watches = make_task(), [train_processes.Watch(), train_processes.Watch()]
    data = make_data(source, **arguments)
    make_trainer(tmp_path / "whole", watches[:1], max_steps=20, enable_checkpointing=False).fit(whole, data)
    first, second = make_task(), make_task()
    callbacks = [Checkpoints(every_n_train_steps=2), train_processes.Stop(interrupted_at)]
    with pytest.raises(InterruptedError):
        make_trainer(tmp_path / "cut", callbacks, max_steps=20).fit(first, make_data(source, **arguments))
    trainer = make_trainer(tmp_path / "cut", [watches[1], Checkpoints(every_n_train_steps=2)], max_steps=20)
    trainer.fit(second, make_data(source, **arguments), ckpt_path=tmp_path / "cut/checkpoints/last.ckpt")
    torch.testing.assert_close(second.state_dict(), whole.state_dict(), rtol=0, atol=0)
    expected, got = (watch.seen["train/loss"] for watch in watches)
    assert got == expected[interrupted_at // 2 * 2 :]


@pytest.mark.parametrize(("workers", "number"), [(0, signal.SIGINT), (1, signal.SIGINT), (0, signal.SIGTERM)])
def test_an_interrupted_run_saves_its_step_and_goes_on_to_the_same_curve(tmp_path, workers, number, caplog):
    """The signal comes in the middle of step 5; no checkpoint is due before step 100."""
    source = Blocks(number=96, num_heldout=4, max_residual=None)
    whole, watches = make_task(), [train_processes.Watch(), train_processes.Watch()]
    data = functools.partial(make_data, source, workers=workers)
    make_trainer(tmp_path / "whole", watches[:1], max_steps=20, enable_checkpointing=False).fit(whole, data())
    first, second, last = make_task(), make_task(), tmp_path / "cut/checkpoints/last.ckpt"
    handler, interrupt = signal.getsignal(number), train_processes.Interrupt(4, number=number)
    with pytest.raises(SystemExit), caplog.at_level("INFO"):
        make_trainer(tmp_path / "cut", [Checkpoints(), interrupt], max_steps=20).fit(first, data())
    assert signal.getsignal(number) is handler
    assert f"stopped at step 5; to go on, repeat the command with --ckpt_path {last}" in caplog.text
    make_trainer(tmp_path / "cut", [watches[1], Checkpoints()], max_steps=20).fit(second, data(), ckpt_path=last)
    assert signal.getsignal(number) is handler
    torch.testing.assert_close(second.state_dict(), whole.state_dict(), rtol=0, atol=0)
    expected, got = (watch.seen["train/loss"] for watch in watches)
    assert got == expected[5:]


def test_the_last_checkpoint_is_that_of_the_last_step(tmp_path):
    make_trainer(tmp_path, [Checkpoints(every_n_train_steps=2)], max_steps=3).fit(make_task(), make_data())
    last = torch.load(tmp_path / "checkpoints/last.ckpt", weights_only=True)
    assert last["global_step"] == 3


@pytest.mark.parametrize("steps", [10, 40])
def test_a_run_of_another_length_does_not_go_on(tmp_path, steps, caplog):
    with pytest.raises(InterruptedError):
        make_trainer(tmp_path, [Checkpoints(2), train_processes.Stop(5)], max_steps=20).fit(make_task(), make_data())
    trainer, last = make_trainer(tmp_path, [Checkpoints(2)], max_steps=steps), tmp_path / "checkpoints/last.ckpt"
    caplog.clear()
    with pytest.raises(ValueError, match=f"a training of 20 steps, .* got {steps} steps"):
        trainer.fit(make_task(), make_data(), ckpt_path=last)
    assert "stopped at step" not in caplog.text


def test_a_second_interrupt_ends_the_run_at_once(tmp_path):
    callbacks = [Checkpoints(), train_processes.Interrupt(4, times=2)]
    with pytest.raises(SystemExit):
        make_trainer(tmp_path, callbacks, max_steps=20).fit(make_task(), make_data())
    assert not (tmp_path / "checkpoints/last.ckpt").exists()


def test_the_progress_bar_counts_the_steps_of_the_training(tmp_path, capsys):
    """An epoch has about nine batches; the training goes on from step 12."""

    def shown_steps(more, **resumed):
        callbacks = [Checkpoints(every_n_train_steps=12), StepProgress(), *more]
        trainer = make_trainer(tmp_path, callbacks, max_steps=20, enable_progress_bar=True)
        with contextlib.suppress(InterruptedError):
            trainer.fit(make_task(), make_data(), **resumed)
        return re.findall(r"Step: .*?\| (\S+) \[", capsys.readouterr().out)

    assert "0/20" in shown_steps([train_processes.Stop(14)])
    steps = shown_steps([], ckpt_path=tmp_path / "checkpoints/last.ckpt")
    assert (steps[0], steps[-1]) == ("12/20", "20/20")


@pytest.mark.parametrize("log", [True, False])
def test_accumulated_batches_make_the_step_of_a_larger_one(tmp_path, log):
    """Up to rounding, where the batches have the same number of samples; the limit of gradients is at work."""
    source, states = SyntheticSamples(number=256, num_heldout=4, max_residual=None), []
    for size, parts in ((64, 1), (16, 4)):
        task = make_task(loss=kln.EpipolarLoss(log=log, heldout_weight=0.5), sample_gradient=0.1).double()
        data = CorrespondenceDataModule(source, source, batch_size=size)
        trainer = make_trainer(tmp_path, max_steps=6, enable_checkpointing=False, accumulate_grad_batches=parts)
        trainer.fit(task, data)
        assert trainer.global_step == 6
        states.append(task.state_dict())
    torch.testing.assert_close(*states, rtol=0, atol=1e-9)


def test_export_and_predictions(tmp_path):
    task, data = make_task(), make_data()
    trainer = make_trainer(tmp_path, [ExportWeights(), WritePredictions()], max_steps=3, enable_checkpointing=False)
    trainer.fit(task, data)
    exported = kln.LearnedNormalizer.from_pretrained(tmp_path / "weights.safetensors")
    assert exported.trained_on == ("synthetic scenes",)
    trainer.predict(task, data)
    written = load_file(tmp_path / "predictions.safetensors")
    samples = data.test.draw(EVALUATION_SEED, 0)
    assert torch.equal(written["pair"], samples.pair)
    for batch in data.test_dataloader():  # as in the run: rounding in the network depends on it
        rows = torch.isin(samples.pair, batch.pair)
        x1, x2 = samples.points1[rows].double(), samples.points2[rows].double()
        F_mat = kln.find_fundamental(x1, x2, normalizer=exported)
        torch.testing.assert_close(written["F_mat"][rows], F_mat)
        residual = kln.symmetric_epipolar_distance(x1, x2, F_mat).mean(-1)
        torch.testing.assert_close(written["residual"][rows], residual)


def test_untrained_weights_are_not_written(tmp_path):
    trainer = make_trainer(tmp_path, [ExportWeights()], max_steps=3, limit_train_batches=0)
    with pytest.raises(ValueError, match="ended before its first step"):
        trainer.fit(make_task(), make_data())
    assert not (tmp_path / "weights.safetensors").exists()


def test_metrics_of_an_untrained_network_are_whitening_s(tmp_path):
    task, data = make_task(), make_data()
    trainer = make_trainer(tmp_path, enable_checkpointing=False)
    (got,) = trainer.test(task, data, verbose=False)
    x1, x2 = (p.double() for p in data.test.draw(EVALUATION_SEED, 0)[:2])
    hartley, whitening = (
        kln.symmetric_epipolar_distance(x1, x2, kln.find_fundamental(x1, x2, normalizer=n)).mean(-1)
        for n in (kln.Hartley(), kln.Whitening())
    )
    assert got["test/better_than_hartley"] == pytest.approx((whitening < hartley).double().mean().item(), abs=1e-6)
    assert got["test/better_than_whitening"] == 0
    assert got["test/log_sed"] == pytest.approx((whitening + 1e-3).log().mean().item(), abs=1e-5)


def test_sample_gradients_are_limited():
    data = make_data()
    batch = next(iter(data.train_dataloader()))
    norms = {}
    for limit in (None, 0.1):
        task = make_task(sample_gradient=limit)
        kept = []
        task.normalizer.network.set_network.register_forward_hook(lambda m, a, out, kept=kept: kept.append(out))
        loss = task.compute_loss(batch)
        (gradient,) = torch.autograd.grad(loss, kept[0])
        norms[limit] = gradient.norm(dim=-1)
    most = 0.1 / len(batch.pair) * (1 + 1e-5)  # per sample and view
    assert norms[None].max() > most
    assert norms[0.1].max() <= most
    small = norms[None] < 0.99 * most
    torch.testing.assert_close(norms[0.1][small], norms[None][small])


def test_heldout_loss_and_epoch_schedule(tmp_path):
    task = make_task(
        loss=kln.EpipolarLoss(heldout_weight=0.5),
        optimizer=lambda params: torch.optim.Adamax(params, lr=1e-3),
        lr_scheduler=lambda optimizer: torch.optim.lr_scheduler.StepLR(optimizer, 1, 0.8),
    )
    trainer = make_trainer(tmp_path, max_steps=20, enable_checkpointing=False)
    trainer.fit(task, make_data())
    epochs = 20 // trainer.num_training_batches
    assert trainer.optimizers[0].param_groups[0]["lr"] == pytest.approx(1e-3 * 0.8**epochs)


def test_loader_counts_and_restarts():
    source = SyntheticSamples(number=300, max_residual=None)
    loader = SampleLoader(source, 64, seed=0, shuffle=True)
    assert len(loader) == 5
    first = [b.points1 for b in loader]
    second = [b.points1 for b in loader]
    assert [len(batch) for batch in first] == [len(batch) for batch in second] == [60] * 5
    assert not torch.equal(first[0], second[0])
    again = SampleLoader(source, 64, seed=0, shuffle=True)
    again.load_state_dict({"epoch": 1, "batch": 2})
    assert all(torch.equal(a, b.points1) for a, b in zip(second[2:], again, strict=True))
    ordered = SampleLoader(source, 64, seed=0, shuffle=False)
    assert len(ordered) == 5
    assert torch.equal(torch.cat([b.pair for b in ordered]), torch.arange(300))


@pytest.mark.parametrize(
    ("size", "options", "message"),
    [
        (64, {}, "a batch takes 64 samples, the source gives 10"),
        (11, {"by_pair": True}, "a batch takes 11 image pairs, the source gives 10"),
        (0, {}, "a batch must hold at least one sample for each process, got 0"),
        (0, {"by_pair": True}, "a batch must hold at least one image pair for each process, got 0"),
        (1, {"rank": 0, "world_size": 2}, "at least one sample for each process, got 1"),
    ],
)
def test_wrong_sizes_of_batches(size, options, message):
    with pytest.raises(ValueError, match=message):
        SampleLoader(SyntheticSamples(number=10, max_residual=None), size, seed=0, shuffle=True, **options)


def test_wrong_datamodules():
    with pytest.raises(ValueError, match="a batch takes 16 image pairs, the source gives 10"):
        CorrespondenceDataModule(train=Pairs(), batch_pairs=16).train_dataloader()
    with pytest.raises(ValueError, match=r"data\.train is not set"):
        CorrespondenceDataModule().train_dataloader()
    assert CorrespondenceDataModule().val_dataloader() == []


def test_validation_shares_no_sample_with_training():
    source = SyntheticSamples(number=64, max_residual=None)
    data = CorrespondenceDataModule(source, source, source, batch_size=64)
    (validated,) = (batch.points1 for batch in data.val_dataloader())
    (trained,) = (batch.points1 for batch in data.train_dataloader())
    assert not (validated[:, None] == trained[None]).flatten(2).all(-1).any()


def same(batches, expected):
    return all(torch.equal(a, b) for pair in zip(batches, expected, strict=True) for a, b in zip(*pair, strict=True))


@pytest.mark.parametrize("batch_pairs", [1, 3, 4, 10])
def test_batches_of_whole_pairs(batch_pairs):
    source = Pairs()
    loader = SampleLoader(source, batch_pairs, seed=5, shuffle=True, by_pair=True)
    assert len(loader) == -(-10 // batch_pairs)
    orders = []
    for epoch in range(3):
        batches = list(loader)
        assert len(batches) == len(loader)
        drawn, order = source.draw(5 + epoch, 0), []
        for batch in batches:
            pairs = batch.pair.unique()
            assert 0 <= batch_pairs - len(pairs) <= 1
            rows = torch.isin(drawn.pair, pairs)
            for got, expected in zip(batch, drawn.select(rows), strict=True):  # all samples of these pairs, once
                assert sorted(got.tolist()) == sorted(expected.tolist())
            order += batch.pair.unique_consecutive().tolist()
        assert sorted(order) == list(range(10))
        orders.append(order)
    assert orders[0] != orders[1] != orders[2] != orders[0]


def test_one_sample_a_pair_is_counting_samples():
    source = SyntheticSamples(number=100)
    by_sample, by_pair = (SampleLoader(source, 16, 0, shuffle=True, by_pair=flag) for flag in (False, True))
    for _ in range(3):  # the filter leaves another number each epoch
        assert same(list(by_pair), list(by_sample))


def test_batch_pairs_are_for_training_alone():
    plain, paired = make_data(Pairs()), make_data(Pairs(), batch_pairs=3)
    for stage in ("val", "test", "predict"):
        batches, expected = (list(getattr(data, f"{stage}_dataloader")()) for data in (paired, plain))
        assert [len(batch.pair) for batch in batches] == [27, 28]
        assert same(batches, expected)
    assert [len(batch.pair.unique()) for batch in paired.train_dataloader()] == [2, 3, 2, 3]
    assert [len(batch.pair) for batch in plain.train_dataloader()] == [27, 28]


@pytest.mark.parametrize("by_pair", [False, True])
@pytest.mark.parametrize("world_size", [1, 2, 3])
def test_processes_share_an_epoch(by_pair, world_size):
    """Every sample once in an epoch, in as many batches for each process."""
    source, batch_size = (Pairs(), 4) if by_pair else (SyntheticSamples(number=9000), 512)
    loaders = [
        SampleLoader(source, batch_size, 0, True, by_pair, rank=rank, world_size=world_size)
        for rank in range(world_size)
    ]
    whole = SampleLoader(source, batch_size, 0, True, by_pair)
    for epoch in range(2):
        shares = [list(loader) for loader in loaders]
        assert {len(batches) for batches in shares} == {len(whole)}
        for *parts, batch in zip(*shares, whole, strict=True):
            assert max(len(p.pair.unique()) for p in parts) - min(len(p.pair.unique()) for p in parts) <= 1
            got = torch.cat([part.points1 for part in parts]).flatten(1).tolist()
            assert sorted(got) == sorted(batch.points1.flatten(1).tolist())
        drawn = [source.draw(epoch, block) for block in range(len(source.blocks(epoch)))]
        got = [row for batches in shares for batch in batches for row in batch.points1.flatten(1).tolist()]
        assert sorted(got) == sorted(row for samples in drawn for row in samples.points1.flatten(1).tolist())


def test_workers_change_nothing():
    source = SyntheticSamples(number=20_000, max_residual=None)
    plain, helped = (SampleLoader(source, 3000, 0, shuffle=True, workers=workers) for workers in (0, 2))
    for _ in range(2):
        assert same(list(helped), list(plain))
    for loader in (plain, helped):
        loader.load_state_dict({"epoch": 1, "batch": 3})
    assert same(list(helped), list(plain))


def test_no_sample_is_lost_to_more_processes_than_samples():
    source = SyntheticSamples(number=1, max_residual=None)
    loaders = [SampleLoader(source, 4, 0, shuffle=False, rank=rank, world_size=3) for rank in range(3)]
    assert [[len(batch.pair) for batch in loader] for loader in loaders] == [[1], [0], [0]]
    pairs = [SampleLoader(Pairs(), 3, 0, True, by_pair=True, rank=rank, world_size=3) for rank in range(3)]
    assert [len(list(loader)) for loader in pairs] == [4, 4, 4]
