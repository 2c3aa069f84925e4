"""What every package computes with: compiled code, threads, rigid motions, and the one back end."""
