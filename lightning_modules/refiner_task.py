"""The training task of a refiner of matches: image pairs and their matches in, no labels needed."""

from typing import Any

import torch
from kornia.geometry.epipolar import fundamental_from_essential
from torch import Tensor, nn

from kornia_learnnorm import RANSAC, EightPoint, LearnedEightPoint, LearnedRelativePose, MatchRefiner
from kornia_learnnorm.data.match_sets import MatchSets
from kornia_learnnorm.estimators.match_refiner import RefinedMatches
from kornia_learnnorm.geometry.distances import symmetric_epipolar_distance
from lightning_modules.task import EstimatorTask, Median, cameras_of

TRUE_MATCH = 4.0  # pixels, the largest distance of the found matches that the validation's medians are of


class HeldOutLoss(nn.Module):
    r"""Distances of one half of the moved matches under the matrix of the other half, and the reverse.

    The matrix comes from an estimator, which is not trained and sends gradients to the points of its half. The loss is
    the mean of :math:`\log(d + f)` with the symmetric epipolar distance :math:`d`, at most ``ceiling``. The predicted
    noise :math:`\sigma` is trained by the likelihood of :math:`d / 2` under Laplace's distribution.

    Args:
        estimator: :class:`~kornia_learnnorm.LearnedEightPoint`, ``robust-synthetic`` when not given;
            :class:`~kornia_learnnorm.LearnedRelativePose`, which needs stores with cameras;
            :class:`~kornia_learnnorm.EightPoint`; or :class:`~kornia_learnnorm.RANSAC`, which sends no gradients.
        floor: distance :math:`f` in pixels, far below which nothing is gained.
        ceiling: larger distances, pixels, count as this and send no gradient. ValueError unless both are positive.
        scale_weight: weight of the likelihood.
        detach: hold the matrices fixed, so that no gradient passes the estimator.
        labels: use the true matrix instead, in sets where it is known.
    """

    def __init__(
        self,
        estimator: nn.Module | None = None,
        floor: float = 0.05,
        ceiling: float = 6.0,
        scale_weight: float = 0.2,
        detach: bool = False,
        labels: bool = False,
    ) -> None:
        super().__init__()
        estimator = LearnedEightPoint.from_pretrained() if estimator is None else estimator
        if not isinstance(estimator, LearnedEightPoint | LearnedRelativePose | EightPoint | RANSAC):
            raise TypeError(f"expected an estimator of fundamental matrices, got {type(estimator).__name__}")
        if not min(floor, ceiling) > 0:
            raise ValueError(f"floor and ceiling must be positive, got {floor} and {ceiling}")
        self.estimator = estimator.requires_grad_(False).train()  # of no effect, but Lightning warns of other modes
        self.floor, self.ceiling, self.scale_weight = floor, ceiling, scale_weight
        self.detach, self.labels = detach, labels

    def forward(self, sets: MatchSets, moved: RefinedMatches) -> Tensor:
        """Return the loss of each set, (B,), of the moved matches (B, 2 N), in the order of :func:`all_matches`."""
        distance = self.distances(sets, moved.points1, moved.points2).clamp(max=self.ceiling)
        likelihood = moved.scale.log() + 2**0.5 * 0.5 * distance.detach() / moved.scale
        return ((distance + self.floor).log() + self.scale_weight * likelihood).mean(-1)

    def distances(self, sets: MatchSets, points1: Tensor, points2: Tensor) -> Tensor:
        """Return the distances (B, 2 N) of both halves of matches, each under the matrix of the other half."""
        halves1, halves2 = (torch.cat([*points.double().chunk(2, 1)]) for points in (points1, points2))  # (2 B, N, 2)
        F_mat = self._estimate(sets, halves1, halves2).roll(len(points1), 0)
        F_mat = F_mat.detach() if self.detach else F_mat
        if self.labels and sets.E_mat is not None:
            true = fundamental_from_essential(sets.E_mat.double(), *cameras_of(sets)).repeat(2, 1, 1)
            F_mat = torch.where(true.isfinite().all(-1).all(-1)[:, None, None], true, F_mat)
        return torch.cat(symmetric_epipolar_distance(halves1, halves2, F_mat).chunk(2), 1)

    def _estimate(self, sets: MatchSets, halves1: Tensor, halves2: Tensor) -> Tensor:
        """Return the matrices (2 B, 3, 3) of halves (2 B, N, 2)."""
        if isinstance(self.estimator, RANSAC):  # of one pair
            pairs = zip(halves1.detach(), halves2.detach(), strict=True)
            return torch.stack([self.estimator(*pair)[0] for pair in pairs])
        calibrated = isinstance(self.estimator, LearnedRelativePose)
        cameras = [K.repeat(2, 1, 1) for K in cameras_of(sets)] if calibrated else []
        return self.estimator.estimate(halves1, halves2, *cameras).F_mat


def all_matches(sets: MatchSets) -> tuple[Tensor, Tensor]:
    """Return the points (B, 2 N, 2) of both views, first those of the sets, then the held-out ones."""
    return torch.cat([sets.points1, sets.heldout1], 1), torch.cat([sets.points2, sets.heldout2], 1)


class RefinerTask(EstimatorTask):
    """Train a :class:`~kornia_learnnorm.MatchRefiner` by the agreement of the matches that it moves, without labels.

    The data are sets with images, of :class:`~kornia_learnnorm.data.image_sets.ImageSets`. Validation logs the median
    distance of matches under the matrix of other matches of their pair, as they were found and moved.

    Args:
        refiner: the refiner to train.
        loss: the loss, :class:`HeldOutLoss` when not given.
        options: ``optimizer``, ``lr_scheduler`` and ``warm_up`` of :class:`~lightning_modules.task.EstimatorTask`.
    """

    loss: HeldOutLoss
    trains = (MatchRefiner,)
    errors = ("median_moved",)

    def __init__(self, refiner: MatchRefiner, loss: HeldOutLoss | None = None, **options: Any) -> None:
        super().__init__(refiner, loss or HeldOutLoss(), sample_gradient=None, **options)
        for name in ("found", "moved"):
            self.metrics[f"median_{name}"] = Median().set_dtype(torch.float64)

    def compute_loss(self, batch: MatchSets) -> Tensor:
        """Return the mean loss of a batch."""
        loss: Tensor = self.loss(batch, self._move(batch)).mean()
        return loss

    def validation_step(self, batch: MatchSets, batch_idx: int) -> None:
        """Log the medians of a batch, in the test too; Lightning gathers them over batches and processes."""
        moved, before = self._move(batch), self.loss.distances(batch, *all_matches(batch))
        after = self.loss.distances(batch, moved.points1, moved.points2)
        for name, distance in (("found", before), ("moved", after)):
            self._log(f"median_{name}", distance[before < TRUE_MATCH])

    test_step = validation_step

    def predict_step(self, batch: MatchSets, batch_idx: int) -> dict[str, Tensor]:
        """Return the moved matches of a batch and the predicted noise."""
        return {**self._move(batch)._asdict(), "pair": batch.pair}

    def _move(self, batch: MatchSets) -> RefinedMatches:
        if batch.image1 is None or batch.image2 is None:
            raise ValueError("a refiner needs sets with images, of ImageSets, got none")
        moved: RefinedMatches = self.estimator(batch.image1, batch.image2, *all_matches(batch))
        return moved
