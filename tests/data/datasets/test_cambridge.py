"""Cambridge Landmarks, against the layout that make_sequences.py writes."""

import numpy as np
from make_sequences import edit, rotated

from kornia_learnnorm.data.datasets.cambridge import read_cambridge


def test_convention(cambridge):
    # Points of the world go to the camera by x = R(q) (X - C), as DSAC* and hloc read these files.
    rng = np.random.default_rng(0)
    q, C, points = rng.normal(size=4), rng.normal(size=3), rng.normal(size=(6, 3))
    q /= np.linalg.norm(q)
    edit(cambridge / "dataset_train.txt", 4, f"seq1/frame00001.png {' '.join(map(repr, [*C.tolist(), *q.tolist()]))}")
    world_to_camera = np.linalg.inv(read_cambridge(cambridge, "train")[0].pose)
    assert np.allclose(points @ world_to_camera[:3, :3].T + world_to_camera[:3, 3], rotated(q, points - C))


def test_without_reconstruction(cambridge):
    edit(cambridge / "reconstruction.nvm", 4, None)
    edit(cambridge / "reconstruction.nvm", 3, "7")
    frames = read_cambridge(cambridge, "train")
    assert np.isnan(frames[0].K).all()
    assert np.isfinite(frames[1].K).all()
    (cambridge / "reconstruction.nvm").unlink()
    assert all(np.isnan(frame.K).all() for frame in read_cambridge(cambridge))


def test_an_unreadable_image_has_no_camera(cambridge):
    (cambridge / "seq1/frame00001.png").write_bytes(b"")
    frame = read_cambridge(cambridge)[0]
    assert frame.size == (0, 0)
    assert np.isnan(frame.K).all()
