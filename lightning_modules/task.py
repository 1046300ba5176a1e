"""The training task: sets of correspondences in, losses of the estimated matrices out, with labels or without."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any, ClassVar, cast

import pytorch_lightning as pl
import torch
from kornia.geometry.epipolar import fundamental_from_essential
from pytorch_lightning.utilities import rank_zero_warn
from torch import Tensor, nn
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler, OneCycleLR
from torchmetrics import CatMetric, MeanMetric, Metric, SumMetric

from kornia_learnnorm import EightPoint, Hartley, LearnedNormalizer, LearnedRelativePose, Whitening
from kornia_learnnorm.data.match_sets import MatchSets
from kornia_learnnorm.estimators.learned_layer import LearnedLayer
from kornia_learnnorm.geometry.checks import solve_dtype
from kornia_learnnorm.geometry.distances import symmetric_epipolar_distance
from kornia_learnnorm.metrics.statistics import comparable
from kornia_learnnorm.training_losses import BoundedEpipolarLoss, InlierLoss, LogEpipolarLoss, LogEssentialLoss

__all__ = ["EstimatorTask", "Median", "SetLoss", "adamw", "cameras_of"]

EARLY_STAGE = 0.3  # weight of the losses of all stages but the last
MAX_SKIPPED = 20  # steps in a row without a finite gradient, after which a training ends
RESIDUAL_FLOOR = 1e-3  # pixels, added to the residuals under the logarithm of the validation
BASELINES = {"hartley": EightPoint(Hartley()), "whitening": EightPoint(Whitening())}
SIZES = {32: "32", 256: "256", 10**9: "1000"}  # largest number of matches in a set, and the name of its median


def adamw(params: Iterable[nn.Parameter]) -> Optimizer:
    """Return AdamW with a learning rate of 2e-3."""
    return torch.optim.AdamW(params, lr=2e-3)


class SetLoss(nn.Module):
    """Loss of sets of matches with outliers, with ground truth or without.

    Args:
        label_free: loss of all matches of the sets without ground truth, times ``label_free_weight``.
        labelled: loss of the true inliers of the sets with ground truth.
        inlier_weight: weight of the cross-entropy of the logits, which is added to ``labelled``.
        label_free_weight: weight of the label-free loss.
        pose: loss of essential matrices and the true ones.
        pose_weight: share of ``pose``, 0 to 1, in the loss of labelled sets with cameras; the rest is ``labelled``'s.
    """

    def __init__(
        self,
        label_free: BoundedEpipolarLoss | None = None,
        labelled: LogEpipolarLoss | None = None,
        inlier_weight: float = 0.3,
        label_free_weight: float = 4.0,
        pose: LogEssentialLoss | None = None,
        pose_weight: float = 0.0,
    ) -> None:
        super().__init__()
        if not 0 <= pose_weight <= 1:
            raise ValueError(f"pose_weight must be in [0, 1], got {pose_weight}")
        self.label_free = label_free or BoundedEpipolarLoss()
        self.labelled = labelled or LogEpipolarLoss()
        self.inlier = InlierLoss()
        self.pose = pose or LogEssentialLoss()
        self.inlier_weight, self.label_free_weight, self.pose_weight = inlier_weight, label_free_weight, pose_weight

    def forward(self, sets: MatchSets, F_mat: Tensor, logits: Tensor | None) -> Tensor:
        """Return the loss of each set, (B,), of its matrix (B, 3, 3) and the logits of its matches (B, N), if any."""
        heldout1, heldout2 = sets.heldout1.double(), sets.heldout2.double()
        unknown: Tensor = self.label_free_weight * self.label_free(heldout1, heldout2, F_mat)
        if sets.labelled is None:
            return unknown
        known = self.labelled(heldout1, heldout2, F_mat)
        if self.pose_weight and sets.K1 is not None and sets.K2 is not None and sets.E_mat is not None:
            calibrated = sets.E_mat.isfinite().flatten(1).all(1)
            eye = torch.eye(3).to(F_mat)  # where unknown: NaN has no derivative that can be dropped
            given = calibrated[:, None, None]
            K1, K2, true = (torch.where(given, value.to(F_mat), eye) for value in (sets.K1, sets.K2, sets.E_mat))
            share = self.pose_weight * calibrated
            known = (1 - share) * known + share * self.pose(K2.mT @ F_mat @ K1, true)
        if logits is not None and sets.inliers is not None:
            known = known + self.inlier_weight * self.inlier(logits, sets.inliers)
        return torch.where(sets.labelled, known, unknown)


class EstimatorTask(pl.LightningModule):
    """Train an estimator, or the normaliser within it, by back-propagating a loss of its matrices.

    With :class:`SetLoss`, validation and test log the median distance of the held-out matches by the size of the sets;
    with another loss, the mean log residual of the samples' own points and the better rates against Hartley and
    whitening. Sets with a NaN or infinite coordinate, or for a relative pose without cameras, are left out and counted:
    ``train/left_out``. A step without any other set, or with a gradient that is not finite, changes nothing, warns, and
    is counted: ``train/skipped``; twenty in a row are a ValueError.

    Args:
        estimator: the estimator to train: a :class:`~kornia_learnnorm.LearnedEightPoint`, a
            :class:`~kornia_learnnorm.LearnedRelativePose`, which needs sets with cameras, or an
            :class:`~kornia_learnnorm.EightPoint` with a :class:`~kornia_learnnorm.LearnedNormalizer`.
        loss: module of ``(points1, points2, F_mat, heldout1, heldout2)`` that returns a scalar or a loss for each set,
            such as :class:`~kornia_learnnorm.EpipolarLoss` or your own; :class:`SetLoss` when not given.
        optimizer: builds the optimiser from the parameters; AdamW with a learning rate of 2e-3 when not given.
        lr_scheduler: builds a schedule that steps once an epoch; when not given, one cycle over all steps of the run
            up to the optimiser's learning rate, and of beta 1 where it is 0.9, PyTorch's default.
        warm_up: share of the cycle in which the learning rate rises.
        sample_gradient: largest norm of one set's gradient with respect to the outputs of a network, before the batch's
            average, since near-degenerate sets have gradients a thousand times the typical one. None for no limit.
    """

    trains: ClassVar[tuple[type[nn.Module], ...]] = (LearnedLayer, EightPoint)
    # Metrics of the validation whose decrease is what the training is for.
    errors: ClassVar = ("log_sed", *(f"median_{name}" for name in SIZES.values()))

    def __init__(
        self,
        estimator: nn.Module,
        loss: nn.Module | None = None,
        optimizer: Callable[[Iterable[nn.Parameter]], Optimizer] = adamw,
        lr_scheduler: Callable[[Optimizer], LRScheduler] | None = None,
        warm_up: float = 0.05,
        sample_gradient: float | None = 1.0,
    ) -> None:
        super().__init__()
        if not isinstance(estimator, self.trains):
            expected = " or ".join(kind.__name__ for kind in self.trains)
            raise TypeError(f"expected a {expected}, got {type(estimator).__name__}")
        if sample_gradient is not None and not sample_gradient > 0:
            raise ValueError(f"sample_gradient must be positive or None, got {sample_gradient}")
        if isinstance(estimator, EightPoint) and not isinstance(estimator.normalizer, LearnedNormalizer):
            raise TypeError(f"expected a LearnedNormalizer in EightPoint, got {type(estimator.normalizer).__name__}")
        self.estimator = cast(LearnedLayer | EightPoint, estimator.train())  # shipped weights come in evaluation mode
        self.loss = loss or SetLoss()
        self.optimizer, self.lr_scheduler = optimizer, lr_scheduler
        self.warm_up, self.sample_gradient = warm_up, sample_gradient
        metrics: dict[str, Metric] = {"left_out": SumMetric(), "log_sed": MeanMetric()}
        metrics |= {f"better_than_{name}": MeanMetric() for name in BASELINES}
        metrics |= {f"median_{name}": Median() for name in SIZES.values()}
        self.metrics = nn.ModuleDict({name: metric.set_dtype(torch.float64) for name, metric in metrics.items()})
        self._sets = 0  # of all processes since the last step
        self._skipped = 0  # steps in a row

    @property
    def trained(self) -> LearnedLayer | LearnedNormalizer:
        """The module that learns, whose weights ``from_pretrained`` reads."""
        if isinstance(self.estimator, EightPoint):
            return cast(LearnedNormalizer, self.estimator.normalizer)
        return self.estimator

    def configure_optimizers(self) -> Any:
        """Build the optimiser and its schedule."""
        optimizer = self.optimizer(p for p in self.parameters() if p.requires_grad)
        # Lightning clips no gradients that a fused optimiser would unscale; so it has them unscaled before.
        optimizer._step_supports_amp_scaling = False  # type: ignore[attr-defined]  # noqa: SLF001
        if self.lr_scheduler is not None:
            return {"optimizer": optimizer, "lr_scheduler": {"scheduler": self.lr_scheduler(optimizer)}}
        if self.trainer.estimated_stepping_batches == float("inf"):
            expected = "give trainer.max_steps or trainer.max_epochs; trainer.max_time may end the training before"
            raise ValueError(f"the learning rate follows one cycle over all steps: {expected}")
        steps = max(2, int(self.trainer.estimated_stepping_batches))
        share = max(self.warm_up, 1.5 / steps)  # the schedule divides by the warm-up's steps less one
        group = optimizer.param_groups[0]
        cycled = group.get("betas", (0.0,))[0] == 0.9  # PyTorch's default; another one, or a momentum, stays
        schedule = OneCycle(optimizer, group["lr"], total_steps=steps, pct_start=share, cycle_momentum=cycled)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def training_step(self, batch: MatchSets, batch_idx: int) -> Tensor:
        """Log the loss of the batch of all processes and return the part of it that this one's sets make."""
        batch, left_out = self._finite(batch)
        number = len(batch.points1)
        # Without sets, all weights still take part: the other processes wait for their gradients.
        loss = self.compute_loss(batch) if number else 0 * torch.stack([p.sum() for p in self.parameters()]).sum()
        own = torch.stack([number * loss.detach(), loss.new_tensor(left_out), loss.new_tensor(number)])
        total, all_left_out, all_sets = self.trainer.strategy.reduce(own.to(solve_dtype(self.device)), reduce_op="sum")
        of_all = int(all_sets)
        self._sets += of_all
        self.log("train/loss", total / max(of_all, 1), prog_bar=True)
        self.log("train/left_out", all_left_out)
        return loss * (number * self.trainer.world_size / max(of_all, 1))  # gradients are averaged over processes

    def on_before_optimizer_step(self, optimizer: Optimizer) -> None:
        """Skip a step that has no sets, or whose gradient is not finite: the same one in all processes."""
        finite = all(bool(p.grad.isfinite().all()) for p in self.parameters() if p.grad is not None)
        if skipped := self._sets == 0 or not finite:
            rank_zero_warn(f"a step was skipped: {'non-finite gradient' if self._sets else 'no samples'}")
            self.zero_grad()  # to None, which an optimiser leaves alone
        self.log("train/skipped", float(skipped))
        self._sets, self._skipped = 0, self._skipped + 1 if skipped else 0
        if self._skipped == MAX_SKIPPED:
            why = "no samples, or no finite gradient of the loss"
            raise ValueError(f"{MAX_SKIPPED} steps in a row were skipped: {why}")

    def _finite(self, batch: MatchSets) -> tuple[MatchSets, int]:
        """Return the sets that are finite, with the cameras that a pose needs, and how many others there are."""
        if isinstance(self.loss, SetLoss) and batch.heldout1.shape[1] == 0:
            raise ValueError("SetLoss needs held-out correspondences, got none: set num_heldout of the data")
        cameras = cameras_of(batch) if isinstance(self.estimator, LearnedRelativePose) else ()
        finite = torch.stack([part.isfinite().flatten(1).all(1) for part in (*batch[:4], *cameras)]).all(0)
        left_out = len(finite) - int(finite.sum())
        return (batch.select(finite) if left_out else batch), left_out

    def compute_loss(self, batch: MatchSets) -> Tensor:
        """Return the loss of a batch, of all stages, each set's gradient limited where it enters the networks."""
        points1, points2, *heldout = (points.double() for points in batch[:4])
        arrived: list[Tensor] = []
        with self._limited_gradients(arrived):
            stages = self._stages(batch)
        total = points1.new_zeros(())
        of_sets = isinstance(self.loss, SetLoss)
        for number, (F_mat, logits) in enumerate(stages, 1):
            loss = self.loss(batch, F_mat, logits) if of_sets else self.loss(points1, points2, F_mat, *heldout)
            if not of_sets and (not isinstance(loss, Tensor) or loss.shape not in ((), F_mat.shape[:1])):
                got = [*loss.shape] if isinstance(loss, Tensor) else type(loss)
                raise ValueError(f"a loss must return a scalar or one number for each of {len(F_mat)} sets, got {got}")
            total = total + (1.0 if number == len(stages) else EARLY_STAGE) * loss.mean()
        if total.requires_grad:
            total.register_hook(arrived.append)  # type: ignore[no-untyped-call]
        return total

    def _stages(self, batch: MatchSets) -> list[tuple[Tensor, Tensor | None]]:
        """Return the matrices of each stage, which its own losses train, and the logits where there are some."""
        layer, points = self.estimator, (batch.points1.double(), batch.points2.double())
        if not isinstance(layer, LearnedLayer):
            return [(layer(*points), None)]
        before, layer.detach_stages = layer.detach_stages, True
        try:
            if not isinstance(layer, LearnedRelativePose):
                return [*layer.estimate(*points, scores=batch.scores).stages]
            cameras = cameras_of(batch)
            stages = layer.estimate(*points, *cameras, scores=batch.scores).stages
            return [(fundamental_from_essential(stage.E_mat, *cameras), stage.logits) for stage in stages]
        finally:
            layer.detach_stages = before

    def _estimate(self, batch: MatchSets) -> Tensor:
        """Return the matrices of the estimator, without scores."""
        points = batch.points1.double(), batch.points2.double()  # in float32, F itself loses digits of the residual
        if isinstance(self.estimator, LearnedRelativePose):
            return self.estimator.estimate(*points, *cameras_of(batch)).F_mat
        F_mat: Tensor = self.estimator(*points)
        return F_mat

    @contextmanager
    def _limited_gradients(self, arrived: list[Tensor]) -> Iterator[None]:
        """Attach the limit, times the gradient of the loss that arrives in a list, to the networks' outputs."""

        def limit(gradient: Tensor) -> Tensor:
            most = self.sample_gradient * arrived[-1] / len(gradient)  # type: ignore[operator]
            norm: Tensor = torch.linalg.vector_norm(gradient, dim=-1, keepdim=True)
            return gradient * torch.where(norm > most, most / norm, 1.0)

        def attach(module: nn.Module, args: Any, outputs: tuple[Tensor, Tensor]) -> None:
            for output in outputs:
                if output.requires_grad and self.sample_gradient is not None:
                    output.register_hook(limit)  # type: ignore[no-untyped-call]

        trained = self.trained
        networks = [trained.network] if isinstance(trained, LearnedNormalizer) else trained.networks
        with ExitStack() as stack:
            for network in networks:
                stack.enter_context(network.register_forward_hook(attach))  # removed when the block ends
            yield

    def validation_step(self, batch: MatchSets, batch_idx: int) -> None:
        """Log the metrics of a batch, in the test too; Lightning gathers them over batches and processes."""
        batch, left_out = self._finite(batch)
        points = batch.points1.double(), batch.points2.double()
        F_mat = self._estimate(batch)
        if isinstance(self.loss, SetLoss):
            size = next(name for largest, name in SIZES.items() if batch.points1.shape[1] <= largest)
            error = self.loss.labelled.residual(batch.heldout1.double(), batch.heldout2.double(), F_mat)
            self._log(f"median_{size}", error.median(-1).values)
        else:
            residual = symmetric_epipolar_distance(*points, F_mat).mean(-1)
            self._log("log_sed", (residual + RESIDUAL_FLOOR).log())
            for name, baseline in BASELINES.items():
                other = symmetric_epipolar_distance(*points, baseline(*points)).mean(-1)
                self._log(f"better_than_{name}", (residual < other)[comparable(residual, other)].double())
        self._log("left_out", torch.tensor(float(left_out)))

    test_step = validation_step

    def _log(self, name: str, value: Tensor) -> None:
        metric = cast(Metric, self.metrics[name])
        metric.update(value)
        stage = "test" if self.trainer.testing else "val"
        self.log(f"{stage}/{name}", metric, prog_bar=name in self.errors, on_epoch=True, on_step=False)

    def predict_step(self, batch: MatchSets, batch_idx: int) -> dict[str, Tensor]:
        """Return matrices, mean residuals and, of a normaliser, transforms of a batch."""
        points, F_mat = (batch.points1.double(), batch.points2.double()), self._estimate(batch)
        distance = self.loss.labelled.residual if isinstance(self.loss, SetLoss) else symmetric_epipolar_distance
        residual = distance(*points, F_mat).mean(-1)
        found = {"F_mat": F_mat, "residual": residual, "pair": batch.pair}
        if isinstance(self.trained, LearnedNormalizer):
            found["T1"], found["T2"] = self.trained(*points)
        return found


def cameras_of(batch: MatchSets) -> tuple[Tensor, Tensor]:
    """Return the cameras of sets, (B, 3, 3) x 2."""
    if batch.K1 is None or batch.K2 is None:
        raise ValueError("LearnedRelativePose needs sets with cameras, got none")
    return batch.K1.double(), batch.K2.double()


class OneCycle(OneCycleLR):
    """PyTorch's schedule, which goes on only in a training of as many steps and the same rate.

    Elsewhere it fails, ends too early, or ignores the new rate.
    """

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Load the state of a checkpoint, which must be of a training of as many steps and the same rate."""
        had, now = (
            f"{found['total_steps']} steps from a learning rate of {found['base_lrs'][0]:.4g}"
            for found in (state_dict, vars(self))
        )
        if had != now:
            text = f"the checkpoint is of a training of {had}, one cycle of learning rates"
            raise ValueError(f"{text}; got {now}: keep both, or begin a new run elsewhere")
        super().load_state_dict(state_dict)


class Median(CatMetric):
    """The median of all values, the lower one of two."""

    def compute(self) -> Tensor:
        """Return the median; NaN without values."""
        values = super().compute()  # an empty list without any
        return values.median() if isinstance(values, Tensor) else torch.tensor(torch.nan)
