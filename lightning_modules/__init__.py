"""Training with PyTorch Lightning: the only place of the project that imports it."""
