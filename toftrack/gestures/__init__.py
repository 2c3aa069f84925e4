"""Names for poses: recognised gestures, pinch and the pointing ray."""
