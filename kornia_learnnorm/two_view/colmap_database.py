"""Matches and their two-view geometries as a database that COLMAP reconstructs. pycolmap is imported on use.

Pixels are COLMAP's in all private functions: they begin at the corner of the first pixel, not at its centre.
"""

import sys
from collections import defaultdict
from collections.abc import Collection, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from kornia_learnnorm.data.images import Size, image_size, stored_pixels
from kornia_learnnorm.data.matching.workers import open_workers
from kornia_learnnorm.data.store import CorrespondenceStore
from kornia_learnnorm.data.store_writer import check_target
from kornia_learnnorm.estimators.learned_eight_point import LearnedEightPoint
from kornia_learnnorm.files import atomic_write, explained
from kornia_learnnorm.geometry.distances import symmetric_epipolar_distance, transfer_distance
from kornia_learnnorm.geometry.pose import relative_pose
from kornia_learnnorm.geometry.transforms import transform_fundamental
from kornia_learnnorm.models.essential import nearest_essential
from kornia_learnnorm.optional import import_extra
from kornia_learnnorm.protocol import RATIO
from kornia_learnnorm.ransac.ransac import RANSAC
from kornia_learnnorm.two_view.input_checks import check_settings, read_cameras
from kornia_learnnorm.two_view.pair_warnings import (
    MAX_LOG_FALSE_ALARMS,
    PairWarning,
    find_camera_doubt,
    log_false_alarms,
)
from kornia_learnnorm.two_view.solver import MIN_SCORE

CORNER = 0.5  # pixels from the corner of the first pixel to its centre
THRESHOLD = 2.0  # pixels, of RANSAC
INLIER_FACTOR = 2.0  # thresholds within which a match is an inlier: imprecise inliers are better than broken tracks
MIN_INLIERS = 15  # of a verified pair, COLMAP's own number
PLANAR_SHARE = 0.8  # of the inliers on one homography, COLMAP's own number
MAX_SKEW = 1e-6  # of the focal length, by rounding
PLANE_SAMPLES = 512  # far more than needed to find a plane with that share of the inliers
Array = NDArray[np.float64]


class DatabaseCounts(NamedTuple):
    """What a database holds."""

    images: int
    pairs: int
    matches: int
    verified: int  # pairs with a two-view geometry
    inliers: int  # of the verified pairs
    unverified: tuple[str, ...]  # names of the images without a verified pair
    doubts: tuple[PairWarning, ...] = ()  # why the camera may be that of another image size


class _Pair(NamedTuple):
    names: tuple[str, str]
    sizes: tuple[Size, Size]  # (width, height)
    points: tuple[Array, Array]  # (N, 2) in each image
    scores: Array  # (N,)


class _Geometry(NamedTuple):
    config: str  # a name of pycolmap.TwoViewGeometryConfiguration
    matrices: dict[str, Array]  # F, E, H, (3, 3), where there are some
    pose: tuple[Array, Array] | None  # R (3, 3) and t (3,)
    inliers: NDArray[np.bool_]  # (N,)


