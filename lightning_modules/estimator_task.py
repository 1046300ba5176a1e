"""The training task of an estimator: sets of matches in, losses of all its stages out, with labels or without."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, cast

import pytorch_lightning as pl
import torch
from pytorch_lightning.utilities import rank_zero_warn
from torch import Tensor, nn
from torch.optim import Optimizer

from kornia_learnnorm.data.sets import MatchSets
from kornia_learnnorm.estimators.eight_point import EightPoint
from kornia_learnnorm.estimators.learned import LearnedEightPoint
from kornia_learnnorm.geometry.distances import symmetric_epipolar_distance
from kornia_learnnorm.losses import BoundedEpipolarLoss, InlierLoss, LogEpipolarLoss
from kornia_learnnorm.normalizers.learned import LearnedNormalizer
from lightning_modules.schedule import OneCycle, steps_of

__all__ = ["EstimatorTask"]

EARLY_STAGE = 0.3  # weight of the losses of all stages but the last
MAX_SET_GRADIENT = 1.0  # norm of a set's gradient of its logits or parameters; nearly degenerate sets have more


def _adamw(params: Iterable[nn.Parameter]) -> Optimizer:
    return torch.optim.AdamW(params, lr=2e-3)


def _limit_gradients(module: nn.Module, args: Any, outputs: tuple[Tensor, ...]) -> None:
    """Limit the norm of each set's gradient of a network's outputs, before the batch's average."""

    def limit(gradient: Tensor) -> Tensor:
        most = MAX_SET_GRADIENT / len(gradient)
        norm: Tensor = torch.linalg.vector_norm(gradient, dim=-1, keepdim=True)
        return gradient * torch.where(norm > most, most / norm, 1.0)

    for output in outputs:
        if output.requires_grad:
            output.register_hook(limit)  # type: ignore[no-untyped-call]


@contextmanager
def _limited_gradients(networks: Iterable[nn.Module]) -> Iterator[None]:
    """Limit the gradient of each set where it enters the networks."""
    limits = [network.register_forward_hook(_limit_gradients) for network in networks]
    try:
        yield
    finally:
        for handle in limits:
            handle.remove()


@contextmanager
def _stages_apart(estimator: LearnedEightPoint) -> Iterator[None]:
    """Train each stage by its own losses."""
    before, estimator.detach_stages = estimator.detach_stages, True
    try:
        yield
    finally:
        estimator.detach_stages = before


