from dataclasses import replace

import h5py
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from kornia.geometry.epipolar import cross_product_matrix
from references import true_essential
from scenes import raises, scenes, seeded

import kornia_learnnorm as kln
from kornia_learnnorm.data.match_sets import MatchSets
from kornia_learnnorm.data.store_writer import write_store
from kornia_learnnorm.data.synthetic.random_matches import random_matches, random_planes, wide_baseline
from kornia_learnnorm.data.synthetic.scenes import synthetic_store
from kornia_learnnorm.data.training_sets import RandomSets, StoreSets, SyntheticSets, augment


def assert_equal(first: tuple, second: tuple) -> None:
    for one, other in zip(first, second, strict=True):
        assert one is other is None or torch.equal(one.nan_to_num(9.0), other.nan_to_num(9.0))


class TestRandomMatches:
    @pytest.mark.parametrize("seed", range(12))
    def test_inliers_lie_near_the_lines_of_the_exact_correspondences(self, seed):
        matches = random_matches(20, 60, 40, seeded(seed))
        exact = matches.exact1, matches.exact2
        F_mat = kln.find_fundamental(*exact, normalizer=kln.Whitening(), rank2="optimal")
        inliers = matches.inliers
        assert 0.3 < inliers.double().mean() < 0.95
        distance = kln.symmetric_epipolar_distance(matches.points1, matches.points2, F_mat)
        medians = torch.stack([d[i].median() for d, i in zip(distance, inliers, strict=True) if i.any()])
        assert medians.median() < 3
        assert distance[~inliers].median() > 10
        assert matches.scores[inliers].mean() > matches.scores[~inliers].mean() + 0.1

    def test_coarse_matches(self):
        """As of learned detectors: the score tells inliers from outliers, and fine from coarse ones."""
        matches = random_matches(40, 200, 5, seeded(2), coarse=1.0)
        scene_scores = matches.scores.double()
        assert scene_scores[matches.inliers].mean() > scene_scores[~matches.inliers].mean() + 0.2
        F_mat = torch.linalg.inv(matches.K2).mT @ matches.E_mat @ torch.linalg.inv(matches.K1)
        assert kln.symmetric_epipolar_distance(matches.exact1, matches.exact2, F_mat).median() < 1e-3
        distance = kln.sampson_distance(matches.points1, matches.points2, F_mat)
        low, high = (distance[matches.inliers & rows] for rows in (scene_scores < 0.5, scene_scores > 0.95))
        assert 1.5 * high.median() < low.median() < 4

    @pytest.mark.parametrize("draw", [random_matches, random_planes])
    def test_depends_on_the_generator_alone(self, draw):
        assert_equal(*(draw(3, 20, 6, seeded(4)) for _ in range(2)))

    @pytest.mark.parametrize("coarse", [0.0, 1.0])
    def test_planes_have_a_homography(self, coarse):
        matches = random_planes(60, 40, 48, seeded(1), coarse=coarse)
        exact = matches.exact1, matches.exact2
        H_mat = kln.find_homography(*exact)
        assert kln.transfer_distance(*exact, H_mat).max() < 1e-6
        assert 0.4 < matches.inliers.double().mean() < 0.95
        distance = kln.transfer_distance(matches.points1, matches.points2, H_mat)
        assert distance[matches.inliers].median() < 2
        assert distance[~matches.inliers].median() > 10
        assert (matches.points1[matches.inliers] > -30).all()

    def test_wide_baseline_is_exact(self):
        scene = wide_baseline(50, 30, seeded())
        distance = kln.symmetric_epipolar_distance(scene.points1, scene.points2, scene.F_mat)
        assert distance[scene.inliers].max() < 1e-6
        assert scene.inliers.double().mean() > 0.99
        cosine = (scene.R.diagonal(dim1=1, dim2=2).sum(-1) - 1) / 2
        assert torch.rad2deg(cosine.clamp(-1, 1).acos()).median() > 8


