"""Predictions of methods on stores, kept in a folder a store: what ``learnnorm evaluate`` makes."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import torch
from kornia.metrics import angle_error_mat, angle_error_vec
from torch import Tensor

from kornia_learnnorm import relative_pose, symmetric_epipolar_distance
from kornia_learnnorm.data.match_sets import MatchSets, draw_samples, plain_residual
from kornia_learnnorm.data.store import CorrespondenceStore, MaxRatio, read_store
from kornia_learnnorm.evaluation.diagnostics import diagnose_in_coordinates
from kornia_learnnorm.evaluation.methods import Method, find_method, identify_method, short_name_of
from kornia_learnnorm.evaluation.runs import results_store
from kornia_learnnorm.evaluation.runs.results_store import About, Arrays, Job, Names, Paths, Stores
from kornia_learnnorm.evaluation.tables import names_of
from kornia_learnnorm.files import explained
from kornia_learnnorm.geometry.problem import LinearProblem
from kornia_learnnorm.metrics.inliers import f1_from_masks, finite_distance
from kornia_learnnorm.metrics.statistics import median
from kornia_learnnorm.models.fundamental import Fundamental
from kornia_learnnorm.normalizers.normalizer import normalizing_transforms
from kornia_learnnorm.protocol import INLIER_THRESHOLD, MAX_RESIDUAL, PROTOCOLS, RATIO, THRESHOLDS

# What a run keeps of each sample, by name.
DIAGNOSTICS = ("condition_number", "rho", "distance1", "distance2", "rank2_share")  # in the order of Diagnostics
ERRORS = ("F_mat", "own", "heldout", "truth", "rotation_error", "translation_error", *DIAGNOSTICS)
AGREEMENT = ("inliers", "f1")  # takes longer than all others together
SAMPLES = ("pair", "plain_residual")  # arrays in the file of samples
KEYS = (ERRORS, (*ERRORS, *AGREEMENT))  # arrays in the file of a method's predictions, without and with agreement
NUM_HELDOUT = 16  # held-out matches of a sample
BATCH_SIZE = 2048  # samples solved at once
MIN_INLIERS = 16  # a pair with fewer has no ground-truth inliers to measure with
MAX_INLIERS = 200  # of a pair, the first in the store's random order


@dataclass(frozen=True)
class SampleOptions:
    """How the samples of a run are drawn."""

    size: int = 8  # correspondences in a sample
    seed: int = 0  # of the shuffle
    max_samples: int | None = 16000  # at most so many samples of each store and protocol, at random; None for all
    max_residual: float = MAX_RESIDUAL  # pixels; samples with a larger residual without normalisation are left out

    def __post_init__(self) -> None:
        if self.size < 8:
            raise ValueError(f"a sample needs at least 8 correspondences, got size={self.size}")
        if self.seed < 0:
            raise ValueError(f"seed must be 0 or more, got {self.seed}")
        if self.max_samples is not None and self.max_samples < 1:
            raise ValueError(f"max_samples must be 1 or more, or None for all, got {self.max_samples}")

    def draw(self, store: CorrespondenceStore, max_ratio: MaxRatio) -> MatchSets:
        """Return samples before the filter on the residual; held-out points of pairs without any are NaN."""
        generator = torch.Generator().manual_seed(self.seed)
        samples = draw_samples(store, generator, self.size, max_ratio, NUM_HELDOUT)
        if self.max_samples is None or len(samples.pair) <= self.max_samples:
            return samples
        order = torch.randperm(len(samples.pair), generator=generator)
        return samples.select(order[: self.max_samples].sort().values)


@torch.no_grad()
def predict(
    method: Method, samples: MatchSets, store: CorrespondenceStore, max_ratio: MaxRatio, agreement: bool = True
) -> Arrays:
    """Return a method's matrices of the samples of a store, ``ERRORS`` and, where wanted, ``AGREEMENT``, (S, ...)."""
    truth = ground_truth_inliers(store)
    batches = torch.split(torch.arange(len(samples.pair)), BATCH_SIZE)
    parts = [_predict_batch(method, samples.select(rows), store, truth) for rows in batches]
    found = {key: torch.cat([part[key] for part in parts]) for key in ERRORS}
    if agreement:
        found |= consensus(found["F_mat"], samples.pair, store, max_ratio)
    return {key: value.numpy() for key, value in found.items()}


