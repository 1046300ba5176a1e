"""Predictions of methods on stores, computed once and kept: ``learnnorm evaluate STORE ... --out RUN``.

A run is a folder. ``run.json`` says what it is of. Each store has a folder with its pairs and the protocols, in each of
which are the samples and a file per method: NumPy archives of arrays in the order of the samples. What is there
already is not computed again, and a run of other options is refused.
"""

from __future__ import annotations

import importlib.metadata
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from kornia_learnnorm.data.samples import RATIO, Samples, draw_samples, plain_residual
from kornia_learnnorm.data.store import CorrespondenceStore, read_store
from kornia_learnnorm.diagnostics import diagnose
from kornia_learnnorm.evaluation.methods import Method, find_method, identify_method, short_names
from kornia_learnnorm.evaluation.motion import pair_motions
from kornia_learnnorm.evaluation.predict import ground_truth_inliers
from kornia_learnnorm.evaluation.run import file_name
from kornia_learnnorm.files import replacing
from kornia_learnnorm.pose_metrics import relative_pose, rotation_error, translation_error
from kornia_learnnorm.residuals import symmetric_epipolar_distance

__all__ = ["PROTOCOLS", "record_run"]

PROTOCOLS: dict[str, float | None] = {"filtered": RATIO, "unfiltered": None}
HELDOUT = 16
SIZES = (8, 9, 10, 12, 16, 24, 32, 64, 128, 256)
TRIALS = 1000
BATCH = 2048
JOINED = ("stores", "methods")

Arrays = dict[str, NDArray[Any]]


def record_run(
    folder: str | Path, stores: Mapping[str, str], methods: list[str], seed: int = 0, max_samples: int | None = None
) -> None:
    """Compute what is not there yet of a run, with a progress bar.

    Args:
        folder: the run, made if missing.
        stores: paths of the stores by the names that tables give them.
        methods: names for :func:`~kornia_learnnorm.evaluation.methods.find_method`.
        seed: seed of the shuffles.
        max_samples: at most so many samples of each store and protocol, drawn at random; None for all.

    Raises:
        ValueError: if the folder holds a run of other options, or a store or a method is wrong.
        OSError: if a file is missing or cannot be written.

    """
    folder, names = Path(folder), short_names(methods)
    found = {names[name]: find_method(name) for name in methods}
    read = {name: read_store(path) for name, path in stores.items()}
    _begin(folder, read, {names[name]: identify_method(name) for name in methods}, seed, max_samples)
    with tqdm(total=len(read) * (2 * len(found) + 2), unit="step", disable=None) as bar:
        for name, store in read.items():
            place = folder / name
            _once(place / "pairs.npz", lambda store=store: pair_motions(store))
            for protocol, ratio in PROTOCOLS.items():
                samples = _draw(store, ratio, seed, max_samples)
                _once(place / protocol / "samples.npz", lambda samples=samples: _describe(samples))
                for method_name, method in found.items():
                    bar.set_postfix_str(f"{name}, {protocol}, {method_name}")
                    path = place / protocol / f"{file_name(method_name)}.npz"
                    _once(path, lambda m=method, s=samples, st=store: _predict(m, s, st))
                    bar.update()
                bar.update()
    pair = _random_pair(read, seed)
    for method_name, method in found.items():
        if not method_name.startswith("searched"):
            path = folder / "sizes" / f"{file_name(method_name)}.npz"
            _once(path, lambda m=method: _sweep(m, *pair, seed))


def _begin(
    folder: Path, stores: Mapping[str, CorrespondenceStore], methods: dict[str, str], seed: int, max_samples: int | None
) -> None:
    """Write what the run is of, or refuse a folder of another run; further stores and methods may join one."""
    about: dict[str, Any] = {
        "stores": {name: f"{s.dataset}, {len(s)} pairs, {s.offsets[-1]} matches" for name, s in stores.items()},
        "methods": methods,
        "seed": seed,
        "max_samples": max_samples,
        "versions": {name: importlib.metadata.version(name) for name in ("kornia_learnnorm", "torch", "kornia")},
    }
    path = folder / "run.json"
    if path.is_file():
        had = json.loads(path.read_text(encoding="utf-8"))
        differ = [
            f"{key} {had.get(key)!r}, now {about[key]!r}"
            for key in about
            if key not in JOINED and had[key] != about[key]
        ]
        for key in JOINED:
            differ += [
                f"{name} {old!r}, now {about[key][name]!r}"
                for name, old in had[key].items()
                if about[key].get(name, old) != old
            ]
            about[key] = {**had[key], **about[key]}
        if differ:
            raise ValueError(f"{folder} is a run of other options, remove it or write elsewhere: {'; '.join(differ)}")
    folder.mkdir(parents=True, exist_ok=True)
    with replacing(path) as beside:
        beside.write_text(json.dumps(about, indent=1), encoding="utf-8")


