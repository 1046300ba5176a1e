"""Matching all pairs of frames into a store, on all cores or many machines; features are kept on disk."""

import sys
from collections import Counter
from collections.abc import Generator, Mapping, Sequence
from contextlib import closing, nullcontext
from dataclasses import asdict, dataclass, replace
from hashlib import sha256
from importlib.metadata import version
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch

from kornia_learnnorm.data.datasets.frames import Frame, FramePair, read_frame
from kornia_learnnorm.data.images import import_cv2
from kornia_learnnorm.data.matching.features import DETECTORS, READS_COLOUR, Features
from kornia_learnnorm.data.matching.matchers import check_methods, match_lightglue, match_nearest, one_to_one
from kornia_learnnorm.data.matching.workers import Workers, open_workers
from kornia_learnnorm.data.store import CorrespondenceStore, passes_ratio_test
from kornia_learnnorm.data.store_writer import StoreWriter
from kornia_learnnorm.files import exclusive
from kornia_learnnorm.optional import import_extra
from kornia_learnnorm.protocol import MAX_FILTERED, RATIO

__all__ = ["MatchOptions", "collect_matches", "match_frames"]

WINDOW = 8  # pairs per process that are matched before unneeded features are deleted
Found = Features | str  # or the reason why there are none
Result = CorrespondenceStore | str  # of a pair, or the reason why there is none
MAX_RESTARTS = 3  # consecutive worker crashes without progress
LOG_INTERVAL = 30.0  # seconds between lines of progress where stderr is not a terminal


@dataclass(frozen=True)
class MatchOptions:
    """How images are matched; ValueError for an unknown name, or a number out of range."""

    detector: str = "sift"  # a key of features.DETECTORS
    num_features: int = 4000  # kept of an image, the strongest ones
    matcher: str = "nearest"  # one of matchers.MATCHERS
    # Matches kept of a pair, drawn at random: so many that fail Lowe's ratio test, so many others; None for all.
    max_matches: int | None = MAX_FILTERED
    seed: int = 0  # of this draw and of the order of a pair's matches

    def __post_init__(self) -> None:
        check_methods(self.detector, self.matcher)
        if self.num_features < 2:
            raise ValueError(f"num_features must be at least 2, got {self.num_features}")
        if self.max_matches is not None and self.max_matches < 8:
            raise ValueError(f"max_matches must be at least 8, or None (a command's 0) for all, got {self.max_matches}")
        if self.seed < 0:
            raise ValueError(f"seed must be 0 or more, got {self.seed}")


def match_frames(
    pair: FramePair, features1: Features, features2: Features, options: MatchOptions, place: int = 0
) -> CorrespondenceStore:
    """Return a store of one pair: its matches, one-to-one and in an order of the seed and of ``place``, its index."""
    if options.matcher == "nearest":
        found1, found2, ratios = match_nearest(features1, features2)
        scores = 1 - ratios
    else:
        found1, found2, scores = match_lightglue(features1, features2, options.detector)
        ratios = torch.full_like(scores, torch.nan)
    kept = one_to_one(found1, found2, -scores)
    points1, points2, ratio, score = (part[kept].numpy() for part in (found1, found2, ratios, scores))
    order = np.random.default_rng([options.seed, place]).permutation(len(ratio))
    if options.max_matches is not None:
        passes = passes_ratio_test(ratio[order], RATIO)
        rank = np.where(passes, passes.cumsum(), (~passes).cumsum())  # from 1, within its class
        order = order[rank <= options.max_matches]
    R, t = pair.motion
    return CorrespondenceStore(
        points1=points1[order],
        points2=points2[order],
        ratio=ratio[order],
        score=score[order],
        offsets=np.array([0, len(order)]),
        image_size=np.array([[features1.size, features2.size]], np.int32),
        names=[(pair.frame1.name, pair.frame2.name)],
        F=pair.F[None],
        K=np.stack([pair.frame1.K, pair.frame2.K])[None],
        R=R[None],
        t=t[None],
        detector=f"{options.detector}, {options.num_features} features, {options.matcher}",
    )


def collect_matches(
    pairs: Sequence[FramePair],
    path: str | Path,
    options: MatchOptions | None = None,
    about: dict[str, str] | None = None,
    jobs: int = 1,
    dask: str | None = None,
) -> dict[str, str]:
    """Match all pairs into a store, with a progress bar; an interrupted run continues.

    Until the store is complete, its pairs are in ``<path>.parts``. ``about`` gives its ``dataset`` and ``pairs``,
    ``jobs`` is a number of processes on this machine, -1 for one a core, and ``dask`` the address of a scheduler whose
    workers match instead; they need the images under the same paths. Returns the pairs that could not be matched,
    ``"name1 name2"``, and why. ValueError if there are no pairs, none could be matched, or ``path`` holds another
    store; OSError if a file cannot be written, another process writes it, or workers crash repeatedly.
    """
    options, about = options or MatchOptions(), about or {}
    if not pairs:
        raise ValueError("no pairs of frames to match: one pair or more expected, got none")
    with nullcontext() if Path(path).exists() else exclusive(path):
        # stores of earlier versions have matches that share points, and are not continued
        writer = StoreWriter(path, {**about, **asdict(options), "matches": "one-to-one", "frames": _digest(pairs)})
        if writer.complete:
            print(f"{path} exists already, made with these options; remove it to match again", file=sys.stderr)
            return writer.skipped
        with closing(writer), open_workers(jobs, dask) as workers:
            skipped = _match_all(pairs, writer, options, about, workers)
            if len(skipped) == len(pairs):
                first = next(iter(skipped.values()))
                raise ValueError(f"none of the {len(pairs)} pairs could be matched; reason for the first: {first}")
            versions = {name: version(name) for name in ("kornia_learnnorm", "numpy", "h5py")}
            versions["opencv"] = str(import_cv2().__version__)
            writer.finish({"versions": versions, "skipped": skipped})
    return skipped


