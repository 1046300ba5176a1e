"""RANSAC with known cameras against the truth of synthetic scenes, a plane among them."""

import numpy as np
import pytest
import torch
from references import cross, homogeneous, up_to_sign
from scenes import distorted, one_scene, seeded, uniform

import kornia_learnnorm as kln
from kornia_learnnorm import RANSAC
from kornia_learnnorm.geometry.pose import in_front
from kornia_learnnorm.metrics.poses import pose_error


def pair(name: str = "handheld", num_points: int = 200, noise: float = 0.3, outliers: float = 0.4, seed: int = 0):
    """Correspondences (N, 2) of one pair, both cameras, its essential matrix, and which are no outliers."""
    scene = one_scene(name, num_points, seed, noise=noise, outliers=outliers)
    E_mat = torch.linalg.cross(scene.t[:, None], scene.R, dim=0)
    return (scene.points1, scene.points2), (scene.K1, scene.K2), E_mat, scene.inliers


def plane(num_points: int = 60, off_plane: int = 0, seed: int = 0, normal=(0.2, -0.1, 1.0)):
    """Noise-free correspondences of a plane, and some points behind it; both cameras, their E, R and t."""
    scene = one_scene("handheld", num_points, seed, noise=0.0, outliers=0.0)
    K1, K2, R, t = (value.numpy() for value in (scene.K1, scene.K2, scene.R, scene.t))
    rays = homogeneous(scene.points1.numpy()) @ np.linalg.inv(K1).T
    depth = 4 / (rays @ np.array(normal))
    depth[:off_plane] *= np.linspace(1.2, 3, off_plane)
    x2 = (depth[:, None] * rays @ R.T + 0.5 * t / np.linalg.norm(t)) @ K2.T
    points = scene.points1, torch.from_numpy(x2[:, :2] / x2[:, 2:])
    return points, (scene.K1, scene.K2), torch.from_numpy(cross(t) @ R), R, t


def of_pixels(E_mat, K1, K2) -> torch.Tensor:
    return (torch.linalg.inv(K2).mT @ E_mat.to(K1) @ torch.linalg.inv(K1))[None]


def estimate(points, cameras, weights=None, **options):
    return RANSAC(seed=0, **options).estimate(*points, weights, *cameras)


def test_weights_and_cameras_save_samples():
    points, cameras, E, true = pair(outliers=0.7, seed=1)
    found = estimate(points, cameras, 0.1 + true + 0.5 * uniform(200))
    assert found.num_samples < estimate(points, cameras).num_samples
    assert up_to_sign(found.E_mat[None], E[None]) < 0.02
    usual, same, more = (estimate(points, cameras, confidence=c).num_samples for c in (None, 0.999, 0.999999))
    assert usual == same < more  # with cameras, less confidence is needed by default


def test_failure():
    """Five matches fit exactly: no other one confirms the matrix."""
    found = estimate((uniform(5, 2), uniform(5, 2, seed=1)), (torch.eye(3), torch.eye(3)))
    assert not any(value.any() for value in (found.E_mat, found.F_mat, found.inliers))


class TestAccuracy:
    def test_mostly_a_plane(self):
        """Samples of eight are degenerate or need points off the plane; samples of five do not."""
        points, cameras, E, _, _ = plane(off_plane=6)
        found = estimate(points, cameras)
        assert up_to_sign(found.E_mat[None], E[None]) < 1e-6
        assert found.inliers.all()

    @pytest.mark.parametrize("seed", range(3))
    def test_plane(self, seed):
        """The poses that fit a plane are those of its homography, by OpenCV: two, each with two signs."""
        cv2 = pytest.importorskip("cv2")
        points, cameras, _, R, t = plane(seed=seed)
        found = estimate(points, cameras)
        assert found.inliers.all()
        assert kln.sampson_distance(*points, found.F_mat).max() < 1e-6
        H = R + 0.5 * np.outer(t / np.linalg.norm(t), np.array([0.2, -0.1, 1.0]) / 4)
        _, rotations, translations, _ = cv2.decomposeHomographyMat(H, np.eye(3))
        solutions = [cross(t[:, 0]) @ R for R, t in zip(rotations, translations, strict=True)]
        assert min(up_to_sign(found.E_mat[None], E[None]) for E in solutions) < 1e-5

    def test_of_the_poses_of_a_plane_the_one_in_front(self):
        behind = []  # share of the inliers
        for seed in range(24):
            views, cameras, *_ = plane(300, 0, seed, (0.4, -0.3, 1.0))
            views = [x + 0.3 * torch.randn(300, 2, generator=seeded(seed + k)).double() for k, x in enumerate(views)]
            views[1][:150] = uniform(150, 2, high=480.0, seed=seed)
            found = estimate(views, cameras)
            given = [value[None] for value in (*cameras, *views)]
            R, t = kln.relative_pose(found.F_mat[None], *given, found.inliers[None])
            behind.append((~in_front(R[None], t[None], *given)[0, 0])[found.inliers].double().mean())
        assert np.mean(behind) < 0.02

    def test_final_fit_is_the_optimum_of_its_loss(self):
        points, cameras, _, _ = pair(outliers=0.2)
        found, points = estimate(points, cameras), [p[None] for p in points]
        optimum = kln.refine_essential(*points, found.E_mat[None], *cameras, loss=kln.GemanMcClure(0.7))
        assert optimum.cost_before <= 1.001 * optimum.cost

    def test_the_optimum_does_not_depend_on_the_samples(self):
        points, cameras, _, _ = pair("driving", 400, noise=1.0, outliers=0.1, seed=9)
        Fs = [RANSAC(seed=seed, inl_th=2.0).estimate(*points, None, *cameras).F_mat for seed in range(6)]
        costs = kln.GemanMcClure(1.4)(torch.stack([kln.sampson_distance(*points, F) for F in Fs]).square())[0].sum(-1)
        assert costs.max() < 1.003 * costs.min()


