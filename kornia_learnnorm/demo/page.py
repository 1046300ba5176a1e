"""The page of ``learnnorm demo``, made of Bokeh's widgets and figures; all of its events are handled in Python."""

from __future__ import annotations

import base64
import json
import logging
import math
from collections.abc import Callable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from functools import partial
from typing import Any

from bokeh.document import Document
from bokeh.layouts import column, row
from bokeh.models import Column
from bokeh.models.widgets import CheckboxGroup, Div, FileInput, RadioButtonGroup
from bokeh.server.server import Server
from jinja2 import Template
from tornado.ioloop import IOLoop

from kornia_learnnorm.demo.compute import (
    MAX_BYTES,
    METHODS,
    Example,
    ImageFile,
    MethodResult,
    compare,
    read_file,
    render_example,
)
from kornia_learnnorm.demo.view import ImageView
from kornia_learnnorm.two_view.result import PairEstimate

__all__ = ["make_server"]

ADDRESS = "127.0.0.1"  # the page is served to this computer alone
MAX_MESSAGE = 4 * MAX_BYTES  # of a browser's message in base64, which ends the connection; smaller ones are told
IMAGES = ("Image 1", "Image 2")
PAIR = "pair"  # what is computed of both images
POINTING = "Point at a spot in one image: its epipolar lines by the three methods appear in the other."
EXPLANATION = (
    "Inliers: matches with a symmetric epipolar distance below 1 px of the images as they are matched. True error: "
    "median distance of exact correspondences, known for rendered images only. Predicted error: what RANSAC and the "
    "learned layer expect it to be. Median distance: of RANSAC's inliers. Time: of one call that gives F. Hartley's "
    "algorithm takes all matches, the false ones too."
)
ROWS = ("inliers", "true error, px", "predicted error, px", "median distance, px", "time, ms", "warnings")
# Extends Bokeh's page: without the tag, phones lay the page out 980 pixels wide and shrink it.
TEMPLATE = Template(
    '{% extends base %}{% block preamble %}<meta name="viewport" content="width=device-width, initial-scale=1">'
    "{% endblock %}"
)
WRAP: Any = {"flex-wrap": "wrap"}
log = logging.getLogger(__name__)


def make_server(port: int, detector: str = "sift", matcher: str = "nearest") -> Server:
    """Return a server of the page, which listens on 127.0.0.1 but does not answer yet; OSError for a taken port."""
    executor = ThreadPoolExecutor(max_workers=1)  # browser tabs wait for each other

    def open_page(document: Document) -> None:
        page = Page(document, executor, partial(compare, detector=detector, matcher=matcher))
        document.on_session_destroyed(lambda _context: page.close())

    origins = [f"{host}:{port}" for host in (ADDRESS, "localhost")]
    return Server(
        {"/": open_page},
        address=ADDRESS,
        port=port,
        allow_websocket_origin=origins,  # no page of another site may connect
        websocket_max_message_size=MAX_MESSAGE,
    )


