"""COLMAP models: their frames and cameras. pycolmap is imported on use."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kornia_learnnorm.data.datasets.frames import Frame
from kornia_learnnorm.data.datasets.textfiles import camera_matrix, text_lines
from kornia_learnnorm.data.images import image_size
from kornia_learnnorm.files import explained
from kornia_learnnorm.optional import import_extra

# Index of the first distortion parameter of a camera model (COLMAP's source, sensor/models.h). These parameters are the
# first of OpenCV's k1, k2, p1, p2.
FIRST_DISTORTION = {"SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 3, "RADIAL": 3, "OPENCV": 4}


def read_colmap(model: str | Path, images: str | Path) -> list[Frame]:
    """Return the frames of a COLMAP model (https://colmap.github.io/format.html) by name, each folder a sequence.

    ``model`` is the folder with cameras, images and points3D, as ``.bin`` or ``.txt``, of any unit of length; the
    images' names start from the folder ``images``. The centre of the top left pixel is (0.5, 0.5) in COLMAP and (0, 0)
    in a frame. Poses are NaN where the model has none. FileNotFoundError if a file of the model or an image is missing;
    ValueError if the model is malformed or empty, a camera has distortion other than k1, k2, p1, p2, or an image does
    not have its camera's size, as one that EXIF turns by a quarter.
    """
    images, reconstruction = Path(images), read_reconstruction(Path(model))
    found = sorted(reconstruction.images.values(), key=lambda image: (image.name.rpartition("/")[0], image.name))
    if not found:
        raise ValueError(f"the model {model} has no images")
    if missing := [image.name for image in found if not (images / image.name).is_file()]:
        raise FileNotFoundError(f"{len(missing)} of {len(found)} images are not in {images}, the first is {missing[0]}")
    return [_frame(image, images / image.name) for image in found]


def read_pinhole(path: Path) -> NDArray[np.float64]:
    """Return the matrix (3, 3) of the one camera, without distortion, of a ``cameras.txt``; ValueError for others.

    Its principal point is that of a frame, see :func:`read_colmap`.
    """
    lines = list(text_lines(path, "COLMAP cameras"))
    if len(lines) != 1:
        raise ValueError(f"{path}: one camera expected, got {len(lines)}")
    words = lines[0].text.split()
    if len(words) < 5 or words[1] not in FIRST_DISTORTION:
        raise lines[0].error(f"an identifier and a camera model of {', '.join(FIRST_DISTORTION)}")
    first = FIRST_DISTORTION[words[1]]
    params = lines[0].numbers(words[4:], len(words[4:]), f"numbers of a {words[1]} camera")
    if len(params) < first or params[first:].any():
        raise lines[0].error("a camera without distortion, as of colmap image_undistorter,")
    return camera_matrix(params[0], params[first - 3], *(params[first - 2 : first] - 0.5))


def read_reconstruction(model: Path) -> Any:
    """Return pycolmap's reconstruction of a model."""
    pycolmap = import_extra("pycolmap", "colmap", "reading COLMAP models")
    for name in ("cameras", "images", "points3D"):
        if not any((model / f"{name}.{suffix}").is_file() for suffix in ("bin", "txt")):
            raise FileNotFoundError(f"no COLMAP model at {model}: it lacks {name}.bin or {name}.txt")
    # IndexError: a reference to a missing camera or point
    with explained(f"the COLMAP model {model} cannot be read", ValueError, IndexError, RuntimeError):
        return pycolmap.Reconstruction(str(model))


def _frame(image: Any, path: Path) -> Frame:
    camera, size = image.camera, image_size(path)
    if camera.model_name not in FIRST_DISTORTION:
        known = ", ".join(FIRST_DISTORTION)
        raise ValueError(f"camera model of {image.name} must be one of {known}, got {camera.model_name}")
    if size not in ((0, 0), (camera.width, camera.height)):
        expected, got = f"{camera.width} x {camera.height}", f"{size[0]} x {size[1]}"
        raise ValueError(f"image {path} must have its camera's size, {expected} pixels, got {got}")
    K: NDArray[np.float64] = np.array(camera.calibration_matrix(), np.float64)
    K[:2, 2] -= 0.5
    terms = [float(term) for term in camera.params[FIRST_DISTORTION[camera.model_name] :]]
    distortion = (*terms, 0.0, 0.0, 0.0)[:4] if terms else ()
    pose = np.full((4, 4), np.nan)
    if image.has_pose:
        pose = np.vstack([image.cam_from_world().inverse().matrix(), [0.0, 0.0, 0.0, 1.0]])
    return Frame(path, image.name, image.name.rpartition("/")[0], size, K, pose, distortion)
