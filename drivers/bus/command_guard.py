"""Who may command the robot: anybody on this computer, and beyond it only who has the owner's token or certificate."""

from __future__ import annotations

import hmac
from dataclasses import dataclass
from pathlib import Path

from ceilvo.config import Zenoh
from ceilvo.config.zenoh_names import needs_network
from ceilvo.errors import BusError, ConfigError
from ceilvo.files import read_secret

FEWEST_CHARS, MOST_BYTES = 16, 4096
"""Of a token; chosen: 16 characters at random cannot be guessed at any rate that a network carries."""
_MAKE_ONE = "make one with: (umask 027; openssl rand -hex 32 > FILE; chgrp ceilvo FILE)"


@dataclass(frozen=True, slots=True)
class CommandGuard:
    """What a command must bring.

    Attributes:
        token: that it must bring as the query's attachment; empty where it needs none.
        closed: why no command is taken at all; "" where they are.
        others: who commands without a token, for the log.
    """

    token: bytes = b""
    closed: str = ""
    others: str = "this computer"

    @staticmethod
    def of(config: Zenoh) -> CommandGuard:
        """As configured.

        Raises:
            ConfigError: the token's file cannot be used.
        """
        if config.command_token_file:
            return CommandGuard(read_token(Path(config.command_token_file), "zenoh.command_token_file"))
        if config.config_file:
            return CommandGuard(others="who zenoh.config_file lets in")
        if needs_network(config):
            return CommandGuard(
                closed="zenoh.listen or zenoh.connect leave this computer, so commands need the owner: set "
                "zenoh.command_token_file, or use certificates (docs/security.md)"
            )
        return CommandGuard()

    def admit(self, command: str, attachment: bytes) -> str:
        """Who it is, for the log.

        Raises:
            BusError: it may not command.
        """
        if self.closed:
            raise BusError(f"command {command}: {self.closed}")
        if not self.token:
            return self.others
        if not hmac.compare_digest(attachment.strip(), self.token):
            found = "another one" if attachment else "none"
            raise BusError(f"command {command}: found {found}, expected the owner's token as the query's attachment")
        return "owner, by token"


def read_token(path: Path, key: str) -> bytes:
    """What the file holds that `key` of the configuration names.

    Raises:
        ConfigError: it cannot be used.
    """

    def check(token: bytes) -> None:
        if not FEWEST_CHARS <= len(token) <= MOST_BYTES:
            raise ConfigError(
                f"{key}: {path} has {len(token)} characters, expected {FEWEST_CHARS} or more; {_MAKE_ONE}"
            )

    return read_secret(path, key, "a token", MOST_BYTES, _MAKE_ONE, f"chmod 640 {path}", check)
