"""Protocol and printed results of Fan et al. The protocol is Ranftl and Koltun's (DFE) as NG-RANSAC evaluates it.

B. Fan, Y. Dai, Y. Seo, M. He, A revisit of the normalized eight-point algorithm and a self-supervised deep solution.
"""

RATIO = 0.8  # of the distances to the nearest and second-nearest descriptor; a filtered match lies below (Lowe's ratio)
MAX_FILTERED = 1000  # filtered matches kept of an image pair
MAX_RESIDUAL = 60.0  # pixels; samples with a larger residual under the un-normalised eight-point algorithm are dropped
INLIER_THRESHOLD = 1.0  # pixels, symmetric epipolar distance under the ground truth
THRESHOLDS = (0.1, 1.0)  # pixels, at which inlier share and F1 are reported
PROTOCOLS: dict[str, float | None] = {"filtered": RATIO, "unfiltered": None}  # largest ratio of a match
# Sequences by dataset and split (section 5.1); None for all sequences that no other split names. StMarysChurch of
# Cambridge Landmarks has its own lists of training and test images, which `read_cambridge` reads.
SPLITS: dict[str, dict[str, tuple[str, ...] | None]] = {
    "kitti": {"train": ("00", "01", "02", "03", "04", "05"), "test": ("06", "07", "08", "09", "10")},
    "tum": {"train": None, "val": ("rgbd_dataset_freiburg3_long_office_household",)},
}
# Fan et al., Table 1: better than Hartley % by training set, on the data of PAPERS_DATA.
TABLE1: dict[str, dict[str, float]] = {
    "KITTI 00-05": {"KITTI": 86.68, "TUM": 90.04},
    "TUM": {"KITTI": 84.22, "TUM": 89.73},
    "KITTI 00-05 and TUM": {"KITTI": 87.05, "TUM": 91.43},
}
# The data that Fan et al. test on: the beginning of what a run notes of a store, KITTI 06-10 or TUM at KITTI's size.
PAPERS_DATA = {
    "KITTI": r"KITTI odometry (0[6-9]|10)(, (0[6-9]|10))*, \d+ pairs",
    "TUM": r"TUM RGB-D (rgbd_dataset_)?freiburg3_long_office_household\b.*, resized to 1\d{3}x3\d{2}, \d+ pairs",
}
# Fan et al., Tables 2 and 3: data, protocol, method, share of inliers and F1 at 0.1 px, then at 1 px, %.
TABLES2_AND_3: tuple[tuple[str, str, str, float, float | None, float, float | None], ...] = (
    ("KITTI", "filtered", "Ranftl and Koltun", 24.61, 14.65, 85.87, 75.77),
    ("KITTI", "filtered", "MLESAC", 18.60, 12.54, 84.48, 75.15),
    ("KITTI", "filtered", "LMEDS", 20.01, 13.34, 84.23, 75.44),
    ("KITTI", "filtered", "USAC", 21.43, 13.90, 85.13, 75.70),
    ("KITTI", "filtered", "RANSAC, Hartley", 21.85, 13.84, 84.96, 75.65),
    ("KITTI", "filtered", "RANSAC, learned", 21.89, 13.86, 84.98, 75.66),
    ("KITTI", "unfiltered", "RANSAC, Hartley", 4.40, None, 30.50, None),
    ("KITTI", "unfiltered", "RANSAC, learned", 4.38, None, 30.55, None),
    ("TUM", "unfiltered", "RANSAC, Hartley", 7.60, None, 44.13, None),
    ("TUM", "unfiltered", "RANSAC, learned", 7.64, None, 44.18, None),
)
