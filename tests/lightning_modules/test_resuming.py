"""Checkpoints and interruption: a training that goes on ends with the weights of one that was not cut."""

import functools
import signal

import pytest
import torch
from train_processes import Blocks, Interrupt, Pairs, Stop, Watch, make_trainer, normaliser_task

from kornia_learnnorm.data.random_sets import RandomSets, SyntheticSets
from kornia_learnnorm.data.sources import SyntheticSamples
from lightning_modules.callbacks import Checkpoints
from lightning_modules.datamodule import CorrespondenceDataModule

SAMPLES = SyntheticSamples(number=400, num_heldout=4)
BLOCKS = Blocks(96, (96, 96, 96))  # so that workers have something to draw


def make_data(source=SAMPLES, **arguments):
    return CorrespondenceDataModule(source, source, **{"batch_size": 32, **arguments})


@pytest.mark.parametrize(
    ("interrupted_at", "source", "arguments"),
    [
        (17, SAMPLES, {}),
        (5, Pairs(), {"batch_pairs": 3}),
        (5, BLOCKS, {"workers": 1}),
        (5, RandomSets([SyntheticSets(16)], sizes=(9, 64), correspondences=256, batches=9), {"batch_size": None}),
    ],
)
def test_resumes_to_the_same_curve(tmp_path, interrupted_at, source, arguments):
    """An epoch has about nine batches: the run is cut in the middle of the first and of the second."""
    whole, watches = normaliser_task(), [Watch(), Watch()]
    data = functools.partial(make_data, source, **arguments)
    make_trainer(tmp_path / "whole", watches[:1], max_steps=20, enable_checkpointing=False).fit(whole, data())
    first, second = normaliser_task(), normaliser_task()
    callbacks = [Checkpoints(every_n_train_steps=2), Stop(interrupted_at)]
    with pytest.raises(InterruptedError):
        make_trainer(tmp_path / "cut", callbacks, max_steps=20).fit(first, data())
    trainer = make_trainer(tmp_path / "cut", [watches[1], Checkpoints(every_n_train_steps=2)], max_steps=20)
    trainer.fit(second, data(), ckpt_path=tmp_path / "cut/checkpoints/last.ckpt")
    torch.testing.assert_close(second.state_dict(), whole.state_dict(), rtol=0, atol=0)
    expected, got = (watch.seen["train/loss"] for watch in watches)
    assert got == expected[interrupted_at // 2 * 2 :]


@pytest.mark.parametrize(("workers", "number"), [(1, signal.SIGINT), (0, signal.SIGTERM)])
def test_an_interrupted_run_saves_its_step_and_goes_on_to_the_same_curve(tmp_path, workers, number, caplog):
    """The signal comes in the middle of step 5; no checkpoint is due before step 100."""
    whole, watches = normaliser_task(), [Watch(), Watch()]
    data = functools.partial(make_data, BLOCKS, workers=workers)
    make_trainer(tmp_path / "whole", watches[:1], max_steps=12, enable_checkpointing=False).fit(whole, data())
    first, second, last = normaliser_task(), normaliser_task(), tmp_path / "cut/checkpoints/last.ckpt"
    handler, interrupt = signal.getsignal(number), Interrupt(4, number=number)
    with pytest.raises(SystemExit), caplog.at_level("INFO"):
        make_trainer(tmp_path / "cut", [Checkpoints(), interrupt], max_steps=12).fit(first, data())
    assert signal.getsignal(number) is handler
    assert f"stopped at step 5; to go on, repeat the command with --ckpt_path {last}" in caplog.text
    make_trainer(tmp_path / "cut", [watches[1], Checkpoints()], max_steps=12).fit(second, data(), ckpt_path=last)
    assert signal.getsignal(number) is handler
    torch.testing.assert_close(second.state_dict(), whole.state_dict(), rtol=0, atol=0)
    expected, got = (watch.seen["train/loss"] for watch in watches)
    assert got == expected[5:]


def test_the_last_checkpoint_is_that_of_the_last_step(tmp_path):
    make_trainer(tmp_path, [Checkpoints(every_n_train_steps=2)], max_steps=3).fit(normaliser_task(), make_data())
    assert torch.load(tmp_path / "checkpoints/last.ckpt", weights_only=True)["global_step"] == 3


def test_a_run_of_another_length_does_not_go_on(tmp_path, caplog):
    last = tmp_path / "checkpoints/last.ckpt"
    with pytest.raises(InterruptedError):
        make_trainer(tmp_path, [Checkpoints(2), Stop(5)], max_steps=20).fit(normaliser_task(), make_data())
    for steps in (10, 40):
        caplog.clear()
        with pytest.raises(ValueError, match=f"a training of 20 steps, .* got {steps} steps"):
            make_trainer(tmp_path, [Checkpoints(2)], max_steps=steps).fit(
                normaliser_task(), make_data(), ckpt_path=last
            )
        assert "stopped at step" not in caplog.text


def test_a_second_interrupt_ends_the_run_at_once(tmp_path):
    with pytest.raises(SystemExit):
        make_trainer(tmp_path, [Checkpoints(), Interrupt(4, times=2)], max_steps=20).fit(normaliser_task(), make_data())
    assert not (tmp_path / "checkpoints/last.ckpt").exists()
