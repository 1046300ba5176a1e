"""The classes against the functions on everything at once: in batches, on processes, in collections."""

from __future__ import annotations

import copy

import pytest
import torch
from two_view import scenes

pytest.importorskip("torchmetrics")

from torchmetrics import MetricCollection

from kornia_learnnorm import better_rate
from kornia_learnnorm.metrics.modules import (
    BetterRateMetric,
    EpipolarErrorMetric,
    F1Metric,
    InlierShareMetric,
    PoseAUCMetric,
)
from kornia_learnnorm.metrics.pairs import epipolar_error, f1_score, inlier_share
from kornia_learnnorm.metrics.pose_accuracy import pose_auc
from kornia_learnnorm.metrics.poses import pose_error, relative_pose

NAN = float("nan")


def estimates(batch_size=11, seed=0):
    """Noisy scenes and wrong matrices; one estimate failed, one ground truth is unknown."""
    scene = scenes("handheld", batch_size, 40, seed=seed, noise=0.5, outliers=0.3)
    wrong = 1 + 1e-3 * torch.randn(scene.F_mat.shape, generator=torch.Generator().manual_seed(seed)).double()
    F, true = scene.F_mat * wrong, scene.F_mat.clone()
    F[1], true[2] = NAN, NAN
    return scene, F, true


def correspondences():
    scene, F, true = estimates()
    return scene.points1, scene.points2, F, true


def poses():
    scene, F, _ = estimates()
    t_true = scene.t.clone()
    t_true[2] = 0
    return *relative_pose(F, scene.K1, scene.K2, scene.points1, scene.points2), scene.R, t_true


def residuals():
    values = torch.rand(2, 11, generator=torch.Generator().manual_seed(0))
    values[0, 3], values[1, 5], values[:, 7] = NAN, values[0, 5], float("inf")
    return tuple(values)


def expected_rate(*data):
    found = better_rate(*data)
    return {
        "better_rate": found.rate,
        "ties": found.ties,
        "degenerate": found.degenerate,
        "compared": found.compared,
    }


def of_known(name, values, reduce=torch.mean):
    known = values[~values.isnan()]
    return {name: reduce(known).item(), "pairs": len(known), "dropped": len(values) - len(known)}


def expected_error(*data):
    values = epipolar_error(*data)
    return of_known("epipolar_error_mean", values) | of_known("epipolar_error_median", values, torch.median)


def expected_auc(*data):
    errors = pose_error(*data)
    known = errors[~errors.isnan()]
    areas = dict(zip(("auc@5", "auc@10", "auc@20"), pose_auc(known), strict=True))
    return {**areas, "pairs": len(known), "dropped": len(errors) - len(known)}


CASES = {
    "better rate": (BetterRateMetric, residuals, expected_rate),
    "inlier share": (
        lambda **options: InlierShareMetric(1.0, **options),
        lambda: correspondences()[:3],
        lambda *data: of_known("inlier_share", inlier_share(*data, 1.0)),
    ),
    "f1": (
        lambda **options: F1Metric(1.0, **options),
        correspondences,
        lambda *data: of_known("f1", f1_score(*data, 1.0)),
    ),
    "epipolar error": (EpipolarErrorMetric, correspondences, expected_error),
    "pose auc": (PoseAUCMetric, poses, expected_auc),
}


def values_of(metric):
    return {name: value.item() for name, value in metric.compute().items()}


def feed(metric, data, sizes):
    for part in zip(*(value.split(sizes) for value in data), strict=True):
        metric.update(*part)
    return metric


@pytest.mark.parametrize("case", CASES)
class TestAll:
    @pytest.mark.parametrize("sizes", [[11], [1] * 11, [2, 9]])
    def test_batches(self, case, sizes):
        make, data, expected = CASES[case]
        assert values_of(feed(make(), data(), sizes)) == pytest.approx(expected(*data()), rel=1e-5)

    def test_the_data_has_something_to_drop(self, case):
        found = CASES[case][2](*CASES[case][1]())
        assert found.get("dropped", found.get("degenerate")) > 0 or case == "inlier share"

    @pytest.mark.parametrize("sizes", [[5, 6], [11, 0], [0, 11], [2, 4, 5]])
    def test_processes(self, case, sizes):
        """Every process gathers the states of all; one of them may have had no batch."""
        make, data, expected = CASES[case]
        ranks = [make(distributed_available_fn=lambda: True) for _ in sizes]
        working = []
        for metric, part in zip(ranks, zip(*(value.split(sizes) for value in data()), strict=True), strict=True):
            if len(part[0]):
                metric.update(*part)
                working.append(metric)
        for metric in working:
            metric.dist_sync_fn = gather(ranks)
            assert values_of(metric) == pytest.approx(expected(*data()), rel=1e-5)

    def test_forward_gives_the_batch_and_keeps_it(self, case):
        make, data, expected = CASES[case]
        first, second = (tuple(part) for part in zip(*(value.split([6, 5]) for value in data()), strict=True))
        metric = make()
        found = {name: value.item() for name, value in metric(*first).items()}
        assert found == pytest.approx(expected(*first), rel=1e-5)
        metric(*second)
        assert values_of(metric) == pytest.approx(expected(*data()), rel=1e-5)

    def test_nothing_measured_and_reset(self, case):
        make, data, expected = CASES[case]
        metric = make()
        metric.update(*(value[:0] for value in data()))
        empty = values_of(metric)
        assert {name for name, value in empty.items() if value != value} == {
            name for name in empty if name not in ("ties", "degenerate", "compared", "pairs", "dropped")
        }
        metric.reset()
        assert values_of(feed(metric, data(), [11])) == pytest.approx(expected(*data()), rel=1e-5)

    def test_pickles_and_moves(self, case, device):
        make, data, expected = CASES[case]
        metric = copy.deepcopy(make()).to(device)
        feed(metric, tuple(value.to(device) for value in data()), [11])
        assert values_of(metric) == pytest.approx(expected(*data()), rel=1e-5)


