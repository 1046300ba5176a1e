"""The task and datamodule of estimators: a few steps on small sets."""

import pytest
import pytorch_lightning as pl
import torch

import kornia_learnnorm as kln
from kornia_learnnorm.data.sets import SyntheticSets
from kornia_learnnorm.data.sources import block_generator
from lightning_modules.callbacks import Checkpoints, ExportWeights
from lightning_modules.estimator_task import EstimatorTask
from lightning_modules.sets_datamodule import MatchSetDataModule


def make_task(**arguments):
    torch.manual_seed(0)
    return EstimatorTask(kln.LearnedEightPoint(width=16, depth=1, stages=2), **arguments)


def make_data(**arguments):
    options = {"sizes": (16, 64), "correspondences": 512, "steps": 20, "val": [SyntheticSets(16)]}
    return MatchSetDataModule(**{"train": [SyntheticSets(16)]} | options | arguments)


def make_trainer(folder, callbacks=(), **arguments):
    quiet = {"logger": False, "enable_progress_bar": False, "enable_model_summary": False, "accelerator": "cpu"}
    return pl.Trainer(default_root_dir=folder, callbacks=list(callbacks), max_epochs=-1, **quiet, **arguments)


@pytest.mark.parametrize("labels", [True, False])
def test_training_lowers_the_loss(tmp_path, labels):
    task, data = make_task(), make_data(train=[SyntheticSets(16, labels=labels)])
    batch = SyntheticSets(32, labels=labels).draw(64, 32, block_generator(9))
    before = task.compute_loss(batch).item()
    options = {"enable_checkpointing": False, "gradient_clip_val": 1.0, "limit_val_batches": 2}
    make_trainer(tmp_path, max_steps=60, **options).fit(task, data)
    assert task.compute_loss(batch).item() < before - (0.05 if labels else 0.01)
    assert not task.estimator.detach_stages


def test_a_loss_leaves_the_estimator_as_it_was():
    task, batch = make_task(), SyntheticSets(8).draw(4, 20, block_generator(1))
    task.compute_loss(batch)
    with pytest.raises(ValueError, match="must be finite"):
        task.compute_loss(batch._replace(points1=batch.points1 * torch.nan))
    assert not task.estimator.detach_stages
    assert not any(network._forward_hooks for network in task.estimator.networks)


@pytest.mark.parametrize("steps", [1, 2, 3, 20, 40])
def test_every_number_of_steps_has_a_schedule(tmp_path, steps):
    trainer = make_trainer(tmp_path, max_steps=steps, limit_val_batches=0, enable_checkpointing=False)
    trainer.fit(make_task(), make_data(correspondences=32))
    assert trainer.global_step == steps


def test_resumes_exactly(tmp_path):
    whole = make_task()
    make_trainer(tmp_path / "whole", max_steps=10, enable_checkpointing=False).fit(whole, make_data())
    task = make_task()
    make_trainer(tmp_path, [Checkpoints(5)], max_steps=10, limit_train_batches=20).fit(task, make_data())
    again = make_task()
    path = sorted((tmp_path / "checkpoints").glob("*step=5.ckpt")) or [tmp_path / "checkpoints/last.ckpt"]
    make_trainer(tmp_path, [Checkpoints(5)], max_steps=10).fit(again, make_data(), ckpt_path=str(path[0]))
    for key, value in whole.estimator.state_dict().items():
        assert torch.equal(again.estimator.state_dict()[key], value)


def test_validation_and_export(tmp_path):
    task, data = make_task(), make_data(steps=2)
    trainer = make_trainer(tmp_path, [ExportWeights()], max_steps=2, limit_val_batches=8)
    trainer.fit(task, data)
    assert {key for key in trainer.callback_metrics if key.startswith("val/")} >= {"val/median_32", "val/median_256"}
    layer = kln.LearnedEightPoint.from_pretrained(tmp_path / "weights.safetensors")
    assert layer.trained_on == ("synthetic scenes",)
    assert all(torch.equal(value, layer.state_dict()[key]) for key, value in task.estimator.state_dict().items())


def test_batches_depend_on_seed_and_number_alone():
    loaders = [make_data().train_dataloader() for _ in range(2)]
    loaders[1].load_state_dict({"epoch": 0, "batch": 3})
    first, second = [list(loader) for loader in loaders]
    assert len(first) == 20
    assert all(torch.equal(a.points1, b.points1) for a, b in zip(first[3:], second, strict=True))
    assert {batch.points1.shape[1] for batch in first} != {first[0].points1.shape[1]}
    assert {batch.scores is None for batch in first} == {True, False}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"train": []}, "data.train is empty"),
        ({"shares": [1.0, 2.0]}, "one non-negative number for each of 1 sources"),
        ({"shares": [0.0]}, "one non-negative number for each"),
        ({"sizes": (4, 9)}, "at least 8 matches"),
        ({"steps": 0}, "at least 1, got 0"),
    ],
)
def test_wrong_options(arguments, message):
    with pytest.raises(ValueError, match=message):
        MatchSetDataModule(**{"train": [SyntheticSets()]} | arguments)


def make_normaliser_task():
    torch.manual_seed(0)
    network = kln.CrossViewNetwork(width=16, depth=1)
    return EstimatorTask(kln.EightPoint(kln.LearnedNormalizer(kln.Hartley(), network)), optimizer=fast)


def fast(params):
    return torch.optim.AdamW(params, lr=1e-2)


def test_a_normalisation_trains_on_sets_of_any_size(tmp_path):
    """The same task trains a normaliser of the eight-point algorithm, and exports that."""
    task, data = make_normaliser_task(), make_data(train=[SyntheticSets(32)])
    batch = SyntheticSets(32).draw(64, 32, block_generator(9))
    before = task.compute_loss(batch).item()
    options = {"enable_checkpointing": False, "gradient_clip_val": 1.0, "limit_val_batches": 2}
    make_trainer(tmp_path, [ExportWeights()], max_steps=100, **options).fit(task, data)
    assert task.compute_loss(batch).item() < before - 0.02
    assert not task.trained.network._forward_hooks
    loaded = kln.LearnedNormalizer.from_pretrained(tmp_path / "weights.safetensors")
    assert loaded.trained_on == ("synthetic scenes",)
    for x, y in zip(loaded(batch.points1, batch.points2), task.trained(batch.points1, batch.points2), strict=True):
        torch.testing.assert_close(x, y)


@pytest.mark.parametrize(
    ("estimator", "message"),
    [
        (kln.Hartley(), "expected a LearnedEightPoint or an EightPoint, got Hartley"),
        (kln.EightPoint(), "expected a LearnedNormalizer in EightPoint, got Hartley"),
    ],
)
def test_estimators_that_learn_nothing_are_refused(estimator, message):
    with pytest.raises(TypeError, match=message):
        EstimatorTask(estimator)


@pytest.mark.parametrize("make", [make_task, make_normaliser_task])
def test_a_training_without_an_end_has_no_cycle(tmp_path, make):
    trainer = make_trainer(tmp_path, max_steps=-1, max_time="00:00:01:00", limit_val_batches=0)
    with pytest.raises(ValueError, match=r"give trainer.max_steps or trainer.max_epochs"):
        trainer.fit(make(), make_data())
