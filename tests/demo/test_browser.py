"""The page of ``learnnorm demo`` as its users meet it: served, in a browser, ended by Ctrl-C."""

from __future__ import annotations

import json
import signal
from contextlib import closing
from http.client import HTTPConnection
from urllib.parse import urlsplit
from urllib.request import urlopen

import numpy as np
import pytest
from demo_browser import find_browser, line, opened, point_at, served, wait_for_status

from kornia_learnnorm.demo.compute import render_example

pytest.importorskip("bokeh", reason="Bokeh is not installed")
pytest.importorskip("cv2", reason="OpenCV is not installed")


def test_only_this_computer_gets_the_page_and_ctrl_c_ends_it():
    with served() as (address, process):
        assert address.startswith("http://127.0.0.1:")
        with urlopen(address, timeout=60) as page:  # for phones
            assert b'<meta name="viewport" content="width=device-width, initial-scale=1">' in page.read()
        websocket = {"Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Version": "13"}
        websocket |= {"Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA==", "Origin": "http://example.org"}
        with closing(HTTPConnection(urlsplit(address).netloc, timeout=60)) as connection:
            connection.request("GET", "/ws", headers=websocket)
            assert connection.getresponse().status == 403
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 0
        assert "Traceback" not in process.stderr.read()


def test_a_visit(tmp_path):
    pytest.importorskip("playwright", reason="Playwright is not installed")
    if find_browser() is None:
        pytest.skip("no Chromium is installed")
    example = render_example()
    truth1, truth2 = example.points1.numpy(), example.points2.numpy()
    row = int(np.linalg.norm(truth1 - (320, 240), axis=1).argmin())
    files = [tmp_path / "left.png", tmp_path / "right.png"]
    for path, image in zip(files, example.images, strict=True):
        path.write_bytes(image.content)
    (tmp_path / "<b>.png").write_bytes(b"no pixels")

    with served() as (address, _), opened(address, 1000, 700) as (page, foreign):
        # the epipolar line of a pixel passes through its exact correspondence, from both images
        for image, points, other, expected in (
            ("Image 1", truth1, "Image 2", truth2),
            ("Image 2", truth2, "Image 1", truth1),
        ):
            point_at(page, image, *points[row])
            for method in ("Learned", "RANSAC"):
                (x1, x2), (y1, y2) = line(page, f"{other}, {method}")
                normal = np.array([y1 - y2, x2 - x1]) / np.hypot(y1 - y2, x2 - x1)
                assert abs(normal @ (expected[row] - (x1, y1))) < 2  # the mouse moves by whole pixels of the screen

        # the inliers of a method, and its matrix as a file
        page.locator(".bk-btn", has_text="Hartley").click()
        with page.expect_download() as download:
            page.locator("a[download='F_Hartley.json']").click()
        content = json.loads(download.value.path().read_text(encoding="utf-8"))
        assert (content["estimator"], content["predicted_error_px"]) == ("EightPoint", None)
        assert np.shape(content["F"]) == (3, 3)

        # images of the user: one, a file that is none, two, twice the same
        inputs = page.locator("input[type=file]")
        inputs.nth(0).set_input_files(files[0])
        wait_for_status(page, "Choose image 2 too.")
        inputs.nth(1).set_input_files(tmp_path / "<b>.png")
        wait_for_status(page, "No result: <b>.png cannot be decoded: 9 bytes, not an image")
        inputs.nth(1).set_input_files(files[1])
        wait_for_status(page, "matches. Point at a spot")
        inputs.nth(0).set_input_files({"name": "none.png", "mimeType": "image/png", "buffer": b""})
        wait_for_status(page, "No result: none.png")
        inputs.nth(0).set_input_files(files[1])
        wait_for_status(page, "No result: no motion between the images")
        assert foreign == []
