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


HEADER = "# Camera list with one line of data per camera:\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("1 PINHOLE 640 480 700 710 320 240", [700, 710, 319.5, 239.5]),
        ("3 SIMPLE_PINHOLE 640 480 700 320 240", [700, 700, 319.5, 239.5]),
        ("1 SIMPLE_RADIAL 640 480 700 320 240 0", [700, 700, 319.5, 239.5]),
        ("1 OPENCV 640 480 700 710 320 240 0 0 0 0", [700, 710, 319.5, 239.5]),
        ("1 SIMPLE_RADIAL 640 480 700 320 240 0.1", "a camera without distortion, as of colmap image_undistorter"),
        ("1 PINHOLE 640 480 700 710 320", "a camera without distortion"),
        ("1 PINHOLE 640 480 700 710 320 a", "line 3: numbers of a PINHOLE camera expected"),
        ("PINHOLE 640 480", "line 3: an identifier and a camera model"),
        ("1 PINHOLE 640 480 700 710 320 240\n2 PINHOLE 640 480 1 1 1 1", "one camera expected, got 2"),
        ("1 FOV 640 480 700 710 320 240 1", "could not convert string to float: "),
    ],
)
def test_cameras_of_colmap(tmp_path, line, expected):
    """The centre of the top left pixel is (0.5, 0.5) in COLMAP."""
    path = tmp_path / "cameras.txt"
    path.write_text(f"{HEADER}{line}\n")
    if isinstance(expected, str):
        with pytest.raises(ValueError, match=expected):
            read_camera(str(path))
        return
    K = read_camera(str(path))
    assert [K[0, 0], K[1, 1], K[0, 2], K[1, 2]] == expected
    assert K[2].tolist() == [0, 0, 1]
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is not installed")
    _, model, width, height, *params = line.split()
    camera = pycolmap.Camera(model=model, width=int(width), height=int(height), params=[*map(float, params)])
    assert np.array_equal(K, camera.calibration_matrix() - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])


def test_camera_of_strecha(tmp_path):
    path = tmp_path / "0000.jpg.camera"
    rows = ["2700 0 1500", "0 2710 1000", "0 0 1", "{} 0 0", *["1 0 0", "0 1 0", "0 0 1"], "-14 -5 0.1", "3072 2048"]
    text = "\n".join(rows)
    path.write_text(text.format(0))
    assert read_camera(str(path)).tolist() == [[2700, 0, 1500], [0, 2710, 1000], [0, 0, 1]]
    path.write_text(text.format(0.1))
    with pytest.raises(ValueError, match=r"no distortion expected, got \[0\.1, "):
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
