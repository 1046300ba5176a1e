import math

import numpy as np
import pytest
from scenes import raises

from kornia_learnnorm.data.cameras import exif_camera, read_camera

Image = pytest.importorskip("PIL.Image", reason="Pillow is not installed")

KITTI = "P{} 0 607.1928 0 0 718.856 185.2157 0 0 0 1 0\n"  # sequence 00; P0 counts
STRECHA = "2700 0 1500\n0 2710 1000\n0 0 1\n{} 0 0\n1 0 0\n0 1 0\n0 0 1\n-14 -5 0.1\n3072 2048"
COLMAP = {  # the centre of the top left pixel is (0.5, 0.5)
    "1 PINHOLE 640 480 700 710 320 240": [700, 710, 319.5, 239.5],
    "3 SIMPLE_PINHOLE 640 480 700 320 240": [700, 700, 319.5, 239.5],
    "1 SIMPLE_RADIAL 640 480 700 320 240 0": [700, 700, 319.5, 239.5],
    "1 OPENCV 640 480 700 710 320 240 0 0 0 0": [700, 710, 319.5, 239.5],
    "1 SIMPLE_RADIAL 640 480 700 320 240 0.1": "a camera without distortion, as of colmap image_undistorter",
    "1 PINHOLE 640 480 700 710 320": "a camera without distortion",
    "1 PINHOLE 640 480 700 710 320 a": "line 3: numbers of a PINHOLE camera expected",
    "PINHOLE 640 480": "line 3: an identifier and a camera model",
    "1 PINHOLE 640 480 700 710 320 240\n2 PINHOLE 640 480 1 1 1 1": "one camera expected, got 2",
    "1 FOV 640 480 700 710 320 240 1": "could not convert string to float: ",
}
HEADER = "# Camera list with one line of data per camera:\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"


def test_files(tmp_path):
    for name, text, expected in [
        ("four.txt", "700 710\n320 240\n", [700, 710, 320, 240]),
        ("nine.txt", "700 0 320\n0 710 240\n0 0 1\n", [700, 710, 320, 240]),
        ("calib.txt", KITTI.format("0: 718.856") + KITTI.format("1: 700"), [718.856, 718.856, 607.1928, 185.2157]),
        ("calib.txt", "\x80\xff", r"expected .*codec can't decode"),
        ("calib.txt", "P0: 1 2 3\n", r"calib\.txt, line 1.*12 numbers"),
        ("calib.txt", KITTI.format("2: 718.856"), r"calib\.txt: expected .* KITTI's calib\.txt"),
        ("0000.jpg.camera", STRECHA.format(0), [2700, 2710, 1500, 1000]),
        ("0000.jpg.camera", STRECHA.format(0.1), r"no distortion expected, got \[0\.1, "),
        *(("cameras.txt", f"{HEADER}{line}\n", expected) for line, expected in COLMAP.items()),
    ]:
        (tmp_path / name).write_bytes(text.encode("latin-1"))
        if isinstance(expected, str):
            raises(ValueError, expected, read_camera, str(tmp_path / name))
        else:
            fx, fy, cx, cy = expected
            assert read_camera(str(tmp_path / name)).tolist() == [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]


@pytest.mark.parametrize("text", ["700,710,320,240", " 700, 710, 320, 240"])
def test_numbers(text):
    assert read_camera(text).tolist() == [[700, 0, 320], [0, 710, 240], [0, 0, 1]]


def test_what_is_refused():
    for text, error, message in [
        ("none.txt", FileNotFoundError, "camera none.txt: no such file; expected fx,fy,cx,cy"),
        ("1,2,3", ValueError, "got 3 numbers"),
        ("a,b,c,d", ValueError, "could not convert"),
        ("-1,700,320,240", ValueError, "positive focal lengths"),
        ("nan,700,320,240", ValueError, "positive focal lengths"),
        ("1 0 0 0 1 0 0,0,2", ValueError, "a last row of 0 0 1"),
        ("1 0 0 7 1 0 0,0,1", ValueError, r"K\[1, 0\] = 0"),
        (".", ValueError, "Is a directory"),
        ("exif", ValueError, "an image file expected"),
    ]:
        raises(error, message, read_camera, text)


def test_exif(tmp_path):
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = 28
    Image.new("L", (600, 400)).save(tmp_path / "a.jpg", exif=exif)
    K = exif_camera(tmp_path / "a.jpg")
    focal = 28 * math.hypot(600, 400) / math.hypot(36, 24)
    assert np.allclose(K, [[focal, 0, 299.5], [0, focal, 199.5], [0, 0, 1]])
    assert np.array_equal(read_camera("exif", tmp_path / "a.jpg"), K)
    Image.new("L", (60, 40)).save(tmp_path / "b.png")
    raises(ValueError, r"b\.png has no focal length", exif_camera, tmp_path / "b.png")
    (tmp_path / "c.png").write_text("no image")
    raises(ValueError, r"c\.png is not an image", exif_camera, tmp_path / "c.png")
