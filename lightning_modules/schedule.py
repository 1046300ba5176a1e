"""The learning rate of a training: one cycle over all its steps."""

from __future__ import annotations

from typing import Any

import pytorch_lightning as pl
from torch.optim.lr_scheduler import OneCycleLR

__all__ = ["OneCycle", "steps_of"]


def steps_of(trainer: pl.Trainer) -> int:
    """Return the number of steps of a training, which a cycle needs: at least two.

    Raises:
        ValueError: if the training has no end.

    """
    steps = trainer.estimated_stepping_batches
    if steps == float("inf"):
        raise ValueError(
            "the learning rate follows one cycle over all steps: give trainer.max_steps or trainer.max_epochs;"
            " trainer.max_time may end the training before"
        )
    return max(2, int(steps))


class OneCycle(OneCycleLR):
    """PyTorch's ``OneCycleLR``, which goes on only in a training of as many steps.

    ``OneCycleLR`` takes the number of steps from the checkpoint. A longer training would fail at its end, and a shorter
    one would stop at a large learning rate.
    """

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Load the state of a checkpoint.

        Raises:
            ValueError: if the checkpoint is of a training of another number of steps.

        """
        if state_dict["total_steps"] != self.total_steps:
            raise ValueError(
                f"the checkpoint is of a training of {state_dict['total_steps']} steps, whose learning rate follows one"
                f" cycle over them; got {self.total_steps} steps: keep the number, or begin a new run in another folder"
            )
        super().load_state_dict(state_dict)