class TestStoreSets:
    @pytest.fixture
    def store(self, tmp_path):
        """Two pairs: one with ground truth and 60 matches, one without and 80; a quarter of the ratios are 0.9."""
        path = tmp_path / "pairs.h5"
        found = [scenes("handheld", 1, number, seed=number, noise=0.1, outliers=0.1) for number in (60, 80)]
        points = {p: torch.cat([getattr(s, p)[0] for s in found]).float().numpy() for p in ("points1", "points2")}
        ratio = np.where(np.arange(140) % 4 == 0, 0.9, 0.5).astype(np.float32)
        F = np.stack([found[0].F_mat[0].numpy(), np.full((3, 3), np.nan)])
        made = synthetic_store(2, 70, scenes=["orbit"])
        write_store(path, replace(made, **points, ratio=ratio, offsets=np.array([0, 60, 140]), F=F))
        return path

    def test_labelled(self, store):
        sets = StoreSets([f"{store}@0:1"], 16, [None]).draw(5, 60, seeded())
        assert sets.labelled.all()
        assert sets.inliers.sum(1).tolist() == [sets.inliers[0].sum()] * 5
        assert 0.7 < sets.inliers.mean() <= 0.95
        reader = h5py.File(store)
        F_mat = torch.from_numpy(reader["F"][:1]).expand(5, 3, 3)
        points = sets.heldout1.double(), sets.heldout2.double()
        assert kln.symmetric_epipolar_distance(*points, F_mat).max() < 1
        R, t = (torch.from_numpy(reader[name][0]) for name in ("R", "t"))
        expected = cross_product_matrix(t[None])[0] @ R
        assert torch.allclose(sets.E_mat.double(), (expected / expected.norm()).expand(5, 3, 3), atol=1e-6)
        assert torch.equal(sets.K1.double(), torch.from_numpy(reader["K"][0, 0]).float().double().expand(5, 3, 3))

    def test_unlabelled(self, store):
        sets = StoreSets([f"{store}@1:2"], 16, [0.8]).draw(5, 40, seeded())
        assert not sets.labelled.any()
        assert sets.inliers.isnan().all()
        assert torch.allclose(sets.scores, torch.tensor(0.5))

    def test_without_labels_the_ground_truth_has_no_effect(self, store, tmp_path):
        wrong = tmp_path / "wrong.h5"
        wrong.write_bytes(store.read_bytes())
        with h5py.File(wrong, "a") as file:
            file["F"][0] = torch.rand(3, 3).numpy()
        hidden, other = (StoreSets([str(path)], 16, labels=False).draw(6, 40, seeded()) for path in (store, wrong))
        assert_equal(hidden, other)
        assert not hidden.labelled.any()
        assert hidden.inliers.isnan().all()

    def test_ratio_test_and_sizes(self, store):
        source = StoreSets([str(store)], 8, [0.8])
        assert source.draw(20, 60, seeded()).labelled.any().item() is False  # 45 of 60 matches pass, 60 of 80
        assert source.draw(2, 500, seeded()).points1.shape == (2, 500, 2)  # repeated where no pair has enough
        assert_equal(source.draw(4, 20, seeded(1)), source.draw(4, 20, seeded(1)))


def test_without_labels_further_matches_supervise():
    sets = SyntheticSets(200, labels=False).draw(8, 100, seeded(3))
    assert (sets.points1.shape, sets.heldout2.shape) == ((8, 100, 2), (8, 200, 2))
    assert not sets.labelled.any()
    assert sets.inliers.isnan().all()
    exact = SyntheticSets(200).draw(8, 100, seeded(3))
    F_mat = kln.find_fundamental(exact.heldout1.double(), exact.heldout2.double(), rank2="optimal")
    heldout = ((s.heldout1.double(), s.heldout2.double()) for s in (sets, exact))
    found, exact = (kln.symmetric_epipolar_distance(*points, F_mat) for points in heldout)
    assert exact.median() < 0.1
    assert (found > 5).double().mean() > 0.1  # outliers are among them


def test_wrong_options():
    for arguments, message in [
        ({"sources": []}, "sources is empty"),
        ({"shares": [1.0, 2.0]}, "one non-negative number for each of 1 sources"),
        ({"shares": [0.0]}, "one non-negative number for each"),
        ({"sizes": (3, 9)}, "at least 4 matches"),
        ({"batches": 0}, "at least 1, got 0"),
    ]:
        raises(ValueError, message, RandomSets, **{"sources": [SyntheticSets()]} | arguments)
    sets = SyntheticSets().draw(2, 9, seeded())._replace(image1=torch.zeros(2, 1, 4, 4))
    raises(ValueError, "sets with images are not augmented: set augmented to 0", augment, sets, seeded())


class TestAugment:
    @given(seed=st.integers(0, 2**20))
    def test_keeps_the_epipolar_geometry(self, seed):
        """Exact correspondences stay exact, in cameras that take the maps."""
        scene, zero = scenes("handheld", 4, 40, noise=0.0), torch.zeros(4, 40)
        views = scene.points1, scene.points2
        known = zero, zero + 1, zero[:, 0] > 0, scene.K1, scene.K2, true_essential(scene)
        moved = augment(MatchSets(*views, *views, torch.arange(4), *known), seeded(seed))
        F_mat = torch.linalg.inv(moved.K2).mT @ moved.E_mat @ torch.linalg.inv(moved.K1)
        assert kln.symmetric_epipolar_distance(moved.heldout1, moved.heldout2, F_mat).max() < 1e-3
        kept = moved.inliers > 0
        assert torch.equal(kept, (moved.points2 == moved.heldout2).all(-1))  # a false match has another partner
        assert kln.symmetric_epipolar_distance(moved.points1, moved.points2, F_mat)[kept].max() < 1e-3
        assert kept.double().mean() > 0.55
        assert augment(MatchSets(*views, *views, torch.arange(4)), seeded()).scores is None
