"""Estimates for other programs, one after the other as they are made."""

from __future__ import annotations

from typing import Protocol

from toftrack.estimate import Estimate


class Stream(Protocol):
    """Where estimates are sent."""

    def send(self, estimate: Estimate) -> None:
        """Send one, without ever waiting for who reads it."""

    def close(self) -> None:
        """The last one was sent."""


class NoStream:
    """Sends nothing."""

    def send(self, estimate: Estimate) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Nothing to close."""
