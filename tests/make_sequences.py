"""Tiny sequences that the readers know: frame ``n`` is a window of a wall, ``STEP * n`` pixels to the right."""

from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
from PIL import Image

SIZE, FRAMES, STEP, DEPTH = (160, 120), 4, 6, 4.0  # pixels, -, pixels, metres
FOCAL = 130.0
KITTI_K = np.array([[FOCAL, 0, 80.5], [0, FOCAL, 58.0], [0, 0, 1]])
KITTI_BASELINES = (0.0, 12.0, 2.0, 14.0)  # of cameras 0 to 3, pixels at the wall's depth
FR1, FR3 = "rgbd_dataset_freiburg1_wall", "rgbd_dataset_freiburg3_long_office_household"
TUM_START, TUM_FOCALS = 1300000000.0, {FR1: 517.3, FR3: 535.4}


def metres(pixels: float, focal: float = FOCAL) -> float:
    """How far a camera moves for the wall to move so many pixels."""
    return pixels * DEPTH / focal


@cache
def texture(seed: int = 0, width: int = 240, height: int = 180) -> np.ndarray:
    """Random blobs at two scales, grey values from 0 to 255; their features are stable."""
    spectrum = np.fft.rfft2(np.random.default_rng(seed).normal(size=(height, width)))
    frequency = np.hypot(np.fft.fftfreq(height)[:, None], np.fft.rfftfreq(width)[None])
    image = sum(np.fft.irfft2(spectrum * np.exp(-((frequency * scale * 4) ** 2))) * scale for scale in (1.5, 4.0))
    low, high = np.percentile(image, [1, 99])
    return (np.clip((image - low) / (high - low), 0, 1) * 255).astype(np.uint8)


def blobs(centres: np.ndarray, width: int = 240, height: int = 180, width_of_blob: float = 3.0) -> np.ndarray:
    """A smooth bright blob about each centre (x, y)."""
    y, x = np.ogrid[:height, :width]
    falloff = 2 * width_of_blob**2
    image = sum(np.exp(-((x - cx) ** 2) / falloff) * np.exp(-((y - cy) ** 2) / falloff) for cx, cy in centres)
    return np.round(np.clip(image, 0, 1) * 250).astype(np.uint8)


def centroids(image: np.ndarray, near: np.ndarray, reach: int = 14, floor: int = 0) -> np.ndarray:
    """Centre of mass of the grey values above a floor about each of some pixels."""
    found = []
    for centre in np.round(near).astype(int):
        (left, top), (right, bottom) = centre - reach, centre + reach + 1
        mass = image[top:bottom, left:right].astype(float).clip(floor) - floor
        found.append([(mass.sum(0) @ np.arange(left, right)), (mass.sum(1) @ np.arange(top, bottom))] / mass.sum())
    return np.array(found)


def write_image(path: Path, shift: int, size: tuple[int, int] = SIZE, seed: int = 0) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(texture(seed, 900, 500)[: size[1], shift : shift + size[0]]).save(path)


