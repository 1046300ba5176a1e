"""Matching many pairs: once a frame, on any number of processes, through kills and full disks."""

import os
import pkgutil
import signal
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scenes import raises

pytest.importorskip("cv2", reason="OpenCV is not installed")
pytest.importorskip("h5py", reason="h5py is not installed")
pytest.importorskip("joblib", reason="joblib is not installed")

from make_sequences import write_image
from PIL import Image

from kornia_learnnorm.cli.main import main
from kornia_learnnorm.data.datasets.frames import FramePair
from kornia_learnnorm.data.datasets.pairing import pair_frames
from kornia_learnnorm.data.datasets.reading import read_folder
from kornia_learnnorm.data.matching import frame_matching
from kornia_learnnorm.data.matching.features import Features
from kornia_learnnorm.data.matching.frame_matching import MatchOptions, collect_matches, match_frames
from kornia_learnnorm.data.store import LAYOUT, read_store

OPTIONS = MatchOptions(num_features=200, max_matches=30)


def frames_of(root: Path, number: int) -> Path:
    for frame in range(number):
        write_image(root / f"{frame:03}.png", 6 * frame)
    return root


def pairs_of(root: Path) -> list[FramePair]:
    return list(pair_frames(read_folder(root)))


def assert_same(path1: Path, path2: Path) -> None:
    one, other = (vars(read_store(path)) for path in (path1, path2))
    np.testing.assert_equal(*([store[name] for name in ("names", "offsets", *LAYOUT)] for store in (one, other)))
    assert one["provenance"]["skipped"] == other["provenance"]["skipped"]


@pytest.fixture(scope="module")
def images(tmp_path_factory):
    return frames_of(tmp_path_factory.mktemp("images"), 12)


@pytest.fixture(scope="module")
def expected(images, tmp_path_factory):
    path = tmp_path_factory.mktemp("expected") / "store.h5"
    assert collect_matches(pairs_of(images), path, OPTIONS) == {}
    return path


def test_scores_of_lightglue_reach_the_store(images, tmp_path, cached_weights):
    cached_weights("xfeat.pt", "xfeat-lighterglue.pt")
    options = MatchOptions("xfeat", 200, "lightglue", max_matches=30)
    collect_matches(pairs_of(images)[:2], tmp_path / "s.h5", options)
    store = read_store(tmp_path / "s.h5")
    assert np.isnan(store.ratio).all()
    assert 0.1 < store.score.min() < store.score.max() <= 1
    assert np.diff(store.offsets).tolist() == [30, 30]  # no ratio test divides them


def test_each_frame_is_detected_once_and_its_features_go(images, tmp_path, monkeypatch):
    detect, waiting = frame_matching.DETECTORS["sift"], []

    def count(*arguments):
        waiting.append(len(list(tmp_path.glob("store.h5.parts/features-*/*.npz"))))
        return detect(*arguments)

    frames = read_folder(images)
    pairs = [FramePair(a, b) for gap in (1, 2, 3) for a, b in zip(frames, frames[gap:], strict=False)]
    pairs.sort(key=lambda pair: pair.frame1.name)
    monkeypatch.setitem(frame_matching.DETECTORS, "sift", count)
    collect_matches(pairs, tmp_path / "store.h5", OPTIONS)
    assert (len(pairs), len(waiting)) == (30, 12)
    # A window of 8 pairs and the frames that reach 3 further: bounded, whatever the number of pairs.
    assert 2 <= max(waiting) <= 8
    assert sorted(path.name for path in tmp_path.iterdir()) == ["store.h5"]


def loky_workers() -> dict[int, bool]:
    """Return the ids of this process's loky workers, and whether each ignores Ctrl-C."""
    found = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            fields = dict(line.split(":\t", 1) for line in (folder / "status").read_text().splitlines())
            if int(fields["PPid"]) == os.getpid() and b"LokyProcess" in (folder / "cmdline").read_bytes():
                found[int(folder.name)] = bool(int(fields["SigIgn"], 16) >> signal.SIGINT - 1 & 1)
        except OSError:  # it ended meanwhile
            continue
    return found


@pytest.fixture
def _a_worker_dies(tmp_path, monkeypatch):
    """Kill the worker that matches the fourth pair, once."""
    mark = tmp_path / "killed"

    def match(pair, features1, features2, options, place):
        from kornia_learnnorm.data.matching.frame_matching import _match  # in the worker the original

        if place == 3 and not mark.exists():
            mark.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return _match(pair, features1, features2, options, place)

    monkeypatch.setattr(frame_matching, "_match", match)
    yield
    assert mark.exists()


