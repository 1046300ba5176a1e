"""Camera matrices from what a person can give: four numbers, a file, or the EXIF data of a photograph."""

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kornia_learnnorm.data.datasets import colmap, kitti
from kornia_learnnorm.data.datasets.textfiles import camera_matrix
from kornia_learnnorm.data.images import image_size, open_image

KITTI_CAMERA = "P0"  # projection of image_0 in a calib.txt
STRECHA_SIZE = 26  # numbers of a file: the camera matrix, distortion (3), rotation (9), centre (3), width and height
FILM_DIAGONAL = math.hypot(36, 24)  # millimetres
EXIF_IFD, FOCAL_LENGTH_35MM = 0x8769, 0xA405  # tags, EXIF 2.32, sections 4.6.3 and 4.6.5; the latter in millimetres


def read_camera(text: str, image: str | Path | None = None) -> NDArray[np.float64]:
    """Return a camera matrix (3, 3), pixels, of ``fx,fy,cx,cy``, a file of a camera, or ``exif`` of an image.

    A file has these four or all nine numbers, or is KITTI's ``calib.txt``, of which ``P0`` counts, COLMAP's
    ``cameras.txt`` or a ``.camera`` of Strecha et al. (CVPR 2008) with one camera without distortion.
    """
    if text == "exif":
        if image is None:
            raise ValueError("camera exif: an image file expected, got none")
        return exif_camera(image)
    expected = "expected fx,fy,cx,cy, a file of four or nine numbers, KITTI's calib.txt, COLMAP's cameras.txt,"
    expected += " Strecha's .camera or exif"
    content = text
    try:
        if "," not in text or Path(text).exists():
            content = Path(text).read_text(encoding="utf-8")
            if any(line.startswith(f"{KITTI_CAMERA}:") for line in content.splitlines()):
                return kitti.read_calibration(Path(text), KITTI_CAMERA)[0]
            if not colmap.FIRST_DISTORTION.keys().isdisjoint(content.split()):
                return colmap.read_pinhole(Path(text))
        numbers = np.array(content.replace(",", " ").split(), float)
    except FileNotFoundError as error:
        raise FileNotFoundError(f"camera {text}: no such file; {expected}") from error
    except (ValueError, IsADirectoryError) as error:
        raise ValueError(f"camera {text}: {expected}: {error}") from error
    if numbers.size == 4:
        numbers = camera_matrix(*numbers)
    if numbers.size == STRECHA_SIZE:
        if numbers[9:12].any():
            raise ValueError(f"camera {text}: no distortion expected, got {numbers[9:12].tolist()}")
        numbers = numbers[:9]
    if numbers.size != 9:
        raise ValueError(f"camera {text}: {expected}, got {numbers.size} numbers")
    K: NDArray[np.float64] = numbers.reshape(3, 3)
    if not np.isfinite(K).all() or K[0, 0] <= 0 or K[1, 1] <= 0 or K[1, 0] or not np.array_equal(K[2], [0, 0, 1]):
        wanted = "positive focal lengths, K[1, 0] = 0 and a last row of 0 0 1 expected"
        raise ValueError(f"camera {text}: {wanted}, got {K.tolist()}")
    return K


def exif_camera(path: str | Path) -> NDArray[np.float64]:
    """Return the camera matrix (3, 3), pixels, by EXIF's focal length on 35 mm film; wrong for cropped photographs."""
    size = image_size(path)
    if size == (0, 0):
        raise ValueError(f"camera exif: {path} is not an image")
    with open_image(Path(path)) as image:
        focal = float(image.getexif().get_ifd(EXIF_IFD).get(FOCAL_LENGTH_35MM, 0))
    if not 0 < focal < math.inf:
        raise ValueError(f"camera exif: {path} has no focal length on 35 mm film; give fx,fy,cx,cy")
    pixels = focal * math.hypot(*size) / FILM_DIAGONAL
    return camera_matrix(pixels, pixels, (size[0] - 1) / 2, (size[1] - 1) / 2)