class Page:
    """The widgets of one browser tab and what they show; the executor runs what takes long, ``compare`` above all."""

    def __init__(self, document: Document, executor: Executor, compare: Callable[..., dict[str, MethodResult]]) -> None:
        self._document, self._executor, self._compare = document, executor, compare
        self._loop, self._closed = IOLoop.current(), False
        self._runs = {IMAGES[0]: 0, IMAGES[1]: 0, PAIR: 0}  # how often each was asked for; only the last run counts
        self._images: list[ImageFile | None] = [None, None]
        self._example: Example | None = None
        self._results: dict[str, MethodResult] = {}
        self._views = [ImageView(title) for title in IMAGES]
        limit = f"up to {MAX_BYTES // 10**6} MB"
        self._inputs = [FileInput(title=f"{title}, {limit}", accept="image/*", width=260) for title in IMAGES]
        for index, (view, widget) in enumerate(zip(self._views, self._inputs, strict=True)):
            view.on_pointer(partial(self._point, index))
            widget.on_change("value", partial(self._uploaded, index))
            widget.on_change("filename", partial(self._uploaded, index))
        plain: dict[str, Any] = {"render_as_text": True, "disable_math": True, "sizing_mode": "stretch_width"}
        self._status = Div(css_classes=["status"], **plain)
        self._warnings = Div(styles={"white-space": "pre-line", "color": "#b3261e"}, **plain)
        self._method = RadioButtonGroup(labels=list(METHODS), active=METHODS.index("RANSAC"))
        self._outliers = CheckboxGroup(labels=["and the other matches"], active=[0])
        for choice in (self._method, self._outliers):
            choice.on_change("active", lambda _attr, _old, _new: self._show_matches())
        self._download, self._table = Div(), Div(name="table")
        document.title = "Fundamental matrix of two images"
        document.template = TEMPLATE
        document.add_root(self._layout())
        self._submit(PAIR, "Rendering a pair ...", render_example, self._show_example)

    def close(self) -> None:
        """Drop the results that are still to come."""
        self._closed = True

    def _layout(self) -> Column:
        choices = row(Div(text="Show the inliers of"), self._method, self._outliers, self._download)
        choices.styles = {**WRAP, "align-items": "center"}
        return column(
            Div(text="<h1>Fundamental matrix of two images</h1>", sizing_mode="stretch_width"),
            row(*self._inputs, styles=WRAP, sizing_mode="stretch_width"),
            self._status,
            self._warnings,
            row(*(view.layout for view in self._views), sizing_mode="stretch_width", styles=WRAP, spacing=8),
            choices,
            self._table,
            Div(text=EXPLANATION, render_as_text=True, sizing_mode="stretch_width"),
            sizing_mode="stretch_width",
            styles={"max-width": "1400px", "margin": "0 auto", "padding": "0 12px", "box-sizing": "border-box"},
        )

    def _show_example(self, example: Example) -> None:
        self._example = example
        self._match([*example.images])

    def _uploaded(self, index: int, attribute: str, _old: str, new: str) -> None:
        if new:  # the name arrives with the content, but after it
            self._document.add_next_tick_callback(partial(self._read, index, attribute))

    def _read(self, index: int, attribute: str) -> None:
        name, encoded = str(self._inputs[index].filename), str(self._inputs[index].value or "")
        if attribute == "filename" and encoded:  # an empty file has a name and no content
            return
        others = self._images if self._example is None else [None, None]
        self._example = None
        self._show_images([None if i == index else other for i, other in enumerate(others)])
        self._runs[PAIR] += 1

        def show(image: ImageFile) -> None:
            self._match([image if i == index else other for i, other in enumerate(self._images)])

        self._submit(IMAGES[index], f"Reading {name} ...", lambda: read_file(name, base64.b64decode(encoded)), show)

    def _match(self, images: list[ImageFile | None]) -> None:
        self._show_images(images)
        first, second = images
        if first is None or second is None:
            self._status.text = f"Choose {IMAGES[first is not None].lower()} too."
            return
        self._submit(PAIR, "Matching ...", partial(self._compare, first, second), self._show_results)

    def _submit(self, subject: str, status: str, work: Callable[[], Any], show: Callable[[Any], None]) -> None:
        """Run work in the background, then show its result or, in one sentence, why there is none."""
        self._runs[subject] += 1
        self._status.text = status
        finish = partial(self._deliver, partial(self._finish, subject, self._runs[subject], show))
        self._executor.submit(work).add_done_callback(lambda done: self._loop.add_callback(finish, done))

    def _deliver(self, finish: Callable[[Future[Any]], None], done: Future[Any]) -> None:
        if not self._closed:  # the document of a closed tab is destroyed
            self._document.add_next_tick_callback(partial(finish, done))

    def _finish(self, subject: str, run: int, show: Callable[[Any], None], done: Future[Any]) -> None:
        if run != self._runs[subject]:
            return
        try:
            result = done.result()
        except (ValueError, OSError) as error:  # OSError: weights of a detector that cannot be loaded
            self._status.text = f"No result: {error}."
        except Exception:
            log.exception("the page could not show a result")
            self._status.text = "No result: an error that the terminal describes."
        else:
            show(result)

    def _show_images(self, images: list[ImageFile | None]) -> None:
        self._images, self._results = images, {}
        self._table.text = self._download.text = ""
        self._warn("")
        for view, image in zip(self._views, images, strict=True):
            view.show(image)
            view.clear()

    def _show_results(self, results: dict[str, MethodResult]) -> None:
        self._results = results
        most = max(result.estimate.num_matches for result in results.values() if result.estimate is not None)
        self._status.text = f"{most} matches. {POINTING}"
        self._table.text = _table(results, self._example)
        self._show_matches()

    def _show_matches(self) -> None:
        if not self._results:
            return
        method = METHODS[self._method.active or 0]
        result = self._results[method]
        if result.estimate is None:
            for view in self._views:
                view.clear()
            self._download.text = ""
            self._warn(result.failure)
            return
        points, inliers = (result.estimate.points1, result.estimate.points2), result.estimate.inliers.numpy()
        for view, x in zip(self._views, points, strict=True):
            view.show_matches(x.numpy(), inliers, bool(self._outliers.active))
        self._warn("\n".join(f"Warning ({warning.code}): {warning.text}." for warning in result.estimate.warnings))
        content = base64.b64encode(json.dumps(result.as_dict(), allow_nan=False).encode()).decode()
        link = f'<a download="F_{method}.json" href="data:application/json;base64,{content}">'
        self._download.text = f"{link}Download F (JSON)</a>"

    def _warn(self, text: str) -> None:
        self._warnings.text, self._warnings.visible = text, bool(text)

    def _point(self, index: int, x: float, y: float) -> None:
        matrices = {name: found.estimate.matrix for name, found in self._results.items() if found.estimate is not None}
        if matrices:
            self._views[index].mark((x, y))
            self._views[1 - index].draw_lines({n: F.mT if index else F for n, F in matrices.items()}, (x, y))


def _table(results: dict[str, MethodResult], example: Example | None) -> str:
    """Return the table of the methods as HTML; a row where nothing is known is left out."""
    columns = [_cells(results[name], results["RANSAC"].estimate, example) for name in METHODS]
    lines = [("", *METHODS), *((label, *(cells.get(label, "") for cells in columns)) for label in ROWS)]
    texts = ("".join(f"<td>{cell}</td>" for cell in line) for line in lines if any(line[1:]))
    return f"<table style='border-spacing: 1em 0.2em'><tr>{'</tr><tr>'.join(texts)}</tr></table>"


def _cells(result: MethodResult, ransac: PairEstimate | None, example: Example | None) -> dict[str, str]:
    """Return the column of a method in the table, without what is not known."""
    found, cells = result.estimate, {"inliers": "no matrix", "time, ms": _number(1e3 * result.seconds)}
    if found is None:
        return cells
    cells["inliers"] = f"{found.num_inliers} ({found.num_inliers / found.num_matches:.0%})"
    if example is not None:
        cells["true error, px"] = _number(result.median_distance(example.points1, example.points2))
    if ransac is not None:
        inliers = ransac.points1[ransac.inliers], ransac.points2[ransac.inliers]
        cells["median distance, px"] = _number(result.median_distance(*inliers))
    if not math.isnan(found.predicted_error):
        cells |= {"predicted error, px": _number(found.predicted_error), "warnings": str(len(found.warnings))}
    return cells


def _number(value: float) -> str:
    return f"{value:.2f}" if value < 100 else f"{value:.0f}"