def _once(path: Path, compute: Any) -> None:
    """Write the arrays that ``compute`` returns unless the file is there."""
    if path.is_file():
        return
    arrays = compute()
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as beside:
        np.savez_compressed(beside, **arrays)


def _draw(store: CorrespondenceStore, ratio: float | None, seed: int, max_samples: int | None) -> Samples:
    generator = torch.Generator().manual_seed(seed)
    samples = draw_samples(store, generator, 8, ratio, HELDOUT)
    if max_samples is None or len(samples.pair) <= max_samples:
        return samples
    return samples.select(torch.randperm(len(samples.pair), generator=generator)[:max_samples].sort().values)


def _describe(samples: Samples) -> Arrays:
    residual = plain_residual(samples.points1, samples.points2)
    return {"pair": samples.pair.numpy(), "plain_residual": residual.numpy()}


@torch.no_grad()
def _predict(method: Method, samples: Samples, store: CorrespondenceStore) -> Arrays:
    """Everything that a report shows of a method's samples."""
    truth = ground_truth_inliers(store)
    parts = [
        _predict_batch(method, samples.select(rows), store, truth)
        for rows in torch.split(torch.arange(len(samples.pair)), BATCH)
    ]
    return {key: torch.cat([part[key] for part in parts]).numpy() for key in parts[0]}


def _predict_batch(method: Method, samples: Samples, store: CorrespondenceStore, truth: Tensor) -> dict[str, Tensor]:
    x1, x2 = samples.points1.double(), samples.points2.double()
    F_mat = method.estimate(x1, x2)
    inside = diagnose(x1, x2, method.normalizer)
    K, R, t = (torch.from_numpy(part)[samples.pair] for part in (store.K, store.R, store.t))
    found = relative_pose(F_mat, K[:, 0], K[:, 1], x1, x2)
    return {
        "F_mat": F_mat,
        "own": symmetric_epipolar_distance(x1, x2, F_mat).mean(-1),
        "heldout": _median(torch.cat([samples.heldout1, samples.heldout2], -1).double(), F_mat),
        "truth": _median(truth[samples.pair], F_mat),
        "condition_number": inside.condition_number,
        "rho": inside.singularity_ratio,
        "distance1": inside.distance1,
        "distance2": inside.distance2,
        "rotation_error": rotation_error(found[0], R),
        "translation_error": translation_error(found[1], t),
    }


def _median(points: Tensor, F_mat: Tensor) -> Tensor:
    """Median symmetric epipolar distance of each set of (x1, y1, x2, y2), (S, N, 4), leaving out NaN, (S,)."""
    known = points.nan_to_num()
    distance = symmetric_epipolar_distance(known[..., :2], known[..., 2:], F_mat)
    distance[points.isnan().any(-1)] = torch.nan
    return distance.nanmedian(-1).values


def _random_pair(stores: Mapping[str, CorrespondenceStore], seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return the filtered points (M, 2) of a random pair of the first store, and its ground-truth inliers."""
    store = next(iter(stores.values()))
    truth = ground_truth_inliers(store)
    passing = np.add.reduceat(store.ratio < RATIO, store.offsets[:-1])
    fit = np.flatnonzero((passing >= SIZES[-1]) & truth.isfinite().any(-1).any(-1).numpy())
    if len(fit) == 0:
        raise ValueError(f"no pair has {SIZES[-1]} matches that pass the ratio test and a ground truth")
    pair = int(np.random.default_rng(seed).choice(fit))
    rows = np.arange(store.offsets[pair], store.offsets[pair + 1])
    rows = rows[store.ratio[rows] < RATIO]
    points = torch.from_numpy(store.points1[rows]).double(), torch.from_numpy(store.points2[rows]).double()
    return *points, truth[pair]


@torch.no_grad()
def _sweep(method: Method, points1: Tensor, points2: Tensor, truth: Tensor, seed: int) -> Arrays:
    """Median errors of random samples of growing size from one pair."""
    generator = torch.Generator().manual_seed(seed)
    own, accuracy = [], []
    for size in SIZES:
        rows = torch.rand(TRIALS, len(points1), generator=generator).argsort(-1)[:, :size]
        F_mat = method.estimate(points1[rows], points2[rows])
        own.append(symmetric_epipolar_distance(points1[rows], points2[rows], F_mat).mean(-1).nanmedian())
        accuracy.append(_median(truth.expand(TRIALS, -1, -1), F_mat).nanmedian())
    return {"size": np.array(SIZES), "own": torch.stack(own).numpy(), "truth": torch.stack(accuracy).numpy()}
