"""The page of ``learnnorm demo`` in a headless Chromium that reaches this computer alone; run, it saves a picture."""

import os
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
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


@contextmanager
def served() -> Iterator[tuple[str, subprocess.Popen]]:
    """Run ``learnnorm demo`` and give the address of its page and the process; end it by Ctrl-C if it runs still."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]  # nobody listens there
    command = [sys.executable, "-c", PROGRAM, "demo", "--no-browser", "--port", str(port)]
    options = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, env={**os.environ, "OMP_NUM_THREADS": "1"}, **options) as process:
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
    """Give the loaded page with the result of the example, and the requests to other computers, all refused."""
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
        wait_for_status(page, "matches are inliers")
        yield page, foreign
        browser.close()


def wait_for_status(page: Any, text: str) -> None:
    """Wait until the line above the picture has a text."""
    page.wait_for_function("text => document.querySelector('#status textarea')?.value.includes(text)", arg=text)


def click_picture(page: Any, x: float, y: float) -> bytes:
    """Click at shares of the picture's width and height, and return the file of the picture that follows."""
    from playwright.sync_api import TimeoutError

    image = page.locator("#picture img")
    before, box = image.get_attribute("src"), image.bounding_box()
    changed = "before => document.querySelector('#picture img').getAttribute('src') != before"
    for _ in range(6):  # a page that still draws loses a click
        image.click(position={"x": x * box["width"], "y": y * box["height"]})
        with suppress(TimeoutError):
            page.wait_for_function(changed, arg=before, timeout=TIMEOUT / 6)
            break
    return page.request.get(image.get_attribute("src")).body()


def main(path: Path) -> None:
    """Take a screenshot of the example with a click on a corner of a picture."""
    with served() as (address, _), opened(address, 1100, 900) as (page, _):
        click_picture(page, 0.2, 0.33)
        page.wait_for_timeout(1000)  # until the line is drawn
        page.screenshot(path=path, type="jpeg", quality=70, full_page=True)
    print(f"wrote {path} ({path.stat().st_size / 1000:.0f} kB)")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
