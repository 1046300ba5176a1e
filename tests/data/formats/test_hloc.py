"""The files of hloc; the reference files are written by hand, not by the export."""

from __future__ import annotations

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from kornia_learnnorm.data.formats.hloc import export_hloc, import_hloc
from kornia_learnnorm.data.store import CorrespondenceStore, read_store
from kornia_learnnorm.data.writer import write_store

UNKNOWN = {"F": (3, 3), "K": (2, 3, 3), "R": (3, 3), "t": (3,)}


@pytest.fixture
def paths(tmp_path):
    return tmp_path / "features.h5", tmp_path / "matches.h5"


def store_of(*pairs, size=(8, 6)) -> CorrespondenceStore:
    """A store of pairs (names, points1, points2, ratio), without ground truth."""
    names, points1, points2, ratio = zip(*pairs, strict=True)
    return CorrespondenceStore(
        *(np.concatenate(points).astype(np.float32).reshape(-1, 2) for points in (points1, points2)),
        np.concatenate(ratio).astype(np.float32),
        np.cumsum([0, *map(len, ratio)]),
        np.array([[size, size]] * len(pairs)),
        list(names),
        *(np.full((len(pairs), *shape), np.nan) for shape in UNKNOWN.values()),
        *("by hand",) * 3,
    )


def named(*names) -> CorrespondenceStore:
    """One match for each pair of names."""
    return store_of(*((pair, [[1, 1]], [[2, 2]], [0.5]) for pair in names))


def small(points1, points2, ratio) -> CorrespondenceStore:
    return store_of((("a.png", "b.png"), np.array(points1), np.array(points2), ratio))


def unknown(got):
    for name, shape in UNKNOWN.items():
        assert getattr(got, name).shape == (len(got), *shape)
        assert np.isnan(getattr(got, name)).all()


def rows(store, pair):
    points1, points2, ratio = store.matches(pair)
    return sorted(map(tuple, np.c_[points1, points2, ratio]))


def same_pairs(got, expected):
    """The same matches of each pair, in any order."""
    assert len(got) == len(expected)
    for pair in range(len(got)):
        assert rows(got, pair) == rows(expected, pair)
    np.testing.assert_array_equal(got.image_size, expected.image_size)


def stored(store, tmp_path):
    """Through a file, which checks it."""
    write_store(tmp_path / "stored.h5", store)
    return read_store(tmp_path / "stored.h5")


def write_hloc(folder, matches="seq-a.png/b_1.png", **change):
    """What extract_features.py and match_features.py of hloc write: halves, shorts, more datasets than needed."""
    keypoints = {"seq/a.png": [[1, 2], [3.5, 4], [5, 6]], "b_1.png": [[7, 8], [9, 10]], "unused.png": [[0, 0]]}
    with h5py.File(folder / "features.h5", "w", libver="latest") as file:
        for name, points in keypoints.items():
            file[f"{name}/keypoints"] = np.float16(points)
            file[f"{name}/image_size"] = np.array([640, 480])
            file[f"{name}/descriptors"] = np.zeros((256, len(points)), np.float16)
            file[f"{name}/keypoints"].attrs["uncertainty"] = 1.0
    data = {"matches0": np.int16([1, -1, 0]), "matching_scores0": np.float16([0.75, 0, 0.5]), **change}
    with h5py.File(folder / "matches.h5", "w", libver="latest") as file:
        for name, values in data.items():
            if values is not None:
                file[f"{matches}/{name}"] = values
    return folder / "features.h5", folder / "matches.h5"


LINKS = {
    "external link": lambda group: group.update(keypoints=h5py.ExternalLink("other.h5", "secret")),
    "soft link": lambda group: group.update(keypoints=h5py.SoftLink("/b_1.png/keypoints")),
    "external data": lambda group: group.create_dataset("keypoints", (3, 2), "f4", external=[("other.h5", 0, 24)]),
}


