"""Estimates of many image pairs, one JSON line each; an interrupted run continues."""

import csv
import json
import shlex
import sys
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from kornia_learnnorm.data.cameras import read_camera
from kornia_learnnorm.data.datasets.pairing import choose_pairs
from kornia_learnnorm.data.datasets.reading import read_folder
from kornia_learnnorm.data.datasets.textfiles import text_lines
from kornia_learnnorm.data.images import image_size, import_cv2
from kornia_learnnorm.data.matching.features import MissingWeightsError
from kornia_learnnorm.data.matching.workers import open_workers
from kornia_learnnorm.estimators.learned_eight_point import LearnedEightPoint
from kornia_learnnorm.estimators.match_refiner import MatchRefiner
from kornia_learnnorm.files import atomic_write, changed_options, exclusive, explained, full_disk_names, write_text
from kornia_learnnorm.optional import import_extra
from kornia_learnnorm.protocol import INLIER_THRESHOLD, RATIO
from kornia_learnnorm.ransac.ransac import RANSAC
from kornia_learnnorm.two_view.estimate_pair import MAX_SIZE, check_matching, estimate_pair
from kornia_learnnorm.two_view.input_checks import check_number, check_settings
from kornia_learnnorm.two_view.result import CONVENTION, NoReliableMatrixError, package_versions

RESULTS = "pairs.jsonl"  # one line a pair, in the order in which they are done
TABLE = "pairs.csv"  # one row a pair, without the matches; the pairs of the last run come first, in their order
COLUMNS = ("model", "num_matches", "num_inliers", "predicted_error_px", "F", "H", "E", "R", "t", "n")  # of the table
OPTIONS = "options.json"
MAX_PASSES = 100  # of MatchRefiner, which takes a few
UNREADABLE = "unreadable"  # code of a pair with an image or camera that cannot be read; the next run tries again

FilePair = tuple[Path, Path]
Line = dict[str, Any]  # the JSON object of a pair


@dataclass(frozen=True)
class PairOptions:
    """How image pairs are estimated; see :func:`~kornia_learnnorm.two_view.estimate_pair.estimate_pair`."""

    weights: str | None = None  # of the learned layer, by name or file; None for RANSAC
    ratio: float = RATIO
    threshold: float = INLIER_THRESHOLD
    seed: int = 0
    K: tuple[str, ...] = ()  # a camera for each image, or one for both, as ``read_camera`` reads it
    max_size: int = MAX_SIZE
    detector: str = "sift"
    matcher: str = "nearest"
    model: str = "auto"
    matches: bool = False  # results hold the matches
    refine: int = 0  # passes of ``MatchRefiner`` over the matches

    def __post_init__(self) -> None:
        check_settings(self.threshold, self.seed, model=self.model)
        check_matching(self.ratio, self.max_size, self.detector, self.matcher)
        check_number("refine", self.refine, whole=True)
        if not 0 <= self.refine <= MAX_PASSES:
            raise ValueError(f"refine must be from 0 to {MAX_PASSES} passes, got {self.refine}")

    def arguments(self, image1: Path, image2: Path) -> dict[str, Any]:
        """Return the keyword arguments of ``estimate_pair`` for two image files."""
        own = "weights", "K", "matches", "refine"  # are not arguments of ``estimate_pair``
        options = {name: value for name, value in vars(self).items() if name not in own}
        texts = self.K * 2 if len(self.K) == 1 else self.K
        if len(texts) not in (0, 2):
            raise ValueError(f"K must be one camera for both images or two, got {len(texts)}")
        cameras = [read_camera(text, image) for text, image in zip(texts, (image1, image2), strict=False)]
        return {**options, **_modules(self.weights, self.refine), **dict(zip(("K1", "K2"), cameras, strict=False))}


@lru_cache(maxsize=1)
def _modules(weights: str | None, passes: int) -> dict[str, Any]:
    refiner = MatchRefiner.from_pretrained() if passes else None
    if refiner is not None:
        refiner.passes = passes
    return {"layer": None if weights is None else LearnedEightPoint.from_pretrained(weights), "refiner": refiner}


def read_pair_list(path: str | Path) -> list[FilePair]:
    """Return the image files of a list, two names a line, relative to the folder of the list.

    Names with spaces stand in quotation marks; a # begins a comment.
    """
    path, pairs = Path(path), []
    for line in text_lines(path, "list of pairs"):
        with explained(f"{path}, line {line.number}", ValueError):
            names = shlex.split(line.text, comments=True)
        if names and len(names) != 2:
            raise line.error("two image files")
        pairs += [(path.parent / names[0], path.parent / names[1])] if names else []
    if not pairs:
        raise ValueError(f"{path} lists no pairs")
    return list(dict.fromkeys(pairs))


def pairs_of_folder(folder: Path, gap: int | None = 1) -> list[FilePair]:
    """Return the image files of a folder that are ``gap`` apart by name in their subfolder, or all pairs for None."""
    pairs, _ = choose_pairs(read_folder(folder), gap)
    return [(pair.frame1.path, pair.frame2.path) for pair in pairs]


