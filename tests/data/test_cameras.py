import math

import numpy as np
import pytest

from kornia_learnnorm.data.cameras import exif_camera, read_camera

Image = pytest.importorskip("PIL.Image", reason="Pillow is not installed")


def test_numbers_and_files(tmp_path):
    expected = [[700, 0, 320], [0, 710, 240], [0, 0, 1]]
    (tmp_path / "four.txt").write_text("700 710\n320 240\n")
    (tmp_path / "nine.txt").write_text("700 0 320\n0 710 240\n0 0 1\n")
    for text in ("700,710,320,240", " 700, 710, 320, 240", str(tmp_path / "four.txt"), str(tmp_path / "nine.txt")):
        assert read_camera(text).tolist() == expected


def test_calibration_of_kitti(tmp_path):
    """P0 counts, with the numbers of sequence 00."""
    path = tmp_path / "calib.txt"
    rows = "{0} 0 607.1928 {1} 0 {0} 185.2157 0 0 0 1 0"
    path.write_text(f"P0: {rows.format(718.856, 0)}\nP1: {rows.format(700, -386.1448)}\n")
    assert read_camera(str(path)).tolist() == [[718.856, 0, 607.1928], [0, 718.856, 185.2157], [0, 0, 1]]
    path.write_bytes(bytes(range(256)))
    with pytest.raises(ValueError, match=r"expected .*codec can't decode"):
        read_camera(str(path))
    path.write_text("P0: 1 2 3\n")
    with pytest.raises(ValueError, match=r"calib\.txt, line 1.*12 numbers"):
        read_camera(str(path))
    path.write_text(f"P2: {rows.format(718.856, 0)}\n")
    with pytest.raises(ValueError, match=r"calib\.txt: expected .* KITTI's calib\.txt"):
        read_camera(str(path))


@pytest.mark.parametrize(
    ("text", "error", "message"),
    [
        ("none.txt", FileNotFoundError, "camera none.txt: no such file; expected fx,fy,cx,cy"),
        ("1,2,3", ValueError, "got 3 numbers"),
        ("a,b,c,d", ValueError, "could not convert"),
        ("-1,700,320,240", ValueError, "positive focal lengths"),
        ("nan,700,320,240", ValueError, "positive focal lengths"),
        ("1 0 0 0 1 0 0,0,2", ValueError, "a last row of 0 0 1"),
        ("exif", ValueError, "an image file expected"),
    ],
)
def test_what_is_refused(text, error, message):
    with pytest.raises(error, match=message):
        read_camera(text)


def test_exif(tmp_path):
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = 28
    Image.new("L", (600, 400)).save(tmp_path / "a.jpg", exif=exif)
    K = exif_camera(tmp_path / "a.jpg")
    focal = 28 * math.hypot(600, 400) / math.hypot(36, 24)
    assert np.allclose(K, [[focal, 0, 299.5], [0, focal, 199.5], [0, 0, 1]])
    assert np.array_equal(read_camera("exif", tmp_path / "a.jpg"), K)
    Image.new("L", (60, 40)).save(tmp_path / "b.png")
    with pytest.raises(ValueError, match=r"b\.png has no focal length"):
        exif_camera(tmp_path / "b.png")
    (tmp_path / "c.png").write_text("no image")
    with pytest.raises(ValueError, match=r"c\.png is not an image"):
        exif_camera(tmp_path / "c.png")
