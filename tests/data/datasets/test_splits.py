"""The splits of Fan et al."""

from __future__ import annotations

import pytest

from kornia_learnnorm.data.datasets.splits import SPLITS, split_sequences

FR1 = "rgbd_dataset_freiburg1_wall"
FR3 = "rgbd_dataset_freiburg3_long_office_household"


def test_kitti(written):
    assert split_sequences("kitti", "train", written / "kitti") == ["00"]
    assert split_sequences("kitti", "test", str(written / "kitti")) == ["06"]


def test_tum(written):
    assert split_sequences("tum", "train", written / "tum") == [FR1]
    assert split_sequences("tum", "val", written / "tum") == [FR3]
    assert split_sequences("tum", "val", written / "tum" / FR3) == [FR3]


def test_no_sequence_is_in_two_splits():
    for dataset in ("kitti", "tum"):
        names = [name for split in SPLITS[dataset].values() for name in split or ()]
        assert len(names) == len(set(names))


def test_wrong_arguments(written, kitti):
    with pytest.raises(ValueError, match="a split of kitti must be one of train, test, got 'val'"):
        split_sequences("kitti", "val", written)
    (kitti / "sequences/06").rename(kitti / "sequences/20")
    with pytest.raises(FileNotFoundError, match=r"no test sequence of kitti at .*: expected 06, .*, got 00, 11, 20"):
        split_sequences("kitti", "test", kitti)
    with pytest.raises(
        FileNotFoundError, match=f"no train sequence of tum at .*: expected others than {FR3}, got {FR3}"
    ):
        split_sequences("tum", "train", written / "tum" / FR3)
