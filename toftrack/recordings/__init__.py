"""File formats of recordings: reading, checking and writing."""
