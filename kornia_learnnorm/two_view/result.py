"""The estimate of an image pair: its fields, the JSON object and the printed text."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from torch import Tensor

from kornia_learnnorm.geometry.distances import symmetric_epipolar_distance
from kornia_learnnorm.metrics.median import median
from kornia_learnnorm.two_view.warnings import PairWarning

__all__ = ["NoReliableMatrixError", "PairEstimate", "package_versions"]


class NoReliableMatrixError(ValueError):
    """The images or matches do not determine a fundamental matrix; ``code`` is one word for programs."""

    def __init__(self, code: str, text: str) -> None:
        super().__init__(text)
        self.code = code


@dataclass(frozen=True, eq=False)
class PairEstimate:
    r"""The fundamental matrix of two images and the correspondences behind it; pixels are those of the full images."""

    F_mat: Tensor  # (3, 3), float64, unit Frobenius norm, x2^T F x1 = 0 in pixels
    E_mat: Tensor | None  # essential matrix (3, 3) nearest to K2^T F K1, unit Frobenius norm; None without cameras
    R: Tensor | None  # rotation (3, 3) of X2 = R X1 + t; None without cameras, and where two poses tie
    t: Tensor | None  # direction of translation (3,); None without cameras
    estimator: str  # what made F_mat: "RANSAC" or "LearnedEightPoint"
    points1: Tensor  # pixels of the matches in image 1, (N, 2), float64
    points2: Tensor  # pixels of the matches in image 2, (N, 2), float64
    scores: Tensor  # of each match, 1 minus its ratio or the matcher's score, (N,), float64
    weights: Tensor  # probability of each match to be an inlier as the estimator sees it, (N,), float64
    inliers: Tensor  # mask of the matches with a distance to F_mat below the threshold, (N,), bool
    front: Tensor | None  # mask of the matches in front of both cameras, (N,), bool; None without cameras
    predicted_error: float  # median symmetric epipolar distance of exact correspondences that is expected, pixels
    warnings: tuple[PairWarning, ...]  # reasons to doubt F_mat; empty when all is well
    size1: tuple[int, int]  # width and height of image 1
    size2: tuple[int, int]  # width and height of image 2
    ratio: float | None  # largest ratio of nearest to second-nearest descriptor distance; None where there is no limit
    threshold: float  # largest symmetric epipolar distance of an inlier, pixels; of the full images as the points are
    seed: int
    path1: Path | None = None
    path2: Path | None = None

    @property
    def num_matches(self) -> int:
        """Number of one-to-one matches."""
        return len(self.points1)

    @property
    def num_inliers(self) -> int:
        """Number of matches within the threshold."""
        return int(self.inliers.sum())

    @property
    def median_distance(self) -> float:
        """Median symmetric epipolar distance of the inliers, pixels."""
        inlying = self.points1[self.inliers], self.points2[self.inliers]
        return median(symmetric_epipolar_distance(*inlying, self.F_mat)).item()

    def as_dict(self, matches: bool = True) -> dict[str, Any]:
        """Return all of it, or all but what each match has, as what JSON can hold."""

        def view(path: Path | None, size: tuple[int, int]) -> dict[str, Any]:
            return {"file": None if path is None else str(path), "width": size[0], "height": size[1]}

        content = {
            "F": self.F_mat,
            "E": self.E_mat,
            "R": self.R,
            "t": self.t,
            "convention": "x2^T F x1 = 0, x = (column, row, 1) in pixels, X2 = R X1 + t; F and E have unit norm",
            "predicted_error_px": self.predicted_error,
            "warnings": [warning._asdict() for warning in self.warnings],
            "image1": view(self.path1, self.size1),
            "image2": view(self.path2, self.size2),
            "estimator": self.estimator,
            "seed": self.seed,
            "ratio": self.ratio,
            "threshold_px": self.threshold,
            "num_matches": self.num_matches,
            "num_inliers": self.num_inliers,
            "versions": package_versions(),
        }
        if matches:
            content |= {name: getattr(self, name) for name in ("points1", "points2", "scores", "weights", "inliers")}
            content["in_front"] = self.front
        return {name: value.tolist() if isinstance(value, Tensor) else value for name, value in content.items()}

    def summary(self) -> str:
        """Return F row by row, the pose with cameras, the counts, the predicted error and the warnings as text."""

        def rows(M: Tensor) -> list[str]:
            return ["  " + " ".join(f"{value: .9e}" for value in row) for row in M.tolist()]

        lines = ["F (x2^T F x1 = 0 in pixels, unit Frobenius norm)", *rows(self.F_mat)]
        if self.R is not None and self.t is not None:
            lines += ["R (X2 = R X1 + t)", *rows(self.R), "t (direction)", *rows(self.t[None])]
        ratio = "" if self.ratio is None else f" (ratio test {self.ratio:g})"
        share = self.num_inliers / self.num_matches
        within = f"symmetric epipolar distance < {self.threshold:.3g} px, median {self.median_distance:.2f} px"
        error = f"{self.predicted_error:.2f} px (typical error of epipolar lines where true matches lie)"
        lines += [f"by       {self.estimator}, seed {self.seed}", f"matches  {self.num_matches}{ratio}"]
        lines += [f"inliers  {self.num_inliers} ({share:.1%}), {within}", f"error    predicted error of F: {error}"]
        return "\n".join([*lines, *(f"warning  {warning.code}: {warning.text}" for warning in self.warnings)])


def package_versions() -> dict[str, str]:
    """Return the versions of the packages that an estimate depends on."""
    return {name: version(name) for name in ("kornia-learnnorm", "kornia", "torch")}