class TestHloc:
    @pytest.mark.parametrize("key", ["seq-a.png/b_1.png", "seq-a.png_b_1.png"])
    def test_reference(self, tmp_path, key):
        got = stored(import_hloc(*write_hloc(tmp_path, key)), tmp_path)
        np.testing.assert_array_equal(got.points1, [[1, 2], [5, 6]])
        np.testing.assert_array_equal(got.points2, [[9, 10], [7, 8]])
        assert got.ratio.tolist() == [0.25, 0.5]
        assert got.image_size.tolist() == [[[640, 480], [640, 480]]]
        assert got.names == [("seq/a.png", "b_1.png")]
        unknown(got)

    def test_no_scores_and_no_matches(self, tmp_path):
        got = import_hloc(*write_hloc(tmp_path, matching_scores0=None))
        assert got.ratio.tolist() == [0, 0]
        got = import_hloc(*write_hloc(tmp_path, matches0=np.int16([-1, -1, -1])))
        assert got.offsets.tolist() == [0, 0]

    def test_export_as_hloc_reads_it(self, tmp_path, paths):
        """Two pairs share an image: its keypoints are the union of its points."""
        both = store_of(
            (("s/a", "b"), [[5, 6], [1, 2]], [[9, 9], [8, 8]], [0.25, 0.5]),
            (("b", "c"), [[8, 8], [7, 7]], [[0, 0], [0, 0]], [0.25, 0.5]),
            size=(9, 9),
        )
        assert export_hloc(both, *paths) == 0
        with h5py.File(paths[0]) as features, h5py.File(paths[1]) as matches:
            assert features["s/a/keypoints"][:].tolist() == [[1, 2], [5, 6]]
            assert features["b/keypoints"][:].tolist() == [[7, 7], [8, 8], [9, 9]]
            assert features["c/keypoints"][:].tolist() == [[0, 0]]
            assert features["b/image_size"][:].tolist() == [9, 9]
            assert matches["s-a/b/matches0"][:].tolist() == [1, 2]
            assert matches["s-a/b/matching_scores0"][:].tolist() == [0.5, 0.75]
            assert matches["b/c/matches0"][:].tolist() == [0, 0, -1]
            assert matches["b/c/matching_scores0"][:].tolist() == [0.5, 0.75, 0]
        assert len(list(tmp_path.iterdir())) == 2

    @pytest.mark.parametrize(
        ("ratio", "dropped", "kept"),
        [
            ([0.5, 0.25, 0.75, 1], 2, [[4, 4], [5, 5]]),
            ([0.5, 0.5, np.nan, 0.75], 2, [[3, 3], [6, 6]]),  # of equal ratios the first; NaN loses
        ],
    )
    def test_one_match_of_a_keypoint(self, paths, ratio, dropped, kept):
        points1, points2 = [[1, 1], [1, 1], [2, 2], [2, 2]], [[3, 3], [4, 4], [5, 5], [6, 6]]
        assert export_hloc(small(points1, points2, ratio), *paths) == dropped
        assert import_hloc(*paths).points2.tolist() == kept

    def test_round_trip_of_a_store(self, uneven, tmp_path, paths):
        assert export_hloc(uneven, *paths) == 0
        got = stored(import_hloc(*paths), tmp_path)
        assert got.names == uneven.names  # the names of this store are in their order
        same_pairs(got, uneven)
        unknown(got)

    def test_order_of_pairs(self, paths):
        export_hloc(named(("i10", "i9"), ("i9", "i10"), ("i9", "i2"), ("a²", "9")), *paths)
        assert import_hloc(*paths).names == [("a²", "9"), ("i9", "i2"), ("i9", "i10"), ("i10", "i9")]

    @given(
        matches=arrays(np.float32, st.tuples(st.integers(0, 9), st.just(4)), elements=st.floats(-999, 999, width=32)),
        data=st.data(),
    )
    def test_what_the_format_holds_returns(self, matches, data, tmp_path_factory):
        ratio = data.draw(arrays(np.float32, len(matches), elements=st.floats(0, 1, width=16)))
        _, first = np.unique(matches[:, :2], axis=0, return_index=True)
        store = small(matches[first, :2], matches[first, 2:], ratio[first])
        folder = tmp_path_factory.mktemp("hloc")
        paths = folder / "features.h5", folder / "matches.h5"
        assert export_hloc(store, *paths) == 0
        same_pairs(import_hloc(*paths), store)

    @pytest.mark.parametrize(
        ("names", "message"),
        [
            ([("/a", "b")], "'/a' cannot name an image"),
            ([("a", "")], "'' cannot name an image"),
            ([("a/./b", "c")], "cannot name an image"),
            ([("a/b", "a-b")], "cannot tell the images 'a-b' and 'a/b' apart"),
            ([("a", "b"), ("a", "b")], r"two pairs are of the images \('a', 'b'\)"),
        ],
    )
    def test_names_that_hloc_cannot_hold(self, tmp_path, names, message):
        with pytest.raises(ValueError, match=message):
            export_hloc(named(*names), tmp_path / "f.h5", tmp_path / "m.h5")
        assert list(tmp_path.iterdir()) == []

    def test_export_refuses(self, uneven, tmp_path):
        with pytest.raises(ValueError, match=r"must be two files, got .*one\.h5 for both"):
            export_hloc(uneven, tmp_path / "one.h5", tmp_path / "one.h5")
        with pytest.raises(FileNotFoundError, match="does not exist"):
            export_hloc(uneven, tmp_path / "none" / "f.h5", tmp_path / "m.h5")
        two = named(("a.png", "b.png"), ("a.png", "c.png"))
        two.image_size[1] = 9
        with pytest.raises(ValueError, match=r"'a.png' has several sizes: \[\[8, 6\], \[9, 9\]\]"):
            export_hloc(two, tmp_path / "f.h5", tmp_path / "m.h5")
        assert list(tmp_path.iterdir()) == []

    def test_missing_and_broken_files(self, tmp_path):
        features, matches = write_hloc(tmp_path)
        for paths in ((tmp_path / "none.h5", matches), (features, tmp_path / "none.h5")):
            with pytest.raises(FileNotFoundError, match=r"no file of hloc at .*none\.h5"):
                import_hloc(*paths)
        whole = features.read_bytes()
        for broken in (b"", b"not HDF5", whole[: len(whole) // 2]):
            (tmp_path / "broken.h5").write_bytes(broken)
            with pytest.raises(ValueError, match=r"broken\.h5 is not a readable HDF5 file"):
                import_hloc(tmp_path / "broken.h5", matches)
            with pytest.raises(ValueError, match=r"broken\.h5 is not a readable HDF5 file"):
                import_hloc(features, tmp_path / "broken.h5")
        with h5py.File(tmp_path / "empty.h5", "w"):
            pass
        with pytest.raises(ValueError, match=r"empty\.h5 holds no pair"):
            import_hloc(features, tmp_path / "empty.h5")

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"matches0": None}, "there is no matches0, only matching_scores0"),
            ({"matches0": np.int16([1, 0])}, r"shape \(3,\), .* of seq/a.png, got int16 with shape \(2,\)"),
            ({"matches0": np.zeros(3)}, "got float64"),
            ({"matches0": np.int16([2, -1, 0])}, "must be -1 to 1, the keypoints of b_1.png, got -1 to 2"),
            ({"matches0": np.int16([0, -2, 0])}, "got -2 to 0"),
            ({"matching_scores0": np.zeros(2)}, r"matching_scores0 must have shape \(3,\), as matches0, got \(2,\)"),
        ],
    )
    def test_wrong_matches(self, tmp_path, change, message):
        with pytest.raises(ValueError, match=rf"matches\.h5, seq-a\.png/b_1\.png: .*{message}"):
            import_hloc(*write_hloc(tmp_path, **change))

    @pytest.mark.parametrize("key", ["seq-a.png/c.png", "seq-a.png_c.png", "x/y/z", "alone"])
    def test_images_without_features(self, tmp_path, key):
        with pytest.raises(ValueError, match=rf"matches\.h5, {key}: .*names no two of the features' images"):
            import_hloc(*write_hloc(tmp_path, key))

    def test_ambiguous_names(self, tmp_path):
        features, matches = write_hloc(tmp_path)
        with h5py.File(features, "r+") as file:
            file.copy("seq/a.png", "seq-a.png")
        with pytest.raises(ValueError, match=r"could be any of the pairs \[.*'seq-a.png'"):
            import_hloc(features, matches)

    @pytest.mark.parametrize(
        ("name", "value", "message"),
        [
            ("keypoints", None, "must have keypoints and image_size, got descriptors, image_size"),
            ("image_size", None, "must have keypoints and image_size, got descriptors, keypoints"),
            ("keypoints", np.zeros((3, 4)), r"must be numbers \(N, 2\) and \(2,\), got float64 \(3, 4\)"),
            ("image_size", np.zeros(3), r"and float64 \(3,\)"),
            ("image_size", np.array([b"a", b"b"]), r"and \|S1 \(2,\)"),
            ("image_size", np.array([np.nan, 1]), "image_size is not a size"),
            ("keypoints", np.full((3, 2), np.nan), "keypoints are NaN"),
        ],
    )
    def test_wrong_features(self, tmp_path, name, value, message):
        features, matches = write_hloc(tmp_path)
        with h5py.File(features, "r+") as file:
            del file["seq/a.png"][name]
            if value is not None:
                file["seq/a.png"][name] = value
        with pytest.raises(ValueError, match=rf"features\.h5.*seq/a\.png.*{message}"):
            import_hloc(features, matches)

    @pytest.mark.parametrize(("which", "name", "message"), [(1, "matches0", "no two of"), (0, "keypoints", "''")])
    def test_datasets_outside_groups(self, tmp_path, which, name, message):
        paths = write_hloc(tmp_path)
        with h5py.File(paths[which], "r+") as file:
            file[name] = np.zeros((3, 2))
        with pytest.raises(ValueError, match=message):
            import_hloc(*paths)

    @pytest.mark.parametrize("kind", LINKS)
    def test_links_are_not_followed(self, tmp_path, kind):
        features, matches = write_hloc(tmp_path)
        with h5py.File(tmp_path / "other.h5", "w") as other:
            other["secret"] = np.zeros((5, 2), np.float32)
        with h5py.File(features, "r+") as file:
            del file["seq/a.png/keypoints"]
            LINKS[kind](file["seq/a.png"])
        with pytest.raises(ValueError, match=r"'seq/a\.png' must have keypoints and image_size"):
            import_hloc(features, matches)
