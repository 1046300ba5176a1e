"""From matches or two images to an estimate with its predicted error and the reasons to doubt it."""
