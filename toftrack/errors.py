"""The one exception that users are meant to see."""


class ToftrackError(Exception):
    """Bad input or environment; the message is one clear sentence: what, where, what to do."""
