"""Reading datasets by their names, and the ground truth of real and written ones."""

import numpy as np
import pytest
from make_sequences import FR1, FR3, STEP

from kornia_learnnorm.data.datasets.frames import FramePair
from kornia_learnnorm.data.datasets.pairing import pair_frames
from kornia_learnnorm.data.datasets.reading import read_dataset


def epipoles_agree(pair: FramePair) -> bool:
    """The wall moves sideways only: with the true F, y stays and any shift in x is allowed."""
    x1 = np.array([[20.0, 30, 1], [90, 80, 1], [140, 10, 1]])
    x2 = x1 - np.array([STEP, 0, 0])
    return bool(np.abs((x2 @ pair.F * x1).sum(1)).max() < 1e-9)


@pytest.mark.parametrize(
    ("dataset", "options", "sequence"),
    [
        ("kitti", {"sequences": ["06"], "camera": "image_3"}, "06"),
        ("kitti", {"split": "train"}, "00"),
        ("tum", {"split": "train"}, FR1),
        ("tum", {"split": "val"}, FR3),
        ("cambridge", {"split": "test"}, "seq2"),
    ],
)
def test_splits_and_ground_truth(written, dataset, options, sequence):
    frames = read_dataset(dataset, written / dataset, **options)
    assert [frame.sequence for frame in frames] == [sequence] * 4
    if dataset != "tum":  # its wall is turned
        assert all(epipoles_agree(pair) for pair in pair_frames(frames))


@pytest.mark.parametrize(
    ("dataset", "options", "store", "count"),
    [
        ("kitti", {"sequences": ["06"]}, "kitti_06", 50),
        # That store takes the nearest pose whatever the difference, 0.067 s for the first frame.
        ("tum", {"sequences": [FR3], "max_difference": 0.1}, "tum_fr3_office", 19),
    ],
)
def test_real_data(real_data, dataset, options, store, count):
    """Cameras, motions and F are those of stores that other code made of the same frames."""
    h5py = pytest.importorskip("h5py", reason="h5py is not installed")
    pairs = {
        (pair.frame1.path.name, pair.frame2.path.name): pair
        for pair in pair_frames(read_dataset(dataset, real_data / dataset, **options))
    }
    with h5py.File(real_data / "correspondences" / f"{store}.h5") as file:
        rows = [(row, tuple(names)) for row, names in enumerate(file["names"].asstr()[:]) if tuple(names) in pairs]
        assert len(rows) == len(pairs) == count
        for row, names in rows:
            pair = pairs[names]
            R, t = pair.motion
            assert np.allclose(pair.F, file["F"][row], rtol=0, atol=1e-6)
            assert np.allclose(np.stack([pair.frame1.K, pair.frame2.K]), file["K"][row], rtol=0, atol=1e-6)
            assert np.allclose(R, file["R"][row], rtol=0, atol=1e-6)
            assert np.allclose(t, file["t"][row], rtol=0, atol=1e-6)
            assert [pair.frame1.size, pair.frame2.size] == [tuple(size) for size in file["image_size"][row]]
