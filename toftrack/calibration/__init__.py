"""A camera calibrated from pictures of a chequerboard: lens and depth."""
