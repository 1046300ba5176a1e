"""Datasets by their names: ground truth, pairs of frames, and what is said about wrong arguments and files."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from make_sequences import FOCAL, FR1, FR3, FRAMES, KITTI_K, SIZE, STEP, TUM_START, edit, moved, names
from scenes import raises

from kornia_learnnorm.data.datasets.frames import Frame
from kornia_learnnorm.data.datasets.pairing import choose_pairs, listed_pairs, pair_frames
from kornia_learnnorm.data.datasets.reading import read_dataset, read_folder

IN_A_FOLDER = ("a.png", "b.PNG", "left/1.jpg", "left/2.JPG", "left/deep/1.bmp", "right/1.tif", "right/2.webp")
LISTED = {  # sequences and names of all frames
    "kitti": [(s, f"sequences/{s}/image_0/{n:06}.png") for s in ("00", "06", "11") for n in range(FRAMES)],
    "tum": [(s, f"{s}/rgb/{TUM_START + n:.6f}.png") for s in (FR1, FR3) for n in range(FRAMES)],
    "cambridge": [(s, f"{s}/frame{n + 1:05}.png") for s in ("seq1", "seq2") for n in range(FRAMES)],
    "colmap": [(s, f"{s}/{n}.png") for s, n in (("one", 0), ("one", 1), ("two", 2), ("two", 3))],
    "folder": [(name.rpartition("/")[0], name) for name in IN_A_FOLDER],
}
CENTRED = [[FOCAL, 0, 79.5], [0, FOCAL, 59.5], [0, 0, 1]]
CAMERAS = {"kitti": KITTI_K, "cambridge": CENTRED, "colmap": CENTRED, "folder": np.full((3, 3), np.nan)}


@pytest.mark.parametrize("dataset", LISTED)
def test_frames(written, dataset):
    root, options = written / dataset, {}
    if dataset == "colmap":
        pytest.importorskip("pycolmap", reason="pycolmap is not installed")
        root, options = root / "images", {"model": root / "model"}
    frames = read_dataset(dataset, root, **options)
    assert [(frame.sequence, frame.name) for frame in frames] == LISTED[dataset]
    for number, frame in enumerate(frames):
        assert frame.path == root / frame.name
        assert frame.size == ((640, 480) if dataset == "tum" else SIZE)
        if dataset != "tum":
            assert frame.distortion == ()
            np.testing.assert_allclose(frame.K, CAMERAS[dataset])
        if dataset in ("cambridge", "colmap"):
            np.testing.assert_allclose(frame.pose, moved(STEP * (number % FRAMES)), atol=1e-7)
        elif dataset == "folder":
            assert np.isnan(frame.pose).all()


def test_splits_and_ground_truth(written):
    """The wall moves sideways only: with the true F, y stays and any shift in x is allowed."""
    x1 = np.array([[20.0, 30, 1], [90, 80, 1], [140, 10, 1]])
    x2 = x1 - np.array([STEP, 0, 0])
    for dataset, options, sequence in [
        ("kitti", {"sequences": ["06"], "camera": "image_3"}, "06"),
        ("kitti", {"split": "train"}, "00"),
        ("tum", {"split": "train"}, FR1),
        ("tum", {"split": "val"}, FR3),
        ("cambridge", {"split": "test"}, "seq2"),
    ]:
        frames = read_dataset(dataset, written / dataset, **options)
        assert [frame.sequence for frame in frames] == [sequence] * 4
        if dataset != "tum":  # its wall is turned
            assert np.abs([(x2 @ pair.F * x1).sum(1) for pair in pair_frames(frames)]).max() < 1e-9


WHOLE = 0  # in place of the number of a line

# File, line, its text, and the message. A line None is taken out, a file None is removed.
MALFORMED = [
    ("poses/00.txt", 2, "1 2 3", r"00\.txt, line 2: the 12 numbers of a pose expected, got '1 2 3'"),
    ("poses/00.txt", 4, None, r"00\.txt has no line 4, the pose of .*000003\.png"),
    ("sequences/00/calib.txt", 1, "P0: 1 2 3", r"calib\.txt, line 1: P0: and 12 numbers expected, got 'P0: 1 2 3'"),
    ("sequences/00/calib.txt", 1, "P0: " + "0 " * 12, "line 1: a camera matrix and a fourth column expected"),
    ("sequences/00/calib.txt", 1, None, r"calib\.txt has no line 'P0: 12 numbers'"),
    ("sequences/00/calib.txt", WHOLE, b"\xff\xfe\x00", r"calib\.txt is not a text file in UTF-8"),
    ("sequences/00/image_0/left3.png", WHOLE, b"", r"left3\.png: an image's name must be its frame's number"),
    (f"{FR1}/rgb.txt", 3, "12.5", r"rgb\.txt, line 3: a timestamp and a file name expected, got '12\.5'"),
    (f"{FR1}/rgb.txt", WHOLE, b"# nothing\n", r"rgb\.txt lists no images"),
    (f"{FR1}/groundtruth.txt", 2, "1 2 3", r"groundtruth\.txt, line 2: timestamp tx ty tz qx qy qz qw expected"),
    (f"{FR1}/groundtruth.txt", 3, "1 2 3 4 0 0 0 0", "line 3: a quaternion other than zero expected"),
    ("dataset_train.txt", 5, "seq1/frame00002.png 1 2 3", r"train\.txt, line 5: ImageFile X Y Z W P Q R"),
    ("dataset_train.txt", 5, "seq1/frame00001.png 0 0 0 1 0 0 0", "5: seq1/frame00001.png is listed twice"),
    ("dataset_train.txt", WHOLE, b"a\nb\n\n", r"dataset_train\.txt lists no images"),
    ("reconstruction.nvm", 1, "NVM_V3 FixedK 1 2 3 4 5", r"reconstruction\.nvm, line 1: NVM_V3 expected"),
    ("reconstruction.nvm", 3, "many", "line 3: the number of images expected, got 'many'"),
    ("reconstruction.nvm", 5, "a.jpg 0 1 0 0 0 0 0 0 0 0", "line 5: a positive focal length expected, got 0"),
    ("reconstruction.nvm", WHOLE, b"NVM_V3\n\n3\n", r"reconstruction\.nvm announces 3 images and has 0"),
]
MISSING = [
    ("sequences/00/calib.txt", WHOLE, None, r"no calibration at .*calib\.txt"),
    ("sequences/00/image_0", WHOLE, None, r"no images \*\.png in .*image_0"),
    ("sequences", WHOLE, None, r"no folder .*sequences"),
    (f"{FR1}/rgb.txt", 3, "12.5 rgb/none.png", r"rgb\.txt, line 3: no image at .*none\.png"),
    ("dataset_train.txt", WHOLE, None, r"no list of images at .*dataset_train\.txt"),
]


@pytest.mark.parametrize(
    ("file", "line", "text", "message", "error"),
    [(*case, ValueError) for case in MALFORMED] + [(*case, FileNotFoundError) for case in MISSING],
)
def test_malformed(written, tmp_path, file, line, text, message, error):
    dataset = "tum" if file.startswith(FR1) else "kitti" if file.startswith(("poses", "sequences")) else "cambridge"
    root = shutil.copytree(written / dataset, tmp_path / dataset)
    if line != WHOLE:
        edit(root / file, line, text)
    elif text is not None:
        (root / file).write_bytes(text)
    elif (root / file).is_dir():
        shutil.rmtree(root / file)
    else:
        (root / file).unlink()
    raises(error, message, read_dataset, dataset, root)


def test_wrong_arguments(written):
    for dataset, root, arguments, error, message in [
        ("kitti", "kitti", {"sequences": ["07"]}, ValueError, r"no sequence '07' at .*, there are 00, 06, 11"),
        ("kitti", "kitti", {"sequences": "00"}, TypeError, "a list of names, got the string '00'"),
        ("kitti", "kitti", {"camera": "image_4"}, ValueError, "image_0 to image_3, got 'image_4'"),
        ("tum", "tum", {"max_difference": -0.1}, ValueError, r"zero or more seconds, got -0\.1"),
        ("tum", "kitti", {}, FileNotFoundError, r"no rgb\.txt in .*kitti, nor in a folder in it"),
        ("cambridge", "cambridge", {"split": "val"}, ValueError, "'train', 'test' or None for both, got 'val'"),
        ("folder", "none", {}, FileNotFoundError, r"no folder at .*none"),
        ("kiti", "", {}, ValueError, "must be one of kitti, tum, cambridge, folder, colmap, got 'kiti'"),
        ("kitti", "kitti", {"colour": True}, ValueError, "colour is for no dataset, got kitti"),
        ("kitti", "kitti", {"split": "val"}, ValueError, "a split of kitti must be one of train, test, got 'val'"),
        ("tum", f"tum/{FR3}", {"split": "train"}, FileNotFoundError, f"expected others than {FR3}, got {FR3}"),
        ("tum", f"tum/{FR1}", {"split": "val"}, FileNotFoundError, f"no val sequence of tum .*: expected {FR3}, got"),
    ]:
        raises(error, message, read_dataset, dataset, written / root, **arguments)


def test_a_folder_within_does_not_part_its_sequence_and_hidden_files_are_none(tmp_path):
    for name in ("s/1.png", "s/2/1.png", "s/10.png", "s/3.png", "s-1/1.png", "s/.thumbs/1.png", "s/._1.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True, parents=True)
        (tmp_path / name).touch()
    assert names(pair_frames(read_folder(str(tmp_path)))) == [("s/1.png", "s/3.png"), ("s/3.png", "s/10.png")]
    assert [(frame.name, frame.size) for frame in read_folder(tmp_path / "s-1")] == [("1.png", (0, 0))]
    assert len(read_folder(tmp_path)) == 5


def numbered(*sequences: str) -> list[Frame]:
    return [Frame(Path(), f"{sequence}/{n}.png", sequence, (640, 480)) for sequence in sequences for n in range(4)]


class TestPairFrames:
    @given(gap=st.integers(1, 6))
    def test_gap_within_a_sequence(self, gap):
        expected = [(f"{s}/{n}.png", f"{s}/{n + gap}.png") for s in "xy" for n in range(4 - gap)]
        assert names(pair_frames(numbered("x", "y"), gap)) == expected

    def test_all_pairs_and_a_wrong_gap(self):
        raises(ValueError, "at least 1, got 0", list, pair_frames(numbered("x"), 0))
        pairs, text = choose_pairs(numbered("x", "y"), gap=None)
        assert text == "all pairs"
        assert len({frozenset(both) for both in names(pairs)}) == len(pairs) == 8 * 7 / 2


class TestListedPairs:
    def test_order_of_the_lines(self, tmp_path):
        (tmp_path / "pairs.txt").write_text("# hloc\nx/3.png  x/0.png\n\nx/1.png\ty/2.png\n")
        pairs = listed_pairs(numbered("x", "y"), str(tmp_path / "pairs.txt"))
        assert names(pairs) == [("x/3.png", "x/0.png"), ("x/1.png", "y/2.png")]

    def test_malformed(self, tmp_path):
        for text, message in [
            ("x/0.png x/1.png\nx/0.png\n", r"pairs\.txt, line 2: two names of two images expected, got 'x/0\.png'"),
            ("x/0.png x/0.png", r"line 1: two names of two images expected"),
            ("x/0.png x/1.png\nx/1.png x/0.png\n\nx/0.png  x/1.png", r"line 4: .* is in line 1 already"),
            ("\nx/0.png 7.png", r"line 2: no frame '7\.png' among 4, such as 'x/0\.png'"),
            ('"x 7.png" x/0.png', r"line 1: no frame 'x 7\.png' among 4"),
            ("x's 7.png x/0.png", "line 1: No closing quotation"),
        ]:
            (tmp_path / "pairs.txt").write_text(text)
            raises(ValueError, message, list, listed_pairs(numbered("x"), tmp_path / "pairs.txt"))
