"""The page of ``learnnorm demo`` in a headless Chromium that reaches this computer alone; run, it takes a screenshot.

python tests/demo_browser.py docs/images/demo.jpg
"""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
TIMEOUT = 60_000  # milliseconds
# Started from a shell in the background, the program would ignore Ctrl-C.
PROGRAM = "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler)"
PROGRAM += "; from kornia_learnnorm.cli.main import main; sys.exit(main())"


def find_browser() -> str | None:
    """Return the path of an installed Chromium or Chrome, if there is one."""
    return next(filter(None, map(shutil.which, BROWSERS)), None)


def free_port() -> int:
    """Return a port of this computer that nobody listens on."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        return server.getsockname()[1]


@contextmanager
def served() -> Iterator[tuple[str, subprocess.Popen]]:
    """Run ``learnnorm demo`` and give the address of its page and the process; end it by Ctrl-C if it runs still."""
    command = [sys.executable, "-c", PROGRAM, "demo", "--no-browser", "--port", str(port := free_port())]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
    ) as process:
        try:
            line = process.stdout.readline()
            if f"127.0.0.1:{port}" not in line:
                raise RuntimeError(f"learnnorm demo did not start: {line}{process.stderr.read()}")
            yield f"http://127.0.0.1:{port}/", process
        finally:
            if process.poll() is None:
                process.send_signal(signal.SIGINT)


@contextmanager
def opened(address: str, width: int, height: int) -> Iterator[tuple[Any, list[str]]]:
    """Give the loaded page with the result of the first example, and the requests to other computers, all refused."""
    from playwright.sync_api import sync_playwright

    foreign: list[str] = []

    def judge(route: Any) -> None:
        if route.request.url.startswith(address):
            route.continue_()
        else:
            foreign.append(route.request.url)
            route.abort()

    arguments = ["--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1"]
    arguments += ["--no-sandbox"] if os.geteuid() == 0 else []  # Chromium refuses to run as root with it
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=find_browser(), args=arguments)
        page = browser.new_page(viewport={"width": width, "height": height})
        page.set_default_timeout(TIMEOUT)
        page.route("**/*", judge)
        page.goto(address)
        wait_for_status(page, "Point at a spot")
        yield page, foreign
        browser.close()


def wait_for_status(page: Any, text: str) -> None:
    """Wait until the line above the images has a text."""
    page.locator(".status", has_text=text).wait_for()


def point_at(page: Any, image: str, x: float, y: float, size: tuple[int, int] = (640, 480)) -> None:
    """Move the mouse to a pixel of an image, ``Image 1`` or ``Image 2``."""
    box = page.locator(".bk-Figure").nth(int(image[-1]) - 1).bounding_box()
    left, top = ((value + 0.5) / side for value, side in zip((x, y), size, strict=True))
    page.mouse.move(box["x"] + left * box["width"], box["y"] + top * box["height"])


def line(page: Any, name: str) -> list[list[float]]:
    """Wait for the epipolar line of a method, as ``Image 2, RANSAC``, and return its ends, [[x, x], [y, y]]."""
    data = "Bokeh.documents[0].get_model_by_name(name).data"
    page.wait_for_function(f"name => {data}.x.length == 2", arg=name)
    return page.evaluate(f"name => [Array.from({data}.x), Array.from({data}.y)]", name)


def main(path: Path) -> None:
    """Take a screenshot of the first example with the mouse on a corner of a picture."""
    with served() as (address, _), opened(address, 1100, 900) as (page, _):
        point_at(page, "Image 1", 261, 156)
        line(page, "Image 2, RANSAC")
        page.wait_for_timeout(1000)  # until the line is drawn
        page.screenshot(path=path, type="jpeg", quality=70, full_page=True)
    print(f"wrote {path} ({path.stat().st_size / 1000:.0f} kB)")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
