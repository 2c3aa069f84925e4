"""What every room computes with: compiled code, threads, rigid motions, and the one back end."""
