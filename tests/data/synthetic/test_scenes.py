import numpy as np
import pytest
import torch
from references import cross, epipolar_distances, homogeneous, unit
from scenes import raises, seeded

from kornia_learnnorm.data.synthetic import draws, forward_driving, handheld, orbit, random_scenes

NAMED = [forward_driving, handheld, orbit]
ALL = [random_scenes, *NAMED]


def clean(make, monkeypatch, batch_size=64, num_points=24, seed=0):
    """Scenes without noise or gross outliers."""
    if make is not random_scenes:
        return make(batch_size, num_points, seeded(seed), noise=0.0)
    monkeypatch.setattr(draws, "student_t", lambda shape, generator: torch.zeros(shape, dtype=torch.float64))
    return make(batch_size, num_points, seeded(seed))


def triangulated_depths(scene):
    """Depths in both views by cross products, in numpy: z2 x2 = z1 R x1 + t."""
    x1 = homogeneous(scene.points1.numpy()) @ np.linalg.inv(scene.K1.numpy()).transpose(0, 2, 1)
    x2 = homogeneous(scene.points2.numpy()) @ np.linalg.inv(scene.K2.numpy()).transpose(0, 2, 1)
    Rx1, t = x1 @ scene.R.numpy().transpose(0, 2, 1), scene.t.numpy()[:, None]
    a, b = np.cross(x2, Rx1), np.cross(x2, np.broadcast_to(t, x2.shape))
    z1 = -(a * b).sum(-1) / (a * a).sum(-1)
    return z1, (z1[..., None] * Rx1 + t)[..., 2]


@pytest.mark.parametrize("make", ALL)
@pytest.mark.parametrize(("batch_size", "num_points"), [(1, 1), (2, 50)])
def test_shapes_and_dtypes(make, batch_size, num_points):
    scene = make(batch_size, num_points, seeded())
    points, matrix = (num_points, 2), (3, 3)
    shapes = [points, points, matrix, (num_points,), matrix, matrix, matrix, (3,), (2,)]
    for name, value, shape in zip(scene._fields, scene, shapes, strict=True):
        assert (value.shape, value.dtype) == ((batch_size, *shape), torch.bool if name == "inliers" else torch.float64)
        assert torch.isfinite(value).all()


@pytest.mark.parametrize("make", ALL)
def test_fundamental_matrix_is_that_of_the_cameras(make):
    scene = make(5, 8, seeded(1))
    for K1, K2, R, t, F_mat in zip(scene.K1, scene.K2, scene.R, scene.t, scene.F_mat, strict=True):
        K1, K2, R = K1.numpy(), K2.numpy(), R.numpy()
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(R) == pytest.approx(1)
        expected = np.linalg.inv(K2).T @ cross(t.numpy()) @ R @ np.linalg.inv(K1)
        np.testing.assert_allclose(F_mat.numpy(), unit(expected), atol=1e-14)


@pytest.mark.parametrize("make", ALL)
def test_inliers_agree_with_the_matrix_and_lie_before_both_cameras_and_in_both_images(make, monkeypatch):
    for seed in range(8):
        scene = clean(make, monkeypatch, num_points=16, seed=seed)
        inliers = scene.inliers.numpy()
        assert epipolar_distances(scene.points1, scene.points2, scene.F_mat)[inliers].max() < 1e-6
        z1, z2 = triangulated_depths(scene)
        assert z1[inliers].min() > 0.5
        assert (z2 > z1 / 4.001)[inliers].all()
        for points in (scene.points1, scene.points2):
            assert (points[scene.inliers] >= 0).all()
            assert (points <= scene.image_size[:, None] - 1)[scene.inliers].all()
        assert make is random_scenes or inliers.all()


@pytest.mark.parametrize("make", ALL)
def test_the_generator_determines_everything(make):
    torch.manual_seed(0)
    before = torch.get_rng_state()
    first, again, other = (make(3, 12, seeded(seed)) for seed in (5, 5, 6))
    assert torch.equal(torch.get_rng_state(), before)
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))
    assert not torch.equal(first.points1, other.points1)


@pytest.mark.parametrize("make", NAMED)
def test_noise_has_the_standard_deviation_asked_for(make):
    exact, noisy = (make(100, 200, seeded(2), noise=noise) for noise in (0.0, 0.7))
    for noise in ((noisy.points1 - exact.points1).numpy(), (noisy.points2 - exact.points2).numpy()):
        assert noise.std() == pytest.approx(0.7, rel=0.02)  # 40,000 numbers: standard error 0.4 %
        assert abs(noise.mean()) < 0.02
        assert np.mean(np.abs(noise) < 0.7) == pytest.approx(0.6827, abs=0.015)  # Gaussian