class TestProcesses:
    @pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="there is no /proc")
    @pytest.mark.usefixtures("_a_worker_dies")
    def test_a_killed_worker_and_ctrl_c_lose_nothing(self, images, expected, tmp_path, capfd, monkeypatch):
        """Ctrl-C reaches all processes of the command: the workers ignore it."""
        out, parts, add = tmp_path / "store.h5", tmp_path / "store.h5.parts", frame_matching.StoreWriter.add

        def add_and_interrupt(writer, place, pair):
            add(writer, place, pair)
            if place == 7:
                while not all(loky_workers().values()):  # one is not ready yet
                    time.sleep(0.05)
                for worker in loky_workers():
                    os.kill(worker, signal.SIGINT)
                raise KeyboardInterrupt

        args = ["match", "folder", images, "--out", out, "--num-features", "200", "--max-matches", "30", "--jobs"]
        monkeypatch.setattr(frame_matching.StoreWriter, "add", add_and_interrupt)
        assert main([*map(str, args), "2"]) == 130
        monkeypatch.undo()
        error = capfd.readouterr().err
        assert error.count("a worker process was killed; continuing") == 1
        assert error.endswith("interrupted\n")
        assert "Traceback" not in error
        assert len(list(parts.glob("0*.h5"))) == 8
        assert not out.exists()
        assert main([*map(str, args), "1"]) == 0
        assert len(capfd.readouterr().err.splitlines()) <= 4  # the bar is quiet where stderr is no terminal
        assert_same(out, expected)

    def test_workers_that_die_again_and_again(self, images, tmp_path, monkeypatch):
        from joblib.externals.loky.process_executor import TerminatedWorkerError

        def broken(*_):
            raise TerminatedWorkerError("killed")
            yield

        monkeypatch.setattr(frame_matching, "_match_rest", broken)
        with pytest.raises(OSError, match=r"were killed 4 times in a row: killed"):
            collect_matches(pairs_of(images), tmp_path / "store.h5", OPTIONS)


class TestDask:
    @pytest.mark.usefixtures("_a_worker_dies")
    def test_same_store_though_a_worker_is_killed(self, images, expected, tmp_path):
        distributed = pytest.importorskip("distributed", reason="Dask is not installed")
        options = {"threads_per_worker": 1, "dashboard_address": ":0", "silence_logs": 50}
        with distributed.LocalCluster(n_workers=2, processes=True, **options) as cluster:
            collect_matches(pairs_of(images), tmp_path / "store.h5", OPTIONS, dask=cluster.scheduler_address)
        assert_same(expected, tmp_path / "store.h5")

    @pytest.mark.parametrize("address", ["127.0.0.1:bad", "http://127.0.0.1:1", "tcp://127.0.0.1:1"])
    def test_nobody_at_the_address(self, images, tmp_path, address):
        pytest.importorskip("distributed", reason="Dask is not installed")  # before its settings are changed
        import dask

        match = "tcp" if address.startswith("tcp") else f"address as tcp://host:8786, got '{address}'"
        with dask.config.set({"distributed.comm.timeouts.connect": "0.2s"}):
            raises(
                (OSError, ValueError), match, collect_matches, pairs_of(images), tmp_path / "s", OPTIONS, dask=address
            )
        assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("place", "error"),
    [
        ("kornia_learnnorm.data.matching.frame_matching.StoreWriter.add", OSError(28, "No space left on device")),
        ("kornia_learnnorm.data.matching.frame_matching.np.savez", OSError("1024 written of 000.png")),
        ("kornia_learnnorm.data.matching.frame_matching.read_frame", KeyboardInterrupt()),
    ],
)
def test_after_an_error(images, expected, tmp_path, monkeypatch, place, error):
    path, calls, call = tmp_path / "store.h5", [], pkgutil.resolve_name(place)

    def fails(*args, **arrays):
        calls.append(args)
        if len(calls) == 11:
            raise error
        return call(*args, **arrays)

    monkeypatch.setattr(place, fails)
    with pytest.raises(type(error), match=r"No space left|cannot write the features of .* full|^$"):
        collect_matches(pairs_of(images), path, OPTIONS)
    monkeypatch.undo()
    assert not path.exists()
    assert any((tmp_path / "store.h5.parts").glob("0*.h5"))
    assert not any((tmp_path / "store.h5.parts").glob("features-*"))  # gives back what room it can
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
        for name, reason in zip(skipped, [*["0 bytes"] * 2, *["truncated"] * 2, *["is blank"] * 2], strict=True):
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
        raises(ValueError, "no pairs of frames to match", collect_matches, [], tmp_path / "store.h5")
        raises(ValueError, r"detector must be one of sift, .* got 'orb'", MatchOptions, detector="orb")


@given(seed=st.integers(0, 1000), most=st.integers(8, 40))
def test_cut_is_a_subset_with_at_most_so_many_of_each_class(images, seed, most):
    rng = np.random.default_rng(seed)
    points = rng.uniform(0, 100, (60, 2)).astype(np.float32)
    near, far = rng.normal(size=(2, 30, 8))
    noisy = np.concatenate([near + rng.normal(size=near.shape) * 0.1, rng.normal(size=(30, 8))])
    first = Features(points, np.concatenate([near, far]).astype(np.float32), (160, 120))
    second = Features(points + 1, noisy.astype(np.float32), (160, 120))
    options = (MatchOptions(max_matches=number, seed=seed) for number in (None, most))
    whole, cut = (match_frames(pairs_of(images)[0], first, second, option) for option in options)
    rows, some = (list(map(tuple, np.column_stack([s.points1, s.points2, s.ratio]))) for s in (whole, cut))
    assert len(set(some)) == len(some)
    assert set(some) <= set(rows)
    assert len({row[:2] for row in rows}) == len({row[2:4] for row in rows}) == len(rows)  # one-to-one
    passes = {True: (whole.ratio < 0.8).sum(), False: (whole.ratio >= 0.8).sum()}
    assert (cut.ratio < 0.8).sum() == min(most, passes[True])
    assert (cut.ratio >= 0.8).sum() == min(most, passes[False])