def export_colmap(
    store: CorrespondenceStore,
    images: str | Path,
    path: str | Path,
    K: Array | None = None,
    single_camera: bool = False,
    layer: LearnedEightPoint | None = None,
    threshold: float = THRESHOLD,
    seed: int = 0,
    turned: bool = True,
    jobs: int = -1,
) -> DatabaseCounts:
    """Write the matches of a store and their two-view geometries as a COLMAP database, and return what it holds.

    :class:`~kornia_learnnorm.RANSAC` estimates the fundamental matrix of each pair and the homography of its main
    plane, with ``K`` also an essential matrix and a pose. A pair with fewer than 15 inliers, or no more than random
    matches have, gets no geometry. Keypoints are the matched points. ``pycolmap.incremental_mapping`` and
    ``colmap mapper`` reconstruct from the database.

    Args:
        store: matches of images at full size, of which those that fail the ratio test are left out; of two pairs of the
            same images, the first counts.
        images: folder that the names in the store start from.
        path: the database to write; there must be none yet.
        K: camera (3, 3) of all images, pixels, without distortion. When not given, COLMAP derives cameras from EXIF, or
            from 1.2 times the longer side.
        single_camera: whether all images share one camera; with ``K`` they do.
        layer: estimates the fundamental matrix instead of RANSAC.
        threshold: RANSAC's largest symmetric epipolar distance, pixels; inliers are the matches within twice this.
        seed: seed of RANSAC.
        turned: whether the points are those of images rotated by EXIF, as a store has them, or of the stored files,
            as hloc and COLMAP read them.
        jobs: number of processes, -1 for one a core.

    Raises:
        FileNotFoundError: if an image is missing.
        FileExistsError: if there is a file at ``path``.
        TypeError: if an argument is of a wrong type.
        ValueError: if an argument is out of range, or COLMAP cannot read an image or finds another size than the store.
        ImportError: if pycolmap is not installed.
    """
    pycolmap = import_extra("pycolmap", "colmap", "writing a COLMAP database")
    tqdm = import_extra("tqdm", "images", "estimating many pairs").tqdm
    images, path = Path(images), Path(path)
    check_database(path)
    check_settings(threshold, seed, layer)
    read_cameras(K, K)
    names = sorted({name for both in store.names for name in both})
    if missing := [name for name in names if not (images / name).is_file()]:
        raise FileNotFoundError(f"{len(missing)} of {len(names)} images are not in {images}, the first is {missing[0]}")
    camera, pairs = _colmap_camera(K), _read_pairs(store, images, turned)
    doubts: tuple[PairWarning, ...] = ()
    if camera is not None and pairs and len(pairs[0].scores):
        matrix, (points1, points2) = torch.from_numpy(camera), map(torch.from_numpy, pairs[0].points)
        doubts = find_camera_doubt((matrix, matrix), pairs[0].sizes, points1, points2, None, threshold)
    with atomic_write(path) as temporary:
        with explained(f"COLMAP cannot write {path}", RuntimeError):
            ids = _write_images(pycolmap, temporary, images, pairs, camera, single_camera)
        arguments = ((pair, layer, threshold, seed, camera) for pair in pairs)
        with open_workers(jobs) as workers, workers.results(_estimate, arguments) as results:
            found = [*tqdm(results, "estimating", len(pairs), unit="pair", file=sys.stderr)]
        with explained(f"COLMAP cannot write {path}", RuntimeError):
            _write_pairs(pycolmap, temporary, ids, pairs, found)
    verified = [(pair, geometry) for pair, geometry in zip(pairs, found, strict=True) if geometry is not None]
    unverified = tuple(sorted(ids.keys() - {name for pair, _ in verified for name in pair.names}))
    number, inliers = sum(len(pair.scores) for pair in pairs), sum(int(part.inliers.sum()) for _, part in verified)
    return DatabaseCounts(len(ids), len(pairs), number, len(verified), inliers, unverified, doubts)


def check_database(path: Path) -> None:
    """Raise a clear error unless a COLMAP database can be written to a path."""
    import_extra("pycolmap", "colmap", "writing a COLMAP database")
    if path.exists():
        raise FileExistsError(f"{path} exists already: remove it, or write elsewhere")
    check_target(path)


def check_images(images: Path, names: Collection[str], K: Array | None = None, single_camera: bool = False) -> None:
    """Raise a ValueError if COLMAP leaves out images that others can read; arguments as for :func:`export_colmap`."""
    pycolmap = import_extra("pycolmap", "colmap", "writing a COLMAP database")
    readable = [name for name in names if image_size(images / name) != (0, 0)]
    with TemporaryDirectory() as folder:
        (database := Path(folder) / "images.db").touch()
        _import_images(pycolmap, database, images, readable, _colmap_camera(K), single_camera)


def _colmap_camera(K: Array | None) -> Array | None:
    """Return a camera of pixels from the corner of the first one."""
    if K is None:
        return None
    if abs(K[0, 1]) > MAX_SKEW * K[0, 0]:
        raise ValueError(f"K must have no skew, as COLMAP's PINHOLE has none, got {K[0, 1]}")
    camera: Array = K / K[2, 2] + np.array([[0, 0, CORNER], [0, 0, CORNER], [0, 0, 0]])
    return camera


def _read_pairs(store: CorrespondenceStore, images: Path, turned: bool) -> list[_Pair]:
    """Return the pairs of a store, each two images once, in pixels of the files as they are."""
    pairs: dict[frozenset[str], _Pair] = {}
    for place, names in enumerate(store.names):
        rows = store.rows(place, RATIO)
        (points1, size1), (points2, size2) = [
            stored_pixels(images / name, points[rows], size, turned)
            for name, points, size in zip(names, (store.points1, store.points2), store.image_size[place], strict=True)
        ]
        points, scores = (points1 + CORNER, points2 + CORNER), store.score[rows].astype(np.float64)
        pairs.setdefault(frozenset(names), _Pair(names, (size1, size2), points, scores))
    return [*pairs.values()]


