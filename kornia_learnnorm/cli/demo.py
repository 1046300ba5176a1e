"""The command ``learnnorm demo``: a browser page to try two of your images."""

import argparse
import os
import socket
import threading
import webbrowser
from tempfile import TemporaryDirectory

from kornia_learnnorm.cli.match import add_feature_arguments
from kornia_learnnorm.data.matching.matchers import check_methods
from kornia_learnnorm.optional import import_extra

PORT = 7860
EXAMPLES = """\
learnnorm demo
learnnorm demo --detector aliked --matcher lightglue --no-browser"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``learnnorm demo`` to a parser."""
    parser.description = f"{parser.description};\nit is served to this computer alone, until Ctrl-C"
    parser.add_argument("--port", type=int, default=PORT, help="port of the page on 127.0.0.1 (default: %(default)s)")
    add_feature_arguments(parser)
    parser.add_argument("--no-browser", action="store_true", help="print the address, but open no browser")


def run(args: argparse.Namespace) -> int:
    """Serve the page until Ctrl-C."""
    if not 1 <= args.port <= 65535:
        raise ValueError(f"--port: a number from 1 to 65535 expected, got {args.port}")
    check_methods(args.detector, args.matcher)
    try:
        socket.create_server(("127.0.0.1", args.port)).close()
    except OSError as error:
        raise OSError(f"--port {args.port}: cannot listen there: {error.strerror}; choose another port") from error
    with TemporaryDirectory() as folder:  # of the images that are uploaded, until the end
        os.environ["GRADIO_TEMP_DIR"] = folder  # Gradio reads it when it is imported
        for module in ("gradio", "cv2", "PIL"):
            import_extra(module, "demo", "the page")
        from kornia_learnnorm.browser_demo import launch, make_app

        app = make_app(args.detector, args.matcher)
        launch(app, args.port)
        address = f"http://127.0.0.1:{args.port}/"
        print(f"the page is at {address}, Ctrl-C ends it", flush=True)
        if not args.no_browser:
            webbrowser.open(address)
        try:
            threading.Event().wait()
        except KeyboardInterrupt:
            app.close(verbose=False)
    return 0
