"""What a run keeps, against closed forms and functions of one pair."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

import kornia_learnnorm as kln
from kornia_learnnorm.data.sets import MatchSets
from kornia_learnnorm.data.synthetic.scenes import synthetic_store
from kornia_learnnorm.evaluation.runs.prediction_run import consensus, predict
from kornia_learnnorm.metrics.inliers import f1_score, inlier_share
from kornia_learnnorm.protocol import THRESHOLDS


def test_predictions_agree_with_the_expectation_under_known_noise():
    """Points with noise s in both views, under the true F, whose lines have normals of lengths n1 and n2.

    Their residual is normal with deviation s sqrt(n1^2 + n2^2), their distance |residual| (1 / n1 + 1 / n2): the mean
    is that of a half-normal variable, s' sqrt(2 / pi), and the share below t is erf(t / (sqrt(2) s')).
    """
    store = synthetic_store(pairs=40, points=64, seed=3, noise=0.5, outliers=0.0, scenes=["orbit"])
    points1, points2 = (torch.from_numpy(p).reshape(40, 64, 2) for p in (store.points1, store.points2))
    samples = MatchSets(points1, points2, points1[:, :1], points2[:, :1], torch.arange(40))
    F_mat = torch.from_numpy(store.F)
    found = predict(SimpleNamespace(normalizer=kln.Hartley(), solve=lambda *_: F_mat), samples, store, None)
    x1, x2 = (np.concatenate([p.double().numpy(), np.ones((40, 64, 1))], -1) for p in (points1, points2))
    n2, n1 = (np.linalg.norm((x @ f)[..., :2], axis=-1) for x, f in ((x1, store.F.swapaxes(1, 2)), (x2, store.F)))
    deviation = 0.5 * np.hypot(n1, n2) * (1 / n1 + 1 / n2)
    assert found["own"].mean() == pytest.approx(deviation.mean() * np.sqrt(2 / np.pi), rel=0.03)  # of 2,560 points
    for place, threshold in enumerate(THRESHOLDS):
        share = torch.erf(torch.from_numpy(threshold / (np.sqrt(2) * deviation))).numpy()
        error = 3 * np.sqrt((share * (1 - share)).sum()) / share.size  # three standard deviations of the mean
        assert found["inliers"][:, place].mean() == pytest.approx(share.mean(), abs=error)
        assert (found["f1"][:, place][~np.isnan(found["f1"][:, place])] == 1).all()
    assert found["rotation_error"].max() < 1e-6
    assert found["translation_error"].max() < 1e-4
    assert found["distance1"] == pytest.approx(2**0.5)


@pytest.mark.parametrize("max_ratio", [0.8, None])
def test_consensus_is_that_of_the_metrics(max_ratio):
    store = synthetic_store(pairs=3, points=60, seed=5)
    store.F[2] = np.nan
    generator = torch.Generator().manual_seed(0)
    pair = torch.tensor([0, 2, 1, 0, 1])
    F_mat = torch.from_numpy(np.nan_to_num(store.F, nan=0.3))[pair]
    F_mat *= 1 + 1e-4 * torch.randn(5, 3, 3, generator=generator, dtype=torch.float64)
    F_mat[3] = torch.nan  # a failed estimate
    found = consensus(F_mat, pair, store, max_ratio)
    for row, index in enumerate(pair.tolist()):
        x1, x2 = (torch.from_numpy(points).double() for points in store.matches(index, max_ratio)[:2])
        true = torch.from_numpy(store.F[index])
        for place, threshold in enumerate(THRESHOLDS):
            share, score = inlier_share(x1, x2, F_mat[row], threshold), f1_score(x1, x2, F_mat[row], true, threshold)
            assert found["inliers"][row, place] == share
            assert found["f1"][row, place] == pytest.approx(score, nan_ok=True)
    assert found["inliers"][3].tolist() == found["f1"][3].nan_to_num().tolist() == [0, 0]
    assert found["f1"][1].isnan().all()
    assert (found["f1"][0] > 0).any()
