"""Synthetic two-view scenes and rendered image pairs."""

from kornia_learnnorm.data.synthetic.scenes import TwoViewScene, forward_driving, handheld, orbit, random_scenes

__all__ = ["TwoViewScene", "forward_driving", "handheld", "orbit", "random_scenes"]
