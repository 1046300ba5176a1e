"""The page of ``learnnorm demo``: what it computes and draws, and as its users meet it, in a browser."""

import io
import json
import re
import signal
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import numpy as np
import pytest
import torch
from demo_browser import click_picture, find_browser, opened, served, wait_for_status
from PIL import Image, ImageColor
from scenes import raises

from kornia_learnnorm import estimate_pair
from kornia_learnnorm.data.synthetic.render import render_pair, write_pair

demo = pytest.importorskip("kornia_learnnorm.browser_demo", reason="Gradio is not installed")
pytestmark = pytest.mark.long
K = "576,576,319.5,239.5"  # of the example


@pytest.fixture(scope="module")
def truth():
    return render_pair()


@pytest.fixture(scope="module")
def result():
    return demo.solve(*demo.example_files(), cameras=K)


@pytest.fixture(scope="module")
def turned(tmp_path_factory):
    """Two files of a camera that only turned, which a homography relates, of unequal shapes."""
    folder, wide = tmp_path_factory.mktemp("turned"), Image.fromarray(render_pair().image1)
    wide.save(folder / "1.png")
    wide.crop((100, 0, 460, 480)).resize((480, 640)).save(folder / "2.png")
    return folder / "1.png", folder / "2.png"


def distance(picture, colour, point):
    """Return the distance in pixels of a point of a picture to the nearest one of a colour."""
    rows, columns = np.nonzero(abs(picture.astype(int) - ImageColor.getrgb(colour)).max(-1) < 60)
    return np.hypot(columns - point[0], rows - point[1]).min()


class TestSolve:
    def test_it_is_what_the_command_estimates(self, result, truth):
        found, camera = result.estimate, torch.from_numpy(truth.K)
        torch.testing.assert_close(found.F_mat, estimate_pair(*demo.example_files(), K1=camera, K2=camera).F_mat)
        torch.testing.assert_close(found.R, torch.from_numpy(truth.R), atol=2e-3, rtol=0)
        content = json.loads(json.dumps(found.as_dict(), allow_nan=False))
        assert content["image1"] == {"file": "image1.png", "width": 640, "height": 480}

    def test_cameras_from_files(self, result, tmp_path):
        (tmp_path / "camera.txt").write_text(K.replace(",", " "))
        found = demo.solve(*demo.example_files(), camera_files=[tmp_path / "camera.txt"]).estimate
        torch.testing.assert_close(found.R, result.estimate.R)

    def test_options(self):
        for options, message in [
            ({"image2": None}, "two images expected, image 2 is missing"),
            ({"matcher": "lightglue"}, "needs detector .*, got sift"),
            ({"estimator": "nope"}, "estimator must be 'RANSAC' or 'learned', got 'nope'"),
            ({"ratio": None}, "ratio must be a number, got None"),
            ({"estimator": "learned", "model": "homography"}, "leave it out with model homography"),
            ({"cameras": "576,576"}, "camera 576,576: expected fx,fy,cx,cy in pixels, or exif"),
            ({"cameras": ";".join([K] * 3)}, "one or two expected, typed or as files, got 3 and 0"),
            ({"cameras": __file__}, "_demo.py: expected fx,fy,cx,cy in pixels, or exif"),  # not read
            ({"cameras": "exif"}, "camera exif: image1.png has no focal length"),
        ]:
            given = dict(zip(("image1", "image2"), demo.example_files(), strict=True)) | options
            raises(ValueError, message, demo.solve, **given)

    def test_files_are_named_without_their_folder(self, monkeypatch, tmp_path):
        (tmp_path / "none.png").touch()
        messages = {10**6: "image none.png cannot be decoded: 0 bytes", 9: "image1.png has 0 MB, at most"}
        for limit, message in messages.items():
            monkeypatch.setattr(demo, "MAX_BYTES", limit)
            with pytest.raises(ValueError, match=message) as caught:
                demo.solve(demo.example_files()[0], tmp_path / "none.png")
            assert "/" not in str(caught.value)


