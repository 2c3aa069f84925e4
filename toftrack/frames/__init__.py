"""What comes in and goes out: the camera, its frames, and what the tracker says of each."""
