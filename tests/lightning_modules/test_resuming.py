"""Checkpoints, interruption and the start: a training that goes on ends with the weights of one that was not cut."""

import functools
import signal

import pytest
import torch
from lightning_fabric.plugins.io.torch_io import TorchCheckpointIO
from scenes import raises
from train_processes import SAMPLES, Blocks, Interrupt, Pairs, Stop, Watch, make_data, make_trainer, normaliser_task

from kornia_learnnorm.data.training_sets import RandomSets, SyntheticSets
from lightning_modules.callbacks import AgainstStart, Checkpoints
from lightning_modules.training_command import WholeCheckpoints

BLOCKS = Blocks(96, (96, 96, 96))  # so that workers have something to draw
RANDOM = RandomSets([SyntheticSets(16)], sizes=(9, 64), correspondences=256, batches=9)
SIGNALS = signal.SIGINT, signal.SIGTERM


@pytest.mark.parametrize(
    ("stop", "every", "saved", "source", "arguments"),
    [
        (Stop(17), 2, 16, SAMPLES, {}),
        (Stop(5), 2, 4, Pairs(), {"batch_pairs": 3}),
        (Stop(5), 2, 4, BLOCKS, {"workers": 1}),
        (Stop(5), 2, 4, RANDOM, {"batch_size": None}),
        (Interrupt(4), 100, 5, BLOCKS, {"workers": 1}),  # no checkpoint is due; the step ends first
        (Interrupt(4, number=signal.SIGTERM), 100, 5, BLOCKS, {}),
        (Interrupt(4), 100, 5, BLOCKS, {"accumulate_grad_batches": 3}),  # in the first of three batches
    ],
)
def test_a_run_that_was_cut_goes_on_to_the_same_curve(tmp_path, caplog, stop, every, saved, source, arguments):
    """An epoch has about nine batches: the run is cut in the middle of the first and of the second."""
    whole, second, watches = normaliser_task(), normaliser_task(), [Watch(), Watch()]
    options = {"max_steps": 20, "accumulate_grad_batches": arguments.pop("accumulate_grad_batches", 1)}
    data = functools.partial(make_data, source, **arguments)
    make_trainer(tmp_path / "whole", watches[:1], enable_checkpointing=False, **options).fit(whole, data())
    handlers, last = [*map(signal.getsignal, SIGNALS)], tmp_path / "cut/checkpoints/last.ckpt"
    with pytest.raises((InterruptedError, SystemExit)), caplog.at_level("INFO"):
        make_trainer(tmp_path / "cut", [Checkpoints(every), stop], **options).fit(normaliser_task(), data())
    assert f"; to go on, repeat the command with --ckpt_path {last}" in caplog.text
    make_trainer(tmp_path / "cut", [watches[1], Checkpoints(every)], **options).fit(second, data(), ckpt_path=last)
    assert [*map(signal.getsignal, SIGNALS)] == handlers
    torch.testing.assert_close(second.state_dict(), whole.state_dict(), rtol=0, atol=0)
    expected, got = (watch.seen["train/loss"] for watch in watches)
    assert got == expected[saved * options["accumulate_grad_batches"] :]


def test_a_checkpoint_that_fails_leaves_the_old_one(tmp_path, monkeypatch):
    (tmp_path / "last.ckpt").write_bytes(b"whole")
    monkeypatch.setattr(TorchCheckpointIO, "save_checkpoint", lambda self, saved, path, _: [path.touch(), saved["a"]])
    raises(KeyError, "a", WholeCheckpoints().save_checkpoint, {}, tmp_path / "last.ckpt")
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [("last.ckpt", b"whole")]


def test_the_last_checkpoint_is_that_of_the_last_step(tmp_path):
    make_trainer(tmp_path, [Checkpoints(every_n_train_steps=2)], max_steps=3).fit(normaliser_task(), make_data())
    assert torch.load(tmp_path / "checkpoints/last.ckpt", weights_only=True)["global_step"] == 3


def test_a_run_of_another_length_does_not_go_on(tmp_path, caplog):
    last = tmp_path / "checkpoints/last.ckpt"
    with pytest.raises(InterruptedError):
        make_trainer(tmp_path, [Checkpoints(2), Stop(5)], max_steps=20).fit(normaliser_task(), make_data())
    for steps, options in ((10, {}), (40, {}), (20, {"optimizer": functools.partial(torch.optim.AdamW, lr=0.5)})):
        caplog.clear()
        trainer = make_trainer(tmp_path, [Checkpoints(2)], max_steps=steps)
        with pytest.raises(ValueError, match=f"a training of 20 steps from .* got {steps} steps from"):
            trainer.fit(normaliser_task(**options), make_data(), ckpt_path=last)
        assert "stopped at step" not in caplog.text


def test_a_second_interrupt_ends_the_run_at_once(tmp_path):
    with pytest.raises(SystemExit):
        make_trainer(tmp_path, [Checkpoints(), Interrupt(4, times=2)], max_steps=20).fit(normaliser_task(), make_data())
    assert not (tmp_path / "checkpoints/last.ckpt").exists()


def test_summary():
    found = AgainstStart()
    for last, expected in [
        ((0.1, 0.2), "better than at the start: a 0.100, at the start 0.300; b 0.200, at the start 0.400"),
        ((0.1, 0.5), "better in 1 of 2 errors than at the start: a 0.100"),
        ((0.3, float("nan")), "not better than at the start: a 0.300, at the start 0.300; b nan"),
        ((), "other errors were measured"),
    ]:
        found.start, found.last = {"a": 0.3, "b": 0.4}, dict(zip("ab", last, strict=False))
        assert found.summary().startswith(expected)


def test_the_start_is_the_untrained_estimator_also_after_a_resumed_run(tmp_path):
    (expected,) = make_trainer(tmp_path).validate(normaliser_task(), make_data(), verbose=False)
    found, options = AgainstStart(), {"max_epochs": 1, "num_sanity_val_steps": -1}
    with pytest.raises(InterruptedError):
        make_trainer(tmp_path, [AgainstStart(), Checkpoints(2), Stop(3)], **options).fit(normaliser_task(), make_data())
    trainer = make_trainer(tmp_path, [found, Checkpoints(2)], **options)
    trainer.fit(normaliser_task(), make_data(), ckpt_path=tmp_path / "checkpoints/last.ckpt")
    assert found.start == {"val/log_sed": pytest.approx(expected["val/log_sed"])}
    assert found.last["val/log_sed"] != found.start["val/log_sed"]
    assert found.step == trainer.global_step > 3


def test_another_validation_or_a_part_is_not_compared(tmp_path):
    found = AgainstStart()
    found.load_state_dict({"start": {"val/log_sed": 1.0}, "batches": [99]})  # of a run with more batches
    make_trainer(tmp_path, [found], max_epochs=1, num_sanity_val_steps=1).fit(normaliser_task(), make_data())
    assert found.start == {}
