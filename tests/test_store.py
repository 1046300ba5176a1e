import h5py
import numpy as np
import pytest

from kornia_learnnorm.data.store import CorrespondenceStore, read_store, write_store
from kornia_learnnorm.data.synthesize import synthetic_store


@pytest.fixture
def store():
    return synthetic_store(pairs=2, points=30, seed=1)


def test_round_trip(store, tmp_path):
    path = tmp_path / "store.h5"
    write_store(path, store)
    again = read_store(path)
    assert len(again) == 6
    for name in ("points1", "points2", "ratio", "offsets", "image_size", "F", "K", "R", "t"):
        expected, got = getattr(store, name), getattr(again, name)
        assert got.dtype == expected.dtype or name == "image_size"
        np.testing.assert_array_equal(got, expected)
    assert (again.names, again.dataset, again.detector) == (store.names, store.dataset, store.detector)
    assert [p.name for p in tmp_path.iterdir()] == ["store.h5"]


def test_file_follows_the_format(store, tmp_path):
    """The format's own description: dataset names, shapes, dtypes, attributes."""
    path = tmp_path / "store.h5"
    write_store(path, store)
    with h5py.File(path) as file:
        assert file.attrs["format"] == "correspondences"
        assert file.attrs["version"] == 1
        assert {"dataset", "pairs", "detector"} <= set(file.attrs)
        shapes = {name: (data.shape, data.dtype.name) for name, data in file.items()}
    assert shapes["points1"] == ((180, 2), "float32")
    assert shapes["offsets"] == ((7,), "int64")
    assert shapes["image_size"] == ((6, 2, 2), "int32")
    assert shapes["K"] == ((6, 2, 3, 3), "float64")
    assert shapes["names"][0] == (6, 2)


def test_missing_file(tmp_path):
    with pytest.raises(FileNotFoundError, match="no store at"):
        read_store(tmp_path / "none.h5")


def test_not_hdf5(tmp_path):
    path = tmp_path / "text.h5"
    path.write_text("not a store")
    with pytest.raises(ValueError, match="not a readable HDF5 file"):
        read_store(path)


def test_truncated(store, tmp_path):
    path = tmp_path / "store.h5"
    write_store(path, store)
    path.write_bytes(path.read_bytes()[:3000])
    with pytest.raises(ValueError, match="not a readable HDF5 file"):
        read_store(path)


def _change(path, name, value):
    with h5py.File(path, "r+") as file:
        del file[name]
        if value is not None:
            file[name] = value


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("ratio", None, "lacks the datasets ratio"),
        ("F", np.zeros((5, 3, 3)), r"F must have shape \(6, 3, 3\), got \(5, 3, 3\)"),
        ("points2", np.zeros((10, 2)), r"points2 must have shape \(180, 2\)"),
        ("offsets", np.array([0, 9, 3, 4, 5, 6, 180]), "offsets must rise"),
        ("offsets", np.array([0]), "offsets must rise"),
        ("points1", np.full((180, 2), np.nan), "NaN or infinite"),
    ],
)
def test_inconsistent_arrays(store, tmp_path, name, value, message):
    path = tmp_path / "store.h5"
    write_store(path, store)
    _change(path, name, value)
    with pytest.raises(ValueError, match=message):
        read_store(path)


def test_other_format_and_version(store, tmp_path):
    path = tmp_path / "store.h5"
    write_store(path, store)
    with h5py.File(path, "r+") as file:
        file.attrs["version"] = 2
    with pytest.raises(ValueError, match=r"expected format='correspondences', version=1, got .*version=.*2"):
        read_store(path)


def test_no_folder_to_write_in(store, tmp_path):
    with pytest.raises(FileNotFoundError, match="does not exist"):
        write_store(tmp_path / "nowhere" / "store.h5", store)


def test_a_failed_write_leaves_the_old_file(store, tmp_path):
    path = tmp_path / "store.h5"
    write_store(path, store)
    before = path.read_bytes()
    broken = CorrespondenceStore(**{**vars(store), "K": "not an array"})
    with pytest.raises(AttributeError):
        write_store(path, broken)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["store.h5"]


def test_ground_truth_of_the_synthetic_store(store):
    """Residuals of the inliers by NumPy: noise of 0.5 px leaves them within a few pixels of their epipolar lines."""
    rows = slice(0, 30)
    x1 = np.c_[store.points1[rows], np.ones(30)].astype(float)
    x2 = np.c_[store.points2[rows], np.ones(30)].astype(float)
    line = x1 @ store.F[0].T
    distance = np.abs((x2 * line).sum(1)) / np.hypot(line[:, 0], line[:, 1])
    assert np.sort(distance)[:24].max() < 4
