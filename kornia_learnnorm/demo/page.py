"""The page of ``learnnorm demo``, made of Bokeh's widgets and figures; all of its events are handled in Python."""

from __future__ import annotations

import base64
import logging
import math
from collections.abc import Callable, Mapping
from concurrent.futures import Executor, Future
from functools import partial
from typing import Any

from bokeh.document import Document
from bokeh.layouts import column, row
from bokeh.models import Column, ColumnDataSource
from bokeh.models.widgets import (
    CheckboxGroup,
    DataTable,
    Div,
    FileInput,
    RadioButtonGroup,
    Select,
    TableColumn,
)
from jinja2 import Template
from tornado.ioloop import IOLoop

from kornia_learnnorm.demo.compute import (
    EXAMPLES,
    MAX_BYTES,
    METHODS,
    Comparison,
    Example,
    Picture,
    compare,
    read_picture,
    render_example,
)
from kornia_learnnorm.demo.view import ImageView

__all__ = ["Page"]

IMAGES = ("Image 1", "Image 2")
PAIR = "pair"  # what is computed of both images
OWN = "Your own images"  # the choice after those of EXAMPLES
POINTING = "Point at a spot in one image: its epipolar lines by the three methods appear in the other."
LABELS = (  # rows of the table, in the order of _cells
    "inliers",
    "true error, px",
    "predicted error, px",
    "median distance, px",
    "time, ms",
    "warnings",
)
EXPLANATION = (
    "Inliers: matches with a symmetric epipolar distance below 1 px of the images as they are matched. True error: "
    "median distance of exact correspondences, known for rendered images only. Predicted error: what RANSAC and the "
    "learned layer expect it to be. Median distance: of RANSAC's inliers. Time: of one call that gives F. Hartley's "
    "algorithm takes all matches, the false ones too."
)
ROW_HEIGHT = 25  # pixels, of the table
# Extends Bokeh's page: without the tag, phones lay the page out 980 pixels wide and shrink it.
TEMPLATE = Template(
    '{% extends base %}{% block preamble %}<meta name="viewport" content="width=device-width, initial-scale=1">'
    "{% endblock %}"
)
WRAP: Any = {"flex-wrap": "wrap"}
log = logging.getLogger(__name__)


