"""The web server of ``learnnorm demo``: on this computer alone, without any request to another one."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

from bokeh.document import Document
from bokeh.server.server import Server

from kornia_learnnorm.demo.compute import MAX_BYTES
from kornia_learnnorm.demo.page import Page

__all__ = ["make_server"]

ADDRESS = "127.0.0.1"
MAX_MESSAGE = 4 * MAX_BYTES  # of a browser's message in base64, which ends the connection; smaller ones are told


def make_server(port: int) -> Server:
    """Return a server of the page, which listens but does not answer yet.

    Args:
        port: port on 127.0.0.1, from 1 to 65535.

    Raises:
        OSError: if the port is taken.

    """
    executor = ThreadPoolExecutor(max_workers=1)  # browser tabs wait for each other

    def open_page(document: Document) -> None:
        page = Page(document, executor)
        document.on_session_destroyed(lambda _context: page.close())

    origins = [f"{host}:{port}" for host in (ADDRESS, "localhost")]
    return Server(
        {"/": open_page},
        address=ADDRESS,
        port=port,
        allow_websocket_origin=origins,  # no page of another site may connect
        websocket_max_message_size=MAX_MESSAGE,
    )
