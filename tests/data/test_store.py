"""Stores: what is written comes back, some pairs of it, parts of a store, and what a broken file says."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import raises, store_of

from kornia_learnnorm.data.store import LAYOUT, CorrespondenceStore, StoreReader, read_store
from kornia_learnnorm.data.store_writer import StoreWriter, write_store


@pytest.fixture
def stored(uneven, tmp_path):
    write_store(tmp_path / "store.h5", uneven)
    return tmp_path / "store.h5"


def same(got, expected):
    np.testing.assert_equal(vars(got), vars(expected))


def test_round_trip(uneven, stored):
    got = read_store(stored)
    same(got, uneven)
    assert (len(got), repr(got)) == (6, f"<store of 6 image pairs, 180 correspondences: {uneven.dataset!r}>")
    with h5py.File(stored) as file:
        assert (file.attrs["format"], file.attrs["version"]) == ("correspondences", 1)
        dtypes = {name: data.dtype for name, data in file.items()}
    assert all(getattr(got, name).dtype == getattr(uneven, name).dtype == dtypes[name] for name in ("offsets", *LAYOUT))
    assert [file.name for file in stored.parent.iterdir()] == ["store.h5"]


def test_a_file_without_scores_has_one_minus_the_ratio(uneven, stored):
    with h5py.File(stored, "r+") as file:
        del file["score"]
    same(read_store(stored), uneven)
    with h5py.File(stored, "r+") as file:
        file["ratio"][:3] = np.nan
    raises(ValueError, "ratio holds NaN or infinite", read_store, stored)


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
def test_inconsistent_arrays_and_links_to_others(stored, name, value, message):
    stored.with_name("other.h5").write_bytes(stored.read_bytes())
    with h5py.File(stored, "r+") as file:
        if name == "version":
            file.attrs[name] = value
        else:
            del file[name]
        if callable(value):
            value(file)
        elif value is not None:
            file[name] = value
    raises(ValueError, message, read_store, stored)


def test_a_failed_write_leaves_the_old_file_and_no_other_is_read_on(uneven, stored):
    before, reader = stored.read_bytes(), StoreReader(stored)
    broken = CorrespondenceStore(**{**vars(uneven), "K": "not an array"})
    raises(ValueError, "could not convert", write_store, stored, broken)
    assert stored.read_bytes() == before
    assert [file.name for file in stored.parent.iterdir()] == ["store.h5"]
    write_store(stored, uneven)
    raises(ValueError, r"store\.h5 has changed since it was opened", reader.read, [0])


@pytest.mark.parametrize(("first", "stop"), [(0, 1), (2, 5), (0, 6)])
def test_some_pairs(uneven, stored, first, stop):
    part = read_store(f"{stored}@{first}:0{stop}")
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
def test_pairs_that_are_not_there(stored, first, stop):
    with pytest.raises(ValueError, match=f"pairs {first}:{stop} were asked for, the store has 0:6"):
        read_store(f"{stored}@{first}:{stop}")


OPTIONS = {"detector": "sift", "num_features": 200, "max_matches": None}


def pair(number: int) -> CorrespondenceStore:
    points = np.full((number + 1, 2), number, np.float32)
    return store_of(points, points + 1, [0, number + 1], [(f"{number}a", f"{number}b")])


@settings(max_examples=8)
@given(order=st.permutations(range(3)), stop=st.integers(0, 3))
def test_order_and_stops_leave_no_trace(tmp_path_factory, order, stop):
    path = tmp_path_factory.mktemp("store") / "store.h5"
    for places in (order[:stop], order[stop:]):
        writer = StoreWriter(path, OPTIONS)
        assert writer.done().isdisjoint(places)
        for place in places:
            writer.add(place, pair(place))
    writer.finish({"by": "a test"})
    store = read_store(path)
    assert store.names == [(f"{i}a", f"{i}b") for i in range(3)]
    assert store.points1[:, 0].tolist() == [i for i in range(3) for _ in range(i + 1)]
    assert store.provenance == {"by": "a test", "options": OPTIONS}
    assert [file.name for file in path.parent.iterdir()] == ["store.h5"]
    assert StoreWriter(path, OPTIONS).complete


@pytest.fixture
def path(tmp_path):
    return tmp_path / "store.h5"


class TestParts:
    @pytest.mark.parametrize("size", [0, 100, 5000])
    def test_broken_part_is_made_again(self, path, size):
        writer = StoreWriter(path, OPTIONS)
        for place in range(3):
            writer.add(place, pair(place))
        part = writer.folder / "00000001.h5"
        part.write_bytes(part.read_bytes()[:size])
        assert StoreWriter(path, OPTIONS).done() == {0, 2}
        assert not part.exists()

    def test_of_other_options_or_images(self, path):
        StoreWriter(path, {**OPTIONS, "frames": "48af"}).add(0, pair(0))
        for options, message in [
            ({"num_features": 300}, r"store\.h5\.parts was made .* num_features 200, now 300"),
            ({"frames": "3500"}, r"other data, remove .* the images, .* have changed since$"),
            ({"frames": "3500", "num_features": 300}, r": num_features 200, now 300$"),  # without the digests
        ]:
            raises(ValueError, message, StoreWriter, path, {**OPTIONS, "frames": "48af", **options})

    def test_nothing_is_written_without_pairs_and_the_folder_goes(self, path):
        writer = StoreWriter(path, OPTIONS)
        raises(ValueError, "got 1 pairs and place -1", writer.add, -1, pair(0))
        raises(ValueError, "no pairs to write", writer.finish, {})
        writer.close()
        assert list(path.parent.iterdir()) == []

    @pytest.mark.parametrize("text", ["[1]", '{"num_feat'])
    def test_without_readable_options(self, path, text):
        writer = StoreWriter(path, OPTIONS)
        writer.add(0, pair(0))
        (writer.folder / "options.json").write_text(text)
        raises(ValueError, r"store\.h5\.parts exists, but was not made by this command", StoreWriter, path, OPTIONS)


NO_PROC = pytest.mark.skipif(not Path("/proc/self").exists(), reason="there is no /proc")


@pytest.mark.parametrize(
    ("make", "name", "error", "message"),
    [
        (lambda path: path.write_bytes(b"\x89HDF"), "store.h5", ValueError, r"store\.h5 is not a readable HDF5 file"),
        (lambda path: write_store(path, pair(0)), "store.h5", ValueError, "exists, but was not made by this command"),
        (lambda path: path.mkdir(), "store.h5", ValueError, "not a regular file"),
        (lambda path: path.with_name("store.h5.parts").touch(), "store.h5", ValueError, "parts, which is not a folder"),
        (id, "nothing/store.h5", FileNotFoundError, r"the folder .*nothing does not exist"),
        pytest.param(id, "/proc/out.h5", OSError, r"^cannot write /proc/out\.h5: ", marks=NO_PROC),
    ],
)
def test_places_that_are_refused(tmp_path, make, name, error, message):
    make(tmp_path / name)
    raises(error, message, StoreWriter, tmp_path / name, OPTIONS)


FULL_DISK = """
import resource, signal, sys
sys.path.append(sys.argv[1])
from test_store import OPTIONS, StoreWriter, pair
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
for limit, rows in ((20_000, 0), (700_000, 20_000)):  # a part, the store of three
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))
    writer = StoreWriter(f"{limit}.h5", OPTIONS)
    try:
        for place in range(3):
            writer.add(place, pair(place + rows))
        writer.finish({})
    except OSError as error:
        print("one line:", error)
"""


@pytest.mark.skipif(os.name != "posix", reason="limits are POSIX's")
def test_full_disk(tmp_path):
    command = [sys.executable, "-c", FULL_DISK, str(Path(__file__).parent)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=60)
    assert done.stdout.count("one line: ") == 2, done.stderr
    assert not list(tmp_path.glob("*.h5"))
    assert not list(tmp_path.rglob(".*"))  # nothing half-written stays
    writer = StoreWriter(tmp_path / "700000.h5", OPTIONS)
    assert writer.done() == {0, 1, 2}
    writer.finish({})
    assert len(read_store(writer.path)) == 3