def _predict_batch(method: Method, samples: MatchSets, store: CorrespondenceStore, truth: Tensor) -> dict[str, Tensor]:
    problem = LinearProblem.from_points(samples.points1, samples.points2, None, Fundamental(method.rank2))
    x1, x2 = problem.points1, problem.points2
    T1, T2 = normalizing_transforms(method.normalizer, problem)
    F_mat = method.solve(problem, T1, T2)
    K, R, t = (torch.from_numpy(part)[samples.pair] for part in (store.K, store.R, store.t))
    K = torch.where(K.isnan(), torch.eye(3).to(K), K)  # unknown cameras, whose true pose is unknown too
    found = relative_pose(F_mat, K[:, 0], K[:, 1], x1, x2)
    return {
        "F_mat": F_mat,
        "own": symmetric_epipolar_distance(x1, x2, F_mat).mean(-1),
        "heldout": median_distance(torch.cat([samples.heldout1, samples.heldout2], -1).double(), F_mat),
        "truth": median_distance(truth[samples.pair], F_mat),
        "rotation_error": angle_error_mat(found[0], R),
        "translation_error": angle_error_vec(found[1], t),
        **dict(zip(DIAGNOSTICS, diagnose_in_coordinates(problem, T1, T2), strict=True)),
    }


def consensus(F_mat: Tensor, pair: Tensor, store: CorrespondenceStore, max_ratio: MaxRatio) -> dict[str, Tensor]:
    """Return ``inliers``, a share, and ``f1``, (S, thresholds), of matrices (S, 3, 3) on all matches of their pairs."""
    inliers = F_mat.new_full((len(F_mat), len(THRESHOLDS)), torch.nan)
    f1 = inliers.clone()
    for index in torch.unique(pair).tolist():
        rows = torch.nonzero(pair == index).flatten()
        points1, points2 = pair_matches(store, index, max_ratio)
        distance = finite_distance(points1, points2, torch.cat([torch.from_numpy(store.F[[index]]), F_mat[rows]]))
        within = distance[:, None] < distance.new_tensor(THRESHOLDS)[:, None]  # of the truth and of each matrix
        inliers[rows] = within[1:].double().mean(-1)
        f1[rows] = f1_from_masks(within[1:], within[0])
    return {"inliers": inliers, "f1": f1}


def pair_matches(store: CorrespondenceStore, pair: int, max_ratio: MaxRatio) -> tuple[Tensor, Tensor]:
    """Return the matches of an image pair in both views below Lowe's ratio, pixels, (M, 2) float64 each."""
    points1, points2, _ = store.matches(pair, max_ratio)
    return torch.from_numpy(points1).double(), torch.from_numpy(points2).double()


def ground_truth_inliers(store: CorrespondenceStore) -> Tensor:
    """Return the filtered matches of each pair within 1 px of the truth, (P, 200, 4), NaN for less, all below 16."""
    result = torch.full((len(store), MAX_INLIERS, 4), torch.nan, dtype=torch.float64)
    for pair, F_mat in enumerate(torch.from_numpy(store.F)):
        x1, x2 = pair_matches(store, pair, RATIO)
        near = symmetric_epipolar_distance(x1, x2, F_mat) < INLIER_THRESHOLD  # none if F_mat is NaN, not known
        points = torch.cat([x1, x2], -1)[near][:MAX_INLIERS]
        if len(points) >= MIN_INLIERS:
            result[pair, : len(points)] = points
    return result


def median_distance(points: Tensor, F_mat: Tensor) -> Tensor:
    """Return the median symmetric epipolar distance (S,) of sets (S, N, 4), pixels; rows of NaN are left out."""
    known = points.nan_to_num()
    distance = symmetric_epipolar_distance(known[..., :2], known[..., 2:], F_mat)
    distance[points.isnan().any(-1)] = torch.nan
    return median(distance)


class RunCell(NamedTuple):
    """The predictions of all methods on the samples of one store and protocol."""

    store: str  # its name
    protocol: str  # filtered or unfiltered
    pair: Tensor  # image pair of each sample, (S,) int64
    drawn: int  # number of samples before the filter on the un-normalised residual
    predictions: dict[str, dict[str, Tensor]]  # arrays (S, ...) by method and quantity, float64

    @property
    def title(self) -> str:
        """Store and protocol."""
        return f"{self.store}, {self.protocol}"


