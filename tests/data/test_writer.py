import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import store_of

from kornia_learnnorm.data.store import CorrespondenceStore, read_store
from kornia_learnnorm.data.writer import StoreWriter, write_store

pytest.importorskip("h5py", reason="h5py is not installed")

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

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"num_features": 300}, r"store\.h5\.parts was made .* num_features was 200 and is 300"),
            ({"frames": "3500"}, r"other data, remove .* the images, .* have changed since$"),
            ({"frames": "3500", "num_features": 300}, r": num_features was 200 and is 300$"),  # without the digests
        ],
    )
    def test_of_other_options_or_images(self, path, options, message):
        StoreWriter(path, {**OPTIONS, "frames": "48af"}).add(0, pair(0))
        with pytest.raises(ValueError, match=message):
            StoreWriter(path, {**OPTIONS, "frames": "48af", **options})

    def test_folder_goes_if_nothing_is_in_it(self, path):
        writer = StoreWriter(path, OPTIONS)
        writer.close()
        assert list(path.parent.iterdir()) == []

    @pytest.mark.parametrize("text", ["[1]", '{"num_feat'])
    def test_without_readable_options(self, path, text):
        writer = StoreWriter(path, OPTIONS)
        writer.add(0, pair(0))
        (writer.folder / "options.json").write_text(text)
        with pytest.raises(ValueError, match=r"store\.h5\.parts exists, but was not made by this command"):
            StoreWriter(path, OPTIONS)

    def test_wrong_arguments(self, path):
        writer = StoreWriter(path, OPTIONS)
        with pytest.raises(ValueError, match="got 1 pairs and place -1"):
            writer.add(-1, pair(0))
        with pytest.raises(ValueError, match="no pairs to write"):
            writer.finish({})


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
    with pytest.raises(error, match=message):
        StoreWriter(tmp_path / name, OPTIONS)


FULL_DISK = """
import resource, signal, sys
sys.path.append(sys.argv[1])
from test_writer import OPTIONS, StoreWriter, pair
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
