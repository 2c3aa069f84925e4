"""How long scoring, decoding and whole frames take: `toftrack benchmark`."""
