"""The difficult pairs of benchmarks/rendered.py."""

from functools import cache

import numpy as np
import pytest
from scenes import epipolar_distances

cv2 = pytest.importorskip("cv2")
from rendered import KINDS, render_kind  # noqa: E402

from kornia_learnnorm.data.synthetic.render import RenderedPair  # noqa: E402

SIZE = (320, 240)


@cache
def rendered(kind: str, seed: int) -> RenderedPair:
    return render_kind(kind, seed, *SIZE)


@pytest.mark.parametrize(("kind", "seed"), [*((kind, 0) for kind in KINDS), ("borders", 1)])
def test_images_show_the_correspondences(kind, seed):
    pair = rendered(kind, seed)
    assert len(pair.points1) == len(pair.points2) >= 500
    for points in (pair.points1, pair.points2):
        assert ((points >= 0) & (points <= np.array(SIZE) - 1)).all()
    values = [
        cv2.remap(cv2.GaussianBlur(image, None, 1.0), points.astype(np.float32)[:, None], None, cv2.INTER_LINEAR)
        for image, points in ((pair.image1, pair.points1), (pair.image2, pair.points2))
    ]
    assert np.corrcoef(values[0].ravel(), values[1].ravel())[0, 1] > 0.85  # 0 for points that do not correspond
    if kind == "rotation":
        H = pair.K @ pair.R @ np.linalg.inv(pair.K)
        np.testing.assert_allclose(cv2.perspectiveTransform(pair.points1[None], H)[0], pair.points2, atol=1e-9)
        assert np.isnan(pair.F_mat).all()
        assert pair.t.tolist() == [0, 0, 0]
        assert 3 <= np.degrees(np.arccos((np.trace(pair.R) - 1) / 2)) <= 16
        return
    assert epipolar_distances(pair.points1, pair.points2, pair.F_mat).max() < 1e-6
