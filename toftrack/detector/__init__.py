"""The learned detector: finds hands in a depth image and proposes poses of them.

It is trained on images of toftrack's own ellipsoid hand only; see docs/detector.md.
"""
