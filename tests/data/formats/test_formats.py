"""KITTI flow maps, NG-RANSAC's files and hloc's files; the references are written by hand, not by the exports."""

from __future__ import annotations

import os
import pickle
import struct
import zlib
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from kornia_learnnorm.cli.synthesize import synthetic_store
from kornia_learnnorm.data.formats.hloc import export_hloc, import_hloc
from kornia_learnnorm.data.formats.interchange import (
    Pair,
    assemble,
    best_of_each,
    files_in,
    natural,
    new_folder,
    split_pairs,
)
from kornia_learnnorm.data.formats.kitti_flow import export_kitti_flow, import_kitti_flow
from kornia_learnnorm.data.formats.ngransac import export_ngransac, import_ngransac
from kornia_learnnorm.data.store import read_store, write_store

UNKNOWN = {"K": (2, 3, 3), "R": (3, 3), "t": (3,), "F": (3, 3)}


@pytest.fixture
def store():
    made = synthetic_store(pairs=2, points=30, seed=1)
    return replace(made, offsets=np.array([0, 10, 10, 50, 90, 150, 180]))


def small(points1, points2, ratio, size=(8, 6), names=("a.png", "b.png")):
    pair = Pair(
        np.array(points1, np.float32), np.array(points2, np.float32), np.array(ratio), np.array([size] * 2), names
    )
    return assemble([pair], "by hand")


