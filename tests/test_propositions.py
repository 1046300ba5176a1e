r"""The two propositions of the paper: no transforms make the condition number one, and the order does not matter.

Proposition 1 says that no pair of transforms gives the design matrix :math:`\hat A` of eight correspondences the
condition number 1. It holds where it matters, but not without a condition: eight of the nine pairings of three places
in one view with three places in the other are a counterexample (:class:`TestCounterexamples`), of full row rank, finite
and affine. What holds, with a proof:

1. *If the eight points are distinct in each view,* :math:`\kappa(\hat A) > 1` *for all invertible transforms.*
   :math:`\kappa = 1` means :math:`\hat A \hat A^\top = c I`, and the entries of that matrix are products,
   :math:`(\hat x_{1,i} \cdot \hat x_{1,j})(\hat x_{2,i} \cdot \hat x_{2,j})`. So each of the 28 pairs is orthogonal in
   one view at least, and one view has 14 orthogonal pairs or more. Counting, for every point, the pairs of points that
   it is orthogonal to gives at least 36, more than there are pairs: two points have two common orthogonal directions.
   Both are the cross product of the two, so they are one, and two points of that view coincide.

2. *If* :math:`\hat F`, *the null vector as a matrix, is not of rank one,* :math:`\kappa(\hat A) > 1`. The Gram matrix
   :math:`G = \hat A^\top \hat A` is a sum of :math:`(x_2 \otimes x_1)(x_2 \otimes x_1)^\top` and therefore does not
   change when its two indices of view 1 are swapped (the partial transposition). :math:`\kappa = 1` means
   :math:`G = c\,(I - f f^\top)`, so :math:`f f^\top` does not change either:
   :math:`F_{ij} F_{kl} = F_{il} F_{kj}`, every minor of two rows vanishes, and the rank of :math:`\hat F` is one. With
   eight points that is the rank of the null vector in pixels too, whatever the transforms. In other words, eight
   orthogonal products leave a ninth (C. Bennett et al., Unextendible product bases and bound entanglement, 1999, use
   the same invariance). It leaves a bound as well, for any number of points: with
   :math:`\hat F = \sum_k r_k u_k v_k^\top` at unit norm, the numbers :math:`(u_1 \otimes v_1)^\top G (u_2 \otimes v_2)`
   and :math:`(u_1 \otimes v_2)^\top G (u_2 \otimes v_1)` are equal, and the descending eigenvalues :math:`d` of
   :math:`G` limit the first from above, the second from below:
   :math:`\kappa^2 \ge (4 - (r_1 - r_2)^2 - 4 r_1 r_2 d_9 / d_8) / (4 - (r_1 + r_2)^2)`.

3. *If the eight points are distinct in each view and no five of them on a line, the smallest* :math:`\kappa` *is
   attained,* and so greater than 1. Where a transform tends to a singular one, seven rows tend to a space of dimension
   six, or four rows to one of dimension three, so :math:`\kappa` grows without limit.

Affine transforms are no restriction: by QR, every invertible matrix is a rotation times an affine transform times a
number, and singular values see neither the rotation nor the number.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.nn.functional import normalize
from two_view import (
    SCENES,
    correspondences,
    hartley_difference,
    homogeneous,
    in_hartley,
    numpy_hartley,
    paper,
    shaken,
    uniform,
    up_to_sign,
)

from kornia_learnnorm import (
    Hartley,
    Identity,
    LearnedNormalizer,
    ReweightedWhitening,
    Whitening,
    design_matrix,
    find_fundamental,
)
from kornia_learnnorm.evaluation.diagnostics import condition_number
from kornia_learnnorm.geometry.dlt import null_vector
from kornia_learnnorm.geometry.transforms import affine_transform

GRID = [(i, j) for i in range(3) for j in range(3)]


def rows(x1, x2) -> np.ndarray:
    """Design matrices of homogeneous points: the products of the coordinates."""
    return (np.asarray(x2)[..., :, None] * np.asarray(x1)[..., None, :]).reshape(*x1.shape[:-1], 9)


def move(x, T) -> np.ndarray:
    return x @ np.swapaxes(T, -1, -2)


def kappa(A) -> np.ndarray:
    s = np.linalg.svd(A, compute_uv=False)
    return s[..., 0] / s[..., 7]


def null_matrix(A) -> np.ndarray:
    return np.linalg.svd(A, full_matrices=True)[2][..., -1, :].reshape(*A.shape[:-2], 3, 3)


def bound(A) -> np.ndarray:
    """The bound of the second argument."""
    s = np.linalg.svd(A, compute_uv=False)
    leftover = 0.0 if s.shape[-1] == 8 else (s[..., 8] / s[..., 7]) ** 2
    r1, r2, _ = np.moveaxis(np.linalg.svd(null_matrix(A), compute_uv=False), -1, 0)
    return np.sqrt((4 - (r1 - r2) ** 2 - 4 * r1 * r2 * leftover) / (4 - (r1 + r2) ** 2))


def in_base(name, batch_size=10, num_points=8, seed=0):
    """Homogeneous points in Hartley's coordinates, where a search for transforms may start."""
    points = correspondences(name, batch_size, num_points, seed)
    return [homogeneous(p.numpy()) @ numpy_hartley(p).swapaxes(1, 2) for p in points]


