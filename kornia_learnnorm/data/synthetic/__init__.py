"""Synthetic two-view scenes and rendered image pairs."""

from kornia_learnnorm.data.synthetic.scenes import forward_driving, handheld, orbit, random_scenes
from kornia_learnnorm.data.synthetic.two_views import TwoViewScene

__all__ = ["TwoViewScene", "forward_driving", "handheld", "orbit", "random_scenes"]