def write_lines(path: Path, *lines: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")


def words(*values: float) -> str:
    return " ".join(f"{value:.9g}" for value in values)


def write_kitti(root: Path) -> None:
    """Sequences 00 and 06 with poses and 11 without, grey cameras 0 and 1, colour cameras 2 and 3."""
    for seed, name in enumerate(["00", "06", "11"]):
        calibration = []
        for number, pixels in enumerate(KITTI_BASELINES):
            P = KITTI_K @ np.column_stack([np.eye(3), [-metres(pixels), 0, 0]])
            calibration.append(f"P{number}: {words(*P.flat)}")
            for frame in range(FRAMES):
                path = root / "sequences" / name / f"image_{number}" / f"{frame:06}.png"
                write_image(path, STEP * frame + int(pixels), seed=seed)
        write_lines(root / "sequences" / name / "calib.txt", *calibration, f"Tr: {words(*np.eye(3, 4).flat)}")
        poses = [words(1, 0, 0, metres(STEP * frame), 0, 1, 0, 0, 0, 0, 1, 0) for frame in range(FRAMES)]
        if name != "11":
            write_lines(root / "poses" / f"{name}.txt", *poses)


def write_tum(root: Path) -> None:
    """A sequence of the first and one of the third Kinect; the world is turned by 90 degrees about the optical axis."""
    for name, focal in TUM_FOCALS.items():
        folder = root / name
        listed, poses, half = [], [], np.sqrt(0.5)
        for frame in range(FRAMES):
            time = TUM_START + frame
            listed.append(f"{time:.6f} rgb/{time:.6f}.png")
            write_image(folder / "rgb" / f"{time:.6f}.png", STEP * frame, (640, 480))
            for moment in (-0.004, 0.006):  # the pose of the frame is the earlier, nearer one
                along = metres(STEP * frame, focal) + (0.1 if moment > 0 else 0)
                poses.append(f"{time + moment:.4f} {words(0, along, 0, 0, 0, half, half)}")
        write_lines(folder / "rgb.txt", "# color images", "# timestamp filename", *listed)
        write_lines(folder / "groundtruth.txt", "# ground truth trajectory", *poses)


def write_cambridge(root: Path) -> None:
    """A scene with folders seq1 and seq2, the first for training, and its reconstruction."""
    header = ("Visual Landmark Dataset V1", "ImageFile, Camera Position [X Y Z W P Q R]", "")
    model = []
    for folder, split in (("seq1", "train"), ("seq2", "test")):
        lines = []
        for frame in range(FRAMES):
            name, along = f"{folder}/frame{frame + 1:05}", metres(STEP * frame)
            write_image(root / f"{name}.png", STEP * frame)
            lines.append(f"{name}.png {words(along, 0, 0, 1, 0, 0, 0)}")
            model.append(f"{name}.jpg\t{words(FOCAL, 1, 0, 0, 0, along, 0, 0, -0.05, 0)}")
        write_lines(root / f"dataset_{split}.txt", *header, *lines)
    write_lines(root / "reconstruction.nvm", "NVM_V3 ", "", str(len(model)), *model, "", "0")


def write_folder(root: Path) -> None:
    """Images side by side and in folders, with suffixes in either case, and files that are none."""
    for name in ("a.png", "b.PNG", "left/1.jpg", "left/2.JPG", "left/deep/1.bmp", "right/1.tif", "right/2.webp"):
        write_image(root / name, 10 * len(name))
    write_lines(root / "left" / "notes.txt", "not an image")


def write_colmap(root: Path) -> None:
    """A text model in ``model``, its images in ``images`` and all pairs of neighbours in ``pairs.txt``."""
    grid = np.stack(np.meshgrid(np.arange(-2.0, 2.6, 0.4), np.arange(-1.6, 1.7, 0.4)), -1).reshape(-1, 2)
    names = [f"{'one' if frame < 2 else 'two'}/{frame}.png" for frame in range(FRAMES)]
    tracks: list[list[str]] = [[] for _ in grid]
    lines = []
    for frame, name in enumerate(names):
        write_image(root / "images" / name, STEP * frame)
        pixels = (grid - [metres(STEP * frame), 0]) * FOCAL / DEPTH + [80, 60]  # the top left corner is (0, 0)
        seen = np.flatnonzero(((pixels >= 0) & (pixels < SIZE)).all(1))
        for place, point in enumerate(seen):
            tracks[point].append(f"{frame + 1} {place}")
        lines.append(f"{frame + 1} {words(1, 0, 0, 0, -metres(STEP * frame), 0, 0)} 1 {name}")
        lines.append(" ".join(f"{words(*pixels[point])} {point + 1}" for point in seen))
    write_lines(root / "model" / "cameras.txt", "# Camera list", f"1 PINHOLE {words(*SIZE, FOCAL, FOCAL, 80, 60)}")
    write_lines(root / "model" / "images.txt", "# Image list", *lines)
    points = [f"{n + 1} {words(*grid[n], DEPTH)} 90 90 90 0.1 {' '.join(t)}" for n, t in enumerate(tracks) if t]
    write_lines(root / "model" / "points3D.txt", "# 3D point list", *points)
    write_lines(root / "pairs.txt", *(f"{a} {b}" for a, b in pairwise(names)))


LAYOUTS = {"kitti": write_kitti, "tum": write_tum, "cambridge": write_cambridge}
LAYOUTS |= {"folder": write_folder, "colmap": write_colmap}


def edit(path: Path, line: int, text: str | None) -> None:
    """Replace a line, counted from 1, or take it out."""
    lines = path.read_text().splitlines()
    lines[line - 1 : line] = [] if text is None else [text]
    path.write_text("".join(f"{one}\n" for one in lines))


def names(pairs) -> list[tuple[str, str]]:
    """Names of the frames of each pair."""
    return [(pair.frame1.name, pair.frame2.name) for pair in pairs]


def moved(pixels: float, focal: float = FOCAL) -> np.ndarray:
    pose = np.eye(4)
    pose[0, 3] = metres(pixels, focal)
    return pose


def rotated(wxyz: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Rotate vectors (N, 3) by a unit quaternion."""
    w, u = wxyz[0], wxyz[1:]
    return vectors + 2 * (w * np.cross(u, vectors) + np.cross(u, np.cross(u, vectors)))