def _estimate(
    pair: _Pair, layer: LearnedEightPoint | None, threshold: float, seed: int, camera: Array | None
) -> _Geometry | None:
    """Return the geometry of a pair, or None where too few matches agree."""
    if len(pair.scores) < MIN_INLIERS:
        return None
    points1, points2, scores = map(torch.from_numpy, (*pair.points, pair.scores))
    K = None if camera is None else torch.from_numpy(camera)
    options: dict[str, Any] = {"inl_th": threshold, "distance": "symmetric", "seed": seed}
    matches = points1, points2, scores.clamp(min=MIN_SCORE)
    if layer is None:
        F_mat = RANSAC(**options).estimate(*matches, K, K).F_mat
    else:
        with torch.no_grad():
            F_mat = layer.estimate(points1[None], points2[None], scores=scores[None]).F_mat[0]
    widest = INLIER_FACTOR * threshold
    inliers = symmetric_epipolar_distance(points1, points2, F_mat) < widest
    number = int(inliers.sum())
    if number < MIN_INLIERS or log_false_alarms(len(scores), number, widest, pair.sizes[1]) > MAX_LOG_FALSE_ALARMS:
        return None
    plane = RANSAC(model="homography", max_samples=PLANE_SAMPLES, **options)
    H_mat = plane.estimate(*(value[inliers] for value in matches)).F_mat
    on_plane = transfer_distance(points1[inliers][None], points2[inliers][None], H_mat[None]) < widest
    matrices, pose, config = {"F": F_mat, "H": H_mat}, None, "UNCALIBRATED"
    if K is not None:
        config = "CALIBRATED"
        matrices["E"] = nearest_essential(transform_fundamental(F_mat, K, K)[None])[0]
        R, t = relative_pose(*(value[None] for value in (F_mat, K, K, points1, points2, inliers)))
        if bool(R.isfinite().all()):
            pose = R[0].numpy(), t[0].numpy()
    if int(on_plane.sum()) > PLANAR_SHARE * number:
        config = "PLANAR_OR_PANORAMIC"
    return _Geometry(config, {name: matrix.numpy() for name, matrix in matrices.items()}, pose, inliers.numpy())


def _write_images(
    pycolmap: Any, database: Path, images: Path, pairs: Sequence[_Pair], camera: Array | None, single_camera: bool
) -> dict[str, int]:
    """Write images and cameras to a database and return the number of each image."""
    sizes = {name: size for pair in pairs for name, size in zip(pair.names, pair.sizes, strict=True)}
    ids = {}
    for name, image_id, stored in _import_images(pycolmap, database, images, sizes, camera, single_camera):
        if sizes[name] != stored:
            text = "{} was matched at {} x {} pixels, COLMAP reads {} x {}: match images at full size"
            raise ValueError(text.format(name, *sizes[name], *stored))
        ids[name] = image_id
    return ids


def _import_images(
    pycolmap: Any, database: Path, images: Path, names: Collection[str], camera: Array | None, single_camera: bool
) -> list[tuple[str, int, Size]]:
    """Write images and cameras to a database and return names, numbers and sizes of the images."""
    options = pycolmap.ImageReaderOptions()
    if camera is not None:
        options.camera_model = "PINHOLE"
        options.camera_params = ",".join(str(camera[place]) for place in ((0, 0), (1, 1), (0, 2), (1, 2)))
    mode = pycolmap.CameraMode.AUTO if camera is None and not single_camera else pycolmap.CameraMode.SINGLE
    pycolmap.import_images(database, images, mode, sorted(names), options)
    with pycolmap.Database.open(database) as file:
        found = file.read_all_images()
        if missing := sorted(set(names) - {image.name for image in found}):
            text = f"COLMAP leaves out {len(missing)} of {len(names)} images, the first is {missing[0]}: a file that it"
            raise ValueError(f"{text} cannot read or, where all share one camera, of another size or orientation")
        stored = [file.read_camera(image.camera_id) for image in found]
    views = zip(found, stored, strict=True)
    return [(image.name, image.image_id, (camera.width, camera.height)) for image, camera in views]


def _write_pairs(
    pycolmap: Any, database: Path, ids: dict[str, int], pairs: list[_Pair], geometries: list[_Geometry | None]
) -> None:
    """Write keypoints, which are all matched points of an image, matches and geometries to a database."""
    seen: defaultdict[str, list[Array]] = defaultdict(list)
    for pair in pairs:
        for name, points in zip(pair.names, pair.points, strict=True):
            seen[name].append(points)
    keypoints = {name: np.unique(np.concatenate(parts), axis=0) for name, parts in seen.items()}
    places = {name: {tuple(point): n for n, point in enumerate(points.tolist())} for name, points in keypoints.items()}

    with pycolmap.Database.open(database) as file, pycolmap.DatabaseTransaction(file):
        for name, points in keypoints.items():
            file.write_keypoints(ids[name], points.astype(np.float32))
        for pair, found in zip(pairs, geometries, strict=True):
            numbers, views = [ids[name] for name in pair.names], zip(pair.names, pair.points, strict=True)
            columns = [[places[name][tuple(point)] for point in points.tolist()] for name, points in views]
            matches = np.array(columns, np.uint32).T
            file.write_matches(*numbers, matches)
            if found is None:
                continue
            config = int(getattr(pycolmap.TwoViewGeometryConfiguration, found.config))
            geometry = pycolmap.TwoViewGeometry(config=config, inlier_matches=matches[found.inliers], **found.matrices)
            if found.pose is not None:
                R, t = found.pose
                geometry.cam2_from_cam1 = pycolmap.Rigid3d(pycolmap.Rotation3d(R), t)
            file.write_two_view_geometry(*numbers, geometry)
