"""The learning rate of a training: one cycle over all its steps."""

from __future__ import annotations

from typing import Any

import pytorch_lightning as pl
from torch.optim import Optimizer
from torch.optim.lr_scheduler import OneCycleLR


def one_cycle(optimizer: Optimizer, trainer: pl.Trainer, warm_up: float) -> OneCycleLR:
    """Return the cycle over the steps of a training, up to the optimiser's learning rate."""
    if trainer.estimated_stepping_batches == float("inf"):
        expected = "give trainer.max_steps or trainer.max_epochs; trainer.max_time may end the training before"
        raise ValueError(f"the learning rate follows one cycle over all steps: {expected}")
    steps = max(2, int(trainer.estimated_stepping_batches))
    # The schedule divides by the warm-up's steps less one.
    return OneCycle(optimizer, optimizer.param_groups[0]["lr"], total_steps=steps, pct_start=max(warm_up, 1.5 / steps))


class OneCycle(OneCycleLR):
    """PyTorch's schedule, which goes on only in a training of as many steps: elsewhere it fails, or ends too early."""

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Load the state of a checkpoint, which must be of a training of as many steps."""
        if state_dict["total_steps"] != self.total_steps:
            had = f"the checkpoint is of a training of {state_dict['total_steps']} steps, one cycle of learning rates"
            raise ValueError(f"{had}; got {self.total_steps} steps: keep the number, or begin a new run elsewhere")
        super().load_state_dict(state_dict)
