"""The estimate of an image pair: its fields, the JSON object and the printed text."""

from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple, cast

from torch import Tensor

from kornia_learnnorm.geometry.distances import symmetric_epipolar_distance
from kornia_learnnorm.metrics.statistics import median
from kornia_learnnorm.two_view.pair_warnings import PairWarning
from kornia_learnnorm.two_view.parallax import Parallax, parallax
from kornia_learnnorm.two_view.plane_pose import PlanePose

CONVENTION = "x2^T F x1 = 0, x2 ~ H x1, x = (column, row, 1) in pixels, X2 = R X1 + t; F, H and E have unit norm"


class NoReliableMatrixError(ValueError):
    """Raised if the images or matches do not determine a matrix; ``code`` is the reason in one word."""

    def __init__(self, code: str, text: str) -> None:
        super().__init__(text)
        self.code = code

    def __reduce__(self) -> tuple[Any, ...]:
        """Return what pickle needs, as in a pool of processes: the arguments are not those of ValueError."""
        return type(self), (self.code, str(self))


class ModelChoice(NamedTuple):
    """The model of the result and the numbers behind the choice; None where a matrix was not sought or not found."""

    model: str  # "fundamental" or "homography"
    reason: str  # one sentence for the user
    parallax: Parallax | None = None  # of the matches of the fundamental matrix
    fundamental_inliers: int | None = None
    homography_inliers: int | None = None
    fundamental_gric: float | None = None
    homography_gric: float | None = None

    @property
    def by_gric(self) -> str | None:
        """Name of the model of smaller GRIC; None unless both matrices were found."""
        if self.fundamental_gric is None or self.homography_gric is None:
            return None
        return "fundamental" if self.fundamental_gric < self.homography_gric else "homography"

    def as_dict(self) -> dict[str, Any]:
        """Return the fields as values for JSON."""
        return {**self._asdict(), "parallax": self.parallax and self.parallax._asdict()}


@dataclass(frozen=True, eq=False)
class PairEstimate:
    r"""The fundamental matrix or homography of two images and the matches behind it; pixels of the full images."""

    choice: ModelChoice
    F_mat: Tensor | None  # (3, 3), float64, unit Frobenius norm, x2^T F x1 = 0 in pixels; None where none was found
    H_mat: Tensor | None  # (3, 3), float64, unit Frobenius norm, x2 ~ H x1 in pixels; None where none was found
    estimator: str  # name of the estimator: "RANSAC" or "LearnedEightPoint"
    points1: Tensor  # pixels of the matches in image 1, (N, 2), float64
    points2: Tensor  # pixels of the matches in image 2, (N, 2), float64
    scores: Tensor  # of each match, 1 minus its ratio or the matcher's score, (N,), float64
    weights: Tensor  # probability of each match to be an inlier as the estimator sees it, (N,), float64
    inliers: Tensor  # mask of the matches with a distance to the matrix below the threshold, (N,), bool
    predicted_error: float  # expected median distance of exact correspondences under the matrix, pixels
    warnings: tuple[PairWarning, ...]  # reasons to doubt the matrix; empty when all is well
    size1: tuple[int, int]  # width and height of image 1
    size2: tuple[int, int]  # width and height of image 2
    ratio: float | None  # largest ratio of nearest to second-nearest descriptor distance; None where there is no limit
    threshold: float  # largest distance of an inlier, pixels; of the full images as the points are
    seed: int
    path1: Path | None = None
    path2: Path | None = None
    E_mat: Tensor | None = None  # (3, 3), nearest to K2^T F K1, unit norm; None without cameras or translation
    R: Tensor | None = None  # rotation (3, 3) of X2 = R X1 + t; None without cameras, and where two poses tie
    t: Tensor | None = None  # direction of translation (3,); None without cameras, and where the camera only rotates
    front: Tensor | None = None  # mask of the matches in front of both cameras, (N,), bool; None without cameras
    n: Tensor | None = None  # unit normal (3,) of the plane, n^T X1 > 0; None without cameras or a plane
    other_pose: PlanePose | None = None  # second pose and normal that the plane allows; None if there is only one
    rows: Tensor | None = None  # index of each match among those given to estimate_matches, (N,); else None

    @property
    def model(self) -> str:
        """Name of the model: ``fundamental`` or ``homography``."""
        return self.choice.model

    @property
    def matrix(self) -> Tensor:
        """The matrix of ``model``, (3, 3): ``F_mat`` or ``H_mat``."""
        return cast(Tensor, self.H_mat if self.model == "homography" else self.F_mat)

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
        """Median distance of the inliers to the matrix, pixels."""
        distance = parallax if self.model == "homography" else symmetric_epipolar_distance
        return median(distance(self.points1[self.inliers], self.points2[self.inliers], self.matrix)).item()

    def as_dict(self, matches: bool = True) -> dict[str, Any]:
        """Return the fields as values for JSON, without those of single matches if ``matches`` is false."""

        def view(path: Path | None, size: tuple[int, int]) -> dict[str, Any]:
            return {"file": None if path is None else str(path), "width": size[0], "height": size[1]}

        content = {
            "model": self.model,
            "choice": self.choice.as_dict(),
            "F": self.F_mat,
            "H": self.H_mat,
            "E": self.E_mat,
            "R": self.R,
            "t": self.t,
            "n": self.n,
            "other_pose": self.other_pose and {name: x.tolist() for name, x in self.other_pose._asdict().items()},
            "convention": CONVENTION,
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
        """Return the matrix row by row, the pose with cameras, the counts, predicted error and warnings as text."""

        def rows(M: Tensor) -> list[str]:
            return ["  " + " ".join(f"{value: .9e}" for value in row) for row in M.tolist()]

        if self.model == "homography":
            name, equation, distance = "H", "x2 ~ H x1", "distance in image 2"
            meaning = "typical error in image 2 of points that H moves"
        else:
            name, equation, distance = "F", "x2^T F x1 = 0", "symmetric epipolar distance"
            meaning = "typical error of epipolar lines where true matches lie"
        lines = [f"{name} ({equation} in pixels, unit Frobenius norm)", *rows(self.matrix)]
        motion = {"R (X2 = R X1 + t)": self.R, "t (direction)": self.t, "n (normal of the plane in camera 1)": self.n}
        for text, value in motion.items():
            lines += [] if value is None else [text, *rows(value.view(-1, 3))]
        ratio = "" if self.ratio is None else f" (ratio test {self.ratio:g})"
        share = self.num_inliers / self.num_matches
        within = f"{distance} < {self.threshold:.3g} px, median {self.median_distance:.2f} px"
        lines += [f"model    {self.model}: {self.choice.reason}", f"by       {self.estimator}, seed {self.seed}"]
        lines += [f"matches  {self.num_matches}{ratio}", f"inliers  {self.num_inliers} ({share:.1%}), {within}"]
        lines += [f"error    predicted error of {name}: {self.predicted_error:.2f} px ({meaning})"]
        return "\n".join([*lines, *(f"warning  {warning.code}: {warning.text}" for warning in self.warnings)])

    __str__ = summary


def package_versions() -> dict[str, str]:
    """Return the versions of the packages that an estimate depends on."""
    return {name: version(name) for name in ("kornia-learnnorm", "kornia", "torch")}