def random_transforms(count, seed=0, spread=1.0) -> np.ndarray:
    """Invertible, with directions of all kinds and singular values that are as unequal as exp of ``spread`` says."""
    random = np.random.default_rng(seed)
    U, V = (np.linalg.qr(random.normal(size=(count, 3, 3)))[0] for _ in range(2))
    return U * np.exp(spread * random.normal(size=(count, 1, 3))) @ V


def distinct(x) -> bool:
    """Whether no two homogeneous points ``(N, 3)`` are one."""
    x = x / np.linalg.norm(x, axis=-1, keepdims=True)
    return bool((np.abs(x @ x.T) - np.eye(len(x)) < 1 - 1e-9).all())


class TestConditionNumberOne:
    """What it means, and what it takes."""

    @given(st.integers(0, 2**31), st.sampled_from([8, 20]))
    def test_inner_products_of_rows_are_products(self, seed, num_points):
        x1, x2 = in_base("random", 3, num_points, seed)
        A = rows(x1, x2)
        expected = (x1 @ x1.swapaxes(1, 2)) * (x2 @ x2.swapaxes(1, 2))
        np.testing.assert_allclose(A @ A.swapaxes(1, 2), expected, rtol=1e-9, atol=1e-9)
        d = np.linalg.eigvalsh(expected)[:, -8:]
        sure = d[:, 0] > 1e-6 * d[:, 7]
        np.testing.assert_allclose(kappa(A)[sure], np.sqrt(d[:, 7] / d[:, 0])[sure], rtol=1e-4)

    def test_fourteen_orthogonal_pairs_share_two(self):
        """Whatever the degrees of 8 points in a graph of 14 edges, more pairs have a common neighbour than exist."""

        @cache
        def fewest(points, ends):
            if points == 0:
                return 0 if ends == 0 else np.inf
            return min(d * (d - 1) // 2 + fewest(points - 1, ends - d) for d in range(min(7, ends) + 1))

        assert fewest(8, 2 * 14) == 36
        assert 36 > 8 * 7 // 2

    @given(st.integers(0, 2**31), st.sampled_from([8, 9, 20]))
    def test_the_gram_matrix_is_its_own_partial_transpose(self, seed, num_points):
        x1, x2 = np.random.default_rng(seed).normal(size=(2, num_points, 3))
        A = rows(x1, x2)
        G = (A.T @ A).reshape(3, 3, 3, 3)  # of view 2, view 1, view 2, view 1
        np.testing.assert_allclose(G.transpose(0, 3, 2, 1), G, atol=1e-12 * G.max())

    @given(st.integers(0, 2**31))
    def test_a_projector_is_its_own_partial_transpose_only_for_rank_one(self, seed):
        """The difference is exactly the sum of squares of all minors of two rows: 2 - 2 sum r^4."""
        U, V = np.linalg.qr(np.random.default_rng(seed).normal(size=(2, 3, 3)))[0]
        for r in ([1, 0, 0], [0.8, 0.6, 0], [1, 1, 0], [1, 1, 1], [1, 1e-3, 0]):
            r = np.array(r) / np.linalg.norm(r)
            f = (U * r @ V).ravel()
            P = np.outer(f, f).reshape(3, 3, 3, 3)
            difference = ((P - P.transpose(0, 3, 2, 1)) ** 2).sum()
            assert difference == pytest.approx(2 - 2 * (r**4).sum(), abs=1e-12)
            assert (difference > 1e-7) == (r[1] > 0)

    @given(st.integers(0, 2**31), st.sampled_from([8, 9, 20]), st.floats(0, 2))
    def test_bound(self, seed, num_points, spread):
        """Of any homogeneous points, from evenly spread to almost in one place."""
        random = np.random.default_rng(seed)
        A = rows(*(random.normal(size=(50, num_points, 3)) * np.exp(spread * random.normal(size=3)) for _ in range(2)))
        assert (bound(A) >= 1).all()
        assert (kappa(A) > bound(A)).all()

    def test_bound_of_a_pure_translation(self):
        """F is a cross product with r1 = r2, so that no rotation or scale brings less than the root of two."""
        random = np.random.default_rng(0)
        t, x1 = random.normal(size=(100, 1, 3)), random.normal(size=(100, 8, 3))
        A = rows(x1, x1 * random.normal(size=(100, 8, 1)) + t)
        np.testing.assert_allclose(bound(A), np.sqrt(2), rtol=1e-6)
        assert (kappa(A) > np.sqrt(2)).all()


class TestCounterexamples:
    """Condition number one, from points that are not distinct."""

    def check(self, x1, x2):
        """The rows are orthogonal and independent, and what they leave is a product, as both arguments demand."""
        A = rows(x1, x2)
        assert np.linalg.matrix_rank(A) == 8
        assert kappa(A) == pytest.approx(1, abs=1e-9)
        np.testing.assert_allclose(np.linalg.svd(null_matrix(A))[1], [1, 0, 0], atol=1e-9)
        assert bound(A) == pytest.approx(1, abs=1e-9)
        assert not distinct(x1)
        assert not distinct(x2)

    @pytest.mark.parametrize("missing", range(9))
    def test_three_places_by_three_places(self, missing):
        """Triangles in pixels, and the affine transforms that make both equilateral, at Hartley's distance."""
        random = np.random.default_rng(missing)
        places, angles = random.uniform(0, 600, (2, 3, 2)), 2 * np.pi * np.arange(3) / 3
        even = np.sqrt(2) * np.stack([np.cos(angles), np.sin(angles)], 1)
        pairs = np.array([pair for k, pair in enumerate(GRID) if k != missing])
        T = [np.linalg.solve(homogeneous(p), homogeneous(even)).T for p in places]
        for transform in T:
            np.testing.assert_allclose(transform[2], [0, 0, 1], atol=1e-9)
        points = [torch.from_numpy(p[index]) for p, index in zip(places, pairs.T, strict=True)]
        assert len(np.unique(pairs, axis=0)) == 8  # no correspondence twice
        assert kappa(rows(*(homogeneous(p.numpy()) for p in points))) > 1e3  # in pixels
        x1, x2 = (homogeneous(p.numpy()) @ t.T for p, t in zip(points, T, strict=True))
        self.check(x1, x2)
        assert condition_number(design_matrix(torch.from_numpy(x1), torch.from_numpy(x2))).item() == pytest.approx(1)

    def test_the_transforms_are_the_whitening_of_the_places(self):
        """So a transform of this package finds them, given each place once."""
        places = uniform(2, 3, 2, high=600)
        index1, index2 = torch.tensor(GRID[:8]).T
        T1, T2 = Whitening()(places[:1], places[1:])
        x = [homogeneous(p.numpy()) @ T[0].numpy().T for p, T in zip(places, (T1, T2), strict=True)]
        self.check(x[0][index1], x[1][index2])

    @pytest.mark.parametrize("missing", range(9))
    def test_dominoes(self, missing):
        """Another orthogonal basis of products, C. Bennett et al., Quantum nonlocality without entanglement, 1999."""
        e = np.eye(3)
        pairs = [(e[1], e[1])]
        for sign in (1, -1):
            pairs += [(e[0], e[0] + sign * e[1]), (e[2], e[1] + sign * e[2])]
            pairs += [(e[1] + sign * e[2], e[0]), (e[0] + sign * e[1], e[2])]
        x = [np.stack([v / np.linalg.norm(v) for v in side]) for side in zip(*pairs, strict=True)]
        self.check(*(np.delete(side, missing, 0) for side in x))

    @pytest.mark.parametrize("missing", range(9))
    def test_random_transforms_undo_it_and_their_inverses_restore_it(self, missing):
        index1, index2 = np.delete(np.array(GRID), missing, 0).T
        S1, S2 = random_transforms(2, missing)
        x1, x2 = S1.T[index1], S2.T[index2]
        assert kappa(rows(x1, x2)) > 1.1
        np.testing.assert_allclose(np.linalg.svd(null_matrix(rows(x1, x2)))[1], [1, 0, 0], atol=1e-9)
        self.check(x1 @ np.linalg.inv(S1).T, x2 @ np.linalg.inv(S2).T)

    def test_points_that_are_free_to_move_end_in_one_place(self):
        """Descent over the points themselves reaches one, and both conclusions hold where it does."""
        x = torch.from_numpy(np.random.default_rng(0).normal(size=(2, 24, 8, 3))).requires_grad_()
        optimizer = torch.optim.Adam([x], 0.05)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, 800)
        for _ in range(800):
            A = design_matrix(*normalize(x, dim=-1))
            loss = (A @ A.mT - torch.eye(8)).square().sum()
            (x.grad,) = torch.autograd.grad(loss, x)
            optimizer.step()
            schedule.step()
        x1, x2 = normalize(x.detach(), dim=-1).numpy()
        k = kappa(rows(x1, x2))
        reached = k < 1 + 1e-3
        assert reached.sum() >= 8
        r = np.linalg.svd(null_matrix(rows(x1, x2)), compute_uv=False)
        assert r[reached, 1].max() < 0.01
        cosines = [np.abs(x @ x.swapaxes(1, 2)) - np.eye(8) for x in (x1, x2)]
        assert np.max(cosines, axis=(0, 2, 3))[reached].min() > 1 - 1e-3


