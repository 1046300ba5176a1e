"""Matching many pairs: once a frame, on any number of processes, through kills and full disks."""

import os
import pkgutil
import re
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("cv2", reason="OpenCV is not installed")
pytest.importorskip("h5py", reason="h5py is not installed")
pytest.importorskip("joblib", reason="joblib is not installed")

from make_sequences import write_image
from PIL import Image

from kornia_learnnorm.cli.main import main
from kornia_learnnorm.data.datasets.folder import read_folder
from kornia_learnnorm.data.datasets.frames import FramePair
from kornia_learnnorm.data.datasets.pairing import pair_frames
from kornia_learnnorm.data.matching import match_store
from kornia_learnnorm.data.matching.feature_cache import FeatureCache
from kornia_learnnorm.data.matching.features import Features
from kornia_learnnorm.data.matching.match_store import MatchOptions, collect_matches, match_frames
from kornia_learnnorm.data.store import CorrespondenceStore, read_store

OPTIONS = MatchOptions(num_features=200, max_matches=30)
ARRAYS = ("points1", "points2", "ratio", "offsets", "image_size", "F", "K", "R", "t")


def frames_of(root: Path, number: int) -> Path:
    for frame in range(number):
        write_image(root / f"{frame:03}.png", 6 * frame)
    return root


def pairs_of(root: Path) -> list[FramePair]:
    return list(pair_frames(read_folder(root)))


def assert_same(path1: Path, path2: Path) -> None:
    store1, store2 = read_store(path1), read_store(path2)
    for name in ARRAYS:
        assert np.array_equal(getattr(store1, name), getattr(store2, name), equal_nan=True), name
    assert (store1.names, store1.provenance) == (store2.names, store2.provenance)


@pytest.fixture(scope="module")
def images(tmp_path_factory):
    return frames_of(tmp_path_factory.mktemp("images"), 24)


@pytest.fixture(scope="module")
def expected(images, tmp_path_factory):
    path = tmp_path_factory.mktemp("expected") / "store.h5"
    assert collect_matches(pairs_of(images), path, OPTIONS) == {}
    return path


class Detector:
    """SIFT that counts its calls and what waits on disk at each."""

    def __init__(self, folder: Path) -> None:
        self.detect, self.calls, self.waiting, self.folder = match_store.DETECTORS["sift"], 0, 0, folder

    def __call__(self, image: np.ndarray, num_features: int) -> Features:
        self.calls += 1
        self.waiting = max(self.waiting, len(list(self.folder.glob("*.npz"))))
        return self.detect(image, num_features)


class TestOnce:
    def test_each_frame_is_detected_once_and_its_features_go(self, images, tmp_path, monkeypatch):
        frames = read_folder(images)
        pairs = [FramePair(a, b) for gap in (1, 2, 3) for a, b in zip(frames, frames[gap:], strict=False)]
        pairs.sort(key=lambda pair: pair.frame1.name)
        detector = Detector(tmp_path / "store.h5.parts" / "features")
        monkeypatch.setitem(match_store.DETECTORS, "sift", detector)
        collect_matches(pairs, tmp_path / "store.h5", OPTIONS)
        assert len(pairs) == 66
        assert detector.calls == 24
        # A window of 8 pairs and the frames that reach 3 further: bounded, whatever the number of pairs.
        assert 2 <= detector.waiting <= 8
        assert sorted(path.name for path in tmp_path.iterdir()) == ["store.h5"]

    def test_cache_gives_back_what_was_put(self, images, tmp_path):
        (pair, *_) = pairs_of(images)
        features = Features(np.ones((2, 2), np.float32), np.arange(6, dtype=np.uint8).reshape(2, 3), (160, 120))
        (tmp_path / "cache").mkdir()
        (tmp_path / "cache" / "of-a-killed-run.npz").touch()
        with FeatureCache(tmp_path / "cache", [pair]) as cache:
            cache.put(pair.frame1, features)
            cache.put(pair.frame2, "unreadable")
            got, reason = map(cache.get, pair)
            assert cache.missing([pair]) == []
            cache.release(pair)
            assert list(cache.folder.iterdir()) == []
        assert reason == "unreadable"
        np.testing.assert_equal(got, features)
        assert got.descriptors.dtype == np.uint8
        assert not cache.folder.exists()