def _digest(pairs: Sequence[FramePair]) -> str:
    digest = sha256()
    for frame in chain(*pairs):
        digest.update(f"{frame.name}\n{frame.size} {frame.matched_size} {frame.distortion}\n".encode())
        for array in (frame.camera, frame.pose):  # rounded: another machine may differ in the last digit
            digest.update((array.round(6) + 0.0).tobytes())
    return digest.hexdigest()


def _match_all(
    pairs: Sequence[FramePair], writer: StoreWriter, options: MatchOptions, about: Mapping[str, Any], workers: Workers
) -> dict[str, str]:
    """Match the pairs that are not done; continue after a worker was killed. Return the skipped pairs and why."""
    from joblib.externals.loky.process_executor import BrokenProcessPool

    tqdm = import_extra("tqdm", "images", "matching many pairs").tqdm
    often = {} if sys.stderr.isatty() else {"mininterval": LOG_INTERVAL, "maxinterval": LOG_INTERVAL}
    done, skipped, restarts = writer.done(), dict[str, str](), 0
    with tqdm(total=len(pairs), initial=len(done), unit="pair", **often) as bar:
        while len(done) < len(pairs):
            try:
                with closing(_match_rest(pairs, done, writer.folder, options, workers)) as results:
                    for place, result in results:
                        if isinstance(result, str):
                            skipped[" ".join(frame.name for frame in pairs[place])] = result
                        else:
                            writer.add(place, replace(result, **about))
                        done.add(place)
                        restarts = 0
                        bar.update()
            except BrokenProcessPool as error:
                restarts += 1
                if restarts > MAX_RESTARTS:
                    raise OSError(f"the worker processes were killed {restarts} times in a row: {error}") from error
                bar.write("a worker process was killed; continuing with new ones", file=sys.stderr)
    return skipped


def _match_rest(
    pairs: Sequence[FramePair], done: set[int], folder: Path, options: MatchOptions, workers: Workers
) -> Generator[tuple[int, Result], None, None]:
    """Yield each place that is not ``done`` at the start, with the store of its pair or why there is none."""
    todo, window = [place for place in range(len(pairs)) if place not in done], WINDOW * workers.number
    uses, held = Counter(frame.name for place in todo for frame in pairs[place]), dict[str, Path]()
    with TemporaryDirectory(prefix="features-", dir=folder) as features:
        for first in range(0, len(todo), window):
            places = todo[first : first + window]
            frames = {frame.name: frame for place in places for frame in pairs[place]}
            missing = [frame for name, frame in frames.items() if name not in held]
            with workers.results(_detect, ((frame, options) for frame in missing)) as found:
                for frame, detected in zip(missing, found, strict=True):
                    held[frame.name] = Path(features, f"{len(held)}.npz")
                    _write_features(held[frame.name], frame, detected)
            tasks = ((pairs[i], *(_read_features(held[frame.name]) for frame in pairs[i]), options, i) for i in places)
            with workers.results(_match, tasks) as results:
                for place, result in zip(places, results, strict=True):
                    yield place, result
                    for frame in pairs[place]:
                        uses[frame.name] -= 1
                        if uses[frame.name] == 0:  # no other pair needs its features
                            held[frame.name].unlink()


def _detect(frame: Frame, options: MatchOptions) -> Found:
    import_cv2().setNumThreads(1)
    try:
        image = read_frame(frame, options.detector in READS_COLOUR)
    except (OSError, ValueError) as error:
        return str(error)
    return DETECTORS[options.detector](image, options.num_features)


def _match(pair: FramePair, features1: Found, features2: Found, options: MatchOptions, place: int) -> Result:
    if isinstance(features1, str):
        return features1
    if isinstance(features2, str):
        return features2
    import_cv2().setNumThreads(1)
    try:
        return match_frames(pair, features1, features2, options, place)
    except ValueError as error:
        return str(error)


def _write_features(path: Path, frame: Frame, found: Found) -> None:
    """Write the features of a frame, or the reason why it has none; OSError on a full disk."""
    arrays: dict[str, Any] = {"reason": found} if isinstance(found, str) else found._asdict()
    try:
        np.savez(path, **{name: value for name, value in arrays.items() if value is not None})
    except OSError as error:  # NumPy's message does not name the file
        raise OSError(f"cannot write the features of {frame.name}, is the disk full? {error}") from error


def _read_features(path: Path) -> Found:
    with np.load(path) as data:
        if "reason" in data:
            return str(data["reason"])
        return Features(data["points"], data["descriptors"], tuple(data["size"].tolist()), data.get("lafs"))
