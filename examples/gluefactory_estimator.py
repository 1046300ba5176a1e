"""RANSAC and the learned relative pose of this package among the robust estimators of glue-factory.

Save this file as gluefactory/robust_estimators/relative_pose/learnnorm.py; evaluations then find it by its name:

    python -m gluefactory.eval.megadepth1500 --conf superpoint+lightglue-official \
        eval.estimator=learnnorm eval.ransac_th=1.0
"""

from __future__ import annotations

from typing import Any

import torch
from gluefactory.geometry.wrappers import Pose
from gluefactory.robust_estimators.base_estimator import BaseEstimator

import kornia_learnnorm as kln


class LearnnormRelativePoseEstimator(BaseEstimator):  # glue-factory takes the one class of the module
    """Relative pose of matches and pinhole cameras, by RANSAC or by LearnedRelativePose."""

    # Weights, such as "robust-pose", make it the learned layer; ransac_th is the largest distance of inliers, pixels.
    default_conf = {"ransac_th": 1.0, "options": {"weights": None, "seed": 0}}  # noqa: RUF012 (as in the base class)
    required_data_keys = ["m_kpts0", "m_kpts1", "camera0", "camera1"]  # noqa: RUF012

    def _init(self, conf: Any) -> None:
        weights = conf.options.weights
        self.layer = None if weights is None else kln.LearnedRelativePose.from_pretrained(weights)

    @torch.no_grad()
    def _forward(self, data: dict[str, Any]) -> dict[str, Any]:
        given = data["m_kpts0"]
        points = [data[key].detach().cpu().double() for key in ("m_kpts0", "m_kpts1")]
        K = [data[key].calibration_matrix().detach().cpu().double() for key in ("camera0", "camera1")]
        R, t, inliers = torch.full((3, 3), torch.nan), torch.zeros(3), torch.zeros(len(given), dtype=torch.bool)
        if len(given) > 5:  # a minimal sample and one more
            if self.layer is None:
                F_mat, inliers = kln.RANSAC(inl_th=self.conf.ransac_th, seed=self.conf.options.seed)(*points, None, *K)
                batch = (value[None] for value in (F_mat, *K, *points, inliers))
                R, t = (value[0] for value in kln.relative_pose(*batch))
            else:
                found = self.layer.estimate(*(value[None] for value in points), *K)
                R, t = found.R[0], found.t[0]
                inliers = kln.sampson_distance(*points, found.F_mat[0]) <= self.conf.ransac_th
        success = bool(R.isfinite().all())
        pose = Pose.from_Rt(R, t) if success else Pose.from_4x4mat(torch.eye(4))
        return {"success": success, "M_0to1": pose.to(given), "inliers": inliers.to(given.device)}
