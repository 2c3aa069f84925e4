"""The poses that a pose space is learned from: synthetic, motion capture, a user's files."""
