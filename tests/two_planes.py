"""Two images of two planes, the left half nearer than the right one, and their true geometry."""

from pathlib import Path

import cv2
import numpy as np
from make_sequences import texture

WIDTH, HEIGHT = 320, 240
K = np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]])
R, t = cv2.Rodrigues(np.array([0.01, -0.03, 0.02]))[0], np.array([0.3, 0.05, 0.1])
F = np.linalg.inv(K).T @ np.cross(t, np.eye(3)).T @ R @ np.linalg.inv(K)


def warp(image: np.ndarray, depth: float) -> np.ndarray:
    """Image 2 of the plane Z = depth: X2 = R X1 + t gives the homography K (R + t n^T / depth) K^-1."""
    H = K @ (R + np.outer(t, [0, 0, 1]) / depth) @ np.linalg.inv(K)
    return cv2.warpPerspective(image, H, (WIDTH, HEIGHT))


def write_images(folder: Path) -> Path:
    """Write ``left.png`` and ``right.png``, and images that give no matrix with them; return the folder."""
    image, near = texture(0, WIDTH, HEIGHT), np.zeros((HEIGHT, WIDTH), np.uint8)
    near[:, : WIDTH // 2] = 255
    moved = np.where(warp(near, 4.0) > 127, warp(image, 4.0), warp(image, 9.0))
    noisy = np.clip(image + np.random.default_rng(1).normal(0, 1, image.shape), 0, 255).astype(np.uint8)
    images = {"left": image, "right": moved, "blank": np.zeros_like(image), "noisy": noisy, "plane": warp(image, 4.0)}
    for name, pixels in images.items():
        cv2.imwrite(str(folder / f"{name}.png"), pixels)
    (folder / "half.png").write_bytes((folder / "left.png").read_bytes()[:5000])
    return folder
