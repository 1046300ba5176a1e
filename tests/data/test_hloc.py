"""The files of hloc, written here as its extract_features.py and match_features.py write them."""

import h5py
import numpy as np
import pytest
from scenes import raises

from kornia_learnnorm.data.hloc import read_hloc
from kornia_learnnorm.data.store import read_store
from kornia_learnnorm.data.store_writer import write_store

PAIR = "seq-a.png/b_1.png"
KEYPOINTS = {"seq/a.png": [[1, 2], [3.5, 4], [5, 6]], "b_1.png": [[7, 8], [9, 10]], "unused.png": [[0, 0]]}


@pytest.fixture
def paths(tmp_path):
    """Halves, shorts, more datasets than needed."""
    features, matches = tmp_path / "features.h5", tmp_path / "matches.h5"
    with h5py.File(features, "w", libver="latest") as file:
        for name, points in KEYPOINTS.items():
            file[f"{name}/keypoints"] = np.float16(points)
            file[f"{name}/image_size"] = np.array([640, 480])
            file[f"{name}/descriptors"] = np.zeros((256, len(points)), np.float16)
    with h5py.File(matches, "w", libver="latest") as file:
        file[f"{PAIR}/matches0"] = np.int16([1, -1, 0])
        file[f"{PAIR}/matching_scores0"] = np.float16([0.75, 0, 0.5])
    return features, matches


def test_reference(paths, tmp_path):
    write_store(tmp_path / "stored.h5", read_hloc(*paths))
    got = read_store(tmp_path / "stored.h5")
    np.testing.assert_array_equal(got.points1, [[1, 2], [5, 6]])
    np.testing.assert_array_equal(got.points2, [[9, 10], [7, 8]])
    assert got.score.tolist() == [0.75, 0.5]
    assert np.isnan(got.ratio).all()
    assert len(got.rows(0, 0.8)) == 2  # no ratio test applies
    assert got.image_size.tolist() == [[[640, 480], [640, 480]]]
    assert got.names == [("seq/a.png", "b_1.png")]
    assert all(np.isnan(getattr(got, name)).all() for name in "FKRt")


@pytest.mark.parametrize(
    ("which", "name", "value", "message"),
    [
        (1, f"{PAIR}/matches0", None, f"/{PAIR} has no dataset matches0"),
        (1, f"{PAIR}/matches0", np.int16([1, 0]), "3 integers from -1 to 1"),
        (1, f"{PAIR}/matches0", np.int16([2, -1, 0]), "3 integers from -1 to 1"),
        (1, PAIR, None, "holds no pair"),
        (0, "b_1.png", None, r"no image b_1\.png"),
        (0, "b_1.png/image_size", None, r"b_1\.png has no dataset image_size"),
        (0, "b_1.png/keypoints", h5py.SoftLink("/seq/a.png/keypoints"), r"b_1\.png has no dataset keypoints"),
        (0, "b_1.png/keypoints", h5py.ExternalLink("other.h5", "secret"), r"no (image|dataset)"),
    ],
)
def test_broken(paths, which, name, value, message):
    with h5py.File(paths[which], "r+") as file:
        del file[name]
        if value is not None:
            file[name] = value
    raises(ValueError, message, read_hloc, *paths)


def test_missing_and_not_hdf5(paths, tmp_path):
    raises(FileNotFoundError, r"no file of hloc at .*none\.h5", read_hloc, paths[0], tmp_path / "none.h5")
    paths[0].write_bytes(b"not HDF5")
    raises(ValueError, r"features\.h5 is not a readable HDF5 file", read_hloc, *paths)
