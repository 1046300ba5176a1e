"""Stores: what is written comes back, some pairs of it, and what a broken file says."""

from dataclasses import replace

import h5py
import numpy as np
import pytest

from kornia_learnnorm.data.store import LAYOUT, CorrespondenceStore, StoreReader, read_store
from kornia_learnnorm.data.writer import write_store


@pytest.fixture
def path(uneven, tmp_path):
    write_store(tmp_path / "store.h5", uneven)
    return tmp_path / "store.h5"


def same(got, expected):
    np.testing.assert_equal(vars(got), vars(expected))


def test_round_trip(uneven, path):
    got = read_store(path)
    same(got, uneven)
    assert len(got) == 6
    with h5py.File(path) as file:
        assert (file.attrs["format"], file.attrs["version"]) == ("correspondences", 1)
        dtypes = {name: data.dtype for name, data in file.items()}
    assert all(getattr(got, name).dtype == getattr(uneven, name).dtype == dtypes[name] for name in ("offsets", *LAYOUT))
    assert [file.name for file in path.parent.iterdir()] == ["store.h5"]


def test_a_file_without_scores_has_one_minus_the_ratio(uneven, path):
    with h5py.File(path, "r+") as file:
        del file["score"]
    same(read_store(path), uneven)
    with h5py.File(path, "r+") as file:
        file["ratio"][:3] = np.nan
    with pytest.raises(ValueError, match="ratio holds NaN or infinite"):
        read_store(path)


def test_matches_without_a_ratio_pass_every_ratio_test(uneven, tmp_path):
    ratio, score = np.full_like(uneven.ratio, np.nan), np.linspace(0, 1, 180, dtype=np.float32)
    write_store(tmp_path / "scored.h5", replace(uneven, ratio=ratio, score=score))
    store = read_store(tmp_path / "scored.h5")
    np.testing.assert_array_equal(store.score, score)
    assert store.rows(2, 0.8).tolist() == store.rows(2).tolist()
    assert StoreReader(tmp_path / "scored.h5").passing(0.8).tolist() == np.diff(store.offsets).tolist()


LINKS = r"lacks the datasets ratio \(links"
LAYOUT_OF_RATIO = h5py.VirtualLayout((180,), "float32")
LAYOUT_OF_RATIO[:] = h5py.VirtualSource("other.h5", "ratio", (180,))


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("ratio", None, "lacks the datasets ratio"),
        ("F", np.zeros((5, 3, 3)), r"F must have shape \(6, 3, 3\), got \(5, 3, 3\)"),
        ("offsets", np.array([0, 9, 3, 4, 5, 6, 180]), "offsets must start at 0 and not decrease"),
        ("offsets", np.array([0, 9, 10, 40, 50, 60, 2**62]), r"points1 must have shape \(4611686018427387904, 2\)"),
        ("points1", np.full((180, 2), np.nan), "points1 holds NaN or infinite"),
        ("score", np.full(180, np.nan), "score must be from 0 to 1"),
        ("score", np.zeros(179), r"score must have shape \(180,\), got \(179,\)"),
        ("points1", np.zeros((180, 2), int), "points1 must be float32, got int64"),
        ("names", lambda file: file.create_dataset("names", (6, 2), h5py.vlen_dtype(np.int32)), "must be strings"),
        ("ratio", lambda file: file.create_group("ratio"), LINKS),
        ("ratio", h5py.SoftLink("/offsets"), LINKS),
        ("ratio", h5py.ExternalLink("other.h5", "ratio"), LINKS),
        ("ratio", lambda file: file.create_dataset("ratio", 180, "f4", external=[("raw", 0, 720)]), LINKS),
        ("ratio", lambda file: file.create_virtual_dataset("ratio", LAYOUT_OF_RATIO), LINKS),
        ("version", 2, r"expected format='correspondences', version=1, got .*version=.*2"),
    ],
)
def test_inconsistent_arrays_and_links_to_others(path, name, value, message):
    path.with_name("other.h5").write_bytes(path.read_bytes())
    with h5py.File(path, "r+") as file:
        if name == "version":
            file.attrs[name] = value
        else:
            del file[name]
        if callable(value):
            value(file)
        elif value is not None:
            file[name] = value
    with pytest.raises(ValueError, match=message):
        read_store(path)


def test_a_failed_write_leaves_the_old_file(uneven, path):
    before = path.read_bytes()
    broken = CorrespondenceStore(**{**vars(uneven), "K": "not an array"})
    with pytest.raises(ValueError, match="could not convert"):
        write_store(path, broken)
    assert path.read_bytes() == before
    assert [file.name for file in path.parent.iterdir()] == ["store.h5"]


@pytest.mark.parametrize(("first", "stop"), [(0, 1), (2, 5), (0, 6)])
def test_some_pairs(uneven, path, first, stop):
    part = read_store(f"{path}@{first}:0{stop}")
    assert part.names == uneven.names[first:stop]
    for new, old in enumerate(range(first, stop)):
        np.testing.assert_equal(part.matches(new), uneven.matches(old))
        for name in ("image_size", "F", "K", "R", "t"):
            np.testing.assert_array_equal(getattr(part, name)[new], getattr(uneven, name)[old])
    assert len(part.points1) == len(part.points2) == len(part.ratio) == part.offsets[-1]


def test_matches_of_a_pair(uneven):
    assert [len(uneven.rows(pair)) for pair in range(6)] == [10, 0, 40, 40, 60, 30]
    assert uneven.rows(2).tolist() == list(range(10, 50))
    assert uneven.rows(2, 0.8).tolist() == [row for row in range(10, 50) if uneven.ratio[row] < 0.8]
    for limit in (None, 0.8):
        for part, name in zip(uneven.matches(2, limit), ("points1", "points2", "ratio"), strict=True):
            np.testing.assert_array_equal(part, getattr(uneven, name)[uneven.rows(2, limit)])
    assert [len(part) for part in uneven.matches(1)] == [0, 0, 0]


@pytest.mark.parametrize(("first", "stop"), [(0, 0), (4, 2), (0, 7)])
def test_pairs_that_are_not_there(path, first, stop):
    with pytest.raises(ValueError, match=f"pairs {first}:{stop} were asked for, the store has 0:6"):
        read_store(f"{path}@{first}:{stop}")
