"""The comparison with the start of a training."""

import pytest

pytest.importorskip("pytorch_lightning", reason="PyTorch Lightning is not installed")

from train_processes import Stop, make_data, make_trainer, normaliser_task

from lightning_modules.callbacks import AgainstStart, Checkpoints


def test_summary():
    found = AgainstStart()
    for last, expected in [
        ((0.1, 0.2), "better than at the start: a 0.100, at the start 0.300; b 0.200, at the start 0.400"),
        ((0.1, 0.5), "better in 1 of 2 errors than at the start: a 0.100"),
        ((0.3, float("nan")), "not better than at the start: a 0.300, at the start 0.300; b nan"),
    ]:
        found.start, found.last = {"a": 0.3, "b": 0.4}, dict(zip("ab", last, strict=True))
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


def test_a_part_of_the_validation_is_not_compared(tmp_path):
    found = AgainstStart()
    make_trainer(tmp_path, [found], max_steps=2, num_sanity_val_steps=1).fit(normaliser_task(), make_data())
    assert found.start == {}