@pytest.mark.parametrize("make", NAMED)
@pytest.mark.parametrize(("outliers", "expected"), [(0.0, 0), (0.25, 10), (1.0, 40)])
def test_share_of_gross_outliers(make, outliers, expected):
    scene = make(20, 40, seeded(3), noise=0.0, outliers=outliers)
    assert ((~scene.inliers).sum(-1) == expected).all()
    exact = make(20, 40, seeded(3), noise=0.0)
    assert torch.equal((scene.points2 != exact.points2).any(-1), ~scene.inliers)
    assert torch.equal(scene.points1, exact.points1)


def test_student_t_noise():
    noise = draws.student_t((200_000, 2), seeded(4)).numpy()
    # Quantiles of Student's t with three degrees of freedom, from its closed-form distribution function:
    # F(x) = 1/2 + (x / (sqrt(3) (1 + x^2/3)) + atan(x / sqrt(3))) / pi.
    for x in (-3.0, -1.0, 0.0, 0.5, 2.0, 6.0):
        u = x / np.sqrt(3)
        expected = 0.5 + (u / (1 + u * u) + np.arctan(u)) / np.pi
        np.testing.assert_allclose((noise < x).mean(0), expected, atol=0.005)


def test_random_scenes_have_the_breadth_promised():
    scene = random_scenes(4000, 20, seeded(7))
    width, height = scene.image_size.unbind(-1)
    focal = scene.K1[:, 0, 0] / width
    for values, low, high in ((width / 1000, 0.4, 1.4), (height / width, 0.3, 0.8), (focal, 0.5, 1.3)):
        assert [values.min(), values.max()] == pytest.approx([low, high], abs=0.02)
    angle = torch.linalg.matrix_norm(scene.R - torch.eye(3).double()).div(8**0.5).asin() * 2
    assert 0.002 <= angle.min() < 0.0025
    assert 0.3 < angle.max() <= 0.48
    # The scenes that drive: one in three, and of the others those that happen to go ahead (a cap of 8 % at 0.84).
    centre = -(scene.R.mT @ scene.t[..., None]).squeeze(-1)
    ahead = (centre[:, 2] / centre.norm(dim=-1) > 0.84).double().mean()
    assert ahead == pytest.approx(1 / 3 + 2 / 3 * 0.08, abs=0.04)
    outliers = (~scene.inliers).double().mean(-1)
    # Half of the scenes, and of the others those with less than half a point in 20: 1 in 12.
    assert (outliers == 0).double().mean() == pytest.approx(0.5 + 0.5 / 12, abs=0.04)
    assert outliers.mean() == pytest.approx(0.075, abs=0.005)


def test_motions_of_the_named_scenes():
    driving, orbiting = forward_driving(50, 8, seeded()), orbit(50, 8, seeded())
    assert driving.image_size[0].tolist() == [1241.0, 376.0]
    assert driving.K1[0].tolist() == [[718.856, 0.0, 607.1928], [0.0, 718.856, 185.2157], [0.0, 0.0, 1.0]]
    centre = -(driving.R.mT @ driving.t[..., None]).squeeze(-1)
    assert (centre[:, 2] > 0.9 * centre.norm(dim=-1)).all()
    pivot = torch.tensor([0.0, 0.0, 4.0]).double()  # stays where it is
    assert torch.allclose(orbiting.R @ pivot + orbiting.t, pivot.expand(50, 3))


@pytest.mark.parametrize("make", ALL)
def test_wrong_arguments(make):
    for name, wrong in (("batch_size", 0), ("num_points", -1), ("generator", 0)):
        with pytest.raises((ValueError, TypeError), match=f"{name} .* {wrong if wrong < 0 else '(0|.*int)'}"):
            make(**{"batch_size": 2, "num_points": 8, "generator": seeded(), name: wrong})
    for name, wrong in (("noise", (-0.5, np.nan, np.inf)), ("outliers", (-0.1, 1.5, np.nan))):
        for value in wrong if make in NAMED else ():
            raises(ValueError, f"{name} .* {value}", make, 2, 8, seeded(), **{name: value})