class Page:
    """The widgets of one browser tab and what they show."""

    def __init__(self, document: Document, executor: Executor, publish: Callable[[Mapping[str, Any]], str]) -> None:
        """Fill a document.

        Args:
            document: the page of a new browser tab.
            executor: runs what takes long.
            publish: makes objects downloadable as JSON, each by its name, in the place of those before; returns the
                address on the server that the name follows.
        """
        self._document, self._executor, self._publish = document, executor, publish
        self._loop, self._closed = IOLoop.current(), False
        self._runs = {IMAGES[0]: 0, IMAGES[1]: 0, PAIR: 0}  # how often each was asked for; only the last run counts
        self._pictures: list[Picture | None] = [None, None]
        self._example: Example | None = None
        self._comparison: Comparison | None = None
        self._views = [ImageView(title) for title in IMAGES]
        for index, view in enumerate(self._views):
            view.on_pointer(partial(self._point, index))
        self._make_widgets()
        document.title = "Fundamental matrix of two images"
        document.template = TEMPLATE
        document.add_root(self._layout())
        self._choose_example(next(iter(EXAMPLES)))

    def close(self) -> None:
        """Drop the results that are still to come, and the last one."""
        self._closed = True
        self._publish({})

    def _make_widgets(self) -> None:
        options: list[Any] = [*EXAMPLES, OWN]
        self._select = Select(title="Images", options=options, value=next(iter(EXAMPLES)), width=260)
        self._select.on_change("value", lambda _attr, _old, new: self._choose_example(new))
        self._inputs = [
            FileInput(title=f"Image {number}, up to {MAX_BYTES // 10**6} MB", accept="image/*", width=260)
            for number in (1, 2)
        ]
        for index, widget in enumerate(self._inputs):
            widget.on_change("value", partial(self._uploaded, index))
            widget.on_change("filename", partial(self._named, index))
        plain: dict[str, Any] = {"render_as_text": True, "disable_math": True, "sizing_mode": "stretch_width"}
        self._status = Div(css_classes=["status"], **plain)
        self._warnings = Div(css_classes=["warnings"], **plain)
        self._warnings.styles = {"white-space": "pre-line", "color": "#b3261e"}
        self._method = RadioButtonGroup(labels=list(METHODS), active=METHODS.index("RANSAC"))
        self._outliers = CheckboxGroup(labels=["and the other matches"], active=[0])
        for choice in (self._method, self._outliers):
            choice.on_change("active", lambda _attr, _old, _new: self._show_matches())
        self._download = Div(name="download")
        self._rows = ColumnDataSource({name: [] for name in ("label", *METHODS)})
        columns = [TableColumn(field=n, title=n if n in METHODS else "", sortable=False) for n in ("label", *METHODS)]
        for entry in columns:
            entry.width = 140 if entry.field == "label" else 80
        self._table = DataTable(source=self._rows, columns=columns, index_position=None, selectable=False)
        self._table.update(height=ROW_HEIGHT * (len(LABELS) + 2), sizing_mode="stretch_width", name="table")

    def _layout(self) -> Column:
        heading = Div(text="<h1>Fundamental matrix of two images</h1>", sizing_mode="stretch_width")
        explanation = Div(text=EXPLANATION, render_as_text=True, sizing_mode="stretch_width")
        chosen = row(
            Div(text="Show the inliers of"),
            self._method,
            self._outliers,
            self._download,
            styles={**WRAP, "align-items": "center"},
        )
        images = row(*(view.layout for view in self._views), sizing_mode="stretch_width", styles=WRAP, spacing=8)
        return column(
            heading,
            row(self._select, *self._inputs, styles=WRAP, sizing_mode="stretch_width"),
            self._status,
            self._warnings,
            images,
            chosen,
            self._table,
            explanation,
            sizing_mode="stretch_width",
            styles={"max-width": "1400px", "margin": "0 auto", "padding": "0 12px", "box-sizing": "border-box"},
        )

    def _choose_example(self, name: str) -> None:
        if name == OWN:
            if self._example is not None:
                self._example = None
                self._set_pictures([None, None])
                self._status.text = "Choose two images."
            return
        for title, widget in zip(IMAGES, self._inputs, strict=True):
            self._runs[title] += 1
            widget.clear()
        self._submit(PAIR, f"Rendering {name} ...", partial(render_example, name), self._show_example)

    def _show_example(self, example: Example) -> None:
        self._example = example
        self._show_pictures([example.picture1, example.picture2])

    def _uploaded(self, index: int, _name: str, _old: str, new: str) -> None:
        if new:  # the name arrives with the content, but after it
            self._document.add_next_tick_callback(partial(self._read, index, new))

    def _named(self, index: int, _name: str, _old: str, new: str) -> None:
        if new:  # an empty file has a name and no content
            self._document.add_next_tick_callback(partial(self._check_empty, index))

    def _check_empty(self, index: int) -> None:
        if not self._inputs[index].value:
            self._read(index, "")

    def _read(self, index: int, encoded: str) -> None:
        others = self._pictures if self._example is None else [None, None]
        self._example, self._select.value = None, OWN
        self._set_pictures([None if i == index else other for i, other in enumerate(others)])
        self._runs[PAIR] += 1
        name = str(self._inputs[index].filename)
        work = partial(_decode, name, encoded)
        self._submit(IMAGES[index], f"Reading {name} ...", work, partial(self._show_upload, index))

    def _show_upload(self, index: int, picture: Picture) -> None:
        self._show_pictures([picture if i == index else other for i, other in enumerate(self._pictures)])

    def _show_pictures(self, pictures: list[Picture | None]) -> None:
        """Show two images and match them; ask for the other one where there is one alone."""
        self._set_pictures(pictures)
        first, second = pictures
        if first is None or second is None:
            self._status.text = f"Choose {IMAGES[first is not None].lower()} too."
            return
        self._submit(PAIR, "Matching ...", partial(compare, first, second), self._show_comparison)

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
        except ValueError as error:
            self._status.text = f"No result: {error}."
        except Exception:
            log.exception("the page could not show a result")
            self._status.text = "No result: an error that the terminal describes."
        else:
            show(result)

    def _set_pictures(self, pictures: list[Picture | None]) -> None:
        """Show two images, or one, without any result."""
        self._pictures, self._comparison = pictures, None
        self._rows.data = {name: [] for name in ("label", *METHODS)}
        self._warn("")
        for view, picture in zip(self._views, pictures, strict=True):
            view.show(picture)
            view.clear()
        self._address, self._download.text = self._publish({}), ""

    def _show_comparison(self, comparison: Comparison) -> None:
        self._comparison = comparison
        found = {name: result for name, result in comparison.results.items() if result.estimate is not None}
        self._address = self._publish({name: result.as_dict() for name, result in found.items()})
        self._status.text = f"{len(comparison.points1)} matches. {POINTING}"
        cells = {name: _cells(comparison, name, self._example) for name in METHODS}
        rows = [i for i in range(len(LABELS)) if any(cells[name][i] for name in METHODS)]
        self._table.height = ROW_HEIGHT * (len(rows) + 2)  # with the header, and space for a scroll bar
        data = {"label": [LABELS[i] for i in rows]}
        self._rows.data = data | {name: [cells[name][i] for i in rows] for name in METHODS}
        self._show_matches()

    def _show_matches(self) -> None:
        """Show the matches, warnings and download of the chosen method."""
        if self._comparison is None:
            return
        method = METHODS[self._method.active or 0]
        result = self._comparison.results[method]
        inliers = None if result.estimate is None else result.estimate.inliers.numpy()
        points1, points2 = self._comparison.points1.numpy(), self._comparison.points2.numpy()
        for view, points in zip(self._views, (points1, points2), strict=True):
            view.show_matches(points, inliers, bool(self._outliers.active))
        warnings = () if result.estimate is None else result.estimate.warnings
        self._warn(result.failure or "\n".join(f"Warning ({w.code}): {w.text}." for w in warnings))
        link = f'<a href="{self._address}{method}">Download F (JSON)</a>'
        self._download.text = "" if result.estimate is None else link

    def _warn(self, text: str) -> None:
        self._warnings.text, self._warnings.visible = text, bool(text)

    def _point(self, index: int, x: float, y: float) -> None:
        """Draw the epipolar lines of a pixel of one image in the other."""
        if self._comparison is None:
            return
        here, there = self._views[index], self._views[1 - index]
        here.mark((x, y))
        matrices = {n: r.estimate.F_mat for n, r in self._comparison.results.items() if r.estimate is not None}
        there.draw_lines({name: F.mT if index else F for name, F in matrices.items()}, (x, y))


def _decode(name: str, encoded: str) -> Picture:
    return read_picture(name, base64.b64decode(encoded))


def _cells(comparison: Comparison, method: str, example: Example | None) -> list[str]:
    """Return the column of a method in the table; an empty cell where nothing is known."""
    result = comparison.results[method]
    if result.estimate is None:
        return ["no matrix", "", "", "", _number(1e3 * result.seconds), ""]
    inliers = result.estimate.num_inliers
    return [
        f"{inliers} ({inliers / result.estimate.num_matches:.0%})",
        "" if example is None else _number(comparison.true_error(method, example)),
        _number(result.estimate.predicted_error) if result.has_prediction else "",
        _number(comparison.distance(method)),
        _number(1e3 * result.seconds),
        str(len(result.estimate.warnings)) if result.has_prediction else "",
    ]


def _number(value: float) -> str:
    return "" if math.isnan(value) else f"{value:.2f}" if value < 100 else f"{value:.0f}"
