import re
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from kornia_learnnorm.data.store import CorrespondenceStore, read_store
from kornia_learnnorm.data.synthetic.stores import synthetic_store
from kornia_learnnorm.data.writer import write_store


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
        ("offsets", np.array([0, 9, 3, 4, 5, 6, 180]), "offsets must start at 0 and not decrease"),
        ("offsets", np.array([0, 9, 10, 40, 50, 60, 2**62]), r"points1 must have shape \(4611686018427387904, 2\)"),
        ("offsets", np.array([0]), "offsets must start at 0 and not decrease"),
        ("points1", np.full((180, 2), np.nan), "points1 holds NaN or infinite"),
        ("ratio", np.full(180, np.nan), "ratio holds NaN or infinite"),
        ("points1", np.zeros((180, 2), int), "points1 must be float32, got int64"),
        ("points1", np.full((180, 2), b"a"), "points1 must be float32"),
    ],
)
def test_inconsistent_arrays(store, tmp_path, name, value, message):
    path = tmp_path / "store.h5"
    write_store(path, store)
    _change(path, name, value)
    with pytest.raises(ValueError, match=message):
        read_store(path)


def virtual(path):
    layout = h5py.VirtualLayout((180,), "float32")
    layout[:] = h5py.VirtualSource(path, "ratio", (180,))
    return layout


@pytest.mark.parametrize(
    "change",
    [
        lambda file, other: file.create_group("ratio"),
        lambda file, other: file.update(ratio=h5py.ExternalLink(other, "ratio")),
        lambda file, other: file.update(ratio=h5py.SoftLink("/offsets")),
        lambda file, other: file.create_dataset("ratio", (180,), "float32", external=[(str(other), 0, 720)]),
        lambda file, other: file.create_virtual_dataset("ratio", virtual(other)),
    ],
)
def test_a_group_or_a_link_in_place_of_a_dataset(store, tmp_path, change):
    path, other = tmp_path / "store.h5", tmp_path / "other.h5"
    write_store(path, store)
    other.write_bytes(path.read_bytes())
    with h5py.File(path, "r+") as file:
        del file["ratio"]
        change(file, other)
    with pytest.raises(ValueError, match=r"lacks the datasets ratio \(links"):
        read_store(path)


def test_names_that_are_not_strings(store, tmp_path):
    path = tmp_path / "store.h5"
    write_store(path, store)
    with h5py.File(path, "r+") as file:
        del file["names"]
        file.create_dataset("names", (6, 2), h5py.vlen_dtype(np.int32))
    with pytest.raises(ValueError, match="names must be strings"):
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
    with pytest.raises(ValueError, match="could not convert"):
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


ARRAYS = ("points1", "points2", "ratio", "offsets", "image_size", "F", "K", "R", "t")


@pytest.fixture
def ragged(store):
    """The same rows, given to the six pairs unevenly; one pair has none."""
    return replace(store, offsets=np.array([0, 10, 10, 50, 90, 150, 180]))


def same(got, expected):
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(got, name), getattr(expected, name))
    for name in ("names", "dataset", "pairs", "detector"):
        assert getattr(got, name) == getattr(expected, name)


@pytest.mark.parametrize(("first", "stop"), [(0, 1), (0, 3), (1, 2), (2, 5), (5, 6)])
def test_select(ragged, first, stop):
    part = ragged.select(first, stop)
    assert len(part) == stop - first
    assert part.offsets[0] == 0
    assert part.names == ragged.names[first:stop]
    assert (part.dataset, part.pairs, part.detector) == (ragged.dataset, ragged.pairs, ragged.detector)
    for new, old in enumerate(range(first, stop)):
        for name in ("points1", "points2", "ratio"):
            np.testing.assert_array_equal(getattr(part, name)[part.rows(new)], getattr(ragged, name)[ragged.rows(old)])
        for name in ("image_size", "F", "K", "R", "t"):
            np.testing.assert_array_equal(getattr(part, name)[new], getattr(ragged, name)[old])
    assert len(part.points1) == len(part.points2) == len(part.ratio) == part.offsets[-1]
    same(part.select(0, len(part)), part)


def test_matches_of_a_pair(ragged):
    assert ragged.rows(2).tolist() == list(range(10, 50))
    assert [len(ragged.rows(pair)) for pair in range(6)] == [10, 0, 40, 40, 60, 30]
    rows = ragged.rows(2, 0.8)
    assert rows.tolist() == [row for row in range(10, 50) if ragged.ratio[row] < 0.8]
    for limit in (None, 0.8):
        for part, name in zip(ragged.matches(2, limit), ("points1", "points2", "ratio"), strict=True):
            np.testing.assert_array_equal(part, getattr(ragged, name)[ragged.rows(2, limit)])
    assert [len(part) for part in ragged.matches(1)] == [0, 0, 0]


def test_select_everything(ragged):
    same(ragged.select(0, 6), ragged)


def test_read_some_pairs(ragged, tmp_path):
    path = tmp_path / "store.h5"
    write_store(path, ragged)
    for part in (read_store(f"{path}@2:5"), read_store(Path(f"{path}@2:5"))):
        same(part, ragged.select(2, 5))
    same(read_store(f"{path}@0:6"), ragged)
    same(read_store(f"{path}@03:04"), ragged.select(3, 4))
    write_store(tmp_path / "part.h5", part)
    same(read_store(tmp_path / "part.h5"), part)


@pytest.mark.parametrize(("first", "stop"), [(0, 0), (6, 6), (4, 2), (0, 7), (6, 9), (-1, 2), (-2, -1)])
def test_pairs_that_are_not_there(store, tmp_path, first, stop):
    message = f"pairs {first}:{stop} were asked for, the store has 0:6"
    with pytest.raises(ValueError, match=message):
        store.select(first, stop)
    if first >= 0:
        write_store(tmp_path / "store.h5", store)
        with pytest.raises(ValueError, match=message):
            read_store(f"{tmp_path / 'store.h5'}@{first}:{stop}")


def test_missing_file_with_pairs(tmp_path):
    with pytest.raises(FileNotFoundError, match=f"no store at {re.escape(str(tmp_path / 'none.h5'))}"):
        read_store(f"{tmp_path / 'none.h5'}@0:2")
