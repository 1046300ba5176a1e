"""Frames and pairs of frames, which the readers of datasets return and matching takes."""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from kornia.geometry.epipolar import cross_product_matrix, fundamental_from_essential
from numpy.typing import NDArray
from torch import Tensor

from kornia_learnnorm.data.images import Pixels, Size, import_cv2, read_colour, read_image, scaling


def fundamental_from_motion(K1: Tensor, K2: Tensor, R: Tensor, t: Tensor) -> Tensor:
    r"""Return :math:`F = K_2^{-\top} [t]_\times R K_1^{-1}` of unit norm, (*, 3, 3); NaN where t is zero or NaN."""
    F_mat: Tensor = fundamental_from_essential(cross_product_matrix(t) @ R, K1, K2)
    scale: Tensor = F_mat.norm(dim=(-2, -1), keepdim=True)
    return F_mat / scale


@dataclass(frozen=True, eq=False)
class Frame:
    """An image, its camera and its pose, which are NaN where they are not known."""

    path: Path  # of the image file
    name: str  # the path below the root of the dataset, with slashes; the name in stores
    sequence: str  # name of the sequence; frames are paired by their order within a sequence
    size: Size  # (width, height) of the file, pixels; (0, 0) where it cannot be read
    camera: NDArray[np.float64] = field(default_factory=lambda: np.full((3, 3), np.nan))  # of the file's pixels
    pose: NDArray[np.float64] = field(default_factory=lambda: np.full((4, 4), np.nan))  # camera to world, metres
    distortion: tuple[float, ...] = ()  # OpenCV's k1, k2, p1, p2[, k3] of the file's pixels; removed before matching
    resized: Size | None = None  # (width, height) to resize to after undistortion; None keeps the file's

    @property
    def matched_size(self) -> Size:
        """Return (width, height) of the image that is matched, pixels."""
        return self.resized or self.size

    @property
    def K(self) -> NDArray[np.float64]:  # noqa: N802
        """Return the camera matrix of the image that is matched, (3, 3)."""
        if self.size == (0, 0):
            return self.camera
        return np.asarray(scaling(self.size, self.matched_size).numpy() @ self.camera)


class FramePair(NamedTuple):
    """Two frames, the first and the second view."""

    frame1: Frame
    frame2: Frame

    @property
    def motion(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return rotation R (3, 3) and translation t (3,) of x2 = R x1 + t, NaN where a pose is unknown."""
        pose1, pose2 = self.frame1.pose, self.frame2.pose
        R = np.linalg.solve(pose2[:3, :3], pose1[:3, :3])
        # The difference first: a camera that stood still has a translation of exactly zero.
        t = np.linalg.solve(pose2[:3, :3], pose1[:3, 3] - pose2[:3, 3])
        return np.asarray(R, np.float64), np.asarray(t, np.float64)

    @property
    def F(self) -> NDArray[np.float64]:  # noqa: N802
        """Return F with x2^T F x1 = 0 and unit norm, (3, 3); NaN where unknown or if the camera did not move."""
        return fundamental_from_motion(*map(torch.from_numpy, (self.frame1.K, self.frame2.K, *self.motion))).numpy()


def resize_frames(frames: Iterable[Frame], size: Size) -> list[Frame]:
    """Return the frames with the (width, height) that they are resized to before matching; ``K`` follows."""
    if min(size) < 1:
        raise ValueError(f"a size must be a positive width and height, got {size[0]} x {size[1]}")
    return [replace(frame, resized=size) for frame in frames]


def read_frame(frame: Frame, colour: bool = False) -> Pixels:
    """Return grey values (H, W) or colours (H, W, 3) of a frame as it is matched: undistorted, resized."""
    cv2 = import_cv2()
    image = (read_colour if colour else read_image)(frame.path)
    if image.shape[1::-1] != frame.size:
        got = f"{image.shape[1]} x {image.shape[0]}"
        raise ValueError(f"image {frame.path} has {got} pixels, its camera {frame.size[0]} x {frame.size[1]}")
    if any(frame.distortion):
        if not np.isfinite(frame.camera).all():
            raise ValueError(f"image {frame.path} has a distortion, but no camera matrix, which undistortion needs")
        image = cv2.undistort(image, frame.camera, np.array(frame.distortion))
    if frame.matched_size != frame.size:
        image = cv2.resize(image, frame.matched_size, interpolation=cv2.INTER_AREA)
    return np.asarray(image, np.uint8)
