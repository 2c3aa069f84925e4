"""Intel RealSense cameras, and their emulator."""
