"""The web server of ``learnnorm demo``: on this computer alone, without any request to another one."""

from __future__ import annotations

import json
import secrets
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

from bokeh.document import Document
from bokeh.server.server import Server
from tornado.web import HTTPError, RequestHandler

from kornia_learnnorm.demo.compute import MAX_BYTES
from kornia_learnnorm.demo.page import Page

__all__ = ["make_server"]

Results = dict[str, dict[str, str]]  # of a page and a method, as JSON

ADDRESS = "127.0.0.1"
MAX_MESSAGE = 4 * MAX_BYTES  # of a browser's message in base64, which ends the connection; smaller ones are told


class _Download(RequestHandler):
    """Serves the last results of a page as files."""

    def initialize(self, results: Results) -> None:
        self._results = results

    def get(self, token: str, name: str) -> None:
        if name not in self._results.get(token, {}):
            raise HTTPError(404)
        self.set_header("Content-Type", "application/json")
        self.set_header("Content-Disposition", f'attachment; filename="F_{name}.json"')
        self.set_header("Cache-Control", "no-store")
        self.write(self._results[token][name])


def make_server(port: int) -> Server:
    """Return a server of the page, which listens but does not answer yet.

    Args:
        port: port on 127.0.0.1, from 1 to 65535.

    Raises:
        OSError: if the port is taken.

    """
    results: Results = {}
    executor = ThreadPoolExecutor(max_workers=1)  # browser tabs wait for each other

    def open_page(document: Document) -> None:
        token = secrets.token_urlsafe()
        page = Page(document, executor, partial(_publish, results, token))
        document.on_session_destroyed(lambda _context: page.close())

    origins = [f"{host}:{port}" for host in (ADDRESS, "localhost")]
    return Server(
        {"/": open_page},
        address=ADDRESS,
        port=port,
        allow_websocket_origin=origins,  # no page of another site may connect
        websocket_max_message_size=MAX_MESSAGE,
        extra_patterns=[("/download/([^/]*)/([^/]*)", _Download, {"results": results})],
    )


def _publish(results: Results, token: str, contents: Mapping[str, Any]) -> str:
    """Keep objects for download in the place of those before, and return the address that their names follow."""
    results.pop(token, None)
    if contents:
        results[token] = {name: json.dumps(content, allow_nan=False) + "\n" for name, content in contents.items()}
    return f"/download/{token}/"
