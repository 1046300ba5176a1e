"""Readers of image datasets: KITTI, TUM RGB-D, Cambridge Landmarks, COLMAP models, folders."""
