r"""Export of the layers as programs that run without this package, and of their networks as ONNX.

ONNX has no operators for eigenvectors, singular values and LU factorisations, so only the networks are written in it.
"""

import copy
import inspect
import logging
import warnings
from collections.abc import Collection
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.export import Dim, ExportedProgram

from kornia_learnnorm.estimators.learned_eight_point import LearnedEightPoint
from kornia_learnnorm.estimators.learned_homography import LearnedHomography
from kornia_learnnorm.estimators.learned_layer import FORMAT, LearnedLayer
from kornia_learnnorm.estimators.learned_relative_pose import LearnedRelativePose
from kornia_learnnorm.estimators.linear import EightPoint
from kornia_learnnorm.normalizers.learned_normalizer import FORMAT as NORMALIZER_FORMAT
from kornia_learnnorm.normalizers.learned_normalizer import LearnedNormalizer
from kornia_learnnorm.optional import import_extra
from kornia_learnnorm.pretrained import own_weights, shipped_weights, weights_format, weights_model

MIN_DYNAMIC_POINTS = 9  # eight correspondences have a solver of their own
EXAMPLE_BATCH = 2  # sets of the example that is traced; a dynamic size must not be one there
ESTIMATORS = {layer.model_name: layer for layer in (LearnedEightPoint, LearnedRelativePose, LearnedHomography)}
Layer = EightPoint | LearnedLayer
OUTPUTS = ("F_mat", "H_mat", "determined", "weights")  # fields of an estimate, where it has them
POSE_OUTPUTS = ("E_mat", "R", "t", "determined", "weights")


def load_layer(name: str | Path) -> Layer:
    """Load trained weights, by name or file, as a layer in evaluation mode; a normaliser's inside :class:`EightPoint`.

    ``MODULE:FILE`` are those of a normaliser with parts of that module of your own, which is then imported.
    FileNotFoundError if there are no such weights, ValueError if the file is not one of this package.

    Example:
        >>> load_layer("crossview").normalizer.max_points
        12
    """
    module, path = own_weights(name)
    file_format = weights_format(path)
    if file_format is None:
        known = ", ".join(shipped_weights(NORMALIZER_FORMAT) + shipped_weights(FORMAT))
        raise FileNotFoundError(f"no weights {str(name)!r}: expected a .safetensors file or one of {known}")
    if file_format == NORMALIZER_FORMAT:
        return EightPoint(LearnedNormalizer.from_pretrained(path, [module] if module else ())).eval()
    return ESTIMATORS.get(weights_model(path), LearnedEightPoint).from_pretrained(path)


def export_layer(
    layer: Layer, inputs: Collection[str] = (), num_points: int | None = None, gradients: bool = False
) -> ExportedProgram:
    r"""Return the program of a layer, which ``torch.export.save`` writes and any PyTorch process runs.

    The program takes ``points1`` and ``points2``, :math:`(B, N, 2)` float32, the cameras ``K1`` and ``K2`` (B, 3, 3)
    for a :class:`~kornia_learnnorm.LearnedRelativePose`, and by name the tensors of ``inputs``. It returns a tuple of
    fields of the layer's ``estimate``: ``F_mat``, ``H_mat``, or ``E_mat``, ``R`` and ``t``, then ``determined`` and, of
    learned layers, ``weights``. Values are not checked: points must be finite but where masked, weights not negative.

    Args:
        layer: the layer; the program runs on its device.
        inputs: required further inputs: ``"weights"``, ``"mask"`` and, for learned layers, ``"scores"``.
        num_points: number of correspondences :math:`N`, at least eight; without it, any number from nine on, up to the
            normaliser's ``max_points`` where there is one. With a mask, sets of eight and less fit in nine rows.
        gradients: keep what derivatives need, as for training the network before the layer.

    TypeError for another layer; ValueError if it has no such input, or ``num_points`` is less than eight.

    Example:
        >>> program = export_layer(EightPoint(), num_points=8)
        >>> F_mat, determined = program.module()(torch.rand(3, 8, 2), torch.rand(3, 8, 2))
        >>> F_mat.shape
        torch.Size([3, 3, 3])
    """
    if not isinstance(layer, Layer):
        raise TypeError(f"layer must be an EightPoint or a learned layer, got {type(layer)}")
    offered = [name for name in list(inspect.signature(layer.forward).parameters)[2:] if name not in ("K1", "K2")]
    if wrong := [name for name in inputs if name not in offered]:
        raise ValueError(f"further inputs of {type(layer).__name__} are {', '.join(offered)}, got {', '.join(wrong)}")
    if num_points is not None and num_points < 8:
        raise ValueError(f"num_points must be at least 8, got {num_points}")
    most = getattr(getattr(layer, "normalizer", None), "max_points", None)
    shape: dict[int, Any] = {0: Dim("B", min=1)}
    if num_points is None:
        shape[1] = Dim("N", min=MIN_DYNAMIC_POINTS, max=most)
    size = (EXAMPLE_BATCH, num_points or MIN_DYNAMIC_POINTS + 1)
    device = next(layer.parameters(), torch.empty(0)).device
    points = {name: torch.zeros(*size, 2, device=device) for name in ("points1", "points2")}
    given = {name: torch.ones(size, device=device, dtype=torch.bool if name == "mask" else None) for name in inputs}
    shapes = dict.fromkeys([*points, *given], shape)
    if isinstance(layer, LearnedRelativePose):
        points |= {name: torch.eye(3, device=device).repeat(EXAMPLE_BATCH, 1, 1) for name in ("K1", "K2")}
        shapes |= {name: {0: shape[0]} for name in ("K1", "K2")}
    program, arguments = _Exported(layer, gradients), tuple(points.values())
    with torch.set_grad_enabled(gradients):
        return torch.export.export(program, arguments, given, dynamic_shapes=shapes, strict=False)