class EstimatorTask(pl.LightningModule):
    """Train a learned estimator by back-propagating losses of its matrices.

    Sets whose ground truth is known have the logarithmic loss of true inliers and the cross-entropy of the logits, the
    others the bounded loss of all matches: sources with ``labels=False`` train without labels. Validation logs the
    median distance of the held-out matches.

    Args:
        estimator: the estimator to train: a :class:`~kornia_learnnorm.LearnedEightPoint`, or an
            :class:`~kornia_learnnorm.EightPoint` with a :class:`~kornia_learnnorm.LearnedNormalizer`, which has one
            stage and no logits.
        label_free: loss of the sets without ground truth, times ``label_free_weight``.
        labelled: loss of the sets with ground truth.
        inlier_weight: weight of the cross-entropy.
        label_free_weight: weight of the label-free loss.
        optimizer: builds the optimiser from the parameters; AdamW with a learning rate of 2e-3 when not given. The
            learning rate follows one cycle over all steps of the run.
    """

    def __init__(
        self,
        estimator: LearnedEightPoint | EightPoint,
        label_free: BoundedEpipolarLoss | None = None,
        labelled: LogEpipolarLoss | None = None,
        inlier_weight: float = 0.3,
        label_free_weight: float = 4.0,
        optimizer: Callable[[Iterable[nn.Parameter]], Optimizer] = _adamw,
    ) -> None:
        super().__init__()
        if not isinstance(estimator, LearnedEightPoint | EightPoint):
            raise TypeError(f"expected a LearnedEightPoint or an EightPoint, got {type(estimator).__name__}")
        if isinstance(estimator, EightPoint) and not isinstance(estimator.normalizer, LearnedNormalizer):
            raise TypeError(f"expected a LearnedNormalizer in EightPoint, got {type(estimator.normalizer).__name__}")
        self.estimator = estimator.train()  # shipped weights come in evaluation mode
        self.label_free = label_free or BoundedEpipolarLoss()
        self.labelled = labelled or LogEpipolarLoss()
        self.inlier = InlierLoss()
        self.inlier_weight, self.label_free_weight = inlier_weight, label_free_weight
        self.optimizer = optimizer
        self._medians: list[tuple[int, Tensor]] = []  # set sizes and errors since the last validation

    @property
    def trained(self) -> LearnedEightPoint | LearnedNormalizer:
        """The module that learns, whose weights ``from_pretrained`` reads."""
        if isinstance(self.estimator, LearnedEightPoint):
            return self.estimator
        return cast(LearnedNormalizer, self.estimator.normalizer)

    def configure_optimizers(self) -> Any:
        """Build the optimiser and its schedule."""
        optimizer = self.optimizer(p for p in self.parameters() if p.requires_grad)
        steps = steps_of(self.trainer)
        warm_up = max(0.05, 1.5 / steps)  # the schedule divides by the warm-up's steps less one
        schedule = OneCycle(optimizer, max_lr=optimizer.param_groups[0]["lr"], total_steps=steps, pct_start=warm_up)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def training_step(self, batch: MatchSets, batch_idx: int) -> Tensor:
        """Return the loss of a batch."""
        loss = self.compute_loss(batch)
        self.log("train/loss", loss.detach(), prog_bar=True)
        return loss

    def compute_loss(self, batch: MatchSets) -> Tensor:
        """Return the loss of a batch: of all stages, and of the sets of both kinds."""
        heldout1, heldout2 = batch.heldout1.double(), batch.heldout2.double()
        total = heldout1.new_zeros(())
        stages = self._stages(batch)
        for number, (F_mat, logits) in enumerate(stages):
            known = self.labelled(heldout1, heldout2, F_mat)
            if logits is not None:
                known = known + self.inlier_weight * self.inlier(logits, batch.inliers)
            unknown = self.label_free_weight * self.label_free(heldout1, heldout2, F_mat)
            loss = torch.where(batch.labelled, known, unknown).mean()
            total = total + (1.0 if number + 1 == len(stages) else EARLY_STAGE) * loss
        return total

    def _stages(self, batch: MatchSets) -> list[tuple[Tensor, Tensor | None]]:
        """Return the matrices of each stage, and the logits of the matches where there are some."""
        points1, points2 = batch.points1.double(), batch.points2.double()
        if isinstance(self.trained, LearnedNormalizer):
            with _limited_gradients([self.trained.network]):
                return [(self.estimator(points1, points2), None)]
        with _stages_apart(self.trained), _limited_gradients(self.trained.networks):
            return [*self.trained.estimate(points1, points2, scores=batch.scores).stages]

    def on_before_optimizer_step(self, optimizer: Optimizer) -> None:
        """Skip a step whose gradient is not finite."""
        finite = all(bool(p.grad.isfinite().all()) for p in self.parameters() if p.grad is not None)
        if not finite:
            rank_zero_warn("a step was skipped: non-finite gradient")
            for p in self.parameters():
                p.grad = None
        self.log("train/skipped", float(not finite))

    def validation_step(self, batch: MatchSets, batch_idx: int) -> None:
        """Collect the median distance of the held-out matches of each set."""
        F_mat = self.estimator(batch.points1.double(), batch.points2.double())
        distance = symmetric_epipolar_distance(batch.heldout1.double(), batch.heldout2.double(), F_mat)
        self._medians.append((batch.points1.shape[1], distance.median(-1).values))

    def on_validation_epoch_end(self) -> None:
        """Log the median over the sets of at most 32, at most 256 and more matches."""
        for name, low, high in (("32", 0, 32), ("256", 32, 256), ("1000", 256, 10**9)):
            own = [errors for size, errors in self._medians if low < size <= high]
            if own:
                self.log(f"val/median_{name}", torch.cat(own).median(), prog_bar=True)
        self._medians = []
