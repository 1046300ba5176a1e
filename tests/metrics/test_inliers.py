"""F1 and epipolar error against sets of correspondences."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from kornia.core.exceptions import ShapeError
from references import epipolar_distances
from scenes import raises, scenes, seeded

from kornia_learnnorm.metrics.inliers import epipolar_error, f1_score

INF, NAN = float("inf"), float("nan")
ROWS = torch.tensor([[[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]], dtype=torch.float64)  # y1 - y2
METRICS = {"f1": f1_score, "error": epipolar_error}


def by_hand(points1, points2, F, true, threshold):
    estimated, actual = (epipolar_distances(points1, points2, matrix) for matrix in (F, true))
    chosen, right = ({i for i, d in enumerate(ds) if d < threshold} for ds in (estimated, actual))
    hits, f1 = len(chosen & right), NAN
    if right:
        precision, recall = hits / max(len(chosen), 1), hits / len(right)
        f1 = 2 * precision * recall / (precision + recall) if hits else 0.0
    error = np.mean([estimated[i] for i in sorted(right)]) if right else NAN
    return {"f1": f1, "error": error}


def pairs(seed=0, batch_size=6, num_points=40, jitter=1e-3):
    """Noisy scenes with outliers, and matrices that are somewhat wrong, in the numbers that the points see."""
    scene = scenes("handheld", batch_size, num_points, seed=seed, noise=0.5, outliers=0.3)
    wrong = 1 + jitter * torch.randn(scene.F_mat.shape, generator=seeded(seed), dtype=torch.float64)
    return scene.points1, scene.points2, scene.F_mat * wrong, scene.F_mat


@pytest.mark.parametrize("name", METRICS)
class TestAll:
    @pytest.mark.parametrize("shape", [(1,), (3,), (2, 3)])
    def test_smoke(self, name, shape, device, dtype):
        points1, points2 = (torch.rand(*shape, 5, 2, device=device, dtype=dtype) for _ in range(2))
        F, true = (torch.rand(*shape, 3, 3, device=device, dtype=dtype) for _ in range(2))
        found = METRICS[name](points1, points2, F, true, 100.0)
        assert (found.shape, found.dtype, found.device.type) == (shape, dtype, device.type)

    @pytest.mark.parametrize("threshold", [0.1, 1.0, 5.0])
    def test_by_hand(self, name, threshold):
        batch = pairs()
        found = METRICS[name](*batch, threshold)
        expected = [by_hand(*(v.numpy() for v in pair), threshold)[name] for pair in zip(*batch, strict=True)]
        np.testing.assert_allclose(found.numpy(), expected, rtol=1e-9)
        assert len(set(expected)) > 1

    @settings(max_examples=10)
    @given(seed=st.integers(0, 2**31), scale=st.floats(0.01, 100), factor=st.sampled_from([-1.0, 1e-9, -3.0, 1e9]))
    def test_what_does_not_matter(self, name, seed, scale, factor):
        """The order, which view is first, the unit of the pixels, scale and sign of the matrices."""
        metric, (points1, points2, F, true) = METRICS[name], pairs(seed)
        order = torch.randperm(points1.shape[1], generator=torch.Generator().manual_seed(seed))
        S = torch.tensor([1 / scale, 1 / scale, 1.0], dtype=F.dtype).diag()
        scaled = metric(scale * points1, scale * points2, S @ F @ S, S @ true @ S, scale)
        expected = metric(points1, points2, F, true, 1.0)
        for found, rtol in (
            (metric(points1[:, order], points2[:, order], F, true, 1.0), 1e-12),
            (metric(points2, points1, F.mT, true.mT, 1.0), 1e-9),
            (scaled / scale if name == "error" else scaled, 1e-7),
            (metric(points1, points2, factor * F, true, 1.0), 1e-9),
            (metric(points1, points2, F, factor * true, 1.0), 1e-9),
        ):
            torch.testing.assert_close(found, expected, rtol=rtol, atol=0, equal_nan=True)

    @pytest.mark.parametrize("value", [NAN, 0.0])
    def test_failed_estimate(self, name, value):
        points1, points2, F, true = pairs()
        found = METRICS[name](points1, points2, torch.full_like(F, value), true, 1.0)
        assert (found == {"f1": 0.0, "error": INF}[name]).all()

    def test_no_correspondences(self, name):
        points1, points2, F, true = pairs()
        assert METRICS[name](points1[:, :0], points2[:, :0], F, true, 1.0).isnan().all()

    def test_exceptions(self, name):
        for change, error, message in [
            (lambda a, b, F, true: (a.float(), b, F, true), TypeError, "."),
            (lambda a, b, F, true: (a[:, :-1], b, F, true), ValueError, "."),
            (lambda a, b, F, true: (a, b, F[:, :2], true[:, :2]), ShapeError, "."),
            *((lambda *p, t=t: (*p, t), ValueError, f"must be positive, got {t}") for t in (0.0, -1.0, NAN)),
        ]:
            points1, points2, F, true, *rest = change(*pairs())
            raises(error, message, METRICS[name], points1, points2, F, true, *(rest or [1.0]))


def test_by_rows():
    """Epipolar lines are rows and the distance is twice the difference of y; at the threshold is outside."""

    def points(*differences):
        points1 = torch.tensor([[[5.0, 7.0]] * len(differences)], dtype=torch.float64)
        return points1, points1 + torch.tensor([[[3.0, d / 2] for d in differences]], dtype=torch.float64)

    estimate, apart = ROWS + torch.tensor([0.0, 0, 1]).diag(), points(0.0, 2.0)  # sets that do not meet
    matrices = (estimate, ROWS), (ROWS, estimate), (ROWS, ROWS)
    assert [f1_score(*apart, *pair, 1.0).item() for pair in matrices] == [0.0, 0.0, 1.0]
    assert epipolar_error(*apart, estimate, ROWS).item() == 2.0
    near = points(0.0, 0.5, 0.75, 1.0, 40.0)  # the error is over inliers below one pixel
    assert epipolar_error(*near, ROWS, ROWS).item() == pytest.approx(1.25 / 3)
    assert epipolar_error(*near, ROWS, ROWS, threshold=1.5).item() == pytest.approx(2.25 / 4)
