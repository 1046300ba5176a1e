import numpy as np
from make_sequences import SIZE, names

from kornia_learnnorm.data.datasets.pairing import pair_frames
from kornia_learnnorm.data.datasets.reading import read_folder


def test_frames(written):
    frames = read_folder(written / "folder")
    listed = ("a.png", "b.PNG", "left/1.jpg", "left/2.JPG", "left/deep/1.bmp", "right/1.tif", "right/2.webp")
    assert [frame.name for frame in frames] == list(listed)
    assert [frame.sequence for frame in frames] == [name.rpartition("/")[0] for name in listed]
    for frame in frames:
        assert frame.size == SIZE
        assert np.isnan(frame.K).all()
        assert np.isnan(frame.pose).all()


def test_a_folder_within_does_not_part_its_sequence(tmp_path):
    for name in ("s/1.png", "s/2/1.png", "s/3.png", "s-1/1.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True, parents=True)
        (tmp_path / name).touch()
    pairs = pair_frames(read_folder(str(tmp_path)))
    assert names(pairs) == [("s/1.png", "s/3.png")]


def test_hidden(tmp_path):
    for name in (".thumbs/1.png", "._1.png", "1.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    frames = read_folder(tmp_path)
    assert [(frame.name, frame.size) for frame in frames] == [("1.png", (0, 0))]
