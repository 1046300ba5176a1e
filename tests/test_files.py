"""Locks of folders and files, in this process and against others."""

import errno
import os
import subprocess
import sys

import pytest
from scenes import raises

from kornia_learnnorm import files
from kornia_learnnorm.cli.main import main
from kornia_learnnorm.data.store_writer import write_store
from kornia_learnnorm.data.synthetic.scenes import synthetic_store
from kornia_learnnorm.files import atomic_write, exclusive

# Without the package, which takes seconds to import.
HOLD = """import runpy, sys
with runpy.run_path(sys.argv[2])["exclusive"](sys.argv[1]):
    print("held", flush=True)
    sys.stdin.read()
"""


@pytest.mark.parametrize("name", ["", "store.h5"])
def test_a_lock_is_refused_then_released_also_after_an_error_and_leaves_no_file(tmp_path, name):
    with exclusive(tmp_path / name):
        with pytest.raises(BlockingIOError, match=r"is in use by process \d+ on .*: wait for it to end, or"):
            exclusive(tmp_path / name).__enter__()
        with exclusive(tmp_path / "other.h5"):
            pass
    with pytest.raises(KeyboardInterrupt), exclusive(tmp_path / name):
        raise KeyboardInterrupt
    with exclusive(tmp_path / name):
        pass
    assert list(tmp_path.iterdir()) == []
    raises(OSError, r"cannot write .*store\.h5", exclusive(tmp_path / "none" / "store.h5").__enter__)


def test_a_killed_process_does_not_block(tmp_path):
    command = [sys.executable, "-c", HOLD, str(tmp_path), files.__file__]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "held\n"
        raises(BlockingIOError, f"{tmp_path} is in use by process {process.pid} on ", exclusive(tmp_path).__enter__)
        process.kill()
    assert (tmp_path / ".lock").is_file()
    with exclusive(tmp_path):
        pass
    assert not (tmp_path / ".lock").exists()


def test_a_failed_write_keeps_the_old_file(tmp_path):
    path = tmp_path / "F.json"
    path.write_text("old")
    with pytest.raises(RuntimeError, match="stop"), atomic_write(path) as temporary:  # noqa: PT012
        temporary.write_text("half")
        raise RuntimeError("stop")
    assert {file.name: file.read_text() for file in tmp_path.iterdir()} == {"F.json": "old"}


def test_a_read_only_place_names_the_file(tmp_path, monkeypatch):
    def refuse(path, *_, **__):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(path))

    for name in ("touch", "unlink"):  # such a file system also refuses to remove what is not there
        monkeypatch.setattr(files.Path, name, refuse)
    with pytest.raises(OSError, match=r"F\.json") as caught, atomic_write(tmp_path / "F.json"):
        pass
    assert caught.value.filename == str(tmp_path / "F.json")


@pytest.mark.parametrize("error", [errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO])
def test_a_full_disk_names_the_file(tmp_path, error):
    outer, inner = tmp_path / "outer.json", tmp_path / "inner.json"
    with (
        pytest.raises(OSError, match=os.strerror(error)) as caught,
        atomic_write(outer),
        atomic_write(inner) as temporary,
        atomic_write(temporary),
    ):
        raise OSError(error, os.strerror(error))
    assert caught.value.filename == (None if error == errno.EIO else str(inner))
    assert [*tmp_path.iterdir()] == []


def test_commands_name_the_file_on_a_full_disk(tmp_path, monkeypatch, planes, refused):
    pytest.importorskip("matplotlib")

    def full(self, *args, **kwargs):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    images, picture, report = (planes / "left.png", planes / "right.png"), tmp_path / "a.png", tmp_path / "a.json"
    for place, path in (("matplotlib.figure.Figure.savefig", picture), ("pathlib.Path.write_text", report)):
        with monkeypatch.context() as patch:
            patch.setattr(place, full)
            refused(["estimate", *images, "--out", picture, "--json", report], f"{path}: No space left on device")
    with monkeypatch.context() as patch:
        patch.setattr("h5py.File", full)
        refused(["synthesize", tmp_path], f"cannot write {tmp_path / 'synthetic.h5'}: No space left on device")
    assert [*tmp_path.iterdir()] == []


@pytest.mark.usefixtures("program")
def test_commands_refuse_a_folder_that_another_run_writes(tmp_path, refused):
    for module in ("cv2", "h5py", "pytorch_lightning"):
        pytest.importorskip(module)
    from make_sequences import write_image

    store, out, matched = tmp_path / "store.h5", tmp_path / "run", tmp_path / "matched.h5"
    write_store(store, synthetic_store(pairs=1, points=40))
    for number in range(2):
        write_image(tmp_path / f"images/{number}.png", 6 * number)
    (tmp_path / "pairs.txt").write_text("images/0.png images/1.png")
    out.mkdir()
    match = ["match", "folder", tmp_path / "images", "--out", matched, "--jobs", "1"]
    with exclusive(out), exclusive(matched):
        refused(["evaluate", store, "--methods", "Hartley", "--out", out], "run is in use by process ")
        refused(["robust", store, "--estimators", "RANSAC", "--out", out], "run is in use by process ")
        refused(["estimate", "--pairs", tmp_path / "pairs.txt", "--out", out], "run is in use by process ")
        options = ["--trainer.max_steps=1", f"--trainer.default_root_dir={out}"]
        refused(["fit", "--config", "crossview-synthetic", *options], "run is in use by process ")
        assert main([*map(str, match)]) == 2
        assert [path.name for path in out.iterdir()] == [".lock"]
    assert not (tmp_path / "matched.h5.parts").exists()
    assert main([*map(str, match)]) == 0