class TestProcesses:
    def test_killed_worker_loses_nothing(self, images, expected, tmp_path, capfd, monkeypatch):
        add, killed = match_store.StoreWriter.add, []

        def kill_first(writer, place, pair):
            if not killed:
                killed.append(loky_workers()[0])
                os.kill(killed[0], signal.SIGKILL)
            add(writer, place, pair)

        monkeypatch.setattr(match_store.StoreWriter, "add", kill_first)
        for attempt in range(5):  # on a busy machine the other worker can have done everything by then
            killed.clear()
            collect_matches(pairs_of(images), tmp_path / f"{attempt}.h5", OPTIONS, jobs=2)
            assert_same(expected, tmp_path / f"{attempt}.h5")
            if "a worker process was killed; continuing" in capfd.readouterr().err:
                return
        pytest.fail("no run missed its worker")

    def test_workers_that_die_again_and_again(self, images, tmp_path, monkeypatch):
        from joblib.externals.loky.process_executor import TerminatedWorkerError

        def broken(*_):
            raise TerminatedWorkerError("killed")
            yield

        monkeypatch.setattr(match_store, "_match_some", broken)
        with pytest.raises(OSError, match=r"were killed 4 times in a row: killed"):
            collect_matches(pairs_of(images), tmp_path / "store.h5", OPTIONS)

    @pytest.mark.parametrize(
        ("where", "message"),
        [
            ({"jobs": 0}, "jobs must be .* got 0"),
            ({"dask": "127.0.0.1:bad"}, "address as tcp://host:8786, got '127.0.0.1:bad'"),
            ({"dask": "http://127.0.0.1:1"}, "address as tcp://host:8786, got 'http://127.0.0.1:1'"),
        ],
    )
    def test_no_processes(self, images, tmp_path, where, message):
        if "dask" in where:
            pytest.importorskip("distributed", reason="Dask is not installed")
        with pytest.raises(ValueError, match=message):
            collect_matches(pairs_of(images), tmp_path / "store.h5", OPTIONS, **where)
        assert list(tmp_path.iterdir()) == []


# What joblib's process for cleaning up says, if it is stopped while it starts.
JOBLIB = r"Traceback \(most recent call last\):\n(?:  .*\n)*KeyError: '\S*joblib_memmapping_folder\S*'\n?"


def loky_workers() -> list[int]:
    """Return the ids of this process's loky workers."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            mine = f"PPid:\t{os.getpid()}\n" in (folder / "status").read_text()
            if mine and b"LokyProcess" in (folder / "cmdline").read_bytes():
                found.append(int(folder.name))
        except OSError:  # it ended meanwhile
            continue
    return found


# The command, stopped by Ctrl-C, which reaches all its processes, after its eighth pair. It waits until its workers
# ignore SIGINT, so that none of them is met while it starts.
STOPPED = """
import os, signal, sys, time
from pathlib import Path
from kornia_learnnorm.cli.main import main
from kornia_learnnorm.data.matching import match_store

add, added = match_store.StoreWriter.add, []

def children_ignore_sigint():
    for status in Path("/proc").glob("[0-9]*/status"):
        try:
            fields = dict(line.split(":", 1) for line in status.read_text().splitlines())
        except OSError:
            continue
        mine = int(fields["PPid"]) == os.getpid() and not fields["State"].strip().startswith("Z")
        if mine and not int(fields["SigIgn"], 16) >> signal.SIGINT - 1 & 1:
            return False
    return True

def add_and_stop(writer, place, pair):
    add(writer, place, pair)
    added.append(place)
    if len(added) == 8:
        while not children_ignore_sigint():
            time.sleep(0.05)
        os.killpg(0, signal.SIGINT)

