"""Limits of bound sockets; ``connection_limits`` enforces them."""

from dataclasses import dataclass

KIB = 1024
MAX_QUEUED = 20_000  # messages that libzmq queues for one peer; it drops later ones


@dataclass(frozen=True, slots=True)
class SocketLimits:
    """Limits of a bound socket."""

    part_bytes: int
    """size of the largest message part"""
    queue_length: int
    """messages of one connection that wait for delivery; above this, its peer waits"""
    num_answers: int = MAX_QUEUED
    """messages queued for one peer; later messages are dropped"""
    cost: float = 0.0
    """part of the sender's budget that each message uses"""

    @property
    def undelivered_bytes(self) -> int:
        """Bytes that libzmq reads from a well-behaved peer while nothing is delivered."""
        return (self.queue_length + 1) * self.message_bytes

    @property
    def message_bytes(self) -> int:
        """Bytes of an incomplete message, with those that libzmq reads at once."""
        return self.part_bytes + 16 * KIB
