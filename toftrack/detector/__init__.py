"""The learned detector: finds hands in a depth image and proposes poses of them.

It is trained, by toftrack.training, on images of toftrack's own hands only; see docs/detector.md.
"""
