"""Train on this process, or on those of ``torchrun --nproc-per-node=N train_processes.py N FOLDER CASE...``."""

import contextlib
import json
import os
import signal
import sys
import warnings
from pathlib import Path

import pytorch_lightning as pl
import torch
from safetensors.torch import save_file

import kornia_learnnorm as kln
from kornia_learnnorm.data.training_samples import Block, SyntheticSamples
from lightning_modules.callbacks import Checkpoints, WritePredictions
from lightning_modules.datamodule import CorrespondenceDataModule
from lightning_modules.task import EstimatorTask

SAMPLES = SyntheticSamples(number=400, num_heldout=4)


class Pairs(SyntheticSamples):
    """Ten image pairs, of pair k the samples of k + 1 scenes, mixed: processes share a batch unequally."""

    def __init__(self):
        super().__init__(number=55, num_heldout=4, max_residual=None)

    def blocks(self, seed):
        return [Block(55, 10)]

    def draw(self, seed, block):
        pair = torch.repeat_interleave(torch.arange(10), torch.arange(1, 11))
        return super().draw(seed, block)._replace(pair=pair[torch.arange(55) * 8 % 55])


class Blocks(SyntheticSamples):
    """Three blocks of so many samples, of which the filter keeps some."""

    def __init__(self, number, kept):
        super().__init__(number=number, num_heldout=4, max_residual=None)
        self.kept = kept

    def blocks(self, seed):
        return [Block(self.number, self.number)] * 3

    def draw(self, seed, block):
        return super().draw(3 * seed + block, 0).select(torch.arange(self.kept[block]))


class Spoil(pl.Callback):
    """Put NaN into samples: all of the last process, one, all; in step five, the last one's gradient is infinite."""

    def on_train_batch_start(self, trainer, pl_module, batch, batch_idx):
        # Of two processes, the last one has every second sample.
        last, every = (trainer.global_rank == 1, 1) if trainer.world_size == 2 else (True, 2)
        rows = {1: slice(every - 1, None, every), 2: slice(every - 1, every), 3: slice(None)}
        if batch_idx in rows and (last or batch_idx == 3):
            batch.points1[rows[batch_idx]] = torch.nan

    def on_validation_batch_start(self, trainer, pl_module, batch, batch_idx, dataloader_idx=0):
        self.on_train_batch_start(trainer, pl_module, batch, batch_idx)

    def on_before_backward(self, trainer, pl_module, loss):
        if trainer.global_rank == trainer.world_size - 1 and trainer.global_step == 4:
            loss.register_hook(lambda gradient: torch.inf * gradient)


class Watch(pl.Callback):
    """Keep the results of each step, and how many samples this process had."""

    def __init__(self):
        self.seen = {"train/loss": [], "train/left_out": [], "train/skipped": []}
        self.samples = []

    def on_train_batch_end(self, trainer, pl_module, outputs, batch, batch_idx):
        self.samples.append(len(batch.pair))
        for name, values in self.seen.items():
            values.append(trainer.callback_metrics.get(name, torch.zeros(())).item())


class Stop(pl.Callback):
    """Stop at a step, as if the machine had."""

    def __init__(self, step):
        self.step = step

    def on_train_batch_end(self, trainer, *_):
        if trainer.global_step == self.step:
            raise InterruptedError("as if the machine had stopped")


class Interrupt(pl.Callback):
    """Send the signal of Ctrl-C, or another one, in the middle of a step."""

    def __init__(self, step, times=1, number=signal.SIGINT):
        self.step, self.times, self.number = step, times, number

    def on_after_backward(self, trainer, *_):
        if trainer.global_step == self.step:
            for _ in range(self.times):
                os.kill(os.getpid(), self.number)
            self.step = None  # not again in the next backward pass of an accumulation


def normaliser_task(double=False, **arguments):
    """A task that trains a small normaliser on samples, the same weights in each call."""
    torch.manual_seed(0)
    normalizer = kln.LearnedNormalizer(kln.Whitening(), kln.CrossViewNetwork(width=8, depth=1))
    estimator = kln.EightPoint(normalizer.double() if double else normalizer)
    return EstimatorTask(estimator, **{"loss": kln.EpipolarLoss(), **arguments})


def make_data(source=SAMPLES, **arguments):
    return CorrespondenceDataModule(source, source, source, **{"batch_size": 32, **arguments})


def make_trainer(folder, callbacks=(), **arguments):
    quiet = {"logger": False, "enable_progress_bar": False, "enable_model_summary": False, "accelerator": "cpu"}
    options = {"default_root_dir": folder, "max_epochs": -1, **quiet, **arguments}
    return pl.Trainer(callbacks=list(callbacks), **options)


def task_and_data(case):
    # in float64, so that rounding is small
    task = normaliser_task(double=True, loss=kln.EpipolarLoss(heldout_weight=0.5), sample_gradient=0.1)
    source = SyntheticSamples(number=75, num_heldout=4, max_residual=None)
    train, batch = {"pairs": (Pairs(), 32), "filtered": (Blocks(40, (40, 0, 1)), 20)}.get(case, (source, 15))
    pairs = 3 if case == "pairs" else None
    return task, CorrespondenceDataModule(train, source, source, batch_size=batch, batch_pairs=pairs)


def run(case, processes, folder):
    """Train for six steps, validate, predict, and write weights, results and predictions to ``folder/case``."""
    folder = Path(folder) / case
    folder.mkdir(parents=True, exist_ok=True)
    options = {"max_steps": 6, "devices": processes, "gradient_clip_val": 1.0, "num_sanity_val_steps": 0}
    options["strategy"] = "ddp" if processes > 1 else "auto"
    last = folder / "checkpoints" / "last.ckpt"
    if case == "resumed" and not last.exists():
        callbacks = [Checkpoints(every_n_train_steps=1), Stop(3)]
        with contextlib.suppress(InterruptedError):
            make_trainer(folder, callbacks, **options).fit(*task_and_data(case))
    watch, resume = Watch(), last.exists()
    more = [Spoil()] if case == "spoiled" else [Checkpoints(every_n_train_steps=1)] if resume else []
    trainer = make_trainer(folder, [watch, *more, WritePredictions()], enable_checkpointing=resume, **options)
    task, data = task_and_data(case)
    trainer.fit(task, data, ckpt_path=last if resume else None)
    results = {name: value.item() for name, value in trainer.callback_metrics.items()}
    trainer.validate(task, data, verbose=False)
    results |= {name: value.item() for name, value in trainer.callback_metrics.items()}
    trainer.predict(task, data)
    rank = trainer.global_rank
    (folder / f"results-{rank}.json").write_text(json.dumps(results | watch.seen | {"samples": watch.samples}))
    save_file(task.trained.state_dict(), folder / f"weights-{rank}.safetensors")


if __name__ == "__main__":
    warnings.filterwarnings("ignore")
    for name in sys.argv[3:]:
        run(name, int(sys.argv[1]), sys.argv[2])