class TestScenes:
    """Real geometries: far from one, whatever the transforms."""

    @pytest.mark.parametrize("name", SCENES)
    def test_points_are_distinct_and_transforms_keep_the_rank_of_the_null_vector(self, name):
        """It moves as F does, so its rank is that of the matrix in pixels: more than one."""
        x1, x2 = in_base(name, 50)
        assert all(distinct(x) for x in (*x1, *x2))
        T1, T2 = random_transforms(50, 1, 0.3), random_transforms(50, 2, 0.3)
        F_mat, F_hat = null_matrix(rows(x1, x2)), null_matrix(rows(move(x1, T1), move(x2, T2)))
        assert up_to_sign(T2.swapaxes(1, 2) @ F_hat @ T1, F_mat) < 1e-6
        assert np.linalg.svd(F_mat, compute_uv=False)[:, 1].min() > 1e-3
        assert np.linalg.svd(F_hat, compute_uv=False)[:, 1].min() > 1e-4

    @pytest.mark.parametrize("name", SCENES)
    @pytest.mark.parametrize("affine", [False, True])
    @pytest.mark.parametrize("spread", [0.3, 1.0])
    def test_no_random_transforms_come_near_one(self, name, affine, spread):
        """Three thousand pairs for each of ten scenes."""
        x1, x2 = in_base(name)
        for k in range(10):
            T1, T2 = (random_transforms(3000, seed, spread) for seed in (2 * k, 2 * k + 1))
            if affine:
                for T in (T1, T2):
                    T[:, 2] = [0, 0, 1]
            assert kappa(rows(move(x1[k], T1), move(x2[k], T2))).min() > 5

    @pytest.mark.parametrize("name", SCENES)
    def test_descent_ends_above_one(self, name):
        """All transforms are open to it, from Hartley's on, and what it finds hardly differs where it stops."""
        x1, x2 = (torch.from_numpy(x) for x in in_base(name))
        T = torch.eye(3).double().repeat(2, 10, 1, 1).requires_grad_()
        optimizer = torch.optim.Adam([T], 0.03)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, 300)
        history = []
        for _ in range(300):
            values = condition_number(design_matrix(x1 @ T[0].mT, x2 @ T[1].mT))
            (T.grad,) = torch.autograd.grad(values.log().sum(), T)
            optimizer.step()
            schedule.step()
            history.append(values.detach())
        least = torch.stack(history).amin(0)
        assert (least < history[0]).all()
        assert (least / history[0]).log().mean() < -0.3
        assert least.min() > 5

    @given(st.integers(0, 2**31))
    def test_projective_transforms_reach_no_more_than_affine_ones(self, seed):
        x1, x2 = in_base("handheld", 5, 8, seed)
        T1, T2 = random_transforms(5, seed), random_transforms(5, seed + 1)
        R1, R2 = (np.linalg.qr(T)[1] for T in (T1, T2))
        affine = kappa(rows(move(x1, R1 / R1[:, 2:, 2:]), move(x2, R2 / R2[:, 2:, 2:])))
        np.testing.assert_allclose(kappa(rows(move(x1, T1), move(x2, T2))), affine, rtol=1e-6)

    @pytest.mark.parametrize("flat", [1, 2])
    @pytest.mark.parametrize("view", [0, 1])
    def test_transforms_that_degenerate_do_not_help(self, flat, view):
        """With one or two singular values on their way to zero the condition number grows without limit."""
        x = in_base("handheld", 20)
        U, V = (np.linalg.qr(np.random.default_rng(k).normal(size=(20, 3, 3)))[0] for k in (0, 1))
        found = []
        for size in (1e-2, 1e-3, 1e-4):
            scales = np.where(np.arange(3) < flat, size, 1.0)
            found.append(kappa(rows(*(move(p, U * scales @ V) if k == view else p for k, p in enumerate(x)))))
        assert (found[1] > 5 * found[0]).all()
        assert (found[2] > 5 * found[1]).all()


