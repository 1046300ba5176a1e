"""Trained layers in the form of the Hugging Face Hub: local folders, upload and download; needs the extra ``hub``."""

import json
from pathlib import Path
from typing import Any, Self

from torch import nn

from kornia_learnnorm.estimators.learned_eight_point import LearnedEightPoint
from kornia_learnnorm.estimators.learned_homography import LearnedHomography
from kornia_learnnorm.estimators.learned_layer import LearnedLayer
from kornia_learnnorm.estimators.learned_relative_pose import LearnedRelativePose
from kornia_learnnorm.estimators.match_refiner import MatchRefiner
from kornia_learnnorm.normalizers.learned_normalizer import LearnedNormalizer
from kornia_learnnorm.optional import import_extra

import_extra("huggingface_hub", "hub", "kornia_learnnorm.hub")

from huggingface_hub import ModelCard, PyTorchModelHubMixin, hf_hub_download  # noqa: E402

CLASSES = LearnedEightPoint, LearnedRelativePose, LearnedHomography, LearnedNormalizer, MatchRefiner
LAYERS = {layer.__name__: layer for layer in CLASSES}  # what a repository may hold
WEIGHTS_FILE = "model.safetensors"
CONFIG_FILE = "config.json"

CARD = """\
---
{{ card_data }}
---

# A layer of kornia_learnnorm

`{{ class_name }}`, trained on: {{ trained_on }}.

With the name of this repository:

```python
from kornia_learnnorm.hub import HubModel

layer = HubModel.from_pretrained("OWNER/NAME").layer
```
"""


class HubModel(nn.Module, PyTorchModelHubMixin, library_name="kornia_learnnorm", model_card_template=CARD):
    r"""Save, upload and download a learned layer by the methods of ``PyTorchModelHubMixin``.

    A folder or repository holds ``model.safetensors``, the file that the layer's own ``save_pretrained`` writes,
    ``config.json``, which names the class of the layer, and a model card, ``README.md``, unless there is one already.

    Args:
        layer: a learned layer for F, E or H, :class:`~kornia_learnnorm.LearnedNormalizer` or
            :class:`~kornia_learnnorm.MatchRefiner`, kept as the attribute ``layer``; TypeError for others.

    Example:
        >>> import tempfile
        >>> from kornia_learnnorm import LearnedEightPoint
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = HubModel(LearnedEightPoint.from_pretrained("robust-synthetic")).save_pretrained(folder)
        ...     layer = HubModel.from_pretrained(folder).layer
        >>> layer.trained_on
        ('synthetic scenes',)
    """

    def __init__(self, layer: LearnedLayer | LearnedNormalizer | MatchRefiner) -> None:
        super().__init__()
        if type(layer) not in LAYERS.values():
            raise TypeError(f"the layer must be one of {', '.join(LAYERS)}, got {type(layer).__name__}")
        self.layer = layer

    def forward(self, *args: Any, **kwargs: Any) -> Any:
        """Return what the layer returns."""
        return self.layer(*args, **kwargs)

    def generate_model_card(self, *args: Any, **kwargs: Any) -> ModelCard:
        """Return the model card; ``model_card_kwargs`` of the mixin's methods override its values."""
        words = {"class_name": type(self.layer).__name__, "trained_on": ", ".join(self.layer.trained_on) or "not known"}
        return super().generate_model_card(*args, **{**words, **kwargs})

    def _save_pretrained(self, save_directory: Path) -> None:
        self.layer.save_pretrained(save_directory / WEIGHTS_FILE)
        text = json.dumps({"class_name": type(self.layer).__name__}, indent=2)
        (save_directory / CONFIG_FILE).write_text(text + "\n", encoding="utf-8")

    @classmethod
    def _from_pretrained(cls, *, model_id: str, config: dict[str, Any] | None = None, **download: Any) -> Self:
        """Load the layer of a local folder or of a repository; ``download`` are options of ``hf_hub_download``."""
        local = Path(model_id)
        path = local / WEIGHTS_FILE if local.is_dir() else Path(hf_hub_download(model_id, WEIGHTS_FILE, **download))
        name = (config or {}).get("class_name")
        if name not in LAYERS:
            raise ValueError(f"{CONFIG_FILE} of {model_id} must have class_name {' or '.join(LAYERS)}, got {name!r}")
        return cls(LAYERS[name].from_pretrained(path)).eval()
