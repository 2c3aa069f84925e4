"""How long scoring, decoding and whole frames take: `python -m toftrack.benchmark`."""