def first_point(points1, points2, weights=None):
    """Centre on the first point: a normalisation that depends on the order."""

    def transform(points):
        scale = 1.4 / (points - points[:, :1]).norm(dim=-1).mean(1)
        return affine_transform(scale[:, None, None] * torch.eye(2).to(points), points[:, 0])

    return transform(points1), transform(points2)


@cache
def normalizers():
    """Made once, and not at import: the networks draw random numbers and read files."""
    return {
        "identity": Identity(),
        "hartley": Hartley(),
        "whitening": Whitening(),
        "reweighted": ReweightedWhitening(),
        "learned": LearnedNormalizer.from_pretrained().double(),
        "paper": shaken(paper()).double(),
    }


class TestOrder:
    """Proposition 2: as blind to the order as the normalisation is, so is the fundamental matrix."""

    @pytest.mark.parametrize("name", ["identity", "hartley", "whitening", "reweighted", "learned", "paper"])
    @given(seed=st.integers(0, 2**31), num_points=st.sampled_from([8, 20]), random=st.randoms())
    def test_does_not_matter(self, name, seed, num_points, random):
        points1, points2 = correspondences("handheld", 3, num_points, seed)
        order = random.sample(range(num_points), num_points)
        with torch.no_grad():
            F_mat = find_fundamental(points1, points2, normalizer=normalizers()[name])
            shuffled = find_fundamental(points1[:, order], points2[:, order], normalizer=normalizers()[name])
        assert hartley_difference(F_mat, shuffled, points1, points2) < 1e-5

    @pytest.mark.parametrize("num_points", [8, 20])
    def test_matters_to_a_normalization_that_depends_on_it(self, num_points):
        """The converse: a transform that starts at the first point takes the matrix along."""
        points = correspondences("handheld", 50, num_points, noise=1.0)
        F_mats = [find_fundamental(*(p.roll(k, 1) for p in points), normalizer=first_point) for k in (0, 1)]
        found, rolled = (in_hartley(F, *points) for F in F_mats)
        difference = np.minimum(np.abs(found - rolled).max((1, 2)), np.abs(found + rolled).max((1, 2)))
        assert np.median(difference) > 1e-3
        assert difference.min() > 1e-8

    @pytest.mark.parametrize("num_points", [8, 20])
    def test_only_orthogonal_row_transformations_are_harmless(self, num_points):
        """The proof's words, "when the row transformation is made", need it: a permutation is orthogonal.

        Eight rows may be mixed in any invertible way, for an exact null vector stays one; more may not.
        """
        A = torch.from_numpy(rows(*in_base("handheld", 20, num_points)))
        f = null_vector(A).unflatten(-1, (3, 3))
        Q = torch.linalg.qr(uniform(num_points, num_points, low=-1))[0]
        assert up_to_sign(null_vector(Q @ A).unflatten(-1, (3, 3)), f) < 1e-8
        assert up_to_sign(null_vector(A[:, torch.randperm(num_points)]).unflatten(-1, (3, 3)), f) < 1e-8
        scaled = up_to_sign(null_vector(A * uniform(num_points, 1, low=0.1)).unflatten(-1, (3, 3)), f)
        assert scaled < 1e-8 if num_points == 8 else scaled > 1e-3