def png(rows, depth=16, colour=2):
    """A PNG from the bytes of its rows, by the specification: no library that writes images."""
    bits = {(16, 2): 48, (8, 2): 24, (16, 0): 16}[depth, colour]
    header = struct.pack(">IIBBBBB", 8 * len(rows[0]) // bits, len(rows), depth, colour, 0, 0, 0)
    chunks = [(b"IHDR", header), (b"IDAT", zlib.compress(b"".join(b"\0" + row for row in rows))), (b"IEND", b"")]
    body = [struct.pack(">I", len(d)) + k + d + struct.pack(">I", zlib.crc32(k + d)) for k, d in chunks]
    return b"\x89PNG\r\n\x1a\n" + b"".join(body)


def unknown(got):
    for name, shape in UNKNOWN.items():
        assert getattr(got, name).shape == (len(got), *shape)
        assert np.isnan(getattr(got, name)).all()


def same_pair(got, expected, order=True):
    """Points and ratios of two pairs, in any order of the rows if asked."""
    rows = [np.c_[pair.points1, pair.points2, pair.ratio] for pair in (got, expected)]
    if not order:
        rows = [np.array(sorted(map(tuple, part))).reshape(-1, 5) for part in rows]
    np.testing.assert_array_equal(*rows)
    np.testing.assert_array_equal(got.image_size, expected.image_size)


def stored(store, tmp_path):
    """Through a file, which checks it."""
    write_store(tmp_path / "stored.h5", store)
    return read_store(tmp_path / "stored.h5")


class TestShared:
    def test_split_and_assemble(self, store):
        pairs = list(split_pairs(store))
        assert [len(pair.ratio) for pair in pairs] == [10, 0, 40, 40, 60, 30]
        again = assemble(pairs, "again")
        for name in ("points1", "points2", "ratio", "offsets", "image_size", "F", "K", "R", "t"):
            np.testing.assert_array_equal(getattr(again, name), getattr(store, name))
        assert (again.names, again.dataset, again.pairs, again.detector) == (
            store.names,
            "again",
            "not known",
            "not known",
        )

    def test_best_of_each(self):
        assert best_of_each(np.array([5, 3, 5, 3, 1]), np.array([0.5, 0.2, 0.1, 0.2, 0.9])).tolist() == [4, 1, 2]
        assert best_of_each(np.array([1, 1]), np.array([np.nan, 0.9])).tolist() == [1]
        assert best_of_each(np.empty(0), np.empty(0)).tolist() == []

    def test_natural(self):
        names = ["a10", "a9", "b", "a9_2", "10", "9", "a²"]
        assert sorted(names, key=natural) == ["9", "10", "a9", "a9_2", "a10", "a²", "b"]

    def test_folders(self, tmp_path):
        with pytest.raises(FileNotFoundError, match=r"no folder at .*none"):
            files_in(tmp_path / "none", "*.npy")
        with pytest.raises(ValueError, match=r"holds no file \*\.npy"):
            files_in(tmp_path, "*.npy")
        file = tmp_path / "x.npy"
        file.touch()
        (tmp_path / "folder.npy").mkdir()
        assert files_in(tmp_path, "*.npy") == [file]
        with pytest.raises(ValueError, match="it is a file, expected a folder"):
            new_folder(file, "*.npy")
        with pytest.raises(ValueError, match=r"already holds .*\.npy"):
            new_folder(tmp_path, "*.npy")
        assert new_folder(tmp_path / "a" / "b", "*").is_dir()


class TestKittiFlow:
    def test_reference(self, tmp_path):
        """Two pixels of a map of 3 x 2: 1.5 px right and 2 px up; 512 px left and 511.984375 px down."""
        first = struct.pack(">9H", 0, 0, 0, 32864, 32640, 1, 0, 0, 0)
        second = struct.pack(">9H", 0, 0, 0, 7, 7, 0, 0, 65535, 1)
        (tmp_path / "000003_10.png").write_bytes(png([first, second]))
        got = stored(import_kitti_flow(tmp_path), tmp_path)
        np.testing.assert_array_equal(got.points1, [[1, 0], [2, 1]])
        np.testing.assert_array_equal(got.points2, [[2.5, -2], [-510, 512.984375]])
        assert got.ratio.tolist() == [0, 0]
        assert got.image_size.tolist() == [[[3, 2], [3, 2]]]
        assert got.names == [("000003_10.png", "000003_11.png")]
        unknown(got)

    def test_export_what_reference_reads(self, tmp_path):
        store = small([[1.3, 0.6], [6.6, 5.4]], [[2.8, -1.4], [6.61, 5.4]], [0.5, 0.6])
        assert export_kitti_flow(store, tmp_path) == {}
        # width, height, bits of a sample and RGB, where the specification of PNG has them
        assert (tmp_path / "000000_10.png").read_bytes()[16:26] == struct.pack(">IIBB", 8, 6, 16, 2)
        got = import_kitti_flow(tmp_path)
        np.testing.assert_array_equal(got.points1, [[1, 1], [7, 5]])
        np.testing.assert_array_equal(got.points2, [[2.5, -1], [7 + 1 / 64, 5]])
        assert got.names == [("a.png", "b.png")]
        assert (tmp_path / "pairs.txt").read_text() == "a.png b.png\n"

    def test_left_out(self, tmp_path):
        points1 = [[-0.6, 1], [-0.4, 1], [7.6, 1], [1, 5.6], [2, 2], [3, 3], [3.2, 3.1], [2.9, 3]]
        points2 = [[0, 0], [0, 0], [0, 0], [0, 0], [514, 2], [9, 9], [8, 8], [7, 7]]
        notes = export_kitti_flow(small(points1, points2, [0, 0, 0, 0, 0, 0.7, 0.3, 0.5]), tmp_path)
        assert notes == {
            "matches outside image 1": 3,
            "matches displaced by 512 px or more": 1,
            "matches at a pixel that a better one has": 2,
        }
        got = import_kitti_flow(tmp_path)
        np.testing.assert_array_equal(got.points1, [[0, 1], [3, 3]])
        np.testing.assert_allclose(got.points2[1], [7.8, 7.9], atol=1 / 128)

    def test_round_trip_of_a_store(self, store, tmp_path):
        notes = export_kitti_flow(store, tmp_path)
        assert notes.pop("names with white space or empty, written with _") == 4
        got = stored(import_kitti_flow(tmp_path), tmp_path)
        assert len(got.ratio) == len(store.ratio) - sum(notes.values())
        assert got.names == [(one.replace(" ", "_"), two.replace(" ", "_")) for one, two in store.names]
        for new, old in zip(split_pairs(got), split_pairs(store), strict=True):
            np.testing.assert_array_equal(new.image_size, old.image_size[[0, 0]])
            for start, end in zip(new.points1, new.points2, strict=True):
                near = np.flatnonzero((np.rint(old.points1) == start).all(1))
                error = np.abs((old.points2 - old.points1)[near] - (end - start)).max(1)
                assert error.min() <= 1 / 128 + 1e-4

    @given(data=st.data())
    def test_what_the_format_holds_returns(self, data, tmp_path_factory):
        """Whole pixels with displacements of 1/64 px lose only their ratios."""
        pixels = data.draw(st.sets(st.integers(0, 47), min_size=0, max_size=20).map(sorted))
        points1 = np.array([[i % 8, i // 8] for i in pixels], np.float32).reshape(-1, 2)
        flow = data.draw(arrays(np.int32, points1.shape, elements=st.integers(-(2**15), 2**15 - 1)))
        store = small(points1, points1 + flow / 64, np.zeros(len(points1)))
        folder = tmp_path_factory.mktemp("flow")
        assert export_kitti_flow(store, folder) == {}
        same_pair(next(split_pairs(import_kitti_flow(folder))), next(split_pairs(store)))

    @pytest.mark.parametrize(
        ("data", "message"),
        [
            (b"", "cannot be decoded: 0 bytes"),
            (b"\xff\xd8\xff no PNG", "not a PNG"),
            (png([bytes(18)])[:60], "truncated or corrupt"),
            (png([bytes(18)]).replace(b"IDAT", b"IDAX"), "cannot be decoded"),
            (png([bytes(9)], depth=8), r"expected 16 bits with shape \(H, W, 3\), got 8 bits with shape \(1, 3, 3\)"),
            (png([bytes(6)], colour=0), r"got 16 bits with shape \(1, 3\)"),
        ],
    )
    def test_not_a_flow_map(self, tmp_path, data, message):
        (tmp_path / "000000_10.png").write_bytes(data)
        with pytest.raises(ValueError, match=rf"000000_10\.png .*{message}"):
            import_kitti_flow(tmp_path)

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            (b"a b\nc d\n", r"pairs\.txt names 2 pairs, the folder has 1 flow maps"),
            (b"\na b c\n", r"pairs\.txt, line 2: two names expected, got 3: 'a b c'"),
            (b"\xff\xfe", r"pairs\.txt is not a text of names"),
        ],
    )
    def test_wrong_names(self, tmp_path, text, message):
        export_kitti_flow(small([[1, 1]], [[2, 2]], [0.5]), tmp_path)
        (tmp_path / "pairs.txt").write_bytes(text)
        with pytest.raises(ValueError, match=message):
            import_kitti_flow(tmp_path)

    def test_export_refuses(self, store, tmp_path):
        with pytest.raises(ValueError, match=r"a\.png: the size of an image must be positive, got 0 x 6"):
            export_kitti_flow(small([[1, 1]], [[2, 2]], [0.5], (0, 6)), tmp_path)
        export_kitti_flow(store, tmp_path)
        with pytest.raises(ValueError, match=r"already holds 00000\d_10\.png"):
            export_kitti_flow(store, tmp_path)
        with pytest.raises(FileNotFoundError, match="no folder"):
            import_kitti_flow(tmp_path / "none")
        (tmp_path / "empty").mkdir()
        with pytest.raises(ValueError, match="holds no file"):
            import_kitti_flow(tmp_path / "empty")


def ngransac_objects():
    """What prepare_data_kitti.py of NG-RANSAC puts in a file: a camera that moves along z without turning."""
    K = np.array([[700, 0, 600], [0, 700, 180], [0, 0, 1]], np.float32)
    points1 = np.array([[[1.5, 2], [3, 4], [5, 6]]], np.float32)
    ratios = np.array([[[0.1], [0.5], [0.9]]], np.float32)
    size = (376, 1241, 3)
    return [points1, points1 + 1, ratios, size, size, K, K, np.eye(3, dtype=np.float32), np.float32([[0], [0], [2]])]


def save_ngransac(path, objects):
    array = np.empty(len(objects), object)
    array[:] = objects
    np.save(path, array, allow_pickle=True)


class Runs:
    def __init__(self, ran):
        self.ran = ran

    def __reduce__(self):
        return Path.touch, (self.ran,)


class TestNGRansac:
    def test_reference(self, tmp_path):
        """A pure translation (0, 0, 2) has the epipole at the principal point, so F is [e]x up to its scale."""
        save_ngransac(tmp_path / "pair_4_5.npy", ngransac_objects())
        got = stored(import_ngransac(tmp_path), tmp_path)
        np.testing.assert_array_equal(got.points1, [[1.5, 2], [3, 4], [5, 6]])
        np.testing.assert_array_equal(got.points2, [[2.5, 3], [4, 5], [6, 7]])
        np.testing.assert_array_equal(got.ratio, np.float32([0.1, 0.5, 0.9]))
        assert got.image_size.tolist() == [[[1241, 376], [1241, 376]]]
        assert got.names == [("4", "5")]
        assert got.K[0, 1, 0].tolist() == [700, 0, 600]
        assert (got.R[0].tolist(), got.t[0].tolist()) == (np.eye(3).tolist(), [0, 0, 2])
        F = np.array([[0, -1, 180], [1, 0, -600], [-180, 600, 0]])
        np.testing.assert_allclose(got.F[0], F / np.linalg.norm(F), atol=1e-12)

    def test_other_ways_to_write_it(self, tmp_path):
        """Shapes as NumPy scalars or arrays, two numbers, Fortran order, float64, the module path of NumPy 1."""
        points1, points2, ratios, _, _, *cameras = ngransac_objects()
        cameras[0] = np.asfortranarray(cameras[0] + np.float32([[0, 1, 0], [0, 0, 0], [0, 0, 0]]))
        sizes = (np.int64(376), np.int64(1241)), np.array([376, 1241], np.uint16)
        save_ngransac(tmp_path / "other.npy", [points1.astype(float), points2[:, :, ::-1], ratios, *sizes, *cameras])
        data = (tmp_path / "other.npy").read_bytes()
        new, old = b"\x8c\x16numpy._core.multiarray", b"\x8c\x15numpy.core.multiarray"
        start = data.index(b"\n") + 1
        frame = data.index(b"\x95", start)  # its length shrinks with the names
        length = struct.unpack("<Q", data[frame + 1 : frame + 9])[0] - data.count(new)
        data = data[: frame + 1] + struct.pack("<Q", length) + data[frame + 9 :].replace(new, old)
        (tmp_path / "other.npy").write_bytes(data)
        got = import_ngransac(tmp_path)
        assert got.names == [("other-1", "other-2")]
        assert got.image_size.tolist() == [[[1241, 376], [1241, 376]]]
        np.testing.assert_array_equal(got.points2, points2[0, :, ::-1])
        np.testing.assert_array_equal(got.K[0, 0], cameras[0])

    def test_export_as_ngransac_reads_it(self, store, tmp_path):
        assert export_ngransac(store, tmp_path) == {}
        assert sorted(path.name for path in tmp_path.iterdir())[:2] == ["pair_0_1.npy", "pair_10_11.npy"]
        data = np.load(tmp_path / "pair_4_5.npy", allow_pickle=True)
        assert [np.asarray(part).shape for part in data] == [
            (1, 40, 2),
            (1, 40, 2),
            (1, 40, 1),
            (3,),
            (3,),
            *[(3, 3)] * 3,
            (3, 1),
        ]
        assert {part.dtype.name for part in [*data[:3], *data[5:]]} == {"float32"}
        assert data[3] == (*store.image_size[2, 0, ::-1], 3)
        np.testing.assert_array_equal(data[1][0], store.points2[10:50])
        np.testing.assert_array_equal(data[8][:, 0], store.t[2].astype(np.float32))

    def test_round_trip_of_a_store(self, store, tmp_path):
        export_ngransac(store, tmp_path)
        got = stored(import_ngransac(tmp_path), tmp_path)
        for name in ("points1", "points2", "ratio", "offsets", "image_size"):
            np.testing.assert_array_equal(getattr(got, name), getattr(store, name))
        for name in ("K", "R", "t"):
            np.testing.assert_array_equal(getattr(got, name), getattr(store, name).astype(np.float32))
        sign = np.sign((got.F * store.F).sum((1, 2), keepdims=True))
        np.testing.assert_allclose(got.F * sign, store.F, atol=1e-6)

    def test_unknown_geometry(self, tmp_path):
        export_ngransac(small([[1, 1]], [[2, 2]], [0.5]), tmp_path)
        unknown(import_ngransac(tmp_path))
        objects = ngransac_objects()
        objects[8] = np.zeros((3, 1))
        save_ngransac(tmp_path / "pair_0_1.npy", objects)
        assert np.isnan(import_ngransac(tmp_path).F).all()

    def test_shared_images_and_order(self, tmp_path):
        """Images are numbered by first appearance, pairs return by number: 0_1, 0_3, 2_3."""
        pair = next(split_pairs(small([[1, 1]], [[2, 2]], [0.5])))
        names = [("a", "b"), ("c", "d"), ("a", "d")]
        export_ngransac(assemble([pair._replace(names=each) for each in names], ""), tmp_path)
        assert import_ngransac(tmp_path).names == [("0", "1"), ("0", "3"), ("2", "3")]

    @given(
        matches=arrays(np.float32, st.tuples(st.integers(0, 9), st.just(5)), elements=st.floats(-999, 999, width=32)),
        size=st.tuples(st.integers(1, 9999), st.integers(1, 9999)),
    )
    def test_what_the_format_holds_returns(self, matches, size, tmp_path_factory):
        store = small(matches[:, :2], matches[:, 2:4], matches[:, 4], size)
        folder = tmp_path_factory.mktemp("ngransac")
        export_ngransac(store, folder)
        same_pair(next(split_pairs(import_ngransac(folder))), next(split_pairs(store)))

    def test_code_is_not_run(self, tmp_path):
        for i, kind in enumerate([Runs(tmp_path / "ran"), print, os.system, np.load, Path("x"), np.ufunc, slice(1)]):
            path = tmp_path / f"pair_0_{i}.npy"
            save_ngransac(path, [*ngransac_objects()[:8], kind])
            with pytest.raises(ValueError, match=rf"{path.name} .*its pickle asks for [\w.]+, only arrays of numbers"):
                import_ngransac(tmp_path)
            path.unlink()
        assert not (tmp_path / "ran").exists()

    def test_forged_object_array(self, tmp_path):
        """An array of objects whose dtype says that it holds none: NumPy takes its bytes for addresses."""

        class Says:
            def __init__(self, *parts):
                self.parts = parts

            def __reduce__(self):
                return self.parts

        dtype = Says(np.dtype, ("O8", False, True), (3, "|", None, None, None, -1, -1, 0))
        rebuild = np.empty(0).__reduce__()[0]
        forged = Says(rebuild, (np.ndarray, (0,), b"b"), (1, (1, 1, 2), dtype, False, b"A" * 16))
        save_ngransac(tmp_path / "pair_0_1.npy", [forged, *ngransac_objects()[1:]])
        with pytest.raises(ValueError, match="expected arrays of numbers, got dtype 'O8'"):
            import_ngransac(tmp_path)

    @pytest.mark.parametrize("cut", [0, 5, 60, 130, 400, -1])
    def test_truncated(self, tmp_path, cut):
        path = tmp_path / "pair_0_1.npy"
        save_ngransac(path, ngransac_objects())
        path.write_bytes(path.read_bytes()[:cut])
        with pytest.raises(ValueError, match=r"pair_0_1\.npy is not a"):
            import_ngransac(tmp_path)

    @given(at=st.integers(0, 1200), value=st.integers(0, 255))
    def test_a_changed_byte_is_an_error_or_a_number(self, at, value, tmp_path_factory):
        folder = tmp_path_factory.mktemp("ngransac")
        path = folder / "pair_0_1.npy"
        save_ngransac(path, ngransac_objects())
        data = bytearray(path.read_bytes())
        data[min(at, len(data) - 1)] = value
        path.write_bytes(data)
        message = "read as pair_0_1.npy"
        try:
            import_ngransac(folder)
        except ValueError as error:
            message = str(error)
        assert "pair_0_1.npy" in message

    @pytest.mark.parametrize(
        ("place", "value", "message"),
        [
            (0, np.zeros((3, 2)), r"points 1 must have shape \(1, 0, 2\), got \(3, 2\)"),
            (1, np.zeros((1, 4, 2)), r"points 2 must have shape \(1, 3, 2\), got \(1, 4, 2\)"),
            (2, np.zeros((1, 3)), r"ratios must have shape \(1, 3, 1\)"),
            (0, np.full((1, 3, 2), np.inf), "NaN or infinite pixels"),
            (3, (376,), r"size 1 must be \(height, width\)"),
            (4, (float("inf"), 3), "size 2 must be"),
            (4, "large", "could not convert string to float"),
            (5, np.eye(4), r"K1 must have shape \(3, 3\)"),
            (5, np.zeros((3, 3)), "K1 or K2 is singular"),
            (6, np.zeros((3, 3)), "K1 or K2 is singular"),
            (8, np.zeros(3), r"t must have shape \(3, 1\)"),
            (8, np.array(["a"]), "expected arrays of numbers, got dtype 'U1'"),
        ],
    )
    def test_wrong_parts(self, tmp_path, place, value, message):
        objects = ngransac_objects()
        objects[place] = value
        save_ngransac(tmp_path / "pair_0_1.npy", objects)
        with pytest.raises(ValueError, match=rf"pair_0_1\.npy.*{message}"):
            import_ngransac(tmp_path)

    def test_other_npy_files(self, tmp_path):
        path = tmp_path / "pair_0_1.npy"
        np.save(path, np.zeros((9,)))
        with pytest.raises(ValueError, match=r"expected 9 objects, got float64 of shape \(9,\)"):
            import_ngransac(tmp_path)
        save_ngransac(path, ngransac_objects()[:5])
        with pytest.raises(ValueError, match=r"expected 9 objects, got object of shape \(5,\)"):
            import_ngransac(tmp_path)
        save_ngransac(path, ngransac_objects())
        header = path.read_bytes()[:128]
        path.write_bytes(header + pickle.dumps([1] * 9))
        with pytest.raises(ValueError, match="expected an array of 9 objects"):
            import_ngransac(tmp_path)

    def test_two_pairs_of_the_same_images(self, tmp_path):
        pair = next(split_pairs(small([[1, 1]], [[2, 2]], [0.5])))
        with pytest.raises(ValueError, match=r"two pairs are of the images \('a.png', 'b.png'\)"):
            export_ngransac(assemble([pair, pair], ""), tmp_path / "new")
        assert not (tmp_path / "new").exists()


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

    def test_export_as_hloc_reads_it(self, tmp_path):
        """Two pairs share an image: its keypoints are the union of its points."""
        one = Pair(
            np.array([[5, 6], [1, 2]]),
            np.array([[9, 9], [8, 8]]),
            np.array([0.25, 0.5]),
            np.full((2, 2), 9),
            ("s/a", "b"),
        )
        two = one._replace(points1=np.array([[8, 8], [7, 7]]), points2=np.array([[0, 0], [0, 0]]), names=("b", "c"))
        paths = tmp_path / "features.h5", tmp_path / "matches.h5"
        assert export_hloc(assemble([one, two], ""), *paths) == {}
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

    def test_one_match_of_a_keypoint(self, tmp_path):
        paths = tmp_path / "features.h5", tmp_path / "matches.h5"
        store = small([[1, 1], [1, 1], [2, 2]], [[3, 3], [4, 4], [5, 5]], [0.5, 0.25, 0.75])
        assert export_hloc(store, *paths) == {"matches of a keypoint that has a better one": 1}
        got = import_hloc(*paths)
        assert got.points2.tolist() == [[4, 4], [5, 5]]

    def test_round_trip_of_a_store(self, store, tmp_path):
        paths = tmp_path / "features.h5", tmp_path / "matches.h5"
        assert export_hloc(store, *paths) == {}
        got = stored(import_hloc(*paths), tmp_path)
        assert got.names == store.names  # the names of this store are in their order
        for new, old in zip(split_pairs(got), split_pairs(store), strict=True):
            same_pair(new, old, order=False)
        unknown(got)

    def test_order_of_pairs(self, tmp_path):
        pair = next(split_pairs(small([[1, 1]], [[2, 2]], [0.5])))
        names = [("i10", "i9"), ("i9", "i10"), ("i9", "i2")]
        paths = tmp_path / "features.h5", tmp_path / "matches.h5"
        export_hloc(assemble([pair._replace(names=each) for each in names], ""), *paths)
        assert import_hloc(*paths).names == [names[2], names[1], names[0]]

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
        assert export_hloc(store, *paths) == {}
        same_pair(next(split_pairs(import_hloc(*paths))), next(split_pairs(store)), order=False)

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
        pair = next(split_pairs(small([[1, 1]], [[2, 2]], [0.5])))
        store = assemble([pair._replace(names=each) for each in names], "")
        with pytest.raises(ValueError, match=message):
            export_hloc(store, tmp_path / "f.h5", tmp_path / "m.h5")
        assert list(tmp_path.iterdir()) == []

    def test_export_refuses(self, store, tmp_path):
        with pytest.raises(ValueError, match=r"must be two files, got .*one\.h5 for both"):
            export_hloc(store, tmp_path / "one.h5", tmp_path / "one.h5")
        with pytest.raises(FileNotFoundError, match="does not exist"):
            export_hloc(store, tmp_path / "none" / "f.h5", tmp_path / "m.h5")
        pair = next(split_pairs(small([[1, 1]], [[2, 2]], [0.5])))
        other = pair._replace(names=("a.png", "c.png"), image_size=np.array([[9, 9], [9, 9]]))
        with pytest.raises(ValueError, match=r"'a.png' has several sizes: \[\[8, 6\], \[9, 9\]\]"):
            export_hloc(assemble([pair, other], ""), tmp_path / "f.h5", tmp_path / "m.h5")
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
            (
                {"matches0": np.int16([1, 0])},
                r"integers with shape \(3,\), .* of seq/a.png, got int16 with shape \(2,\)",
            ),
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
            (
                "keypoints",
                None,
                "must have keypoints and image_size, got descriptors, image_size",
            ),
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

    def test_datasets_outside_groups(self, tmp_path):
        features, matches = write_hloc(tmp_path)
        with h5py.File(matches, "r+") as file:
            file["matches0"] = np.zeros(3)
        with pytest.raises(ValueError, match="names no two"):
            import_hloc(features, matches)
        with h5py.File(features, "r+") as file:
            file["keypoints"] = np.zeros((3, 2))
        with pytest.raises(ValueError, match="the image '' must have"):
            import_hloc(features, matches)


@pytest.fixture(scope="module")
def kitti():
    folder = os.environ.get("LEARNNORM_DATA")
    if not folder:
        pytest.skip("LEARNNORM_DATA does not name a folder of real correspondences")
    return read_store(f"{folder}/correspondences/kitti_06.h5@0:3")


class TestRealMatches:
    def test_kitti_flow(self, kitti, tmp_path):
        notes = export_kitti_flow(kitti, tmp_path)
        got = stored(import_kitti_flow(tmp_path), tmp_path)
        assert got.names == kitti.names
        assert len(got.ratio) + sum(notes.values()) == len(kitti.ratio)
        assert len(got.ratio) > 0.7 * len(kitti.ratio)  # SIFT finds some places twice, and more share a pixel

    def test_ngransac(self, kitti, tmp_path):
        export_ngransac(kitti, tmp_path)
        got = stored(import_ngransac(tmp_path), tmp_path)
        assert got.names == [("0", "1"), ("1", "2"), ("2", "3")]
        for new, old in zip(split_pairs(got), split_pairs(kitti), strict=True):
            same_pair(new, old)
            np.testing.assert_allclose(new.F * np.sign((new.F * old.F).sum()), old.F, atol=1e-5)

    def test_hloc(self, kitti, tmp_path):
        paths = tmp_path / "features.h5", tmp_path / "matches.h5"
        dropped = sum(export_hloc(kitti, *paths).values())
        got = stored(import_hloc(*paths), tmp_path)
        assert got.names == kitti.names
        assert len(got.ratio) == len(kitti.ratio) - dropped
        for new, old in zip(split_pairs(got), split_pairs(kitti), strict=True):
            rows = {tuple(row) for row in np.c_[old.points1, old.points2, old.ratio]}
            assert {tuple(row) for row in np.c_[new.points1, new.points2, new.ratio]} <= rows
            assert len(np.unique(new.points1, axis=0)) == len(new.points1) == len(np.unique(old.points1, axis=0))
