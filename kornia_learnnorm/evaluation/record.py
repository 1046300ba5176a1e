"""Predictions of methods on stores, computed once and kept: ``learnnorm evaluate STORE ... --out RUN``.

A run is a folder. ``run.json`` says what it is of. Each store has a folder with its pairs and the protocols, in each of
which are the samples and a file per method: NumPy archives of arrays in the order of the samples. What is there
already is not computed again, and a run of other options is refused.
"""

from __future__ import annotations

import importlib.metadata
import json
from collections.abc import Callable, Mapping
from functools import partial
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
from kornia_learnnorm.evaluation.consensus import consensus
from kornia_learnnorm.evaluation.example import median_distance, random_pair, sweep
from kornia_learnnorm.evaluation.methods import Method, find_method, identify_method, short_names
from kornia_learnnorm.evaluation.motion import pair_motions
from kornia_learnnorm.evaluation.predict import ground_truth_inliers
from kornia_learnnorm.evaluation.run import FORMAT, file_name, read_arrays, within_limit
from kornia_learnnorm.evaluation.trained import trained_on
from kornia_learnnorm.files import replacing
from kornia_learnnorm.pose_metrics import relative_pose, rotation_error, translation_error
from kornia_learnnorm.residuals import symmetric_epipolar_distance

__all__ = ["PROTOCOLS", "record_run"]

PROTOCOLS: dict[str, float | None] = {"filtered": RATIO, "unfiltered": None}
HELDOUT = 16
BATCH = 2048
JOINED = ("stores", "methods", "trained_on")

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
    joined: dict[str, dict[str, Any]] = {
        "stores": {name: f"{s.dataset}, {len(s)} pairs, {s.offsets[-1]} matches" for name, s in read.items()},
        "methods": {names[name]: identify_method(name) for name in methods},
        "trained_on": {names[name]: trained_on(name) for name in methods},
    }
    _begin(folder, joined, seed, max_samples)
    with tqdm(total=len(read) * (2 * len(found) + 2), unit="step", disable=None) as bar:
        for name, store in read.items():
            bar.set_postfix_str(name)
            _record_store(folder / name, store, found, seed, max_samples, bar)
    _once(folder / "example.npz", partial(random_pair, read, seed))
    example = read_arrays(folder / "example.npz")
    for method_name, method in found.items():
        if not method_name.startswith("searched"):
            path = folder / "sizes" / f"{file_name(method_name)}.npz"
            _once(path, partial(sweep, method, example, seed))


def _record_store(
    folder: Path, store: CorrespondenceStore, methods: dict[str, Method], seed: int, max_samples: int | None, bar: tqdm
) -> None:
    """Compute what is not there yet of a store's pairs, samples and predictions."""
    _once(folder / "pairs.npz", partial(pair_motions, store))
    for protocol, ratio in PROTOCOLS.items():
        place = folder / protocol
        drawn = _draw(store, ratio, seed, max_samples)
        _once(place / "samples.npz", partial(_describe, drawn))
        samples = drawn.select(within_limit(place))
        bar.update()
        for name, method in methods.items():
            _once(place / f"{file_name(name)}.npz", partial(_predict, method, samples, store, ratio))
            bar.update()


def _begin(folder: Path, joined: dict[str, dict[str, Any]], seed: int, max_samples: int | None) -> None:
    """Write what the run is of, or refuse a folder of another run; further stores and methods may join one."""
    about: dict[str, Any] = {
        "format": FORMAT,
        **joined,
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
            if key not in JOINED and had.get(key) != about[key]
        ]
        for key in JOINED:
            differ += [
                f"{name} {old!r}, now {about[key][name]!r}"
                for name, old in had.get(key, {}).items()
                if about[key].get(name, old) != old
            ]
            about[key] = {**had.get(key, {}), **about[key]}
        if differ:
            raise ValueError(f"{folder} is a run of other options, remove it or write elsewhere: {'; '.join(differ)}")
    folder.mkdir(parents=True, exist_ok=True)
    with replacing(path) as beside:
        beside.write_text(json.dumps(about, indent=1), encoding="utf-8")


def _once(path: Path, compute: Callable[[], dict[str, Any]]) -> None:
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
def _predict(method: Method, samples: Samples, store: CorrespondenceStore, max_ratio: float | None) -> Arrays:
    """Everything that a report shows of a method's samples."""
    truth = ground_truth_inliers(store)
    parts = [
        _predict_batch(method, samples.select(rows), store, truth)
        for rows in torch.split(torch.arange(len(samples.pair)), BATCH)
    ]
    found = {key: torch.cat([part[key] for part in parts]) for key in parts[0]}
    found |= consensus(found["F_mat"], samples.pair, store, max_ratio)
    return {key: value.numpy() for key, value in found.items()}


def _predict_batch(method: Method, samples: Samples, store: CorrespondenceStore, truth: Tensor) -> dict[str, Tensor]:
    x1, x2 = samples.points1.double(), samples.points2.double()
    transforms = method.normalizer(x1, x2, None)  # once: the searched optimum takes its time

    def known(*_: Tensor | None) -> tuple[Tensor, Tensor]:
        return transforms

    F_mat = method.solve(x1, x2, known)
    inside = diagnose(x1, x2, known)
    K, R, t = (torch.from_numpy(part)[samples.pair] for part in (store.K, store.R, store.t))
    found = relative_pose(F_mat, K[:, 0], K[:, 1], x1, x2)
    return {
        "F_mat": F_mat,
        "own": symmetric_epipolar_distance(x1, x2, F_mat).mean(-1),
        "heldout": median_distance(torch.cat([samples.heldout1, samples.heldout2], -1).double(), F_mat),
        "truth": median_distance(truth[samples.pair], F_mat),
        "condition_number": inside.condition_number,
        "rho": inside.singularity_ratio,
        "distance1": inside.distance1,
        "distance2": inside.distance2,
        "rotation_error": rotation_error(found[0], R),
        "translation_error": translation_error(found[1], t),
    }
