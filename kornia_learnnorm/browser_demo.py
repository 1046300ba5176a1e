"""The page of ``learnnorm demo``: two images, their matches and epipolar lines, made of Gradio's components."""

import atexit
import json
import logging
import re
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple
from urllib.parse import urlsplit

import gradio as gr
import numpy as np
import torch
from kornia.geometry.linalg import transform_points
from starlette.datastructures import Headers
from starlette.middleware import Middleware
from starlette.responses import PlainTextResponse

from kornia_learnnorm.data.images import Pixels, read_colour
from kornia_learnnorm.data.matching import features, matchers
from kornia_learnnorm.data.synthetic.render import render_pair, write_pair
from kornia_learnnorm.geometry.checks import check_choice
from kornia_learnnorm.two_view.drawing import INLIER, OUTLIER, blend_images, draw_line, import_matplotlib, stacked
from kornia_learnnorm.two_view.estimate_pair import estimate_pair
from kornia_learnnorm.two_view.input_checks import MODELS
from kornia_learnnorm.two_view.many_pairs import PairOptions
from kornia_learnnorm.two_view.result import PairEstimate

ADDRESS = "127.0.0.1"  # of this computer
MAX_BYTES = 50_000_000  # of an uploaded file
LIMIT = f"{MAX_BYTES // 10**6} MB"
SHOWN_SIZE = 1200  # pixels of the longer side of image 1 in the picture
GAP = 0.02  # between the images, of the width or height of image 1
MAX_LINES = 60  # that join inliers, drawn at random: more would hide the images
DPI = 150  # pixels per inch of the picture
MARK, LINE = "#00e5ff", "#ffd43b"  # colours of the point that was clicked and of its epipolar line
ESTIMATORS = {"RANSAC": None, "learned": "robust-synthetic"}  # and their weights
# What may be typed as a camera. Anything else would be read as the name of a file on the server.
CAMERA = re.compile(r"exif|[-+.\deE\s]+(,[-+.\deE\s]+){3}")
CACHE = (600, 3600)  # seconds between deletions of uploaded files, and age of those that are deleted
LEGEND = """\
Blue dots: inliers, some of them joined by lines. Red crosses in image 1: the other matches. **Click a point** of an
image: its epipolar line, or with a homography its match, appears in the other one. With a homography, the second
picture is image 1 as it moves it, over image 2."""
CAMERAS = "fx,fy,cx,cy in pixels, or exif; two with a semicolon between where the cameras differ"
OFF = ("share", "ssr_mode", "mcp_server", "pwa", "run_history", "enable_monitoring")  # of Gradio
# Numbers stand below each other on a phone too, 51 characters in a row.
CSS = "#estimate textarea {font: clamp(8.5px, 2.2vw, 14px) / 1.5 monospace}"
PROGRESS = gr.Progress()
log = logging.getLogger(__name__)


class Result(NamedTuple):
    """Two images, reduced to be shown, and their estimate in pixels of the full images."""

    images: tuple[Pixels, Pixels]
    estimate: PairEstimate


def solve(
    image1: str | Path | None,
    image2: str | Path | None,
    detector: str = PairOptions.detector,
    matcher: str = PairOptions.matcher,
    model: str = PairOptions.model,
    estimator: str = "RANSAC",
    ratio: float = PairOptions.ratio,
    threshold: float = PairOptions.threshold,
    cameras: str | None = None,
    camera_files: Sequence[str | Path] | None = None,
) -> Result:
    """Return what :func:`~kornia_learnnorm.estimate_pair`, which describes the options, makes of two image files.

    ``estimator`` is ``RANSAC`` or ``learned``. ``cameras`` is ``fx,fy,cx,cy`` or ``exif`` for both images, or two of
    them with a semicolon between; ``camera_files`` are one or two files instead. All errors of the input are a
    ValueError, which names the files without their folders.
    """
    files = [Path(file) for file in (image1, image2, *(camera_files or ())) if file is not None]
    try:
        if image1 is None or image2 is None:
            raise ValueError(f"two images expected, image {1 if image1 is None else 2} is missing")
        for file in files:
            if (size := file.stat().st_size) > MAX_BYTES:
                raise ValueError(f"{file} has {size / 1e6:.0f} MB, at most {LIMIT} expected")
        check_choice("estimator", estimator, ESTIMATORS)
        first, second, *others = files
        K, weights = _cameras(cameras, others), ESTIMATORS[estimator]
        options = PairOptions(weights, ratio, threshold, K=K, detector=detector, matcher=matcher, model=model)
        found = estimate_pair(first, second, **options.arguments(first, second))
        found = replace(found, path1=Path(first.name), path2=Path(second.name))
        return Result((read_colour(first, SHOWN_SIZE), read_colour(second, SHOWN_SIZE)), found)
    except (TypeError, ValueError, OSError) as error:
        text = str(error)
        for file in files:
            text = text.replace(str(file), file.name)
        raise ValueError(" ".join(text.split())) from error


