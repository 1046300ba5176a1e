"""The command ``learnnorm demo`` where it cannot serve its page."""

import socket

import pytest


def test_wrong_options(refused):
    for port in (0, -1, 65536):
        refused(["demo", f"--port={port}"], f"from 1 to 65535 expected, got {port}")
    refused(["demo", "--matcher", "lightglue"], "keynet, got sift")


def test_a_port_in_use(refused):
    pytest.importorskip("gradio", reason="Gradio is not installed")
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        refused(["demo", "--no-browser", f"--port={port}"], f"--port {port}: cannot listen there")