def gather(ranks):
    """A gathering of the states, in the order in which torchmetrics asks for them, from metrics in one process."""
    states = [[copy.copy(state) for state in metric.metric_state.values()] for metric in ranks]
    asked = iter(range(len(states[0])))

    def collect(state, group=None):
        k = next(asked)
        found = [of_rank[k] for of_rank in states]
        if isinstance(found[0], list):  # concatenated before they are sent, empty in the metric's dtype
            return [torch.cat(of_rank) if of_rank else torch.zeros(0) for of_rank in found]
        return found

    return collect


class TestCollections:
    def test_metrics_that_agree_on_the_first_batch(self):
        """A collection shares equal states of equal names: those of other metrics or thresholds must not be."""
        points1, points2, F, true = correspondences()
        exact = scenes("handheld", 5, 40, seed=1)
        collection = MetricCollection(
            {
                "inliers": InlierShareMetric(1.0),
                "low": F1Metric(0.1),
                "high": F1Metric(1.0),
                "low_error": EpipolarErrorMetric(0.5),
                "high_error": EpipolarErrorMetric(),
            }
        )
        batches = [(exact.points1, exact.points2, exact.F_mat, exact.F_mat), (points1, points2, F, true)]
        for a, b, F_mat, F_true in batches:
            collection.update(points1=a, points2=b, F_mat=F_mat, F_true=F_true)
        found = collection.compute()
        data = [torch.cat(parts) for parts in zip(*batches, strict=True)]
        assert found["inliers_inlier_share"].item() == pytest.approx(inlier_share(*data[:3], 1.0).mean().item())
        for name, threshold in (("low", 0.1), ("high", 1.0)):
            expected = of_known("f1", f1_score(*data, threshold))
            assert found[f"{name}_f1"].item() == pytest.approx(expected["f1"], rel=1e-5)
            assert found[f"{name}_dropped"].item() == expected["dropped"]
        for name, threshold in (("low_error", 0.5), ("high_error", 1.0)):
            expected = of_known("", epipolar_error(*data, threshold), torch.median)[""]
            assert found[f"{name}_epipolar_error_median"].item() == pytest.approx(expected, rel=1e-5)


def test_mask_is_passed_on():
    points1, points2, F, true = correspondences()
    mask = torch.rand(points1.shape[:2], generator=torch.Generator().manual_seed(0)) < 0.5
    for metric, function, data in (
        (InlierShareMetric(1.0), inlier_share, (points1, points2, F)),
        (F1Metric(1.0), f1_score, (points1, points2, F, true)),
        (EpipolarErrorMetric(1.0), epipolar_error, (points1, points2, F, true)),
    ):
        metric.update(*data, mask=mask)
        expected = function(*data, 1.0, mask)
        found = next(iter(metric.compute().values()))
        assert found.item() == pytest.approx(expected[~expected.isnan()].mean().item(), rel=1e-5)


def test_double_precision():
    points1, points2, F, true = correspondences()
    metric = F1Metric(1.0).set_dtype(torch.float64)
    metric.update(points1, points2, F, true)
    expected = f1_score(points1, points2, F, true, 1.0)
    assert metric.compute()["f1"].item() == expected[~expected.isnan()].mean().item()


def test_names_of_thresholds():
    metric = PoseAUCMetric(thresholds=(2.5, 10))
    metric.update(*poses())
    assert [*metric.compute()] == ["auc@2.5", "auc@10", "pairs", "dropped"]


def test_exceptions():
    with pytest.raises(ValueError, match=r"two \(S,\) tensors, got \[3\] and \[2\]"):
        BetterRateMetric().update(torch.rand(3), torch.rand(2))
    with pytest.raises(ValueError, match="threshold must be positive, got 0"):
        InlierShareMetric(0).update(*correspondences()[:3])
