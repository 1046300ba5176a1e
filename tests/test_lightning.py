"""The task, the datamodule, the callbacks: a few steps of training on small data."""

import pytest
import pytorch_lightning as pl
import torch
from safetensors.torch import load_file

import kornia_learnnorm as kln
from kornia_learnnorm.data.samples import SyntheticSamples
from lightning_modules.callbacks import Checkpoints, ExportWeights, WritePredictions
from lightning_modules.datamodule import EVALUATION_SEED, CorrespondenceDataModule, SampleLoader
from lightning_modules.task import NormalizerTask


def make_task(**arguments):
    torch.manual_seed(0)
    return NormalizerTask(kln.LearnedNormalizer(network=kln.CrossViewNetwork(width=8, depth=1)), **arguments)


def make_data(**arguments):
    source = SyntheticSamples(number=400, num_heldout=4)
    return CorrespondenceDataModule(source, source, source, batch_size=32, **arguments)


def make_trainer(folder, callbacks=(), **arguments):
    quiet = {"logger": False, "enable_progress_bar": False, "enable_model_summary": False, "accelerator": "cpu"}
    return pl.Trainer(default_root_dir=folder, callbacks=list(callbacks), max_epochs=-1, **quiet, **arguments)


class Interrupt(pl.Callback):
    def __init__(self, step):
        self.step = step

    def on_train_batch_end(self, trainer, *_):
        if trainer.global_step == self.step:
            raise InterruptedError("as if the machine had stopped")


def test_training_lowers_the_loss(tmp_path):
    task, data = make_task(optimizer=lambda params: torch.optim.AdamW(params, lr=2e-2)), make_data()
    batch = next(iter(data.train_dataloader()))
    before = task.compute_loss(batch).item()
    make_trainer(tmp_path, max_steps=60, enable_checkpointing=False).fit(task, data)
    assert task.compute_loss(batch).item() < before - 0.02


@pytest.mark.parametrize("interrupted_at", [5, 17])
def test_resumes_to_the_same_curve(tmp_path, interrupted_at):
    """An epoch has about nine batches: the run is cut in the middle of the first and of the second."""
    whole = make_task()
    make_trainer(tmp_path / "whole", max_steps=20, enable_checkpointing=False).fit(whole, make_data())
    first, second = make_task(), make_task()
    callbacks = [Checkpoints(every_n_train_steps=2), Interrupt(interrupted_at)]
    with pytest.raises(InterruptedError):
        make_trainer(tmp_path / "cut", callbacks, max_steps=20).fit(first, make_data())
    trainer = make_trainer(tmp_path / "cut", [Checkpoints(every_n_train_steps=2)], max_steps=20)
    trainer.fit(second, make_data(), ckpt_path=tmp_path / "cut/checkpoints/last.ckpt")
    for (name, expected), got in zip(whole.state_dict().items(), second.state_dict().values(), strict=True):
        assert torch.equal(got, expected), name


def test_export_and_predictions(tmp_path):
    task, data = make_task(), make_data()
    trainer = make_trainer(tmp_path, [ExportWeights(), WritePredictions()], max_steps=3, enable_checkpointing=False)
    trainer.fit(task, data)
    exported = kln.LearnedNormalizer.from_pretrained(tmp_path / "weights.safetensors")
    trainer.predict(task, data)
    written = load_file(tmp_path / "predictions.safetensors")
    samples = data.test.draw(EVALUATION_SEED)
    assert torch.equal(written["pair"], samples.pair)
    for rows in torch.arange(len(samples.pair)).split(32):  # as in the run: rounding in the network depends on it
        x1, x2 = samples.points1[rows].double(), samples.points2[rows].double()
        F_mat = kln.find_fundamental(x1, x2, normalizer=exported)
        torch.testing.assert_close(written["F_mat"][rows], F_mat)
        residual = kln.symmetric_epipolar_distance(x1, x2, F_mat).mean(-1)
        torch.testing.assert_close(written["residual"][rows], residual)


def test_metrics_of_an_untrained_network_are_whitening_s(tmp_path):
    task, data = make_task(), make_data()
    trainer = make_trainer(tmp_path, enable_checkpointing=False)
    (got,) = trainer.test(task, data, verbose=False)
    x1, x2 = (p.double() for p in data.test.draw(EVALUATION_SEED)[:2])
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
    assert len(loader) == 4
    first = [b.points1 for b in loader]
    second = [b.points1 for b in loader]
    assert len(first) == len(second) == 4
    assert not torch.equal(first[0], second[0])
    again = SampleLoader(source, 64, seed=0, shuffle=True)
    again.load_state_dict({"epoch": 1, "batch": 2})
    assert all(torch.equal(a, b.points1) for a, b in zip(second[2:], again, strict=True))
    ordered = SampleLoader(source, 64, seed=0, shuffle=False)
    assert len(ordered) == 5
    assert torch.equal(torch.cat([b.pair for b in ordered]), torch.arange(300))


def test_bad_loaders():
    source = SyntheticSamples(number=10, max_residual=None)
    with pytest.raises(ValueError, match="a batch takes 64 samples, the source gives 10"):
        SampleLoader(source, 64, seed=0, shuffle=True)
    with pytest.raises(ValueError, match="batch_size must be positive"):
        SampleLoader(source, 0, seed=0, shuffle=True)
    with pytest.raises(ValueError, match=r"data\.train is not set"):
        CorrespondenceDataModule().train_dataloader()
    assert CorrespondenceDataModule().val_dataloader() == []


def test_validation_shares_no_sample_with_training():
    source = SyntheticSamples(number=64, max_residual=None)
    data = CorrespondenceDataModule(source, source, source, batch_size=64)
    (validated,) = (batch.points1 for batch in data.val_dataloader())
    (trained,) = (batch.points1 for batch in data.train_dataloader())
    assert not (validated[:, None] == trained[None]).flatten(2).all(-1).any()