match_store.StoreWriter.add = add_and_stop
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="there is no /proc")
class TestSignals:
    def test_interrupted_run_goes_on(self, images, expected, tmp_path, capfd):
        out, parts = tmp_path / "store.h5", tmp_path / "store.h5.parts"
        args = ["match", "folder", images, "--out", out, "--jobs", "2", "--num-features", "200", "--max-matches", "30"]
        stopped = [sys.executable, "-c", STOPPED, *map(str, args)]
        run = subprocess.run(stopped, capture_output=True, text=True, timeout=120, start_new_session=True)
        assert len(list(parts.glob("0*.h5"))) == 8, run.stderr
        assert not out.exists()
        assert run.returncode == 130
        error = re.sub(JOBLIB, "", run.stderr)
        assert error.rstrip().endswith("interrupted")
        assert "Traceback" not in error
        assert main([*map(str, args), "--jobs", "1"]) == 0
        assert len(capfd.readouterr().err.splitlines()) <= 4  # the bar is quiet where stderr is no terminal
        store, whole = read_store(out), read_store(expected)
        assert all(np.array_equal(getattr(store, name), getattr(whole, name), equal_nan=True) for name in ARRAYS)


class TestDask:
    @pytest.fixture
    def cluster(self):
        distributed = pytest.importorskip("distributed", reason="Dask is not installed")
        with distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, dashboard_address=":0", silence_logs=50
        ) as cluster:
            yield cluster

    def test_same_store_though_a_worker_is_killed(self, images, expected, tmp_path, cluster, monkeypatch):
        add, places = match_store.StoreWriter.add, []

        def add_and_kill(writer, place, pair):
            add(writer, place, pair)
            places.append(place)
            if len(places) == 4:  # the last 7 of 23 pairs are not sent before the first 16 are written
                os.kill(next(iter(cluster.workers.values())).pid, signal.SIGKILL)

        monkeypatch.setattr(match_store.StoreWriter, "add", add_and_kill)
        collect_matches(pairs_of(images), tmp_path / "store.h5", OPTIONS, dask=cluster.scheduler_address)
        assert places == list(range(23))
        assert_same(expected, tmp_path / "store.h5")

    def test_nobody_at_the_address(self, images, tmp_path):
        pytest.importorskip("distributed", reason="Dask is not installed")  # before its settings are changed
        import dask

        with dask.config.set({"distributed.comm.timeouts.connect": "0.2s"}), pytest.raises(OSError, match="tcp"):
            collect_matches(pairs_of(images), tmp_path / "store.h5", OPTIONS, dask="tcp://127.0.0.1:1")
        assert list(tmp_path.iterdir()) == []


class TestGoingOn:
    def test_other_cameras_are_refused(self, images, expected):
        moved = [FramePair(replace(pair.frame1, camera=np.eye(3)), pair.frame2) for pair in pairs_of(images)]
        with pytest.raises(ValueError, match=r"other data.* the images, their cameras, their poses or the pairs"):
            collect_matches(moved, expected, OPTIONS)

    def test_store_of_an_earlier_version_is_refused(self, images, tmp_path, monkeypatch):
        """Its options do not say that its matches share no point."""
        monkeypatch.setattr(match_store, "METHOD", {})
        collect_matches(pairs_of(images)[:2], tmp_path / "store.h5", OPTIONS)
        monkeypatch.undo()
        with pytest.raises(ValueError, match=r"made with other options, .*: matches was None and is 'one-to-one'"):
            collect_matches(pairs_of(images)[:2], tmp_path / "store.h5", OPTIONS)

    @pytest.mark.parametrize(
        ("place", "error"),
        [
            ("kornia_learnnorm.data.matching.match_store.StoreWriter.add", OSError(28, "No space left on device")),
            ("kornia_learnnorm.data.matching.feature_cache.np.savez", OSError("1024 written of 000.png")),
            ("kornia_learnnorm.data.matching.match_store.read_frame", KeyboardInterrupt()),
        ],
    )
    def test_after_an_error(self, images, expected, tmp_path, monkeypatch, place, error):
        path, calls, call = tmp_path / "store.h5", [], pkgutil.resolve_name(place)

        def fails(*args, **arrays):
            calls.append(args)
            if len(calls) == 12:
                raise error
            return call(*args, **arrays)

        monkeypatch.setattr(place, fails)
        with pytest.raises(type(error), match=r"No space left|cannot write the features of .* full|^$"):
            collect_matches(pairs_of(images), path, OPTIONS)
        monkeypatch.undo()
        assert not path.exists()
        assert any((tmp_path / "store.h5.parts").glob("0*.h5"))
        assert not (tmp_path / "store.h5.parts" / "features").exists()  # gives back what room it can
        collect_matches(pairs_of(images), path, OPTIONS)
        assert_same(expected, path)