def _cameras(typed: str | None, files: Sequence[Path]) -> tuple[str, ...]:
    """Return the cameras, none, one or two, as ``PairOptions`` takes them."""
    texts = [text.strip() for text in (typed or "").split(";") if text.strip()]
    if (texts and files) or len([*texts, *files]) > 2:
        raise ValueError(f"cameras: one or two expected, typed or as files, got {len(texts)} and {len(files)}")
    if wrong := [text for text in texts if not CAMERA.fullmatch(text)]:
        raise ValueError(f"camera {wrong[0]}: expected {CAMERAS}")
    return tuple(texts or map(str, files))


def draw_result(result: Result, pixel: Sequence[float] | None = None) -> Pixels:
    """Return a picture of both images, side by side or stacked, and of their matches, RGB.

    ``pixel`` is x and y of a point of an image in the picture: it is marked, and so is its epipolar line in the other
    image, or its match where the model is a homography; lines do not join the matches then.
    """
    found = result.estimate
    figure, views = _views((found.size1, found.size2))
    points, inliers = (found.points1.numpy(), found.points2.numpy()), found.inliers.numpy()
    for axes, image, x in zip(views, result.images, points, strict=True):
        axes.imshow(image, extent=(*axes.get_xlim(), *axes.get_ylim()), aspect="auto", interpolation="lanczos")
        axes.plot(*x[inliers].T, "o", color=INLIER, markersize=2)
    views[0].plot(*points[0][~inliers].T, "x", color=OUTLIER, markersize=3.5, markeredgewidth=0.8)
    if pixel is None:
        joined = np.random.default_rng(0).permutation(np.flatnonzero(inliers))[:MAX_LINES]
        ends = np.stack([axes.transData.transform(x[joined]) for axes, x in zip(views, points, strict=True)], 1)
        style = {"colors": INLIER, "linewidths": 0.7, "alpha": 0.8}
        figure.add_artist(import_matplotlib().collections.LineCollection(ends, transform=None, **style))
    else:
        _mark(views, found, (pixel[0] + 0.5, figure.bbox.height - pixel[1] - 0.5))
    canvas = import_matplotlib().backends.backend_agg.FigureCanvasAgg(figure)
    canvas.draw()
    return np.array(canvas.buffer_rgba())[..., :3]


def _views(sizes: tuple[tuple[int, int], tuple[int, int]]) -> tuple[Any, list[Any]]:
    """Return a figure and axes of both images, with equal heights side by side or with equal widths stacked."""
    axis = int(stacked(sizes))  # along which image 2 follows
    size1, size2 = (np.array(size, float) for size in sizes)
    size1 = size1 * SHOWN_SIZE / size1.max()  # in the picture
    size2 = size2 * size1[1 - axis] / size2[1 - axis]
    step = np.where(np.arange(2) == axis, (1 + GAP) * size1, 0.0)
    shape = np.ceil(np.maximum(size1, step + size2))
    figure, views = import_matplotlib().figure.Figure(figsize=tuple(shape / DPI), dpi=DPI, facecolor="white"), []
    for (width, height), size, corner in zip(sizes, (size1, size2), (0 * step, step), strict=True):
        (left, top), (wide, high) = corner / shape, size / shape
        axes = figure.add_axes((left, 1 - top - high, wide, high))
        axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), autoscale_on=False)
        axes.set_axis_off()
        views.append(axes)
    return figure, views


def _mark(views: list[Any], found: PairEstimate, point: tuple[float, float]) -> None:
    """Draw a point of the figure, if it lies in an image, and in the other image its epipolar line or its match."""
    view = next((number for number, axes in enumerate(views) if axes.bbox.contains(*point)), None)
    if view is None:
        return
    here, there = views[view], views[1 - view]
    x, cross = here.transData.inverted().transform(point), {"markersize": 16, "markeredgewidth": 2.5, "color": MARK}
    here.plot(*x, "+", **cross)
    if found.model == "homography":
        H_mat = torch.linalg.inv(found.matrix) if view else found.matrix
        there.plot(*transform_points(H_mat[None], torch.from_numpy(x)[None, None]).flatten().tolist(), "+", **cross)
    else:
        F_mat = found.matrix.mT if view else found.matrix
        draw_line(there, F_mat.numpy() @ np.append(x, 1.0), color=LINE, linewidth=2.5)


@cache
def example_files() -> tuple[str, str]:
    """Return the files of the rendered example pair."""
    folder = TemporaryDirectory()
    atexit.register(folder.cleanup)
    write_pair(folder.name, render_pair())
    return f"{folder.name}/image1.png", f"{folder.name}/image2.png"