class TestDrawing:
    def test_the_line_of_a_point_passes_through_its_match(self, result, truth):
        row = np.linalg.norm(truth.points1 - (320, 240), axis=1).argmin()
        scale, step = 1200 / 640, (1.02 * 640, 0)
        points = [(truth.points1[row] + 0.5) * scale, (truth.points2[row] + 0.5 + step) * scale]
        for here, there in (points, points[::-1]):
            picture = demo.draw_result(result, here)
            assert picture.shape == (900, 2424, 3)
            assert distance(picture, demo.LINE, there) < 3
            assert distance(picture, demo.MARK, here) < 2
        assert (demo.draw_result(result, (1212, 300)) == demo.draw_result(result, (1212, 500))).all()  # between them

    def test_a_homography_moves_the_point(self, turned):
        status, picture, moved, text, _, result = demo.answer(*turned)
        assert status.startswith("homography: ")
        assert "x2 ~ H x1" in text
        assert moved["value"].shape == (640, 480, 3)
        assert picture.shape == (900, 1224 + 675, 3)
        # x2 = (x1 - 100) 4/3, and 3/4 of it in the picture, 1.02 widths to the right
        here, there = 1.875 * np.array([300.5, 200.5]), 1.875 * np.array([300.5 - 100 + 1.02 * 640, 200.5])
        assert distance(demo.draw_result(result, here), demo.MARK, there) < 3


def test_an_unknown_error_is_logged(monkeypatch, caplog):
    monkeypatch.setattr(demo, "estimate_pair", lambda *args, **options: 1 / 0)
    status, picture, *_, result = demo.answer(*demo.example_files())
    assert (status, picture, result) == ("No result: an error that the terminal describes", None, None)
    assert "ZeroDivisionError" in caplog.text


def test_only_this_computer_gets_the_page_and_ctrl_c_ends_it():
    with served() as (address, process):
        page = urlopen(address, timeout=60).read().decode()
        assert re.search('<meta\\s+name="viewport"\\s+content="width=device-width', page)  # for phones
        assert re.findall(r"<(?:script|link|img|iframe)[^>]+(?:src|href)=\"(?:https?:)?//[^\"]+", page) == []
        for header in ({"Origin": "http://example.org"}, {"Host": "example.org"}):
            raises(HTTPError, "403", urlopen, Request(address, headers=header), timeout=60)
        form = b"--x\r\nContent-Disposition: form-data; name=files; filename=a.png\r\n\r\n%b\r\n--x--\r\n"
        upload = Request(f"{address}gradio_api/upload", form % bytes(demo.MAX_BYTES + 1))
        upload.add_header("Content-Type", "multipart/form-data; boundary=x")
        raises(HTTPError, "413", urlopen, upload, timeout=60)
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 0
        assert "Traceback" not in process.stderr.read()


def test_a_visit(truth, turned, tmp_path):
    pytest.importorskip("playwright", reason="Playwright is not installed")
    if find_browser() is None:
        pytest.skip("no Chromium is installed")
    write_pair(tmp_path, truth)
    (tmp_path / "bad.png").write_bytes(b"no pixels")
    row = np.linalg.norm(truth.points1 - (320, 240), axis=1).argmin()
    places = truth.points1[row] + 0.5, truth.points2[row] + 0.5 + (1.02 * 640, 0)
    points = [place / (2.02 * 640, 480) for place in places]  # as shares of the picture

    with served() as (address, _), opened(address, 1000, 700) as (page, foreign):

        def estimate(status, *files):
            for view, file in enumerate(files, 1):
                page.locator(f"#image{view}").get_by_label("Clear").click()
                page.locator(f"#image{view} input[type=file]").set_input_files(file)
                page.locator(f"#image{view}").get_by_label("Clear").wait_for()
            page.get_by_role("button", name="Estimate", exact=True).click()
            wait_for_status(page, status)

        for here, there in (points, points[::-1]):
            picture = np.array(Image.open(io.BytesIO(click_picture(page, *here))).convert("RGB"))
            assert distance(picture, demo.LINE, there * (2424, 900)) < 6  # two pixels of the screen
        estimate("No result: image bad.png cannot be decoded: 9 bytes", tmp_path / "bad.png", tmp_path / "image2.png")
        page.get_by_text("Cameras: for R and t").click()
        page.locator("#cameras textarea").fill(K)
        estimate("fundamental: ", tmp_path / "image1.png")
        assert "R (X2 = R X1 + t)" in page.locator("#estimate textarea").input_value()
        estimate("homography: ", *turned)
        page.locator("#moved img").wait_for()
        for width in (400, 1400):  # nothing is cut off
            page.set_viewport_size({"width": width, "height": 900})
            assert page.evaluate("document.documentElement.scrollWidth") == width
        assert foreign == []