class TestBadInput:
    def test_unreadable_and_blank_images_are_skipped_and_listed(self, tmp_path, capsys):
        root = frames_of(tmp_path / "images", 9)
        (root / "002.png").write_bytes(b"")
        data = (root / "004.png").read_bytes()
        (root / "004.png").write_bytes(data[: len(data) // 2])
        Image.new("L", (160, 120)).save(root / "006.png")
        skipped = collect_matches(pairs_of(root), tmp_path / "store.h5", OPTIONS)
        assert list(skipped) == [f"{i:03}.png {i + 1:03}.png" for i in range(1, 7)]
        for name, reason in zip(skipped, ["is empty", "is empty", *["truncated"] * 2, *["is blank"] * 2], strict=True):
            assert reason in skipped[name]
        path = tmp_path / "store.h5"
        store, before = read_store(path), path.stat().st_mtime_ns
        assert store.names == [("000.png", "001.png"), ("007.png", "008.png")]
        assert store.provenance["skipped"] == skipped
        assert collect_matches(pairs_of(root), path, OPTIONS) == skipped  # a complete store is left alone
        assert path.stat().st_mtime_ns == before
        assert "exists already" in capsys.readouterr().err

    def test_nothing_matched_blocks_no_later_run(self, images, tmp_path):
        (pair, *_) = pairs_of(images)
        wrong = FramePair(replace(pair.frame1, size=(100, 100)), pair.frame2)
        with pytest.raises(ValueError, match=r"none of the 1 pairs .* 160 x 120 pixels, its camera 100 x 100"):
            collect_matches([wrong], tmp_path / "store.h5", OPTIONS)
        assert list(tmp_path.iterdir()) == []
        collect_matches([pair], tmp_path / "store.h5", replace(OPTIONS, seed=1))
        assert len(read_store(tmp_path / "store.h5")) == 1

    def test_no_pairs(self, tmp_path):
        with pytest.raises(ValueError, match="no pairs of frames to match"):
            collect_matches([], tmp_path / "store.h5")
        with pytest.raises(ValueError, match=r"detector must be one of sift, .* got 'orb'"):
            MatchOptions(detector="orb")


def matched(pair: FramePair, seed: int, most: int | None) -> CorrespondenceStore:
    rng = np.random.default_rng(seed)
    points = rng.uniform(0, 100, (60, 2)).astype(np.float32)
    near, far = rng.normal(size=(2, 30, 8))
    noisy = np.concatenate([near + rng.normal(size=near.shape) * 0.1, rng.normal(size=(30, 8))])
    first = Features(points, np.concatenate([near, far]).astype(np.float32), (160, 120))
    second = Features(points + 1, noisy.astype(np.float32), (160, 120))
    return match_frames(pair, first, second, options=MatchOptions(max_matches=most, seed=seed))


class TestMatchFrames:
    @given(seed=st.integers(0, 1000), most=st.integers(8, 40))
    def test_cut_is_a_subset_with_at_most_so_many_of_each_class(self, images, seed, most):
        (pair, *_) = pairs_of(images)
        whole, cut = matched(pair, seed, None), matched(pair, seed, most)
        rows, some = (
            list(map(tuple, np.column_stack([store.points1, store.points2, store.ratio]))) for store in (whole, cut)
        )
        assert len(set(some)) == len(some)
        assert set(some) <= set(rows)
        assert len({row[:2] for row in rows}) == len({row[2:4] for row in rows}) == len(rows)  # one-to-one
        passes = {True: (whole.ratio < 0.8).sum(), False: (whole.ratio >= 0.8).sum()}
        assert (cut.ratio < 0.8).sum() == min(most, passes[True])
        assert (cut.ratio >= 0.8).sum() == min(most, passes[False])