def make_app(detector: str = PairOptions.detector, matcher: str = PairOptions.matcher) -> gr.Blocks:
    """Return the page, which :func:`launch` serves, with a detector and a matcher that are chosen at first."""
    app: gr.Blocks
    with gr.Blocks(title="Two-view geometry", analytics_enabled=False, delete_cache=CACHE) as app:
        gr.Markdown("# Two-view geometry\nFundamental matrix or homography of two images, with its predicted error.")
        with gr.Row():
            files = [
                gr.File(file, height=130, min_width=300, elem_id=f"image{n}", label=f"Image {n}, at most {LIMIT}")
                for n, file in enumerate(example_files(), 1)
            ]
        with gr.Row():
            options: list[Any] = [
                gr.Dropdown([*names], value=value, label=label, min_width=150)
                for label, names, value in (
                    ("Detector", features.DETECTORS, detector),
                    ("Matcher", matchers.MATCHERS, matcher),
                    ("Model", MODELS, PairOptions.model),
                    ("Estimator of F", ESTIMATORS, "RANSAC"),
                )
            ]
            options += [
                gr.Number(PairOptions.ratio, label="Ratio test", step=0.05, min_width=150),
                gr.Number(PairOptions.threshold, label="Threshold, px", step=0.25, min_width=150),
            ]
        with gr.Accordion("Cameras: for R and t", open=False), gr.Row():
            options += [
                gr.Textbox(label="Cameras", elem_id="cameras", info=CAMERAS, min_width=300),
                gr.File(label="or one or two files", file_count="multiple", height=130, min_width=300),
            ]
        with gr.Row():
            button = gr.Button("Estimate", variant="primary")
            example = gr.Button("Example pair")
        status = gr.Textbox(label="Result", elem_id="status", lines=1, max_lines=10)
        shown: dict[str, Any] = {"interactive": False, "show_label": False, "buttons": ["download", "fullscreen"]}
        picture = gr.Image(elem_id="picture", **shown)
        gr.Markdown(LEGEND)
        moved = gr.Image(elem_id="moved", visible=False, **shown)
        text = gr.Textbox(label="Estimate", elem_id="estimate", lines=4, max_lines=40, buttons=["copy"])
        with gr.Accordion("JSON", open=False):
            content = gr.Code(language="json", elem_id="json", show_label=False)
        state = gr.State()
        outputs = [status, picture, moved, text, content, state]
        private: dict[str, Any] = {"api_visibility": "private"}
        event = {"inputs": [*files, *options], "outputs": outputs, "show_progress_on": picture, **private}
        gr.on([button.click, app.load], answer, **event)
        example.click(lambda: [*example_files()], None, files, **private).then(answer, **event)
        picture.select(_point, state, picture, show_progress="hidden", **private)
    return app


def answer(*inputs: Any, progress: gr.Progress = PROGRESS) -> list[Any]:
    """Return what the page shows of a pair: a line of text, pictures, texts, and the result for later clicks.

    The inputs are those of :func:`solve`. Where there is no result, the line says why, and the rest is empty.
    """
    try:
        progress(0.1, "Matching and estimating")
        result = solve(*inputs)
        progress(0.8, "Drawing")
        found, moved = result.estimate, gr.update(value=None, visible=False)
        if found.model == "homography":
            moved = gr.update(value=blend_images(*result.images, found), visible=True)
        status = f"{found.model}: {found.num_inliers} of {found.num_matches} matches are inliers, "
        status += f"predicted error {found.predicted_error:.2f} px of the full images"
        status = "\n".join([status, *(f"warning ({warning.code}): {warning.text}" for warning in found.warnings)])
        content = json.dumps(found.as_dict(matches=False), indent=2, allow_nan=False)
        return [status, draw_result(result), moved, found.summary(), content, result]
    except (ValueError, ImportError) as error:
        status = f"No result: {error}"
    except Exception:
        log.exception("the page could not show a result")
        status = "No result: an error that the terminal describes"
    return [status, None, gr.update(value=None, visible=False), "", "", None]


def _point(result: Result | None, event: gr.SelectData) -> Any:
    return gr.skip() if result is None else draw_result(result, event.index)


def own_pages(app: Any) -> Any:
    """Return middleware that answers this computer alone, and no pages of other sites that its browser shows."""

    async def answer_own(scope: Any, receive: Any, send: Any) -> None:
        headers = Headers(scope=scope) if scope["type"] == "http" else {"host": ADDRESS}
        host = headers.get("host", "")
        own = headers.get("origin", f"http://{host}") == f"http://{host}"
        if own and urlsplit(f"//{host}").hostname in (ADDRESS, "localhost"):
            await app(scope, receive, send)
        else:
            await PlainTextResponse("only pages of this computer are answered", 403)(scope, receive, send)

    return answer_own


def launch(app: gr.Blocks, port: int | None = None) -> None:
    """Serve a page of :func:`make_app` without analytics, a public link, or fonts and scripts of other computers.

    With a port, it is served to this computer alone, and the function returns at once; an OSError if the port is taken.
    Without one, Gradio's environment variables say where, as in a hosted space, until the process ends.
    """
    options: dict[str, Any] = dict.fromkeys(OFF, False) | {"quiet": True, "footer_links": [], "show_error": True}
    if port is not None:
        options |= {"server_name": ADDRESS, "server_port": port, "prevent_thread_lock": True}
        options["app_kwargs"] = {"middleware": [Middleware(own_pages)]}
    theme = gr.themes.Default(font=("system-ui", "sans-serif"), font_mono=("ui-monospace", "monospace"))
    app.launch(theme=theme, css=CSS, max_file_size=MAX_BYTES, **options)
