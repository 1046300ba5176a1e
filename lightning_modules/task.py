"""The training task: correspondences in, loss of the fundamental matrix out, no labels."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import pytorch_lightning as pl
import torch
from pytorch_lightning.utilities import rank_zero_warn
from torch import Tensor, nn
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler

from kornia_learnnorm.data.samples import Samples
from kornia_learnnorm.estimators.fundamental import find_fundamental, solve_fundamental, solve_in_coordinates
from kornia_learnnorm.geometry.checks import solve_dtype
from kornia_learnnorm.geometry.distances import symmetric_epipolar_distance
from kornia_learnnorm.geometry.problem import LinearProblem
from kornia_learnnorm.losses import EpipolarLoss
from kornia_learnnorm.metrics.modules import BetterRateMetric
from kornia_learnnorm.normalizers.contract import Normalizer
from kornia_learnnorm.normalizers.hartley import Hartley
from kornia_learnnorm.normalizers.learned import LearnedNormalizer
from kornia_learnnorm.normalizers.whitening import Whitening
from lightning_modules.schedule import OneCycle, steps_of

__all__ = ["NormalizerTask"]


def _adamw(params: Iterable[nn.Parameter]) -> Optimizer:
    return torch.optim.AdamW(params, lr=3e-3)


class NormalizerTask(pl.LightningModule):
    """Train a learned normaliser by back-propagating a residual through the whole eight-point algorithm.

    Validation and test log the mean log residual and the better rates against Hartley and whitening on the samples'
    own points; prediction returns the transforms, the fundamental matrix and the residual of each sample.

    Of several processes, all samples count the same, however they are distributed. In training, validation and test,
    samples with a NaN or infinite coordinate are left out and counted: ``train/left_out``. A step without any other
    sample, or with a gradient that is not finite, leaves the weights and the optimiser as they are, with a warning, and
    is counted: ``train/skipped``.

    Args:
        normalizer: the normaliser to train.
        loss: residual and reduction.
        optimizer: builds the optimiser from the parameters; AdamW with a learning rate of 3e-3 when not given.
        lr_scheduler: builds a schedule that steps once an epoch; when not given, one cycle over all steps of the run
            up to the optimiser's learning rate.
        sample_gradient: largest norm of one sample's gradient with respect to its predicted parameters, before the
            batch's average. Near-degenerate samples have gradients a thousand times the typical one, and a clip of the
            whole batch would leave only their direction. None leaves all as they are.
    """

    def __init__(
        self,
        normalizer: LearnedNormalizer,
        loss: EpipolarLoss | None = None,
        optimizer: Callable[[Iterable[nn.Parameter]], Optimizer] = _adamw,
        lr_scheduler: Callable[[Optimizer], LRScheduler] | None = None,
        sample_gradient: float | None = 1.0,
    ) -> None:
        super().__init__()
        self.normalizer = normalizer.train()  # shipped weights come in evaluation mode
        self.loss = loss or EpipolarLoss()
        self.optimizer = optimizer
        self.lr_scheduler = lr_scheduler
        self.sample_gradient = sample_gradient
        self.baselines: dict[str, Normalizer] = {"hartley": Hartley(), "whitening": Whitening()}
        self.better_than_hartley, self.better_than_whitening = BetterRateMetric(), BetterRateMetric()
        self._log_residuals: list[Tensor] = []  # since the last validation or test
        self._left_out = 0  # since the last validation or test
        self._samples = 0  # of all processes since the last step

    def configure_optimizers(self) -> Any:
        """Build the optimiser and its schedule."""
        optimizer = self.optimizer(p for p in self.parameters() if p.requires_grad)
        if self.lr_scheduler is not None:
            return {"optimizer": optimizer, "lr_scheduler": {"scheduler": self.lr_scheduler(optimizer)}}
        schedule = OneCycle(optimizer, max_lr=optimizer.param_groups[0]["lr"], total_steps=steps_of(self.trainer))
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def forward(self, points1: Tensor, points2: Tensor, weights: Tensor | None = None) -> Tensor:
        """Return the fundamental matrices of correspondences; see :func:`kornia_learnnorm.find_fundamental`."""
        return find_fundamental(points1, points2, weights, self.normalizer)

    def training_step(self, batch: Samples, batch_idx: int) -> Tensor:
        """Log the loss of the batch of all processes and return the part of it that this one's samples make."""
        batch, left_out = _finite(batch)
        samples = len(batch.pair)
        # Without samples, all weights still take part: the other processes wait for their gradients.
        loss = self.compute_loss(batch) if samples else 0 * torch.stack([p.sum() for p in self.parameters()]).sum()
        total, all_left_out, all_samples = self._sum(samples * loss.detach(), left_out, samples)
        of_all = int(all_samples)
        self._samples += of_all
        self.log("train/loss", total / max(of_all, 1), prog_bar=True)
        self.log("train/left_out", all_left_out)
        return loss * (samples * self.trainer.world_size / max(of_all, 1))  # gradients are averaged over processes

    def on_before_optimizer_step(self, optimizer: Optimizer) -> None:
        """Skip a step that has no samples, or whose gradient is not finite: the same one in all processes."""
        finite = all(bool(p.grad.isfinite().all()) for p in self.parameters() if p.grad is not None)
        skipped = self._samples == 0 or not finite
        if skipped:
            rank_zero_warn(f"a step was skipped: {'non-finite gradient' if self._samples else 'no samples'}")
            for p in self.parameters():
                p.grad = None  # an optimiser leaves these alone
        self.log("train/skipped", float(skipped))
        self._samples = 0

    def _sum(self, *numbers: Tensor | float) -> list[Tensor]:
        """Sum numbers over all processes."""
        dtype = solve_dtype(self.device)
        own = torch.stack([torch.as_tensor(number, dtype=dtype, device=self.device) for number in numbers])
        return list(self.trainer.strategy.reduce(own, reduce_op="sum"))

    def compute_loss(self, batch: Samples) -> Tensor:
        """Return the loss of a batch of samples, each sample's gradient limited where it enters the network."""
        x1, x2 = batch.points1.double(), batch.points2.double()
        arrived: list[Tensor] = []
        with self._limited_gradients(arrived):
            F_mat = self(x1, x2)
        loss: Tensor = self.loss(x1, x2, F_mat, batch.heldout1.double(), batch.heldout2.double())
        if loss.requires_grad:
            loss.register_hook(arrived.append)  # type: ignore[no-untyped-call]
        return loss

    @contextmanager
    def _limited_gradients(self, arrived: list[Tensor]) -> Iterator[None]:
        """Attach the limit to the network's outputs while the block runs.

        Processes, accumulated batches and the scaler of half precision multiply the loss after it is computed. What
        they make of its gradient arrives in a list, and the limit is multiplied alike.
        """

        def limit(gradient: Tensor) -> Tensor:
            most = self.sample_gradient * arrived[-1] / len(gradient)  # type: ignore[operator]
            norm: Tensor = torch.linalg.vector_norm(gradient, dim=-1, keepdim=True)
            return gradient * torch.where(norm > most, most / norm, 1.0)

        def attach(module: nn.Module, args: Any, params: tuple[Tensor, Tensor]) -> None:
            for p in params:
                if p.requires_grad and self.sample_gradient is not None:
                    p.register_hook(limit)  # type: ignore[no-untyped-call]

        handle = self.normalizer.network.register_forward_hook(attach)
        try:
            yield
        finally:
            handle.remove()

    def validation_step(self, batch: Samples, batch_idx: int) -> None:
        """Collect the residuals of a batch, in the test too."""
        batch, left_out = _finite(batch)
        self._left_out += left_out
        problem = LinearProblem.from_points(batch.points1, batch.points2)
        learned = self._residuals(problem, self.normalizer)
        self._log_residuals.append((learned + self.loss.floor).log())
        for name, normalizer in self.baselines.items():
            getattr(self, f"better_than_{name}").update(learned, self._residuals(problem, normalizer))

    test_step = validation_step

    def predict_step(self, batch: Samples, batch_idx: int) -> dict[str, Tensor]:
        """Return transforms, fundamental matrices and mean residuals of a batch."""
        x1, x2 = batch.points1.double(), batch.points2.double()  # in float32, F itself loses digits of the residual
        problem = LinearProblem.from_points(x1, x2)
        T1, T2 = self.normalizer.transforms(problem)
        F_mat = solve_in_coordinates(problem, T1, T2)
        residual = symmetric_epipolar_distance(x1, x2, F_mat).mean(-1)
        return {"T1": T1, "T2": T2, "F_mat": F_mat, "residual": residual, "pair": batch.pair}

    def on_validation_epoch_end(self) -> None:
        """Log the metrics of the collected residuals."""
        self._log_metrics("val")

    def on_test_epoch_end(self) -> None:
        """Log the metrics of the collected residuals."""
        self._log_metrics("test")

    def _residuals(self, problem: LinearProblem, normalizer: Normalizer) -> Tensor:
        """Return the mean symmetric epipolar distance of each sample under a normaliser, (B,)."""
        F_mat = solve_fundamental(problem, normalizer)
        return symmetric_epipolar_distance(problem.points1, problem.points2, F_mat).mean(-1)

    def _log_metrics(self, stage: str) -> None:
        """Log the metrics of the samples of all processes; NaN where there are none."""
        own = torch.cat([torch.zeros(0, device=self.device), *self._log_residuals])
        total, samples, left_out = self._sum(own.sum(), len(own), self._left_out)
        self._log_residuals, self._left_out = [], 0
        self.log(f"{stage}/log_sed", total / samples, prog_bar=True, sync_dist=True)
        for name in self.baselines:
            metric: BetterRateMetric = getattr(self, f"better_than_{name}")
            rate = metric.compute()["better_rate"]
            self.log(f"{stage}/better_than_{name}", rate, prog_bar=True, sync_dist=True)
            metric.reset()
        self.log(f"{stage}/left_out", left_out, sync_dist=True)


def _finite(batch: Samples) -> tuple[Samples, int]:
    """Return the samples whose coordinates are all finite, and how many others there are."""
    finite = torch.stack([points.isfinite().flatten(1).all(1) for points in batch[:4]]).all(0)
    left_out = len(finite) - int(finite.sum())
    return (batch.select(finite) if left_out else batch), left_out
