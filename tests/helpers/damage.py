"""Files that arrive other than they were sent."""

import numpy as np


def damaged(content: bytes, seed: int) -> bytes:
    """A file of which some bytes, most of them near its beginning, are others."""
    random = np.random.default_rng(seed)
    broken = bytearray(content)
    reach = len(broken) if seed % 2 else min(len(broken), 6000)
    for _ in range(int(random.integers(1, 20))):
        broken[random.integers(0, reach)] = random.integers(0, 256)
    return bytes(broken)