def export_networks(layer: Layer) -> dict[str, Any]:
    """Return the networks of a layer as ONNX programs, without the steps around them.

    The networks of learned layers, ``stage1`` and so on, map ``features`` (B, N, C), see
    :mod:`~kornia_learnnorm.estimators.network_features`, and ``absent`` (B, N) to ``logits`` (B, N) and ``params``
    (B, P). The ``network`` of a learned normaliser maps ``points1`` and ``points2`` (B, N, 2) in the base's
    coordinates, and ``null_matrix`` (B, 3, 3) where it needs one, to ``params1`` and ``params2`` (B, P). ImportError if
    onnx or onnxscript is not installed, ValueError if the layer has no network.
    """
    import_extra("onnx", "onnx", "ONNX export")
    import_extra("onnxscript", "onnx", "ONNX export")
    if isinstance(layer, LearnedLayer):
        programs = {}
        for stage, part in enumerate(layer.networks):
            features = torch.zeros(EXAMPLE_BATCH, 10, layer.features + (layer.residual_features if stage else 0))
            example = {"features": features, "absent": torch.zeros(EXAMPLE_BATCH, 10, dtype=torch.bool)}
            programs[f"stage{stage + 1}"] = _to_onnx(part, example, ["logits", "params"])
        return programs
    network = getattr(layer.normalizer, "network", None)
    if network is None:
        raise ValueError(f"the layer has no network: its normaliser is {type(layer.normalizer).__name__}")
    example = {name: torch.zeros(EXAMPLE_BATCH, 10, 2) for name in ("points1", "points2")}
    if getattr(network, "needs_null_matrix", False):
        example["null_matrix"] = torch.eye(3).repeat(EXAMPLE_BATCH, 1, 1)
    return {"network": _to_onnx(network, example, ["params1", "params2"])}


class _Exported(nn.Module):
    """A layer with a plain tuple as output: a named tuple needs its class where the program is loaded."""

    layer: Any  # an EightPoint or a learned layer, whose `estimate` takes the inputs

    def __init__(self, layer: Layer, gradients: bool) -> None:
        super().__init__()
        self.layer, self.gradients = layer, gradients

    def forward(
        self,
        points1: Tensor,
        points2: Tensor,
        K1: Tensor | None = None,
        K2: Tensor | None = None,
        weights: Tensor | None = None,
        mask: Tensor | None = None,
        scores: Tensor | None = None,
    ) -> tuple[Tensor, ...]:
        """Return the outputs of the points and of the inputs that are given."""
        inputs = {"K1": K1, "K2": K2, "weights": weights, "mask": mask, "scores": scores}
        found = self.layer.estimate(points1, points2, **{k: value for k, value in inputs.items() if value is not None})
        names = POSE_OUTPUTS if isinstance(self.layer, LearnedRelativePose) else OUTPUTS
        outputs = [getattr(found, name) for name in names if hasattr(found, name)]
        # Steps that need a gradient have been left out of the graph: what is left would give a wrong one.
        return tuple(outputs) if self.gradients else tuple(value.detach() for value in outputs)


def _to_onnx(network: nn.Module, example: dict[str, Tensor], outputs: list[str]) -> Any:
    sizes = {0: Dim("B", min=1), 1: Dim("N", min=2)}
    shapes = {name: {0: sizes[0]} if name == "null_matrix" else sizes for name in example}
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)  # it reports every package that it would also support, and warns of its own calls
    try:
        with warnings.catch_warnings(action="ignore"):
            return torch.onnx.export(
                copy.deepcopy(network).float().cpu().eval(),
                (),
                kwargs=example,
                dynamo=True,
                verbose=False,
                input_names=[*example],
                output_names=outputs,
                dynamic_shapes=shapes,
            )
    finally:
        logger.setLevel(level)
