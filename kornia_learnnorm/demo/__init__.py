"""The page of ``learnnorm demo``: two images, their matches and epipolar lines by three methods, in a browser."""