def estimate_pairs(
    pairs: list[FilePair], folder: str | Path, options: PairOptions, jobs: int = -1, dask: str | None = None
) -> list[Line]:
    """Estimate the pairs that are not done yet, append a JSON line of each to ``pairs.jsonl`` and write ``pairs.csv``.

    A line has what :meth:`~kornia_learnnorm.two_view.result.PairEstimate.as_dict` returns, or
    :func:`describe_failure` where there is no matrix or an image cannot be read. A later run in the folder must have
    the same options. ``jobs`` is a number of processes, -1 for as many as there are cores; the workers of the Dask
    scheduler at the address ``dask`` estimate instead. Returns the JSON objects of all pairs, in their order.
    """
    folder = Path(folder)
    cameras = [text if text == "exif" else read_camera(text).tolist() for text in options.K]
    _modules(options.weights, options.refine)  # raise for wrong weights once, not for each pair
    given = json.loads(json.dumps({**asdict(options), "K": cameras}))
    folder.mkdir(parents=True, exist_ok=True)
    with exclusive(folder):
        had = folder / OPTIONS
        if not had.exists():
            write_text(had, json.dumps(given, indent=2) + "\n")
        elif differ := changed_options(_parse(had, had.read_text(encoding="utf-8")), given):
            raise ValueError(f"{folder} holds results of other options, write elsewhere: {differ}")
        done = _read_done(folder / RESULTS)
        todo = [pair for pair in pairs if pair not in done]
        tqdm = import_extra("tqdm", "images", "estimating many pairs").tqdm
        with (
            open_workers(jobs, dask) as workers,
            full_disk_names(folder / RESULTS),
            (folder / RESULTS).open("a", encoding="utf-8") as file,
            workers.results(_estimate, ((*pair, options) for pair in todo)) as results,
        ):
            shown = tqdm(results, initial=len(pairs) - len(todo), total=len(pairs), unit="pair", file=sys.stderr)
            for pair, line in zip(todo, shown, strict=True):
                file.write(json.dumps(line, allow_nan=False) + "\n")
                file.flush()
                done[pair] = line
        _write_table(folder / TABLE, [done[pair] for pair in dict.fromkeys([*pairs, *done])])
    return [done[pair] for pair in pairs]


def _write_table(path: Path, lines: list[Line]) -> None:
    """Write a row of each pair, matrices row by row with spaces between the numbers, and the codes of the warnings."""

    def cell(value: Any) -> Any:
        return " ".join(map(str, np.ravel(value))) if isinstance(value, list) else value

    with atomic_write(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(["image1", "image2", *COLUMNS, "warnings"])
        for line in lines:
            files, codes = [line[view]["file"] for view in ("image1", "image2")], [w["code"] for w in line["warnings"]]
            table.writerow([*files, *(cell(line.get(name)) for name in COLUMNS), " ".join(codes)])


def _read_done(path: Path) -> dict[FilePair, Line]:
    """Return the results of a file of JSON lines; drop a last line that was not written whole, and unreadable pairs."""
    if not path.exists():
        return {}
    texts = [text for text in path.read_text(encoding="utf-8").splitlines(keepends=True) if text.endswith("\n")]
    lines = {}
    try:
        for line in (_parse(path, text) for text in texts):
            if UNREADABLE not in [why["code"] for why in line["warnings"]]:
                lines[Path(line["image1"]["file"]), Path(line["image2"]["file"])] = line
    except (LookupError, TypeError) as error:  # of a line that this command did not write
        raise ValueError(f"{path} is damaged: remove it and estimate again: {error!r}") from error
    write_text(path, "".join(json.dumps(line, allow_nan=False) + "\n" for line in lines.values()))
    return lines


def _parse(path: Path, text: str) -> Any:
    with explained(f"{path} is damaged: remove it and estimate again", ValueError):
        return json.loads(text)


def describe_failure(code: str, text: str, image1: Path, image2: Path, options: PairOptions) -> Line:
    """Return the JSON object of a pair without a matrix: the reason as a warning, and null for what is not known."""

    def describe(path: Path) -> Line:  # sizes are null where the file cannot be read
        width, height = image_size(path) if path.is_file() else (0, 0)
        return {"file": str(path), "width": width or None, "height": height or None}

    return {
        **dict.fromkeys(("model", "choice", "F", "H", "E", "R", "t", "n", "other_pose")),
        "convention": CONVENTION,
        **dict.fromkeys(("predicted_error_px", "num_matches", "num_inliers")),
        "warnings": [{"code": code, "text": text}],
        "image1": describe(image1),
        "image2": describe(image2),
        "estimator": (RANSAC if options.weights is None else LearnedEightPoint).__name__,
        "seed": options.seed,
        "ratio": options.ratio if options.matcher == "nearest" else None,
        "threshold_px": options.threshold,
        "versions": package_versions(),
    }


def _estimate(image1: Path, image2: Path, options: PairOptions) -> Line:
    import_cv2().setNumThreads(1)
    try:
        return estimate_pair(image1, image2, **options.arguments(image1, image2)).as_dict(options.matches)
    except MissingWeightsError:  # of all pairs
        raise
    except (ValueError, OSError) as error:
        code = error.code if isinstance(error, NoReliableMatrixError) else UNREADABLE
        return describe_failure(code, str(error), image1, image2, options)
