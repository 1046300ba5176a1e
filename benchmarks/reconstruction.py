"""Reconstruct photographs by COLMAP from matches that this package verified, and from those that COLMAP verified.

Both get the keypoints and matches of learnnorm export-colmap. Table, for each scene: registered images, mean
reprojection error, the median error of the camera centres after a similarity, of all images and (median) where any one
image is left out, and seconds for verifying and for reconstructing.

    python benchmarks/reconstruction.py FOLDER [--scenes NAME ...] [--matches DETECTOR+MATCHER ...] [--csv FILE]

The folder, such as $LEARNNORM_DATA/images/photographs, has a file cameras.json: for each image K and camera_to_world,
metres; a scene is a subfolder of images of one camera. Cameras are either given, or estimated from COLMAP's default.
"""

import json
import shutil
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pycolmap
import torch
from numpy.typing import NDArray
from shared import make_parser, write_csv

from kornia_learnnorm.data.datasets.pairing import choose_pairs
from kornia_learnnorm.data.datasets.reading import read_folder
from kornia_learnnorm.data.matching.frame_matching import MatchOptions, collect_matches
from kornia_learnnorm.data.store import CorrespondenceStore, read_store
from kornia_learnnorm.estimators.learned_eight_point import LearnedEightPoint
from kornia_learnnorm.evaluation.tables import format_table
from kornia_learnnorm.two_view.colmap_database import export_colmap

HEADER = ["scene", "matches", "cameras", "verified by", "pairs", "inliers", "images"]
HEADER += ["reprojection px", "centres mm", "one left out mm", "verify s", "reconstruct s"]
METHODS = ("COLMAP", "RANSAC")  # others are weights of LearnedEightPoint


class Scene(NamedTuple):
    folder: Path
    store: CorrespondenceStore
    K: NDArray[np.float64]
    centres: dict[str, NDArray[np.float64]]  # metres, by name


def read_scene(folder: Path, work: Path, detector: str, matcher: str) -> Scene:
    """Return a scene with the matches of all its pairs."""
    about = json.loads((folder.parent / "cameras.json").read_text(encoding="utf-8"))
    cameras = {name.removeprefix(f"{folder.name}/"): camera for name, camera in about.items()}
    frames = [frame for frame in read_folder(folder) if f"{folder.name}/{frame.name}" in about]
    pairs, _ = choose_pairs(frames, gap=None)
    path = work / f"{folder.name}.h5"
    collect_matches(pairs, path, MatchOptions(detector, matcher=matcher, max_matches=None))
    centres = {frame.name: np.array(cameras[frame.name]["camera_to_world"])[:3, 3] for frame in frames}
    return Scene(folder, read_store(path), np.array(cameras[frames[0].name]["K"]), centres)


def verify(scene: Scene, database: Path, method: str, known: bool) -> tuple[int, int, float]:
    """Write a database; return the verified pairs, their inliers and the seconds that verifying took."""
    layer = None if method in METHODS else LearnedEightPoint.from_pretrained(method)
    start = time.perf_counter()
    export_colmap(scene.store, scene.folder, database, scene.K if known else None, True, layer, jobs=1)
    if method == "COLMAP":
        with pycolmap.Database.open(database) as file:
            file.clear_two_view_geometries()
        pairs = database.with_suffix(".txt")
        pairs.write_text("\n".join(" ".join(names) for names in scene.store.names), encoding="utf-8")
        options = pycolmap.TwoViewGeometryOptions()
        options.ransac.random_seed = 0
        start = time.perf_counter()
        pycolmap.verify_matches(database, pairs, options)
    seconds = time.perf_counter() - start
    with pycolmap.Database.open(database) as file:
        return file.num_verified_image_pairs(), file.num_inlier_matches(), seconds


def reconstruct(scene: Scene, database: Path, known: bool, names: list[str]) -> tuple[Any, float]:
    """Return the largest reconstruction of some images, or None, and the median error of its camera centres, metres."""
    options = pycolmap.IncrementalPipelineOptions()
    options.image_names, options.min_model_size, options.extract_colors = names, 3, False
    options.random_seed, options.num_threads = 0, 1
    if known:
        options.ba_refine_focal_length = options.mapper.abs_pose_refine_focal_length = False
        options.ba_refine_extra_params = options.mapper.abs_pose_refine_extra_params = False
    pycolmap.set_random_seed(0)
    out = database.with_suffix("")
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir()
    found = pycolmap.incremental_mapping(database, scene.folder, out, options)
    best = max(found.values(), key=lambda one: one.num_reg_images(), default=None)
    posed = [] if best is None else [image for image in best.images.values() if image.has_pose]
    centres = np.array([image.projection_center() for image in posed])
    truth = np.array([scene.centres[image.name] for image in posed])
    similarity = pycolmap.estimate_sim3d(centres, truth) if len(posed) > 3 else None  # three lie in a plane
    if similarity is None:
        return best, float("nan")
    errors = [np.linalg.norm(similarity * centre - true) for centre, true in zip(centres, truth, strict=True)]
    return best, float(np.median(errors))


def measure(scene: Scene, work: Path, method: str, known: bool, about: str) -> list[str]:
    """Return the row of a scene and a method."""
    database = work / f"{scene.folder.name}-{method}-{known}.db"
    pairs, inliers, seconds = verify(scene, database, method, known)
    names = sorted(scene.centres)
    start = time.perf_counter()
    found, error = reconstruct(scene, database, known, names)
    took = time.perf_counter() - start
    without = [reconstruct(scene, database, known, [n for n in names if n != name])[1] for name in names]
    images = 0 if found is None else found.num_reg_images()
    reprojection = float("nan") if found is None else found.compute_mean_reprojection_error()
    row = [scene.folder.name, about, "given" if known else "estimated", method, str(pairs), str(inliers)]
    numbers = (1000 * error, 1000 * np.median(without), seconds, took)
    return [*row, f"{images} of {len(names)}", f"{reprojection:.2f}", *(f"{number:.1f}" for number in numbers)]


def main(arguments: list[str] | None = None) -> None:
    parser = make_parser(__doc__, csv="write the table to this file")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scenes", nargs="+", help="subfolders (default: all)")
    text = "COLMAP, RANSAC or weights, such as robust (default: COLMAP RANSAC)"
    parser.add_argument("--methods", metavar="NAME", nargs="+", default=METHODS, help=text)
    text = "detectors and matchers (default: %(default)s)"
    parser.add_argument("--matches", metavar="DETECTOR+MATCHER", nargs="+", default=["sift+nearest"], help=text)
    args = parser.parse_args(arguments)
    torch.set_num_threads(1)
    pycolmap.logging.minloglevel = int(pycolmap.logging.ERROR)
    rows = []
    with tempfile.TemporaryDirectory() as work:
        for name in args.scenes or sorted(path.name for path in args.folder.iterdir() if path.is_dir()):
            for matches in args.matches:
                place = Path(work) / matches
                place.mkdir(exist_ok=True)
                scene = read_scene(args.folder / name, place, *matches.split("+"))
                for known in (True, False):
                    for method in args.methods:
                        rows.append(measure(scene, place, method, known, matches))
                        print(*rows[-1], flush=True)
    print(format_table(HEADER, rows))
    write_csv(args.csv, [HEADER, *rows])


if __name__ == "__main__":
    main()