class Run(NamedTuple):
    """A run of predictions."""

    about: About  # what the run was computed from, its section of run.json
    cells: list[RunCell]
    missing: list[str]  # what has not been computed yet


def temporary_run(stores: Paths, methods: Names, options: SampleOptions) -> Run:
    """Return a run that is not kept, without shares of inliers."""
    with TemporaryDirectory(prefix="learnnorm-") as folder:
        record_run(folder, stores, methods, options, complete=False)
        return read_run(folder, complete=False)


def record_run(
    folder: str | Path, stores: Paths, methods: Names, options: SampleOptions, complete: bool = True, command: str = ""
) -> None:
    """Compute what a run does not have yet; a ValueError or OSError tells what is wrong, at the end of a failed method.

    ``stores`` are paths by the names that tables give them, ``methods`` names for ``find_method``. A run that is
    ``complete`` has shares of inliers and F1, too. ``command`` is the command line that asks for it, for the report.
    """
    folder, names = Path(folder), names_of(methods, short_name_of, "methods")
    found = {names[name]: find_method(name) for name in methods}
    read = {name: read_store(path) for name, path in stores.items()}
    about = {
        **vars(options),
        "methods": {names[name]: identify_method(name) for name in methods},
        "trained_on": {name: list(method.trained_on) for name, method in found.items()},
    }
    jobs, total = _jobs(folder, read, found, options, complete), len(read) * len(PROTOCOLS) * len(found)
    if failed := results_store.record(folder, "evaluate", read, about, jobs, total, (), command):
        raise ValueError(failed + (f". All others are in {folder}" if complete else ""))


def _jobs(
    folder: Path, stores: Stores, methods: Mapping[str, Method], options: SampleOptions, complete: bool
) -> Iterator[Job]:
    """Make the files of the stores' samples, and give those of the methods to make."""
    for (name, store), (protocol, max_ratio) in product(stores.items(), PROTOCOLS.items()):
        path = partial(results_store.array_path, folder, name, protocol)
        samples = _samples(path("samples"), f"{name}, {protocol}", options, store, max_ratio)
        for label, method in methods.items():
            yield label, path(label), partial(predict, method, samples, store, max_ratio, complete)


def _samples(path: Path, place: str, options: SampleOptions, store: CorrespondenceStore, ratio: MaxRatio) -> MatchSets:
    """Return the samples within the limit on the residual; write all that were drawn."""
    limit = options.max_residual
    with explained(place, ValueError):
        drawn = options.draw(store, ratio)
    if not path.is_file():
        residual = plain_residual(drawn.points1, drawn.points2).numpy()
        if not (residual < limit).any():
            few = f"none of {len(residual)} samples has an un-normalised residual below {limit:g} px"
            raise ValueError(f"{place}: {few}")
        results_store.write_arrays(path, {"pair": drawn.pair.numpy(), "plain_residual": residual})
    found = results_store.read_arrays(path, SAMPLES, len(drawn.pair))
    if not torch.equal(found["pair"], drawn.pair):
        raise ValueError(f"{path.parent} is of other samples than the run's seed draws of the store, remove it")
    return drawn.select(found["plain_residual"] < limit)


def read_run(folder: str | Path, complete: bool = True) -> Run:
    """Read what there is of a run; raise FileNotFoundError for a folder without one, ValueError if it is damaged."""
    folder = Path(folder)
    about, missing = results_store.read_section(folder, "evaluate"), list[str]()
    if about is None:
        raise FileNotFoundError(f"no run at {folder}: learnnorm evaluate STORE --out {folder} makes one")
    cells = []
    for store, protocol in product(about["stores"], PROTOCOLS):
        path, absent = partial(results_store.array_path, folder, store, protocol), ["all methods"]
        if path("samples").is_file():
            samples = results_store.read_arrays(path("samples"), SAMPLES)
            kept = samples["plain_residual"] < about["max_residual"]
            pair, there = samples["pair"][kept], [name for name in about["methods"] if path(name).is_file()]
            found = {name: results_store.read_arrays(path(name), KEYS[complete], len(pair)) for name in there}
            cells.append(RunCell(store, protocol, pair, len(kept), found))
            absent = [name for name in about["methods"] if name not in there]
        missing += [f"{name} on {store}, {protocol}" for name in absent]
    return Run(about, cells, missing)