def error_of_pose(F_mat, points, cameras, R, t):
    near = kln.sampson_distance(*points, F_mat) <= 1
    return pose_error(*kln.relative_pose(*(v[None] for v in (F_mat, *cameras, *points, near))), R, t).item()


class TestInexactCameras:
    """Where the correspondences contradict the cameras, the fit has seven parameters."""

    @pytest.mark.parametrize("name", ["driving", "handheld", "orbit"])
    def test_exact_cameras_are_kept(self, name):
        """Rounding does not speak against cameras either: the last pair has no noise."""
        pairs = [pair(name, noise=0.5, seed=seed) for seed in range(2)] + [pair(noise=0.0, outliers=0.3)]
        for points, cameras, _, _ in pairs:
            found = estimate(points, cameras)
            assert up_to_sign(found.F_mat[None], of_pixels(found.E_mat, *cameras)) < 1e-9

    def test_distortion(self):
        """The pose is better than that of the best essential matrix, and the essential matrix is the nearest one."""
        free, known = [], []
        for seed in range(5):
            scene = one_scene("handheld", 300, seed, noise=0.3, outliers=0.3)
            cameras, R, t = (scene.K1, scene.K2), scene.R[None], scene.t[None]
            points = [distorted(p, K, -0.03) for p, K in zip((scene.points1, scene.points2), cameras, strict=True)]
            found = estimate(points, cameras)
            one = [v[None] for v in (*points, found.E_mat, *cameras)]
            fitted = kln.refine_essential(*one, loss=kln.GemanMcClure(0.7))
            free.append(error_of_pose(found.F_mat, points, cameras, R, t))
            known.append(error_of_pose(fitted.F_mat[0], points, cameras, R, t))
            U, _, Vh = torch.linalg.svd(cameras[1].mT @ found.F_mat @ cameras[0])
            assert up_to_sign(found.E_mat[None], (U[:, :2] @ Vh[:2] * 0.5**0.5)[None]) < 1e-9
        assert np.mean(free) < 0.8 * np.mean(known)


def test_matches_behind_a_camera_do_not_count_in_the_fit():
    points, cameras, E, _ = pair(noise=0.5, outliers=0.0)
    points1, points2 = (p.clone() for p in points)
    K1, K2 = cameras
    F = of_pixels(E, K1, K2)[0]
    R, t = kln.relative_pose(*(v[None] for v in (F, K1, K2, points1, points2)))
    # Every fifth match moves along its own epipolar line to the other side of the epipole, half a pixel beside it.
    epipole = torch.linalg.svd(F)[0][:, 2]
    epipole = epipole[:2] / epipole[2]
    moved = slice(None, None, 5)
    offset = points2[moved] - epipole
    normal = torch.stack([-offset[:, 1], offset[:, 0]], -1) / offset.norm(dim=-1, keepdim=True)
    points2[moved] = epipole - 0.3 * offset + 0.7 * normal
    front = in_front(R[:, None], t[:, None], *(v[None] for v in (K1, K2, points1, points2)))[0, 0]
    assert not front[moved].any()
    alone = points1[front], points2[front]
    assert up_to_sign(*(estimate(p, cameras).E_mat[None] for p in ((points1, points2), alone))) < 2e-3


@pytest.mark.parametrize(("distortion", "kept", "least", "most"), [(0.005, 0, 0, 1), (0.1, 0.3, 7, 8), (0.1, 9, 0, 0)])
def test_leaves_the_cameras_where_much_of_the_noise_speaks_against_them(distortion, kept, least, most, monkeypatch):
    """A distortion by half a percent is significant in three of the pairs, and explains little of the noise."""
    monkeypatch.setattr("kornia_learnnorm.estimators.camera_evidence.MIN_KEPT", kept)  # of the fit, by its pose
    left = 0
    for seed in range(8):
        points, cameras, _, _ = pair(num_points=800, noise=0.3, outliers=0.2, seed=seed)
        moved = [distorted(p, K, distortion) for p, K in zip(points, cameras, strict=True)]
        values = torch.linalg.svdvals(cameras[1].mT @ estimate(moved, cameras).F_mat @ cameras[0])
        left += bool(values[1] < 0.9999 * values[0])
    assert least <= left <= most
