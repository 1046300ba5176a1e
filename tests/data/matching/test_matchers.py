import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from kornia.core.exceptions import ShapeError
from make_sequences import texture

from kornia_learnnorm.data.matching.features import Features
from kornia_learnnorm.data.matching.matchers import match_both_ways, match_images, match_nearest, one_to_one

cv2 = pytest.importorskip("cv2", reason="OpenCV is not installed")


class TestMatchImages:
    def test_neighbours_and_ratio_match_numpy(self):
        image1, image2 = texture(0), texture(0)[:, 15:].copy()
        matches = match_images(image1, image2, num_features=100)
        sift = cv2.SIFT_create(100)
        (keys1, descriptors1), (keys2, descriptors2) = (sift.detectAndCompute(i, None) for i in (image1, image2))
        distances = np.linalg.norm(descriptors1[:, None].astype(float) - descriptors2[None], axis=2)
        nearest = distances.argmin(1)
        ranked = np.sort(distances, 1)
        assert np.allclose(matches.ratio, ranked[:, 0] / ranked[:, 1], atol=1e-5)
        assert all(part.dtype == torch.float32 for part in matches)
        assert np.allclose(matches.points1 + 0.25, [key.pt for key in keys1])  # OpenCV's are off
        assert np.allclose(matches.points2 + 0.25, [keys2[index].pt for index in nearest])

    def test_ties_have_ratio_one(self):
        # Two copies of a patch in image 2: both neighbours are at distance zero.
        patch = np.full((120, 120), 128, np.uint8)
        patch[30:90, 30:90] = texture(width=60, height=60)
        assert (match_images(patch, np.hstack([patch, patch])).ratio == 1).float().mean() > 0.9

    def test_wrong_arguments(self):
        for changes, error, message in [
            ({"image1": np.full((180, 240), 7, np.uint8)}, ValueError, r"image 1 is blank .* 0 features"),
            ({"image2": np.full((180, 240), 7, np.uint8)}, ValueError, r"image 2 is blank .* 0 features"),
            ({"image2": np.zeros((180, 240, 3), np.uint8)}, ValueError, r"must be grey .* got \(180, 240, 3\)"),
            ({"num_features": 0}, ValueError, "num_features must be at least 2, got 0"),
        ]:
            with pytest.raises(error, match=message):
                match_images(**{"image1": texture(), "image2": texture(), **changes})


@st.composite
def shared_matches(draw) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Matches among few pixels, so that many are shared, with few ratios, so that some are equal."""
    number = draw(st.integers(0, 30))
    pixels = st.lists(st.tuples(st.integers(0, 3), st.integers(0, 1)), min_size=number, max_size=number)
    ratios = draw(st.lists(st.integers(0, 8), min_size=number, max_size=number))
    points1, points2 = (torch.tensor(draw(pixels), dtype=torch.float32).reshape(-1, 2) + 0.1 for _ in range(2))
    return points1, points2, torch.tensor(ratios, dtype=torch.float32) / 8


def greedy(rows: list[tuple]) -> list[tuple]:
    """The rows, best first, that share no pixel with a better one that is kept."""
    kept: list[tuple] = []
    for row in rows:
        if not any(row[:2] == other[:2] or row[2:4] == other[2:4] for other in kept):
            kept.append(row)
    return kept


class TestOneToOne:
    @given(matches=shared_matches(), seed=st.integers(0, 99))
    def test_against_a_loop(self, matches, seed):
        kept = one_to_one(*matches)
        assert kept.dtype == torch.int64
        rows = [(*p1, *p2, r) for p1, p2, r in zip(*(part.tolist() for part in matches), strict=True)]
        ranked = sorted(rows, key=lambda row: row[::-1])
        wanted = greedy(ranked)
        assert [rows[index] for index in kept.tolist()] == wanted
        # no pixel twice, and no effect of the order
        assert len({row[:2] for row in wanted}) == len({row[2:4] for row in wanted}) == len(wanted)
        order = torch.randperm(len(rows), generator=torch.Generator().manual_seed(seed))
        again = order[one_to_one(*(part[order] for part in matches))]
        assert [rows[index] for index in again.tolist()] == wanted

    @given(matches=shared_matches(), limit=st.integers(0, 8))
    def test_ratio_test_before_or_after(self, matches, limit):
        points1, points2, ratio = matches
        below = (ratio < limit / 8).nonzero()[:, 0]
        kept = one_to_one(points1, points2, ratio)
        before = below[one_to_one(points1[below], points2[below], ratio[below])]
        rows = torch.cat([points1, points2, ratio[:, None]], 1)
        assert torch.equal(rows[before], rows[kept[ratio[kept] < limit / 8]])

    def test_wrong_shapes(self):
        with pytest.raises(ShapeError):
            one_to_one(torch.zeros(5, 2), torch.zeros(4, 2), torch.zeros(5))


def test_both_ways():
    rng = np.random.default_rng(0)
    descriptors = [rng.integers(0, 256, (number, 128), dtype=np.uint8) for number in (40, 30)]
    descriptors[1][:20] = descriptors[0][:20] + rng.integers(0, 3, (20, 128), dtype=np.uint8)
    views = [Features(rng.uniform(0, 99, (len(d), 2)).astype(np.float32), d, (100, 100)) for d in descriptors]
    matches, back = match_both_ways(*views)
    for ours, expected in zip(matches, match_nearest(*views), strict=True):
        assert torch.equal(ours, expected)
    table = np.linalg.norm(descriptors[0][:, None].astype(float) - descriptors[1], axis=2)
    for i, ratio in enumerate(back.tolist()):
        j = table[i].argmin()
        first, second = np.sort(table[:, j])[:2]
        assert ratio == pytest.approx(first / second if table[:, j].argmin() == i else 1.0, abs=1e-6)
