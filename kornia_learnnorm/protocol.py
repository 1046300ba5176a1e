"""Constants of the evaluation protocol of Fan et al., which is Ranftl and Koltun's (DFE) as NG-RANSAC evaluates it."""

RATIO = 0.8  # of the distances to the nearest and second-nearest descriptor; a filtered match lies below (Lowe's ratio)
MAX_FILTERED = 1000  # filtered matches kept of an image pair
MAX_RESIDUAL = 60.0  # pixels; samples with a larger residual under the un-normalised eight-point algorithm are dropped
INLIER_THRESHOLD = 1.0  # pixels, symmetric epipolar distance under the ground truth
THRESHOLDS = (0.1, 1.0)  # pixels, at which inlier share and F1 are reported
PROTOCOLS: dict[str, float | None] = {"filtered": RATIO, "unfiltered": None}  # largest ratio of a match
