"""Who may command the robot: anybody on this computer, and beyond it only who has the owner's token or certificate."""

from __future__ import annotations

import hmac
import os
from dataclasses import dataclass
from pathlib import Path

from ceilvo.config import Zenoh
from ceilvo.config.zenoh_names import needs_network
from ceilvo.errors import BusError, ConfigError

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
            return CommandGuard(_read(Path(config.command_token_file)))
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


def _read(path: Path) -> bytes:
    key = "zenoh.command_token_file"
    try:
        if path.exists() and not path.is_file():  # a pipe would be waited for
            raise ConfigError(f"{key}: found {path}: not a file, expected one with a token; {_MAKE_ONE}")
        with path.open("rb") as f:
            token = f.read(MOST_BYTES + 1).strip()
            mode = os.fstat(f.fileno()).st_mode
    except OSError as e:
        raise ConfigError(f"{key}: found {path}: {e.strerror}, expected a file with a token; {_MAKE_ONE}") from e
    if not FEWEST_CHARS <= len(token) <= MOST_BYTES:
        raise ConfigError(f"{key}: {path} has {len(token)} characters, expected {FEWEST_CHARS} or more; {_MAKE_ONE}")
    if mode & 0o007:
        raise ConfigError(f"{key}: {path} may be read by everybody, expected mode 640 or 600; chmod 640 {path}")
    return token
